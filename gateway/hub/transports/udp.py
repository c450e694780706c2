"""UDP to a single peer, on a connected socket.

A connected socket costs a fifth less per datagram than `sendto`, the kernel reports an ICMP
refusal on the socket that it concerns, and with its own send buffer a peer behind a slow interface
does not fill that of others.
"""

import asyncio
import socket
from collections import deque
from typing import Any, Final

from gateway.hub.endpoint import Endpoint, host_and_port
from gateway.hub.hosts import is_numeric
from gateway.hub.send_queue import Packer
from gateway.hub.transports.base import Client, Write, not_open
from gateway.hub.transports.listener import RETRY_US
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import is_frame, split_datagram

NOBODY_LISTENS: Final = "nobody listens there"
MAX_DATAGRAM: Final = 4096
"""Programs that join frames fill a packet of the network, at most some 2000 bytes; what is beyond
this is cut off."""
READ_BUDGET: Final = 64
"""Datagrams read at one wake-up, if they are small."""
ALONE_US: Final = 300
"""A datagram that arrives so long after the last wake-up is most likely the only one. A second
read, which would raise BlockingIOError, is left out; if more is there, the loop wakes again."""
RESOLVE_AGAIN_US: Final = 60 * US_PER_S
"""Names of home networks change their address at most some times a day."""
RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""The default holds only about 256 small datagrams; a parameter upload bursts more."""
BACKLOG_DATAGRAMS: Final = 256
"""Waiting for a full socket buffer; older ones are of no use to a ground station."""


class DatagramClient(Client):
    """A peer behind a datagram socket; base of unicast, broadcast and multicast."""

    refused_us: int | None = None
    _socket: socket.socket | None = None
    _direct: Write = staticmethod(not_open)
    _is_gathering = False
    _woken_us = 0

    def __post_init__(self) -> None:
        """Start without a socket."""
        super().__post_init__()
        self._backlog: deque[bytes] = deque(maxlen=BACKLOG_DATAGRAMS)
        self._packer = _packer(self.endpoint)

    @property
    def is_direct(self) -> bool:
        """Whether a frame may be passed to `write` directly."""
        return self._packer is None

    @property
    def queued(self) -> int:
        """Datagrams that wait for room in the socket buffer."""
        return len(self._backlog)

    def transmit(self, frame: bytes, message_id: int) -> None:  # noqa: ARG002
        """Send one frame; count it as dropped if the network refuses it."""
        if self._packer is not None:
            self._pack(frame)
            return
        try:
            self.write(frame)
        except OSError as error:
            self._recover(frame, 1, error)
            return
        counters = self.counters
        counters.sent += 1
        counters.bytes_sent += len(frame)

    def close(self) -> None:
        """Close the socket."""
        self.write = not_open
        self.counters.dropped += len(self._backlog)
        self._backlog.clear()
        if self._socket is not None:
            self.loop.remove_reader(self._socket)
            self.loop.remove_writer(self._socket)
            self._socket.close()
            self._socket = None

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options, packing included."""
        self._flush()
        self._packer = _packer(endpoint)
        super().reconfigure(endpoint)

    def adopt(self, sock: socket.socket, write: Write) -> None:
        """Use an open socket from now on."""
        self._socket = sock
        self.write = self._direct = write
        self.revive()
        self.loop.add_reader(sock, self._on_readable, sock)

    def accept(self, data: bytes, now_us: int) -> None:
        """Process one datagram of this peer."""
        if self.state != "open":
            self.revive()
        if not is_frame(data):
            self.receive(split_datagram(data), len(data), now_us)
            return
        self.heard_us = now_us
        if express := self.express.get(data[5:10]):
            express.send(data)
            return
        self.counters.received += 1
        self.counters.bytes_received += len(data)
        self.context.deliver(self, data, now_us)

    def revive(self) -> None:
        """Note that the peer is reachable after all."""
        self.become("open")
        self.refused_us = None

    def recover_uncounted(self, data: bytes, error: OSError) -> None:
        """Handle a failed send whose frame will still be counted as sent."""
        self._count_sent(-1, -len(data))
        self._recover(data, 1, error)

    def _pack(self, frame: bytes) -> None:
        assert self._packer is not None
        self._send_packed(self._packer.add(frame))
        if not self._is_gathering:
            self._is_gathering = True
            self.context.flush_soon(self._flush, self.endpoint.pack_wait_s)

    def _flush(self) -> None:
        self._is_gathering = False
        if self._packer is not None:
            self._send_packed(self._packer.flush())

    def _send_packed(self, frames: list[bytes]) -> None:
        if not frames:
            return
        data = b"".join(frames)
        try:
            self.write(data)
        except OSError as error:
            self._recover(data, len(frames), error)
            return
        self._count_sent(len(frames), len(data))

    def _count_sent(self, frames: int, size: int) -> None:
        self.counters.sent += frames
        self.counters.bytes_sent += size

    def _recover(self, data: bytes, frames: int, error: OSError) -> None:
        """Handle a failed send: wait for room, retry, or drop the frames."""
        if isinstance(error, BlockingIOError) and self._socket is not None:
            self.write = self._wait
            self.loop.add_writer(self._socket, self._on_writable, self._socket)
            self._wait(data)
            self._count_sent(frames, len(data))
            return
        if isinstance(error, ConnectionRefusedError):
            if self._sends_after_refusal(data):
                self._count_sent(frames, len(data))
            else:
                self.counters.unheard += frames
            return
        if self._socket is not None:
            self.become("unreachable", error)
        self.counters.dropped += frames

    def _sends_after_refusal(self, data: bytes) -> bool:
        """Send again: a refusal reported now belongs to an earlier datagram."""
        self._note_refusal()
        try:
            self.write(data)
        except OSError:
            return False
        return True

    def _note_refusal(self) -> None:
        self.become("refused")
        self.reason = NOBODY_LISTENS
        self.refused_us = self.context.now_us()

    def _wait(self, data: bytes) -> None:
        """Queue datagrams while the socket buffer is full; the oldest makes room."""
        if len(self._backlog) == BACKLOG_DATAGRAMS:
            self.counters.dropped += 1
            self.counters.sent -= 1
        self._backlog.append(data)

    def _on_writable(self, sock: socket.socket) -> None:
        while self._backlog:
            try:
                self._direct(self._backlog[0])
            except BlockingIOError:
                return
            except OSError:
                self.counters.dropped += 1
                self.counters.sent -= 1
            self._backlog.popleft()
        self.loop.remove_writer(sock)
        self.write = self._direct

    def _on_readable(self, sock: socket.socket) -> None:
        now_us = self.context.now_us()
        is_alone = now_us - self._woken_us > ALONE_US
        self._woken_us = now_us
        size, most = 0, 0 if is_alone else self.context.read_bytes
        for _ in range(READ_BUDGET):
            try:
                data = sock.recv(MAX_DATAGRAM)
            except BlockingIOError:
                break
            except ConnectionRefusedError:
                self._note_refusal()
                return
            except OSError as error:
                self.become("unreachable", error)
                return
            size += len(data)
            self.accept(data, now_us)
            if self._socket is not sock:
                return
            if size >= most:
                break
        self.pause_stranger(sock, self._on_readable, size)


class UdpClient(DatagramClient):
    """A UDP peer at a configured address.

    A name may resolve only later, or to another address later: it is looked up again while nothing
    is received from there. Of several addresses, as `localhost` has, the next is tried when one
    refuses.
    """

    _port = 0
    _retry_us = 0
    _resolve_us = 0
    _task: asyncio.Task[None] | None = None

    def __post_init__(self) -> None:
        """Start without an address."""
        super().__post_init__()
        self._places: list[tuple[int, tuple[Any, ...]]] = []
        self.become("resolving")

    def tick(self, now_us: int) -> None:
        """Open the socket or look the name up again; clear a refusal that was not repeated."""
        if now_us < self._retry_us:
            return
        self._retry_us = now_us + RETRY_US
        if self.state == "unreachable":
            super().close()
        if self.refused_us is not None:
            if len(self._places) > 1:
                self._places.append(self._places.pop(0))
                self._connect()
            elif now_us - self.refused_us >= RETRY_US:
                self.revive()
        if self._task is None and (self._socket is None or self._wants_look_up(now_us)):
            self._resolve_us = now_us + RESOLVE_AGAIN_US
            self._task = self.loop.create_task(self._open())

    def close(self) -> None:
        """Close the socket and stop resolving."""
        if self._task is not None:
            self._task.cancel()
        super().close()

    def _wants_look_up(self, now_us: int) -> bool:
        silent = self.heard_us is None or now_us - self.heard_us > RESOLVE_AGAIN_US
        return silent and now_us >= self._resolve_us and not is_numeric(self.endpoint.host)

    async def _open(self) -> None:
        host, port = self.endpoint.host, self.endpoint.port
        try:
            found = await self.loop.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
        except (OSError, ValueError) as error:
            # An invalid name raises a ValueError.
            if self._socket is None:
                self.become("resolving", error)
        else:
            self._places = [(family, address) for family, _, _, _, address in found]
            known = {host_and_port(*address[:2]) for _, address in self._places}
            if self._socket is None or self.remote not in known:
                self._connect()
        finally:
            self._task = None

    def _connect(self) -> None:
        """Use the first address that has a route."""
        super().close()
        for family, address in self._places:
            try:
                sock = self._connected(family, address)
            except OSError as error:
                self.become("unreachable", error)
                continue
            self.remote = host_and_port(*address[:2])
            self.adopt(sock, sock.send)
            return

    def _connected(self, family: int, address: tuple[Any, ...]) -> socket.socket:
        """Open a socket that keeps the port it had, so that the peer sees the same client."""
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
            sock.bind(("", self._port))
            sock.connect(address)
        except OSError:
            sock.close()
            self._port = 0
            raise
        self._port = sock.getsockname()[1]
        return sock


def _packer(endpoint: Endpoint) -> Packer | None:
    return Packer(endpoint.pack_bytes) if endpoint.pack_bytes else None
