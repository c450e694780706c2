"""A Zenoh session beside an event loop that never waits for it.

Zenoh calls back on a thread of its own: what comes is put aside there and taken by the loop, a
bounded number at a time. What may be dropped is published by the loop itself, for Zenoh then never
waits. What may not be is published by a thread, since Zenoh waits while a link is congested.

Nothing is published as `express`: that gives every message a batch of its own, and a link has only
a few batches, so that a burst of some frames would be dropped by a link that is idle. Messages that
share batches leave as soon as the link is free, so that nothing is held back for it.
"""

import asyncio
import logging
import queue
import re
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import msgspec

from gateway.hub.send_queue import BULK_IDS
from gateway.reasons import reason_of

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

NOT_INSTALLED: Final = "the extra mavgate[fleet] is not installed: see mavgate doctor"
MAX_WAITING: Final = 4096
"""What has come and was not taken yet: a third of a second of two hundred aircraft."""
AT_ONCE: Final = 64
"""Taken in one turn of the loop, so that a flood cannot starve the others."""
MAX_MESSAGE: Final = 4096
"""Bytes of one message with frames, as of a datagram; ours have at most 1100."""
BYTES_AT_ONCE: Final = 4 * MAX_MESSAGE
"""Taken in one turn by a fleet, which has no samples that would have to wait meanwhile."""
MAX_PATIENT: Final = 1024
"""What waits for a congested link and must not be lost: a whole parameter list."""
BATCHES: Final = 4
"""Of 64 KiB that may wait on a link: two thousand frames at once, and not much memory a site."""
GIVE_UP_S: Final = 10.0
"""Zenoh gives a message up after half of this, and closes the link."""
PATIENT_IDS: Final = BULK_IDS | {75, 76, 77, 253}
"""Parameters, missions, files, commands, their answers, texts: none of them comes again."""

TLS_FILES: Final = (
    "root_ca_certificate",
    *("connect_certificate", "connect_private_key", "listen_certificate", "listen_private_key"),
)
NO_ANSWER: Final = re.compile(r"Unable to connect to any of \[Single\((.*)\)\]!")
SECURED: Final = ("tls/", "quic/", "wss/")

Item = TypeVar("Item")
_Patient = tuple["zenoh.Publisher", bytes, bytes | None]


def session_config(place: str, file: str, mode: str = "client") -> "zenoh.Config":
    """Return how a session is to be opened.

    Parameters
    ----------
    place : str
        A locator, as `tcp/127.0.0.1:7447`: to connect to, or where a router listens.
    file : str
        Zenoh's own configuration file, which rules all but mode and place; empty for none.
    mode : str
        `client`, or `router` for one that others connect to.

    Raises
    ------
    ModuleNotFoundError
        If Zenoh is not installed.
    ValueError
        If the file or the place is none.
    """
    import zenoh

    listens = "listen" if mode == "router" else "connect"
    try:
        if file:
            config = zenoh.Config.from_file(Path(file).expanduser())
        else:
            config = zenoh.Config()
            # Only to the configured place: no site joins a stranger's network by itself.
            config.insert_json5("scouting/multicast/enabled", "false")
            config.insert_json5("scouting/gossip/enabled", "false")
            config.insert_json5("transport/link/tx/queue/size/data", str(BATCHES))
        config.insert_json5("mode", f'"{mode}"')
        config.insert_json5(f"{listens}/endpoints", f'["{place}"]')
        drop = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
        config.insert_json5(drop, "0")
    except zenoh.ZError as error:
        raise ValueError(f"zenoh: {_words(error)}") from None
    return config


def open_session(config: "zenoh.Config") -> "zenoh.Session":
    """Open a session; waits, so not on the loop.

    Raises
    ------
    OSError
        If there is nobody at the place, or a certificate or key cannot be read.
    """
    import zenoh

    _check_files(config)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise OSError(_words(error)) from None


def _check_files(config: "zenoh.Config") -> None:
    """Name a certificate or key that cannot be read; Zenoh only says that it cannot connect."""
    tls: dict[str, Any] = msgspec.json.decode(config.get_json("transport/link/tls")) or {}
    for name in TLS_FILES:
        if file := tls.get(name):
            try:
                Path(file).open("rb").close()
            except OSError as error:
                raise OSError(f"{name} {file}: {reason_of(error)}") from None


def end_session(session: "zenoh.Session", outlets: "Outlets | None", declared: list[Any]) -> None:
    """Undeclare what was declared, and close; waits, so not on the loop.

    What is still declared when Python ends would wait for ever for threads that have ended. A
    publisher cannot be undeclared while its thread publishes.
    """
    import zenoh

    if outlets is not None:
        declared += outlets.ended()
    while declared:
        with suppress(zenoh.ZError, RuntimeError):
            declared.pop().undeclare()
    with suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def frames_of(sample: "zenoh.Sample") -> bytes:
    """Return the bytes of a message with frames; what is beyond `MAX_MESSAGE` is cut off."""
    return sample.payload.to_bytes()[:MAX_MESSAGE]


def part_of_turn(size: int, bytes_at_once: int) -> float:
    """Return which part of a turn of the loop a message of this size takes."""
    return max(1 / AT_ONCE, size / bytes_at_once)


def take_a_turn(
    waiting: deque[Item], take: Callable[[Item], None], cost: Callable[[Item], float]
) -> None:
    """Take from the front what makes one turn of the loop full; `cost` tells the part of each."""
    spent = 0.0
    while waiting and spent < 1.0:
        item = waiting.popleft()
        spent += cost(item)
        take(item)


class Inlet(Generic[Item]):
    """Hands items from a thread to the loop, in order; when too many wait the oldest go.

    Parameters
    ----------
    take : callable
        Called on the loop with each item.
    cost : callable, optional
        Returns which part of a turn an item takes.
    pause_s : callable, optional
        Returns how long nothing is to be taken; 0 for now.
    """

    def __init__(
        self,
        take: Callable[[Item], None],
        cost: Callable[[Item], float] = lambda _: 1 / AT_ONCE,
        pause_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        self._take = take
        self._cost = cost
        self._pause_s = pause_s
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[Item] = deque(maxlen=MAX_WAITING)
        self._is_due = False
        self._is_closed = False
        self.dropped = 0

    def put(self, item: Item) -> None:
        """Take an item from any thread."""
        if self._is_closed:
            return
        self.dropped += len(self._waiting) == MAX_WAITING
        self._waiting.append(item)
        if not self._is_due:
            self._is_due = True
            try:
                self._loop.call_soon_threadsafe(self._drain)
            except RuntimeError:
                # The loop has ended meanwhile.
                self._is_closed = True

    def close(self) -> None:
        """Take nothing more."""
        self._is_closed = True
        self._waiting.clear()

    def _drain(self) -> None:
        if pause_s := self._pause_s():
            self._loop.call_later(pause_s, self._drain)
            return
        # Before the queue is looked at: what comes from now on wakes us again.
        self._is_due = False
        take_a_turn(self._waiting, self._take, self._cost)
        if self._waiting and not self._is_due:
            self._is_due = True
            self._loop.call_soon(self._drain)


class Reader:
    """Hands what a subscription brings to the loop, in order; when too much waits the oldest go.

    Zenoh would call back once a message on a thread of its own, and each call would wait until the
    loop's thread lets go of Python: at thousands of messages a second that costs more than all that
    is done with them. Here a thread waits for the first message, wakes the loop, and sleeps until
    the loop has taken all that has come meanwhile.

    Parameters
    ----------
    session : zenoh.Session
        An open session.
    key : str
        What is subscribed to.
    take : callable
        Called on the loop with each message.
    """

    def __init__(
        self, session: "zenoh.Session", key: str, take: Callable[["zenoh.Sample"], None]
    ) -> None:
        import zenoh

        self._take = take
        self._usual = zenoh.Priority.DATA
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[zenoh.Sample] = deque()
        self._all_taken = threading.Event()
        self._is_closed = False
        # Twice, so that what the loop could not take is dropped and counted here, not in there.
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(2 * MAX_WAITING)
        self._subscriber: Any = session.declare_subscriber(key, ring)
        self.dropped = 0
        threading.Thread(target=self._wait, name=key, daemon=True).start()

    def close(self) -> None:
        """Take nothing more."""
        self._is_closed = True
        self._all_taken.set()

    def undeclare(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()

    def _wait(self) -> None:
        for sample in self._subscriber:
            self._all_taken.clear()
            try:
                self._loop.call_soon_threadsafe(self._drain, sample)
            except RuntimeError:
                # The loop has ended meanwhile.
                return
            if self._is_closed:
                return
            self._all_taken.wait()

    def _drain(self, sample: "zenoh.Sample | None" = None) -> None:
        waiting = self._waiting
        while not self._is_closed and (sample := sample or self._subscriber.try_recv()) is not None:
            waiting.append(sample)
            sample = None
        for _ in range(len(waiting) - MAX_WAITING):
            oldest = waiting.popleft()
            if oldest.priority == self._usual:
                self.dropped += 1
            else:
                # Commands, parameters, missions, texts: none of them comes again.
                self._take(oldest)
        take_a_turn(waiting, self._take, _cost)
        if waiting:
            self._loop.call_soon(self._drain)
        else:
            self._all_taken.set()


def _cost(sample: "zenoh.Sample") -> float:
    return part_of_turn(min(len(sample.payload), MAX_MESSAGE), BYTES_AT_ONCE)


class Outlets:
    """Publishes under many keys, each declared when it is first used.

    Parameters
    ----------
    session : zenoh.Session
        An open session.
    """

    def __init__(self, session: "zenoh.Session") -> None:
        import zenoh

        self._zenoh = zenoh
        self._session = session
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._waiting: queue.Queue[_Patient | None] = queue.Queue(MAX_PATIENT)
        self._is_closed = False
        self._thread = threading.Thread(target=self._publish, name="zenoh-patient", daemon=True)
        self._thread.start()

    def publish(
        self, key: str, payload: bytes, *, patient: bool, mark: bytes | None = None
    ) -> bool:
        """Publish without waiting; return whether it was taken.

        Parameters
        ----------
        key : str
            Where.
        payload : bytes
            Some frames.
        patient : bool
            Whether it waits for a congested link, and is not dropped.
        mark : bytes, optional
            Attached to it.
        """
        publisher = self._publishers.get((key, patient)) or self._declare(key, patient=patient)
        if not patient:
            publisher.put(payload, attachment=mark)
            return True
        try:
            self._waiting.put_nowait((publisher, payload, mark))
        except queue.Full:
            return False
        return True

    @property
    def queued(self) -> int:
        """How many wait for a congested link."""
        return self._waiting.qsize()

    def close(self) -> None:
        """Publish nothing more; what waits is lost."""
        self._is_closed = True
        # It wakes the thread; if there is no room for it the thread is awake.
        with suppress(queue.Full):
            self._waiting.put_nowait(None)

    def ended(self) -> list["zenoh.Publisher"]:
        """Wait for what is being published, and return what is to be undeclared."""
        self._thread.join(GIVE_UP_S)
        return [*self._publishers.values()]

    def _declare(self, key: str, *, patient: bool) -> "zenoh.Publisher":
        control, priority = self._zenoh.CongestionControl, self._zenoh.Priority
        publisher = self._session.declare_publisher(
            key,
            congestion_control=control.BLOCK if patient else control.DROP,
            priority=priority.INTERACTIVE_HIGH if patient else priority.DATA,
        )
        self._publishers[key, patient] = publisher
        return publisher

    def _publish(self) -> None:
        while (item := self._waiting.get()) is not None and not self._is_closed:
            publisher, payload, mark = item
            try:
                publisher.put(payload, attachment=mark)
            except self._zenoh.ZError as error:
                log.debug("not published: %s", error)


def _words(error: Exception) -> str:
    """Return what Zenoh says, without where in its source it says so."""
    text = str(error).partition(" at /")[0].strip()
    if (found := NO_ANSWER.fullmatch(text)) is None:
        return text
    is_secured = found[1].startswith(SECURED)
    return f"no router answers at {found[1]}{', or a certificate does not fit' * is_secured}"
