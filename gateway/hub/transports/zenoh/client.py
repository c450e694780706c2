"""A fleet as one client of the hub: frames of this site are published, requests are received.

The session finds its router again by itself. While it has none nothing is sent and nothing is
queued, so that old data never arrives as new.
"""

import asyncio
import logging
from functools import partial
from typing import Final, NamedTuple

from gateway.hub.endpoint import JSON_KEYS, RAW_KEYS, SITE_KEYS, Endpoint
from gateway.hub.send_queue import Packer
from gateway.hub.transports.base import READ_BYTES, Client
from gateway.hub.transports.zenoh.session import (
    ALL_SYSTEMS,
    JSON_IN,
    JSON_OUT,
    MAX_MESSAGE,
    NOT_INSTALLED,
    OWN,
    RAW_IN,
    RAW_OUT,
    RELIABLE_IDS,
    ROOT,
    SECURED,
    Connection,
    LoopQueue,
    Payload,
    Publishers,
    in_key,
    off_loop,
    open_session,
    out_key,
    part_of_turn,
    payload_of,
    ping_key,
    presence_key,
    recordings_key,
    session_config,
)
from gateway.hub.transports.zenoh.site_queries import QueryAnswers, RecordingAnswers
from gateway.units import US_PER_S
from gateway.wire.mavlink_json import frame_from_json, json_from_frame
from gateway.wire.mavlink_splitter import MavFrame, split_datagram

log = logging.getLogger(__name__)

LOCAL: Final = ("tcp/127.", "tcp/[::1]", "tcp/localhost:", "unixsock-stream/")
MAX_DUPLICATE_SESSIONS: Final = 16
"""Other sessions with this site's name that are registered; more are forged."""


class _Topic(NamedTuple):
    """Key and attachment that frames are published with."""

    key: str
    attachment: bytes | None


class ZenohClient(Client):
    """A fleet behind a router."""

    _connection: Connection | None = None
    _task: asyncio.Task[None] | None = None

    def __post_init__(self) -> None:
        """Begin without a session; the first tick opens it."""
        super().__post_init__()
        self._duplicate_sessions: set[str] = set()
        self._packers: dict[_Topic, Packer] = {}

    @property
    def queued(self) -> int:
        """Frames that wait for a congested link and must not be lost."""
        return self._connection.publishers.queued if self._connection is not None else 0

    def transmit(self, frame: MavFrame) -> None:
        """Publish one frame, or gather it with others."""
        if self.state != "open" or self._connection is None:
            self.counters.dropped += 1
            return
        if self.endpoint.keys == JSON_KEYS:
            self._publish_json(frame, self._connection.publishers)
            return
        origin = frame.origin
        if self.endpoint.keys == RAW_KEYS:
            topic = _Topic(RAW_OUT, None)
        else:
            attachment = OWN if self.context.is_own(origin) else None
            topic = _Topic(out_key(self.endpoint.site, origin[0]), attachment)
        if frame.message_id in RELIABLE_IDS:
            self._publish(topic, [frame.data], reliable=True)
        elif self.endpoint.pack_bytes:
            self._pack(topic, frame.data)
        else:
            self._publish(topic, [frame.data], reliable=False)

    def tick(self, now_us: int) -> None:
        """Open the session, and check whether it has a router."""
        if self._connection is None:
            if self._task is None and self._is_retry_due(now_us):
                self._task = self.loop.create_task(self._open())
            return
        is_linked = self._connection.has_router
        if is_linked and self.state != "open":
            self.become("open")
            self.context.greet(self)
        elif not is_linked and self.state == "open":
            self.become("connecting")
            self._packers.clear()
        self._report_duplicates()

    def close(self) -> None:
        """End the session; a thread closes it, which may take a moment."""
        if self._task is not None:
            self._task.cancel()
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options; another site or file needs the endpoint to be added again."""
        for packer in self._packers.values():
            packer.flush()
        self._packers.clear()
        super().reconfigure(endpoint)

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
            self._connection = Connection(session)
            self._declare(self._connection)
            self._warn_of_open_access()
            self.tick(self.context.now_us())
        finally:
            self._task = None

    def _warn_of_open_access(self) -> None:
        locator = self.endpoint.host
        if self.trusted and not locator.startswith((*SECURED, *LOCAL)):
            log.warning(
                "%s: trusted=yes without TLS: everyone who reaches the router or the network can "
                "command the vehicles; see docs/fleet.md, Mutual TLS",
                self.name,
            )

    def _declare(self, connection: Connection) -> None:
        """Subscribe to frames for this site, and announce its presence."""
        session, site = connection.session, self.endpoint.site
        frames: LoopQueue[Payload] = LoopQueue(
            self._handle, _cost_of, lambda: self.read_pause_us() / US_PER_S
        )
        connection.readers.append(frames)
        self._duplicate_sessions.clear()
        keys = {RAW_KEYS: RAW_IN, JSON_KEYS: JSON_IN}
        wanted = keys.get(self.endpoint.keys) or in_key(site, ALL_SYSTEMS)
        connection.declared.append(
            session.declare_subscriber(wanted, lambda sample: frames.put(payload_of(sample)))
        )
        if self.endpoint.keys != SITE_KEYS:
            return
        token = session.liveliness().declare_token(presence_key(site, session.zid()))
        connection.declared += [token, QueryAnswers(session, ping_key(site), lambda _: b"")]
        connection.watch_presence(site, self._handle_presence)
        if self.trusted and self.context.recordings is not None:
            answers = RecordingAnswers(self.context.recordings)
            connection.declared.append(QueryAnswers(session, recordings_key(site), answers))

    def _handle(self, payload: Payload) -> None:
        data, size = payload
        if not self.trusted:
            self.context.untrusted_reads.level -= min(size, MAX_MESSAGE)
        if data and self.endpoint.keys == JSON_KEYS:
            data = frame_from_json(data)
        if not data:
            self.count_garbage(size)
            return
        self.receive(split_datagram(data), size, self.context.now_us())

    def _handle_presence(self, _site: str, session: str, is_here: bool) -> None:
        if self._connection is None or session == str(self._connection.session.zid()):
            return
        if is_here and len(self._duplicate_sessions) < MAX_DUPLICATE_SESSIONS:
            self._duplicate_sessions.add(session)
        elif not is_here:
            self._duplicate_sessions.discard(session)
        self._report_duplicates()

    def _report_duplicates(self) -> None:
        """Report, for as long as it lasts, that another session uses this site's name."""
        text = (
            f"another site is called {self.endpoint.site!r} too" if self._duplicate_sessions else ""
        )
        if self.state != "open" or text == self.reason:
            return
        self.reason = text
        if text:
            log.warning("%s: %s; rename one of them", self.name, text)

    def _publish_json(self, frame: MavFrame, publishers: Publishers) -> None:
        """Publish a message as mavlink-server does: as a whole, by its name, and by its fields."""
        if (found := json_from_frame(frame.data)) is None:
            self.counters.dropped += 1
            return
        name, whole, fields = found
        system_id, component_id = frame.origin
        key = f"{ROOT}/{system_id}/{component_id}/{name}"
        reliable = frame.message_id in RELIABLE_IDS
        self._publish(_Topic(JSON_OUT, None), [whole], reliable=reliable)
        publishers.put_once(key, whole)
        for field, value in fields.items():
            publishers.put_once(f"{key}/{field}", value)

    def _pack(self, topic: _Topic, frame: bytes) -> None:
        packer = self._packers.get(topic)
        if packer is None:
            publish = partial(self._publish, topic, reliable=False)
            flush_soon = partial(self.context.flush_soon, self.endpoint.pack_wait_s)
            packer = self._packers[topic] = Packer(self.endpoint.pack_bytes, publish, flush_soon)
        packer.add(frame)

    def _publish(self, topic: _Topic, frames: list[bytes], *, reliable: bool) -> None:
        data = b"".join(frames)
        if (
            self._connection is not None
            and self.state == "open"
            and self._connection.publishers.publish(
                topic.key, data, reliable=reliable, attachment=topic.attachment
            )
        ):
            self.counters.sent += len(frames)
            self.counters.bytes_sent += len(data)
        else:
            self.counters.dropped += len(frames)


def _cost_of(payload: Payload) -> float:
    """Return the part of a turn of a message: no client is read for longer at a time."""
    return part_of_turn(payload[1], READ_BYTES)
