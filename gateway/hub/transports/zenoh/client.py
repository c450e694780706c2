"""The zenoh: endpoint: frames or messages under the keys of a site, or of mavlink-server.

The session finds its router again by itself. While it has none nothing is sent and nothing is
queued, so that old data never arrives as new.
"""

import asyncio
import logging
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from gateway.extras import how_to_add
from gateway.hub.endpoint import Endpoint
from gateway.hub.packer import Packer
from gateway.hub.transports.base import READ_BYTES, Client
from gateway.hub.transports.zenoh.session import (
    JSON_IN,
    JSON_OUT,
    MAX_MESSAGE,
    OWN,
    RAW_IN,
    RAW_OUT,
    RELIABLE_IDS,
    ROOT,
    SECURED,
    Connection,
    is_local,
    off_loop,
    open_session,
    payload_of,
    session_config,
    site_key,
)
from gateway.hub.transports.zenoh.site_queries import QueryAnswers, RecordingAnswers
from gateway.units import US_PER_S
from gateway.wire.mavlink_json import frame_from_json, json_from_frame
from gateway.wire.mavlink_splitter import MavFrame, split_datagram

if TYPE_CHECKING:
    import zenoh

log = logging.getLogger(__name__)

MAX_DUPLICATE_SESSIONS: Final = 16
"""Maximum registered sessions with this site's name; more are forged."""


class Topic(NamedTuple):
    """Key and attachment that frames are published with."""

    key: str
    attachment: bytes | None = None


class ZenohClient(Client):
    """A fleet behind a router."""

    _connection: Connection | None = None
    _task: asyncio.Task[None] | None = None

    def __post_init__(self) -> None:
        """Begin without a session; the first tick opens it."""
        super().__post_init__()
        self._packers: dict[Topic, Packer] = {}

    @property
    def in_key(self) -> str:
        """The key of frames from the fleet."""
        raise NotImplementedError

    def topic_of(self, frame: MavFrame) -> Topic:
        """Return where a frame is published."""
        raise NotImplementedError

    def declare(self, connection: Connection) -> None:
        """Declare more than the subscription to `in_key` on a new session."""

    def frames_in(self, data: bytes) -> bytes:
        """Return the frames of a received message; none if it is malformed."""
        return data

    @property
    def queued(self) -> int:
        """Frames that wait for a congested link and must not be lost."""
        return self._connection.publishers.queued if self._connection is not None else 0

    def transmit(self, frame: MavFrame) -> None:
        """Publish one frame, or gather it with others."""
        topic = self.topic_of(frame)
        is_reliable = frame.message_id in RELIABLE_IDS
        if is_reliable or not self.endpoint.pack_bytes or self.state != "open":
            self.publish(topic, [frame.data], reliable=is_reliable)
            return
        packer = self._packers.get(topic)
        if packer is None:
            publish = partial(self.publish, topic, reliable=False)
            flush_soon = partial(self.context.flush_soon, self.endpoint.pack_wait_s)
            packer = self._packers[topic] = Packer(self.endpoint.pack_bytes, publish, flush_soon)
        packer.add(frame.data)

    def publish(self, topic: Topic, frames: list[bytes], *, reliable: bool) -> None:
        """Publish some frames as one message, and count them as sent or dropped."""
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

    def tick(self, now_us: int) -> None:
        """Open the session, and check whether it has a router."""
        if self._connection is None:
            if self._task is None and self._is_retry_due(now_us):
                self._task = self.loop.create_task(self._open())
            return
        is_linked = self._connection.has_router
        if is_linked and self.state != "open":
            self.become("open")
            self.context.greet(self.client_id)
        elif not is_linked and self.state == "open":
            self.become("connecting")
            self._packers.clear()

    def close(self) -> None:
        """End the session; a thread closes it, which may take some time."""
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
            endpoint = self.endpoint
            config = await off_loop(session_config, endpoint.host, endpoint.config)
            session = await off_loop(open_session, config)
        except ModuleNotFoundError:
            self.become("unreachable")
            self.reason = how_to_add("this endpoint", "fleet")
        except (OSError, ValueError) as error:
            self.become("unreachable", error)
        else:
            self._connection = Connection(session)
            # No more at a time than from any other client.
            limits = {"bytes_at_once": READ_BYTES, "pause_s": self._pause_s}
            self._connection.subscribe(self.in_key, self._handle, **limits)
            self.declare(self._connection)
            self._warn_of_open_access()
            self.tick(self.context.now_us())
        finally:
            self._task = None

    def _warn_of_open_access(self) -> None:
        locator = self.endpoint.host
        if self.trusted and not (locator.startswith(SECURED) or is_local(locator)):
            log.warning(
                "%s: trusted=yes without TLS: everyone who reaches the router or the network can "
                "command the vehicles; see docs/fleet.md, Mutual TLS",
                self.name,
            )

    def _pause_s(self) -> float:
        return self.read_pause_us() / US_PER_S

    def _handle(self, sample: "zenoh.Sample") -> None:
        data, size = payload_of(sample)
        if not self.trusted:
            self.context.untrusted_reads.level -= min(size, MAX_MESSAGE)
        frames = self.frames_in(data) if data else b""
        if frames:
            self.receive(split_datagram(frames), size, self.context.now_us())
        else:
            self.count_garbage(size)


class ZenohSite(ZenohClient):
    """One site, whose name no other site of the fleet may have."""

    def __post_init__(self) -> None:
        """Begin without other sessions of the same name."""
        super().__post_init__()
        self._duplicate_sessions: set[str] = set()

    @property
    def in_key(self) -> str:
        """The key of frames for any system of the site."""
        return site_key(self.endpoint.site, "*", "in")

    def topic_of(self, frame: MavFrame) -> Topic:
        """Return where a frame is published: by its system, and marked if that is our own."""
        attachment = OWN if self.context.is_own(frame.origin) else None
        return Topic(site_key(self.endpoint.site, frame.origin[0], "out"), attachment)

    def declare(self, connection: Connection) -> None:
        """Announce the site's presence, and answer queries."""
        session, site = connection.session, self.endpoint.site
        self._duplicate_sessions.clear()
        token = session.liveliness().declare_token(site_key(site, "site", session.zid()))
        connection.declared += [token, QueryAnswers(session, site_key(site, "ping"), lambda _: b"")]
        connection.watch_presence(site, self._handle_presence)
        if self.trusted and self.context.recordings is not None:
            answers = RecordingAnswers(self.context.recordings)
            connection.declared.append(QueryAnswers(session, site_key(site, "recordings"), answers))

    def tick(self, now_us: int) -> None:
        """Open the session, check whether it has a router, and report duplicate names."""
        super().tick(now_us)
        self._report_duplicates()

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


class ZenohRaw(ZenohClient):
    """Frames as they are, all under one key."""

    in_key = RAW_IN

    def topic_of(self, frame: MavFrame) -> Topic:  # noqa: ARG002
        """Return the one key."""
        return Topic(RAW_OUT)


class ZenohJson(ZenohClient):
    """Messages as JSON: each as a whole, by its name, and by its fields."""

    in_key = JSON_IN

    def frames_in(self, data: bytes) -> bytes:
        """Encode a received message; empty if it is malformed."""
        return frame_from_json(data)

    def transmit(self, frame: MavFrame) -> None:
        """Publish one message."""
        found = json_from_frame(frame.data) if self.state == "open" else None
        if found is None or self._connection is None:
            self.counters.dropped += 1
            return
        name, whole, fields = found
        system_id, component_id = frame.origin
        key = f"{ROOT}/{system_id}/{component_id}/{name}"
        self.publish(Topic(JSON_OUT), [whole], reliable=frame.message_id in RELIABLE_IDS)
        publishers = self._connection.publishers
        publishers.put_once(key, whole)
        for field, value in fields.items():
            publishers.put_once(f"{key}/{field}", value)
