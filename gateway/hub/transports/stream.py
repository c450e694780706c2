"""Base of byte-stream transports, with a bounded queue in front of each connection.

A stalled client fills its own queue and loses its own oldest telemetry; the kernel closes the
connection when nothing was acknowledged for long.
"""

import socket
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final

from gateway.compiled.messages import STREAM
from gateway.hub.endpoint import host_and_port
from gateway.hub.routing_table import Origin
from gateway.hub.send_queue import SendQueue
from gateway.hub.transports.base import Client
from gateway.hub.transports.listener import Listener, Peer
from gateway.hub.transports.sockets import accept_each, new_socket
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame, MavlinkSplitter, frame_of

CHUNK_BYTES: Final = 4096
"""Maximum bytes joined into one write while a queue drains."""
SLOW_CHUNK_BYTES: Final = 512
"""The same for a slow connection: joined frames can no longer be overtaken."""
USER_TIMEOUT_MS: Final = 30_000
"""Time without an acknowledgement after which a peer is gone; a paused one may resume sooner."""
PROBE_S: Final = 5
"""Interval of keepalive probes of an idle peer, s: a vanished one is noticed within the time above,
and not only at the next probe, after 75 s by default."""
SEND_BUFFER_BYTES: Final = 32_768
"""Most bytes that the peer has not acknowledged: those in flight on a long link."""
UNSENT_BYTES: Final = 2048
"""Most bytes in the kernel beyond those: frames wait in our queue, where urgent ones are first."""
JOINED_BYTES: Final = 1024
"""The kernel joins unsent writes, and checks `UNSENT_BYTES` only when it starts another segment."""
SLOW_AFTER_US: Final = US_PER_S
"""A connection that needs longer to drain its queue is slow; after a stall it drains faster."""
FRESH_US: Final = US_PER_S // 2
"""Telemetry that has waited longer is not sent on a slow connection."""
ACCEPT_BACKLOG: Final = 128
"""Connections that may wait in the kernel, as when all pages reconnect: a wake-up accepts one."""


class QueuedClient(Client):
    """A peer behind a link that may be slow or stalled: frames wait in a bounded queue."""

    _partial = b""
    """The rest of a write that the system has not accepted completely."""

    def __post_init__(self) -> None:
        """Start with an empty queue."""
        super().__post_init__()
        signer = self.context.signer
        self._queue = SendQueue(
            self.queue_bytes, self._is_own, signer, self._system_here, self._is_numbered
        )
        self._splitter = MavlinkSplitter()
        self._step = self.context.forwarding.step(self.memory, reads=False)

    def _system_here(self, system: int) -> int:
        return system if self.renumbering is None else self.renumbering.here(system)

    def _is_own(self, origin: Origin) -> bool:
        return self.context.is_own((self._system_here(origin[0]), origin[1]))

    def _is_numbered(self, origin: Origin) -> bool:
        return self.context.numbers(self.client_id, (self._system_here(origin[0]), origin[1]))

    def feed(self, data: bytes, now_us: int) -> None:
        """Process a chunk of the stream; the compiled step forwards frames with known routes."""
        forwarding = self.context.forwarding
        if not self.routes or not forwarding.is_compiled:
            self.accept_rest(data, now_us)
            return
        rest = self._splitter.take()
        # These bytes will be counted again.
        self.counters.bytes_received -= len(rest)
        forwarding.load(rest + data, now_us)
        self._step()
        self.go_on(self._step, now_us)

    def accept_rest(self, data: bytes, now_us: int) -> None:
        """Process received bytes, without the compiled step."""
        if not self.sink_bytes(data, now_us):
            self.receive(self._splitter.feed(data), len(data), now_us)

    @property
    def queue_bytes(self) -> int:
        """Maximum bytes that wait."""
        return self.context.settings.queue_bytes

    @property
    def queued(self) -> int:
        """Frames that wait."""
        return len(self._queue)

    def _push(self, frame: MavFrame) -> None:
        """Queue a frame, and count it as sent."""
        self.counters.sent += 1
        self._drop(self._queue.push(frame, self.context.now_us()))

    def _drop(self, frames: int) -> None:
        self.counters.dropped += frames
        self.counters.sent -= frames

    def _drop_all(self) -> None:
        self._partial = b""
        self._drop(self._queue.clear())


class StreamClient(QueuedClient):
    """A peer behind a socket that carries a byte stream."""

    _socket: socket.socket | None = None
    _sending_us: int | None = None
    """Since when the queue was not empty."""
    _chunk_bytes = CHUNK_BYTES
    _joined = 0
    """Bytes written to the present segment."""
    _read: Callable[[], None]

    @property
    def is_direct(self) -> bool:
        """Whether frames are sent as they are, unless others wait."""
        return self.is_unchanged

    def send_rest(self, frames: Iterable[bytes], number: int, part: int) -> None:  # noqa: ARG002
        """Send the frames that the compiled step counted as sent but did not send."""
        for data in frames:
            self.counters.bytes_sent -= len(data) - part
            if part and self._socket is not None:
                self._write(self._socket, data[part:])
            else:
                self.counters.sent -= 1
                self.transmit(frame_of(data))
            part = 0

    def _update_output(self) -> None:
        """Let the compiled step send while nothing waits."""
        is_idle = self._socket is not None and not self._partial and not self._queue
        self.memory.output = self.memory.input if is_idle else -1

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame at once if nothing waits, else queue it."""
        if self._socket is None or self.state != "open":
            self.counters.dropped += 1
            return
        if self._partial or self._queue:
            self._push(frame)
        else:
            self.counters.sent += 1
            data = self._queue.encode(frame, self.context.now_us())
            self._write(self._socket, self._wrap(data))

    def adopt(self, sock: socket.socket) -> None:
        """Use a connected socket from now on."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, USER_TIMEOUT_MS // 2000)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, PROBE_S)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._socket = sock
        self.memory.input = sock.fileno()
        self.memory.is_forwardable, self.memory.way = 1, STREAM
        self._splitter.reset()
        self._read = partial(self._on_readable, sock)
        self.loop.add_reader(sock, self._read)
        self._begin()
        self._update_output()

    def _begin(self) -> None:
        """Start the protocol on a new connection."""
        self.become("open")
        self.context.greet(self.client_id)

    def close(self) -> None:
        """Close the connection; waiting frames are lost."""
        self.memory.input = self.memory.output = -1
        if self._socket is not None:
            self.loop.remove_reader(self._socket)
            self.loop.remove_writer(self._socket)
            self._socket.close()
            self._socket = None
        self._sending_us = None
        self._drop_all()

    def _broke(self) -> None:
        """Handle the end of the connection."""
        raise NotImplementedError

    def _wrap(self, frames: bytes) -> bytes:
        """Return the bytes that carry some frames on this connection."""
        return frames

    def accept(self, data: bytes, now_us: int) -> None:
        """Process received bytes."""
        self.feed(data, now_us)

    def _write(self, sock: socket.socket, data: bytes) -> bool:
        """Write; keep the bytes that the socket does not accept and wait for room."""
        self._joined += len(data)
        flags = socket.MSG_EOR if self._joined >= JOINED_BYTES else 0
        if flags:
            self._joined = 0
        try:
            taken = sock.send(data, flags)
        except BlockingIOError:
            taken = 0
        except OSError:
            self._broke()
            return False
        self.counters.bytes_sent += taken
        self._partial = data[taken:]
        if self._partial:
            self.memory.output = -1
            self.loop.add_writer(sock, self._on_writable, sock)
        return not self._partial

    def _on_writable(self, sock: socket.socket) -> None:
        self._drop_stale(self.context.now_us())
        if self._partial and not self._write(sock, self._partial):
            return
        while data := self._next_chunk():
            if not self._write(sock, data):
                return
        self.loop.remove_writer(sock)
        self._sending_us = None
        self._update_output()

    def _drop_stale(self, now_us: int) -> None:
        """Drop old telemetry on a connection that is too slow for it."""
        if self._sending_us is None:
            self._sending_us = now_us
        is_slow = now_us - self._sending_us > SLOW_AFTER_US
        self._chunk_bytes = SLOW_CHUNK_BYTES if is_slow else CHUNK_BYTES
        if is_slow:
            self._drop(self._queue.expire(now_us - FRESH_US))

    def _next_chunk(self) -> bytes:
        messages, frames, size, now_us = [], b"", 0, self.context.now_us()
        while size < self._chunk_bytes and (frame := self._queue.pop(now_us)) is not None:
            if frames and len(frames) + len(frame) > self.endpoint.pack_bytes:
                messages.append(self._wrap(frames))
                frames = b""
            frames += frame
            size += len(frame)
        if frames:
            messages.append(self._wrap(frames))
        return b"".join(messages)

    def _on_readable(self, sock: socket.socket) -> None:
        try:
            data = sock.recv(self.context.read_bytes)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._broke()
            return
        self.accept(data, self.context.now_us())
        if self._socket is sock:
            self.limit_reads(sock, self._read, len(data))


class StreamListener(Listener[Peer]):
    """A port that accepts connections."""

    def _bind(self) -> socket.socket:
        host, port = self.endpoint.host, self.endpoint.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with new_socket(family, socket.SOCK_STREAM) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((host, port))
            sock.listen(ACCEPT_BACKLOG)
            return sock

    def _watch(self, sock: socket.socket) -> None:
        accept_each(sock, self._on_connection, self._report)

    def _on_connection(self, connection: socket.socket, address: tuple[Any, ...]) -> None:
        if self._has_room(str(address[0]), self._context.now_us()):
            self._admit(connection, host_and_port(*address[:2]))
        else:
            self.turned_away += 1
            connection.close()

    def _admit(self, connection: socket.socket, peer: str) -> None:
        """Make a client of a connection."""
        raise NotImplementedError
