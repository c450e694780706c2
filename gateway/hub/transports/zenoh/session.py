"""A Zenoh session next to an event loop that never waits for it.

Theory of operation. Zenoh calls back on threads of its own; received messages are queued there and
handled by the loop, a bounded number at a time. Messages that may be dropped are published by the
loop itself, because Zenoh then never waits. The others are published by a thread, because Zenoh
waits while a link is congested: 5 s before it gives a message up, 10 s before it gives a session
up. Python cannot exit cleanly during such a wait, so every call that may wait runs in `off_loop`'s
threads, and the end of the process waits for those with a timeout (`end_calls`).

Nothing is published as `express`: that gives every message a batch of its own, and a link has only
a few batches, so an idle link would drop frames of a short burst. Messages that share batches leave
as soon as the link is free, so nothing is held back for it.

| key                          | meaning                                                     |
| ---------------------------- | ----------------------------------------------------------- |
| `mavlink/SITE/SYSTEM/out`    | frames of a system of the site                              |
| `mavlink/SITE/SYSTEM/in`     | frames for a system of the site; `0` is for all             |
| `mavlink/SITE/site/SESSION`  | a liveliness token of one session of the site               |
| `mavlink/SITE/ping`          | the site answers queries at once                            |
| `mavlink/SITE/recordings`    | the site answers queries for its recordings                 |
| `mavlink_raw/out`, `…/in`    | frames without sites, as mavlink-server has them            |
| `mavlink/out`, `…/in`        | messages as JSON, as mavlink-server has them by default     |
| `mavlink/SYSTEM/COMPONENT/NAME[/FIELD]` | the newest message of each kind, and its fields  |

`OWN` is attached to frames of the site's own gateway. The hub accepts no frame in their name from a
client, so such a frame originates here and has not gone round a loop. Frames of a client of the
site, such as an autopilot, and those of other programs have no attachment.
"""

import asyncio
import logging
import queue
import re
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import msgspec

from gateway.hub.endpoint import is_loopback
from gateway.hub.send_queue import BULK_IDS
from gateway.hub.transports.url_files import regular_file
from gateway.printable import reason_of
from gateway.wire.mavlink_messages import ids_of

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

ROOT: Final = "mavlink"
OWN: Final = b"own"
RAW_OUT: Final = "mavlink_raw/out"
RAW_IN: Final = "mavlink_raw/in"
JSON_OUT: Final = "mavlink/out"
JSON_IN: Final = "mavlink/in"
MAX_CONFIG: Final = 1 << 20
"""Maximum size of a configuration file, which Zenoh reads at once; a full one has some 30 kB."""
MAX_KEY: Final = 256
"""Maximum characters of a key; ours have at most 150."""
MAX_WAITING: Final = 4096
"""Maximum received messages that wait for the loop: a third of a second of 200 aircraft."""
AT_ONCE: Final = 64
"""Maximum messages handled in one turn of the loop, so that a flood delays no other client."""
MAX_MESSAGE: Final = 4096
"""Maximum bytes of one message with frames, as of a datagram; ours have at most 1100. Longer ones
are dropped unread."""
BYTES_AT_ONCE: Final = 4 * MAX_MESSAGE
"""Maximum bytes handled in one turn by a fleet, which has no sensor samples to delay."""
LONGEST_PAUSE_S: Final = 0.05
"""Longest pause before messages are taken from Zenoh, which bounds their number but not bytes."""
MAX_RELIABLE: Final = 1024
"""Maximum waiting messages of a congested link that must not be dropped: a whole parameter list."""
BATCHES: Final = 4
"""Batches of 64 KiB that may wait on a link: two thousand frames, and little memory a site."""
GIVE_UP_S: Final = 10.0
"""Timeout of publishing a message; Zenoh gives it up after half of this, and closes the link."""
RELIABLE_IDS: Final = BULK_IDS | ids_of("COMMAND_INT", "COMMAND_LONG", "COMMAND_ACK", "STATUSTEXT")
"""Messages that are not repeated: parameters, missions, files, commands, their answers, texts."""
MAX_CALLS: Final = 64
"""Maximum calls at a time: sessions that open or end, and a query for each fetched recording."""
CLOSE_S: Final = 3.0
"""Timeout of closing, s: ten times its duration over a link that works."""
TLS_FILES: Final = (
    "root_ca_certificate",
    *("connect_certificate", "connect_private_key", "listen_certificate", "listen_private_key"),
)
IN_USE: Final = "Address already in use"
NO_ANSWER: Final = re.compile(r"Unable to connect to any of \[Single\((.*)\)\]!")
SECURED: Final = ("tls/", "quic/", "wss/")
LOCAL: Final = "unixsock-stream"
"""The protocol that no other machine can reach."""
Result = TypeVar("Result")
Payload = tuple[bytes, int]
"""Frames of a message, and its size in bytes; no frames if it is longer than `MAX_MESSAGE`."""
_Reliable = tuple["zenoh.Publisher", bytes, bytes | None]
_calls: Final = ThreadPoolExecutor(MAX_CALLS, "zenoh")


def site_key(site: str, *rest: object) -> str:
    """Return a key of a site, as in the table above."""
    return "/".join(map(str, (ROOT, site, *rest)))


def site_of(key: str) -> str:
    """Return the site of a key; empty if the key is not one of the table."""
    parts = key.split("/")
    return parts[1] if len(parts) in (3, 4) and parts[0] == ROOT else ""


def off_loop(work: Callable[..., Result], *args: object) -> "asyncio.Future[Result]":
    """Call a function that waits for Zenoh, on a thread that `end_calls` waits for."""
    return asyncio.get_running_loop().run_in_executor(_calls, work, *args)


def end_calls() -> bool:
    """Refuse new calls, wait for running ones, and return whether all have ended in `CLOSE_S`."""
    ending = threading.Thread(target=_calls.shutdown, daemon=True)
    ending.start()
    ending.join(CLOSE_S)
    return not ending.is_alive()


def is_local(locator: str) -> bool:
    """Return whether no other machine reaches a locator."""
    protocol, _, rest = locator.partition("/")
    host = rest.partition("?")[0].partition("#")[0].rpartition(":")[0].strip("[]")
    return protocol == LOCAL or is_loopback(host)


def session_config(locator: str, file: str, mode: str = "client") -> "zenoh.Config":
    """Return the configuration of a session: a `client`, or a `router` that others connect to.

    Zenoh's own configuration file, if any, is used for everything but mode, locator and scouting.
    Raises ModuleNotFoundError if Zenoh is not installed, ValueError if the file or the locator,
    such as `tcp/127.0.0.1:7447`, is malformed.
    """
    import zenoh

    listens = "listen" if mode == "router" else "connect"
    try:
        if file:
            config = zenoh.Config.from_file(regular_file(file, MAX_CONFIG))
        else:
            config = zenoh.Config()
            config.insert_json5("transport/link/tx/queue/size/data", str(BATCHES))
        # Only the configured locator: no session joins an unknown network by itself.
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        config.insert_json5("mode", f'"{mode}"')
        config.insert_json5(f"{listens}/endpoints", msgspec.json.encode([locator]).decode())
        drop = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
        config.insert_json5(drop, "0")
    except zenoh.ZError as error:
        raise ValueError(f"zenoh: {_message_of(error)}") from None
    except OSError as error:
        raise ValueError(f"zenoh: {reason_of(error)}") from None
    return config


def open_session(config: "zenoh.Config") -> "zenoh.Session":
    """Open a session; waits, so it is called off the loop.

    Raises OSError without an answer at the locator, or if a certificate or key cannot be read.
    """
    import zenoh

    _check_files(config)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise OSError(_message_of(error)) from None


def _check_files(config: "zenoh.Config") -> None:
    """Raise an error that names an unreadable certificate or key; Zenoh's error does not."""
    tls: dict[str, Any] = msgspec.json.decode(config.get_json("transport/link/tls")) or {}
    for name in TLS_FILES:
        if file := tls.get(name):
            try:
                Path(file).open("rb").close()
            except OSError as error:
                raise OSError(f"{name} {file}: {reason_of(error)}") from None


def payload_of(sample: "zenoh.Sample") -> Payload:
    """Return the frames of a message and its size; a longer one is not even copied."""
    size = len(sample.payload)
    return (b"" if size > MAX_MESSAGE else sample.payload.to_bytes()), size


class Subscription:
    """Pass the messages of a subscription to the loop; the oldest are dropped on overflow.

    Zenoh would call back once a message on a thread of its own, and each call would wait for
    Python's lock: at thousands of messages a second that costs more than handling them. Here a
    thread waits for the first message, wakes the loop, and sleeps until the loop has handled this
    and all later messages.

    `declare` makes a subscriber with a channel. `handle` is called with each message on the loop,
    with about `bytes_at_once` in a turn; `pause_s` returns for how long nothing may be handled.
    """

    def __init__(
        self,
        declare: Callable[["zenoh.handlers.RingChannel[zenoh.Sample]"], Any],
        handle: Callable[["zenoh.Sample"], None],
        bytes_at_once: int = BYTES_AT_ONCE,
        pause_s: Callable[[], float] = lambda: 0.0,
    ) -> None:
        import zenoh

        self._handle, self._bytes_at_once, self._pause_s = handle, bytes_at_once, pause_s
        self._usual = zenoh.Priority.DATA
        self._loop = asyncio.get_running_loop()
        self._waiting: deque[zenoh.Sample] = deque()
        self._all_handled = threading.Event()
        self._is_closed = False
        # Twice the size, so that an overflow is dropped and counted here, not within Zenoh.
        self._subscriber = declare(zenoh.handlers.RingChannel(2 * MAX_WAITING))
        self.dropped = 0
        threading.Thread(target=self._wait, name="zenoh-reader", daemon=True).start()

    def close(self) -> None:
        """Stop handling messages; those that wait are dropped."""
        self._is_closed = True
        self._waiting.clear()
        self._all_handled.set()

    def undeclare(self) -> None:
        """End the subscription."""
        self._subscriber.undeclare()

    def _wait(self) -> None:
        for sample in self._subscriber:
            self._all_handled.clear()
            try:
                self._loop.call_soon_threadsafe(self._drain, sample)
            except RuntimeError:
                # The loop has ended.
                return
            if self._is_closed:
                return
            self._all_handled.wait()

    def _drain(self, sample: "zenoh.Sample | None" = None) -> None:
        waiting, pause_s = self._waiting, self._pause_s()
        while not self._is_closed and (sample := sample or self._subscriber.try_recv()) is not None:
            if len(sample.payload) > MAX_MESSAGE:
                # Handled at once, so that the queue is bounded in bytes.
                self._handle(sample)
            else:
                waiting.append(sample)
            sample = None
        for _ in range(len(waiting) - MAX_WAITING):
            oldest = waiting.popleft()
            if oldest.priority == self._usual:
                self.dropped += 1
            else:
                # Commands, parameters, missions and texts are not repeated.
                self._handle(oldest)
        spent = 0.0
        while waiting and spent < 1.0 and not pause_s:
            oldest = waiting.popleft()
            spent += max(1 / AT_ONCE, len(oldest.payload) / self._bytes_at_once)
            self._handle(oldest)
        if waiting:
            self._loop.call_later(min(pause_s, LONGEST_PAUSE_S), self._drain)
        else:
            self._all_handled.set()


class Publishers:
    """Publish under many keys, each declared at its first use."""

    def __init__(self, session: "zenoh.Session") -> None:
        import zenoh

        self._zenoh = zenoh
        self._session = session
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._waiting: queue.Queue[_Reliable | None] = queue.Queue(MAX_RELIABLE)
        self._is_closed = False
        self._thread = threading.Thread(target=self._publish, name="zenoh-reliable", daemon=True)
        self._thread.start()

    def publish(
        self, key: str, payload: bytes, *, reliable: bool, attachment: bytes | None = None
    ) -> bool:
        """Publish without waiting; return whether the message was accepted."""
        publisher = self._publishers.get((key, reliable)) or self._declare(key, reliable=reliable)
        if not reliable:
            publisher.put(payload, attachment=attachment)
            return True
        try:
            self._waiting.put_nowait((publisher, payload, attachment))
        except queue.Full:
            return False
        return True

    def put_once(self, key: str, payload: bytes) -> None:
        """Publish under a key that is not declared, as one of very many."""
        self._session.put(
            key,
            payload,
            congestion_control=self._zenoh.CongestionControl.DROP,
            priority=self._zenoh.Priority.DATA,
        )

    @property
    def queued(self) -> int:
        """Messages that wait for a congested link."""
        return self._waiting.qsize()

    def close(self) -> None:
        """Stop publishing; waiting messages are lost."""
        self._is_closed = True
        # None wakes the thread; if the queue is full, the thread is awake.
        with suppress(queue.Full):
            self._waiting.put_nowait(None)

    def ended(self) -> list["zenoh.Publisher"]:
        """Wait for the message being published, and return the publishers to undeclare."""
        self._thread.join(GIVE_UP_S)
        return [*self._publishers.values()]

    def _declare(self, key: str, *, reliable: bool) -> "zenoh.Publisher":
        control, priority = self._zenoh.CongestionControl, self._zenoh.Priority
        publisher = self._session.declare_publisher(
            key,
            congestion_control=control.BLOCK if reliable else control.DROP,
            priority=priority.INTERACTIVE_HIGH if reliable else priority.DATA,
        )
        self._publishers[key, reliable] = publisher
        return publisher

    def _publish(self) -> None:
        while (item := self._waiting.get()) is not None and not self._is_closed:
            publisher, payload, attachment = item
            try:
                publisher.put(payload, attachment=attachment)
            except self._zenoh.ZError as error:
                log.debug("not published: %s", error)


class Connection:
    """An open session with its publishers and all that is declared on it."""

    def __init__(self, session: "zenoh.Session") -> None:
        self.session = session
        self.publishers = Publishers(session)
        self.subscriptions: list[Subscription] = []
        self.declared: list[Any] = []
        """All else that is declared."""

    @property
    def has_router(self) -> bool:
        """Whether the session is linked with a router."""
        return bool(self.session.info.routers_zid())

    def subscribe(self, key: str, handle: Callable[["zenoh.Sample"], None], **how: Any) -> None:
        """Pass the messages of a key to the loop until the session is closed."""
        declare = partial(self.session.declare_subscriber, key)
        self.subscriptions.append(Subscription(declare, handle, **how))

    def watch_presence(self, site: str, handle: Callable[[str, str, bool], None]) -> None:
        """Call back with a site, one of its sessions, and whether that session is present."""
        import zenoh

        def put(sample: zenoh.Sample) -> None:
            key = str(sample.key_expr)
            handle(site_of(key), key.rpartition("/")[2], sample.kind == zenoh.SampleKind.PUT)

        tokens, liveliness = site_key(site, "site", "*"), self.session.liveliness()
        declare = partial(liveliness.declare_subscriber, tokens, history=True)
        self.subscriptions.append(Subscription(declare, put))

    def close(self) -> None:
        """End the session; a thread closes it, which may take a moment."""
        for subscription in self.subscriptions:
            subscription.close()
        self.publishers.close()
        off_loop(self._end)

    def _end(self) -> None:
        """Undeclare everything, and close; waits for Zenoh.

        A declaration that is left when Python ends would wait for ever for ended threads. A
        publisher cannot be undeclared while its thread publishes.
        """
        import zenoh

        self.declared += [*self.subscriptions, *self.publishers.ended()]
        while self.declared:
            with suppress(zenoh.ZError, RuntimeError):
                self.declared.pop().undeclare()
        with suppress(zenoh.ZError):
            self.session.close()  # type: ignore[no-untyped-call]


def _message_of(error: Exception) -> str:
    """Return Zenoh's message without the position in its source code."""
    text = str(error).partition(" at /")[0].strip()
    if IN_USE in text:
        return "another program listens at this port; choose another one by --listen"
    if (found := NO_ANSWER.fullmatch(text)) is None:
        return text
    if found[1].startswith(SECURED):
        return f"no router answers at {found[1]}, or a certificate does not fit"
    return f"no router answers at {found[1]}, or it refuses the login"
