"""TCP to clients and sources, with a bounded queue in front of each connection.

A stalled client fills its own queue and loses its own oldest telemetry; the kernel closes the
connection when nothing was acknowledged for long.
"""

import asyncio
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from gateway.hub.accepting import accept_each
from gateway.hub.client_table import Presence, who_leaves
from gateway.hub.endpoint import host_and_port
from gateway.hub.transports.listener import RETRY_US, Listener, Peer
from gateway.hub.transports.queued import QueuedClient
from gateway.units import US_PER_S

CHUNK_BYTES: Final = 4096
"""Joined into one write while a queue drains."""
SLOW_CHUNK_BYTES: Final = 512
"""Of a slow connection: what is joined can no longer be overtaken."""
USER_TIMEOUT_MS: Final = 30_000
"""A peer that acknowledges nothing for so long is gone; a paused one may come back sooner."""
SEND_BUFFER_BYTES: Final = 32_768
"""What the peer has not acknowledged, and is underway on a long link."""
UNSENT_BYTES: Final = 2048
"""What the kernel takes beyond that: frames shall wait in our queue, where the urgent go first."""
JOINED_BYTES: Final = 1024
"""The kernel joins what it has not sent, and looks at `UNSENT_BYTES` only when it begins anew."""
PATIENCE_US: Final = US_PER_S
"""A connection that needs longer for what waits is slow; after a stall one catches up sooner."""
FRESH_US: Final = US_PER_S // 2
"""Telemetry that has waited longer is not sent to a slow one."""
ACCEPT_BACKLOG: Final = 128
"""Pages that connect again at once wait there, since each wake-up accepts one."""


class StreamClient(QueuedClient):
    """A peer behind a socket that carries a byte stream."""

    _socket: socket.socket | None = None
    _sending_us: int | None = None
    """Since when it has sent what waits without coming to an end."""
    _chunk_bytes = CHUNK_BYTES
    _joined = 0
    """Bytes written since the kernel was told to begin anew."""

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame at once if nothing waits, else queue it."""
        if self._socket is None:
            self.counters.dropped += 1
            return
        self.counters.sent += 1
        step = self._numbering.enter(frame)
        if self._partial or self._outbox:
            self._push(frame, message_id, step)
        else:
            self._write(self._socket, self.wrap(self._numbering.leave(frame, step)))

    def adopt(self, sock: socket.socket) -> None:
        """Use a connected socket from now on."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, USER_TIMEOUT_MS // 2000)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, UNSENT_BYTES)
        self._socket = sock
        self._splitter.reset()
        self.loop.add_reader(sock, self._on_readable, sock)
        self.begin()

    def begin(self) -> None:
        """Start the protocol on a new connection."""
        self.become("open")
        self.context.greet(self)

    def close(self) -> None:
        """Close the connection; waiting frames are lost."""
        if self._socket is not None:
            self.loop.remove_reader(self._socket)
            self.loop.remove_writer(self._socket)
            self._socket.close()
            self._socket = None
        self._sending_us = None
        self._drop_all()

    def broke(self) -> None:
        """Handle the end of the connection."""
        raise NotImplementedError

    def wrap(self, frames: bytes) -> bytes:
        """Return the bytes that carry some frames on this connection."""
        return frames

    def accept(self, data: bytes, now_us: int) -> None:
        """Process received bytes."""
        self.receive(self._splitter.feed(data), len(data), now_us)

    def _write(self, sock: socket.socket, data: bytes) -> bool:
        """Write; keep what the socket does not accept and wait for room."""
        self._joined += len(data)
        flags = socket.MSG_EOR if self._joined >= JOINED_BYTES else 0
        if flags:
            self._joined = 0
        try:
            taken = sock.send(data, flags)
        except BlockingIOError:
            taken = 0
        except OSError:
            self.broke()
            return False
        self.counters.bytes_sent += taken
        self._partial = data[taken:]
        if self._partial:
            self.loop.add_writer(sock, self._on_writable, sock)
        return not self._partial

    def _on_writable(self, sock: socket.socket) -> None:
        self._note_pace(self.context.now_us())
        if self._partial and not self._write(sock, self._partial):
            return
        while data := self._next_chunk():
            if not self._write(sock, data):
                return
        self.loop.remove_writer(sock)
        self._sending_us = None

    def _note_pace(self, now_us: int) -> None:
        """Drop telemetry that is old on a connection that does not come to an end with it."""
        if self._sending_us is None:
            self._sending_us = now_us
        is_slow = now_us - self._sending_us > PATIENCE_US
        self._chunk_bytes = SLOW_CHUNK_BYTES if is_slow else CHUNK_BYTES
        if is_slow:
            self._drop(self._outbox.expire(now_us - FRESH_US))

    def _next_chunk(self) -> bytes:
        messages, frames, size = [], b"", 0
        while size < self._chunk_bytes and (waiting := self._outbox.pop()) is not None:
            frame = self._numbering.leave(*waiting)
            if frames and len(frames) + len(frame) > self.endpoint.pack_bytes:
                messages.append(self.wrap(frames))
                frames = b""
            frames += frame
            size += len(frame)
        if frames:
            messages.append(self.wrap(frames))
        return b"".join(messages)

    def _on_readable(self, sock: socket.socket) -> None:
        try:
            data = sock.recv(self.context.read_bytes)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.broke()
            return
        self.accept(data, self.context.now_us())
        if self._socket is sock:
            self.pause_stranger(sock, self._on_readable, len(data))


class TcpClient(StreamClient):
    """A connection that the gateway makes, and remakes when it breaks."""

    _retry_us = 0
    _task: asyncio.Task[None] | None = None

    def tick(self, now_us: int) -> None:
        """Connect if there is no connection and the last attempt is long enough ago."""
        if self._socket is None and self._task is None and now_us >= self._retry_us:
            self._retry_us = now_us + RETRY_US
            self._task = self.loop.create_task(self._connect())

    def close(self) -> None:
        """Close the connection and stop connecting."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    def broke(self) -> None:
        """Let the next tick connect again."""
        super().close()
        self.become("connecting")

    async def _connect(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self.loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            for family, _, _, _, address in found:
                if await self._connect_to(family, address):
                    break
        except (OSError, ValueError) as error:
            # An invalid name raises a ValueError.
            self.become("resolving", error)
        finally:
            self._task = None

    async def _connect_to(self, family: int, address: tuple[Any, ...]) -> bool:
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            await self.loop.sock_connect(sock, address)
            if sock.getsockname() == sock.getpeername():
                # A closed local port may be chosen as our own and so connect to itself.
                raise ConnectionRefusedError
        except OSError as error:
            sock.close()
            if isinstance(error, ConnectionRefusedError):
                self.become("refused")
            else:
                self.become("unreachable", error)
            return False
        except asyncio.CancelledError:
            sock.close()
            raise
        self.remote = host_and_port(*address[:2])
        self.adopt(sock)
        return True


@dataclass(eq=False)
class TcpPeer(StreamClient):
    """A connection that a client made."""

    leave: Callable[["TcpPeer"], None] = field(kw_only=True)

    def broke(self) -> None:
        """Remove the client; it may connect again."""
        self.leave(self)

    def fail(self, error: Exception) -> None:  # noqa: ARG002
        """Remove the client after an unexpected error."""
        self.leave(self)


class StreamListener(Listener[Peer]):
    """A port that accepts connections."""

    def _bind(self) -> socket.socket:
        host, port = self.endpoint.host, self.endpoint.port
        sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((host, port))
            sock.listen(ACCEPT_BACKLOG)
        except OSError:
            sock.close()
            raise
        return sock

    def _watch(self, sock: socket.socket) -> None:
        accept_each(sock, self._on_connection, self._report)

    def _on_connection(self, connection: socket.socket, address: tuple[Any, ...]) -> None:
        if self._has_room(str(address[0])):
            self._admit(connection, host_and_port(*address[:2]))
        else:
            self.turned_away += 1
            connection.close()

    def _has_room(self, host: str) -> bool:
        """Return whether there is room for a newcomer, after removing another if needed."""
        most = self._context.settings.max_clients
        if len(self._clients) < most:
            return True
        present = [
            Presence(client.client_id, (client.host, 0), client.heard_us or client.since_us)
            for client in self._clients.values()
        ]
        leaver = who_leaves(present, host, most, self._context.now_us())
        if leaver is None:
            return False
        self.leave(self._clients[leaver.client_id])
        return True

    def _admit(self, connection: socket.socket, peer: str) -> None:
        """Make a client of a connection."""
        raise NotImplementedError


class TcpListener(StreamListener[TcpPeer]):
    """A TCP port and its clients."""

    def _admit(self, connection: socket.socket, peer: str) -> None:
        client_id = self._context.new_client_id()
        name = self.endpoint.name_of(peer)
        client = TcpPeer(self._context, client_id, self.endpoint, peer, name, leave=self.leave)
        self._clients[client_id] = client
        self._context.appear(client)
        client.adopt(connection)
