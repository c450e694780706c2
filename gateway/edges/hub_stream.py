"""TCP to clients and sources, with a bounded queue in front of each connection.

A stalled client fills its own queue and loses its own oldest telemetry; the kernel ends the
connection when nothing was acknowledged for long.
"""

import asyncio
import logging
import socket
from typing import Any, Final

from gateway.edges.hub_link import HubContext, Link
from gateway.edges.hub_udp import RETRY_US
from gateway.routing.endpoint import Endpoint
from gateway.routing.outbox import Numbering, Outbox
from gateway.wire.mavlink_splitter import MavlinkSplitter

log = logging.getLogger(__name__)

CHUNK_BYTES: Final = 4096
"""Joined into one write while a queue drains; and read at once."""
READ_BUDGET: Final = 16
"""Chunks taken at one wake-up, so that one flooding peer cannot starve the others."""
USER_TIMEOUT_MS: Final = 30_000
"""A peer that acknowledges nothing for so long is gone; a stopped one may come back sooner."""
SEND_BUFFER_BYTES: Final = 32_768
"""Small, so that what waits does so in the queue, where the old can make room for the new."""
ACCEPT_BACKLOG: Final = 16


class StreamLink(Link):
    """A peer behind a byte stream."""

    __slots__ = ("_numbering", "_outbox", "_partial", "_socket", "_splitter")

    def __init__(
        self,
        context: HubContext,
        client_id: int,
        endpoint: Endpoint,
        *,
        remote: str,
        name: str = "",
    ) -> None:
        super().__init__(client_id, endpoint, remote, context, name, state="connecting")
        self._outbox = Outbox(context.settings.queue_bytes)
        self._numbering = Numbering(context.is_own)
        self._splitter = MavlinkSplitter()
        self._partial = b""
        self._socket: socket.socket | None = None

    @property
    def queued(self) -> int:
        """Frames that wait for the connection."""
        return len(self._outbox)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Send one frame at once if nothing waits, else queue it."""
        if self._socket is None:
            self.counters.dropped += 1
            return
        self.counters.sent += 1
        step = self._numbering.enter(frame)
        if self._partial or self._outbox:
            self._drop(self._outbox.push(frame, message_id, step))
        else:
            self._write(self._socket, self._numbering.leave(frame, step))

    def adopt(self, sock: socket.socket) -> None:
        """Use a connected socket from now on."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, USER_TIMEOUT_MS)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, USER_TIMEOUT_MS // 2000)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        self._socket = sock
        self._splitter.reset()
        self.state = "open"
        self.loop.add_reader(sock, self._on_readable, sock)
        self.context.greet(self)

    def close(self) -> None:
        """Close the connection; what waits is lost."""
        if self._socket is not None:
            self.loop.remove_reader(self._socket)
            self.loop.remove_writer(self._socket)
            self._socket.close()
            self._socket = None
        self._partial = b""
        self._drop(self._outbox.clear())

    def broke(self) -> None:
        """Handle the end of the connection."""
        raise NotImplementedError

    def _drop(self, frames: int) -> None:
        self.counters.dropped += frames
        self.counters.sent -= frames

    def _write(self, sock: socket.socket, data: bytes) -> bool:
        """Write; keep what the socket does not take and wait for room."""
        try:
            taken = sock.send(data)
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
        if self._partial and not self._write(sock, self._partial):
            return
        while data := self._next_chunk():
            if not self._write(sock, data):
                return
        self.loop.remove_writer(sock)

    def _next_chunk(self) -> bytes:
        frames, size = [], 0
        while size < CHUNK_BYTES and (waiting := self._outbox.pop()) is not None:
            frames.append(self._numbering.leave(*waiting))
            size += len(frames[-1])
        return b"".join(frames)

    def _on_readable(self, sock: socket.socket) -> None:
        for _ in range(READ_BUDGET):
            try:
                data = sock.recv(CHUNK_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self.broke()
                return
            self.receive(self._splitter.feed(data), len(data), self.context.now_us())
            if self._socket is not sock:
                return


class TcpLink(StreamLink):
    """A connection that the gateway makes, and makes again when it breaks."""

    __slots__ = ("_retry_us", "_task")

    def __init__(self, context: HubContext, client_id: int, endpoint: Endpoint) -> None:
        super().__init__(
            context,
            client_id,
            endpoint,
            remote=f"{endpoint.host}:{endpoint.port}",
        )
        self._retry_us = 0
        self._task: asyncio.Task[None] | None = None
        self.tick(context.now_us())

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
        self.state = "connecting"

    async def _connect(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self.loop.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            for family, _, _, _, address in found:
                if await self._connect_to(family, address):
                    break
        except OSError:
            self.state = "resolving"
        finally:
            self._task = None

    async def _connect_to(self, family: int, address: tuple[Any, ...]) -> bool:
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            await self.loop.sock_connect(sock, address)
            if sock.getsockname() == sock.getpeername():
                # A closed local port may be drawn as our own and so connect to itself.
                raise ConnectionRefusedError
        except OSError as error:
            sock.close()
            refused = isinstance(error, ConnectionRefusedError)
            self.state = "refused" if refused else "unreachable"
            return False
        except asyncio.CancelledError:
            sock.close()
            raise
        self.remote = f"{address[0]}:{address[1]}"
        self.adopt(sock)
        return True


class TcpPeer(StreamLink):
    """A connection that a client made."""

    __slots__ = ("_listener",)

    def __init__(
        self, context: HubContext, client_id: int, listener: "TcpListener", peer: str
    ) -> None:
        super().__init__(context, client_id, listener.endpoint, remote=peer, name=peer)
        self._listener = listener

    def broke(self) -> None:
        """Leave for good; the client may connect again."""
        self._listener.leave(self)


class TcpListener:
    """A TCP port and its clients."""

    def __init__(self, context: HubContext, endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        self.refused = 0
        self._context = context
        self._loop = asyncio.get_running_loop()
        self._links: dict[int, TcpPeer] = {}
        self._socket: socket.socket | None = None
        self._retry_us = 0
        self._failed = False
        self.tick(context.now_us())

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._socket.getsockname()[1] if self._socket else 0

    def tick(self, now_us: int) -> None:
        """Bind or accept again if that failed."""
        if now_us < self._retry_us:
            return
        self._retry_us = now_us + RETRY_US
        if self._socket is not None:
            self._loop.add_reader(self._socket, self._on_readable, self._socket)
            return
        host, port = self.endpoint.host, self.endpoint.port
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        sock = socket.socket(family, socket.SOCK_STREAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind((host, port))
            sock.listen(ACCEPT_BACKLOG)
        except OSError as error:
            sock.close()
            if not self._failed:
                log.warning("cannot listen at %s yet: %s", self.endpoint.name, error)
            self._failed = True
            return
        self._failed = False
        self._socket = sock
        self._loop.add_reader(sock, self._on_readable, sock)

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Take over changed options of the same place, for the clients that are there too."""
        self.endpoint = endpoint
        for link in self._links.values():
            link.reconfigure(endpoint)

    def close(self) -> None:
        """Part from all clients and close the port."""
        for link in list(self._links.values()):
            self.leave(link)
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def leave(self, link: TcpPeer) -> None:
        """Part from one client."""
        self._links.pop(link.client_id, None)
        self._context.vanish(link)

    def _on_readable(self, sock: socket.socket) -> None:
        for _ in range(READ_BUDGET):
            try:
                connection, address = sock.accept()
            except BlockingIOError:
                return
            except OSError as error:
                log.warning("cannot accept a client: %s", error)
                # Out of descriptors: the waiting client would wake us for ever.
                self._loop.remove_reader(sock)
                return
            if len(self._links) >= self._context.settings.max_clients:
                self.refused += 1
                connection.close()
                continue
            client_id = self._context.new_client_id()
            link = TcpPeer(self._context, client_id, self, f"{address[0]}:{address[1]}")
            self._links[client_id] = link
            self._context.appear(link)
            link.adopt(connection)
