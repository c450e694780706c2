"""A fleet as one client of the hub: all frames of this site go there, and its wishes come back.

The session finds its router again by itself. While it has none nothing is sent and nothing waits,
so that nothing old ever arrives as new.
"""

import asyncio
import logging
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from gateway.edges.hub.fleet_link.query_answers import QueryAnswers
from gateway.edges.hub.fleet_link.recording_answers import RecordingAnswers
from gateway.edges.hub.fleet_link.site_keys import (
    ALL_SYSTEMS,
    OWN,
    in_key,
    out_key,
    ping_key,
    presence_key,
    recordings_key,
)
from gateway.edges.hub.fleet_link.zenoh_session import (
    NOT_INSTALLED,
    PATIENT_IDS,
    Inlet,
    Outlets,
    end_session,
    frames_of,
    open_session,
    part_of_turn,
    session_config,
)
from gateway.edges.hub.fleet_link.zenoh_threads import off_loop
from gateway.hub.endpoint import RAW_KEYS, Endpoint
from gateway.hub.send_queue import Packer
from gateway.hub.transports.base import READ_BYTES, Client
from gateway.hub.transports.listener import RETRY_US
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import origin_of, split_datagram

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

RAW_OUT: Final = "mavlink_raw/out"
RAW_IN: Final = "mavlink_raw/in"


class _Way(NamedTuple):
    """How frames are published."""

    key: str
    mark: bytes | None
    """Attached; None for nothing."""


class ZenohClient(Client):
    """A fleet behind a router."""

    _session: "zenoh.Session | None" = None
    _task: asyncio.Task[None] | None = None
    _outlets: Outlets | None = None
    _retry_us = 0
    _is_gathering = False

    def __post_init__(self) -> None:
        """Begin without a session; the first tick opens it."""
        super().__post_init__()
        self._namesakes: set[str] = set()
        self._packers: dict[_Way, Packer] = {}
        self._inlets: list[Inlet[Any]] = []
        self._declared: list[object] = []

    @property
    def queued(self) -> int:
        """Frames that wait for a congested link and must not be lost."""
        return self._outlets.queued if self._outlets is not None else 0

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Publish one frame, or gather it with others."""
        if self.state != "open" or self._outlets is None:
            self.counters.dropped += 1
            return
        origin = origin_of(frame)
        if self._is_raw:
            way = _Way(RAW_OUT, None)
        else:
            mark = OWN if self.context.is_own(origin) else None
            way = _Way(out_key(self.endpoint.site, origin[0]), mark)
        if message_id in PATIENT_IDS:
            self._publish(way, [frame], patient=True)
        elif self.endpoint.pack_bytes:
            self._pack(way, frame)
        else:
            self._publish(way, [frame], patient=False)

    def tick(self, now_us: int) -> None:
        """Open the session, and see whether it has a router."""
        if self._session is None:
            if self._task is None and now_us >= self._retry_us:
                self._retry_us = now_us + RETRY_US
                self._task = self.loop.create_task(self._open())
            return
        is_linked = bool(self._session.info.routers_zid())
        if is_linked and self.state != "open":
            self.become("open")
            self.context.greet(self)
        elif not is_linked and self.state == "open":
            self.become("connecting")
            self._packers.clear()
        self._tell_namesakes()

    def close(self) -> None:
        """End the session; it says good-bye by itself, which may take a moment."""
        if self._task is not None:
            self._task.cancel()
        for inlet in self._inlets:
            inlet.close()
        if self._outlets is not None:
            self._outlets.close()
        if self._session is not None:
            off_loop(end_session, self._session, self._outlets, self._declared)
        self._session, self._outlets, self._declared = None, None, []

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Take over changed options; another site or file needs the endpoint to be added anew."""
        self._flush()
        self._packers.clear()
        super().reconfigure(endpoint)

    @property
    def _is_raw(self) -> bool:
        return self.endpoint.keys == RAW_KEYS

    async def _open(self) -> None:
        try:
            config = session_config(self.endpoint.host, self.endpoint.config)
            session = await off_loop(open_session, config)
        except ModuleNotFoundError:
            self.become("unreachable")
            self.reason = NOT_INSTALLED
        except (OSError, ValueError) as error:
            self.become("unreachable", error)
        else:
            self._session = session
            self._outlets = Outlets(session)
            self._declare(session)
            self.tick(self.context.now_us())
        finally:
            self._task = None

    def _declare(self, session: "zenoh.Session") -> None:
        """Declare to the router what we take, and that we are here."""
        import zenoh

        inlet: Inlet[bytes] = Inlet(self._take, _cost, lambda: self._pause_us() / US_PER_S)
        presence: Inlet[tuple[bool, str]] = Inlet(self._note_session)
        self._inlets = [inlet, presence]
        self._namesakes.clear()
        wanted = RAW_IN if self._is_raw else in_key(self.endpoint.site, ALL_SYSTEMS)
        self._declared = [
            session.declare_subscriber(wanted, lambda sample: inlet.put(frames_of(sample)))
        ]
        if self._is_raw:
            return
        site, liveliness = self.endpoint.site, session.liveliness()
        here = zenoh.SampleKind.PUT
        self._declared += [
            liveliness.declare_token(presence_key(site, session.zid())),
            liveliness.declare_subscriber(
                presence_key(site, "*"),
                lambda sample: presence.put((sample.kind == here, str(sample.key_expr))),
                history=True,
            ),
            QueryAnswers(session, ping_key(site), lambda _: b""),
        ]
        if self.trusted and self.context.recordings is not None:
            answers = RecordingAnswers(self.context.recordings)
            self._declared.append(QueryAnswers(session, recordings_key(site), answers))

    def _take(self, data: bytes) -> None:
        if not self.trusted:
            self.context.strangers.level -= len(data)
        self.receive(split_datagram(data), len(data), self.context.now_us())

    def _note_session(self, news: tuple[bool, str]) -> None:
        is_here, key = news
        session = key.rpartition("/")[2]
        if self._session is None or session == str(self._session.zid()):
            return
        if is_here:
            self._namesakes.add(session)
        else:
            self._namesakes.discard(session)
        self._tell_namesakes()

    def _tell_namesakes(self) -> None:
        """Say for as long as it lasts that somebody else bears our name."""
        text = f"another site is called {self.endpoint.site!r} too" if self._namesakes else ""
        if self.state != "open" or text == self.reason:
            return
        self.reason = text
        if text:
            log.warning("%s: %s; rename one of them", self.name, text)

    def _pack(self, way: _Way, frame: bytes) -> None:
        packer = self._packers.setdefault(way, Packer(self.endpoint.pack_bytes))
        self._publish(way, packer.add(frame), patient=False)
        if not self._is_gathering:
            self._is_gathering = True
            self.context.flush_soon(self._flush, self.endpoint.pack_wait_s)

    def _flush(self) -> None:
        self._is_gathering = False
        for way, packer in self._packers.items():
            self._publish(way, packer.flush(), patient=False)

    def _publish(self, way: _Way, frames: list[bytes], *, patient: bool) -> None:
        if not frames or self._outlets is None:
            return
        data = b"".join(frames)
        if self._outlets.publish(way.key, data, patient=patient, mark=way.mark):
            self.counters.sent += len(frames)
            self.counters.bytes_sent += len(data)
        else:
            self.counters.dropped += len(frames)


def _cost(data: bytes) -> float:
    """Return which part of a turn a message takes: no more is read from any client at a time."""
    return part_of_turn(len(data), READ_BYTES)
