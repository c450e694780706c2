"""Base of datagram transports: one socket per peer, a short backlog, optional packing."""

import asyncio
import errno
import os
import socket
import struct
from collections import deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import Final

from gateway.compiled.messages import way_to_send
from gateway.hub import forwarding_step as kernel
from gateway.hub.endpoint import Endpoint
from gateway.hub.packer import Packer
from gateway.hub.round_trip import MEASURING
from gateway.hub.routing_table import Origin
from gateway.hub.transports.base import RETRY_US, STALE_AFTER_US, Client
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import HEARTBEAT_ID
from gateway.wire.mavlink_splitter import DatagramSplitter, MavFrame, message_id_of, read_datagram

UNPROVEN: Final = "unproven"
"""State of a client of a listening port that has not shown that it receives."""
SENDING: Final = ("open", UNPROVEN)
NOBODY_LISTENS: Final = "nobody listens there"
IP_PKTINFO: Final = 8
"""Option for the local address of a datagram; `socket` exports it only from Python 3.14 on."""
BACKLOG_DATAGRAMS: Final = 256
"""Maximum datagrams that wait for a full socket buffer: older ones are of no use."""
UNPROVEN_FACTOR: Final = 10
"""Bytes sent for each byte received, to a peer that has not proven that it receives: a heartbeat of
a station pays for a vehicle's heartbeat and home, which is all that it waits for."""
MEASURING_RESERVE: Final = 80
"""Part of that allowance for PING and TIMESYNC only, bytes: their answers are the proof."""
HEARTBEAT_RESERVE: Final = 42
"""A further part for heartbeats: telemetry would leave no room for them."""
UNPROVEN_IDLE_US: Final = 5 * US_PER_S
"""A peer that has not proven that it receives is removed after this time without a frame."""

Address = tuple[str | int, ...]
Write = Callable[[bytes], object]


def not_open(data: bytes) -> int:
    """Write function of a client without an open socket; raises OSError."""
    raise ConnectionError(f"{len(data)} bytes for a socket that is not open")


class DatagramClient(Client):
    """A peer behind a datagram socket; base of unicast, broadcast and multicast."""

    refused_us: int | None = None
    write: Write = staticmethod(not_open)
    """Sends one datagram at once or raises OSError."""
    _socket: socket.socket | None = None
    _direct: Write = staticmethod(not_open)
    _output = -1
    """The connected socket that the compiled step may send to."""
    _read: Callable[[], None]

    def __post_init__(self) -> None:
        """Start without a socket."""
        super().__post_init__()
        self._backlog: deque[bytes] = deque(maxlen=BACKLOG_DATAGRAMS)
        self._packer = self._packer_of(self.endpoint)
        self.splitter = DatagramSplitter()

    @property
    def is_direct(self) -> bool:
        """Whether the compiled step may send to it."""
        return self._packer is None and self.is_unchanged

    @property
    def queued(self) -> int:
        """Datagrams that wait for room in the socket buffer."""
        return len(self._backlog)

    def transmit(self, frame: MavFrame) -> None:
        """Send one frame; count it as dropped if the network refuses it."""
        if self._packer is not None:
            self._packer.add(frame.data)
        else:
            self._send(frame.data)

    def close(self) -> None:
        """Close the socket."""
        self.memory.input = -1
        self._use(not_open)
        self.counters.dropped += len(self._backlog)
        self._backlog.clear()
        if self._socket is not None:
            self.loop.remove_reader(self._socket)
            self.loop.remove_writer(self._socket)
            self._socket.close()
            self._socket = None

    def reconfigure(self, endpoint: Endpoint) -> None:
        """Apply changed options, packing included."""
        if self._packer is not None:
            self._packer.flush()
        self._packer = self._packer_of(endpoint)
        super().reconfigure(endpoint)

    def adopt(
        self, sock: socket.socket, write: Write | None = None, *, is_read: bool = True
    ) -> None:
        """Use an open socket from now on; `write` sends on one that is not connected.

        Without `is_read`, call `begin_reading` later.
        """
        self._socket = sock
        self.memory.input = sock.fileno()
        self._output = sock.fileno() if write is None else -1
        self.memory.way = way_to_send(sock)
        self._direct = write or sock.send
        self._use(self._direct)
        self._revive()
        self._read = self._reader(sock)
        if is_read:
            self.begin_reading()

    def begin_reading(self) -> None:
        """Read the socket from now on, unless it has been closed."""
        if self._socket is not None:
            self.loop.add_reader(self._socket, self._read)

    def _use(self, write: Write) -> None:
        """Send by a function from now on; the compiled step sends if it is the direct one."""
        self.write = write
        self.memory.output = self._output if write is self._direct else -1

    def become(self, state: str, error: Exception | None = None) -> None:
        """Set the state and its reason."""
        super().become(state, error)
        self._update_plain()

    def _update_plain(self) -> None:
        """Let Python process the next datagram if it may change the state or complete a frame."""
        self.memory.is_forwardable = self.state in SENDING and not self.splitter

    def accept_rest(self, data: bytes, now_us: int, sender: Address | None = None) -> None:
        """Process one datagram of this peer; `sender` distinguishes several."""
        if self.state not in SENDING:
            self._revive()
        frame = None if self.splitter else read_datagram(data)
        if frame is None:
            self.receive(self.splitter.feed(data, now_us, sender), len(data), now_us)
            self._update_plain()
            return
        self.counters.bytes_received += len(data)
        self.receive_frame(frame, now_us)

    def _revive(self) -> None:
        """Note that the peer is reachable after all."""
        self.become("open")
        self.refused_us = None

    def send_rest(self, frames: Iterable[bytes], number: int, part: int) -> None:  # noqa: ARG002
        """Send the frames that the compiled step counted as sent but did not send."""
        for data in frames:
            self._count_sent(-1, -len(data))
            if number:
                self._recover(data, 1, OSError(number, os.strerror(number)))
            else:
                self._send(data)
            number = 0

    def _packer_of(self, endpoint: Endpoint) -> Packer | None:
        if not endpoint.pack_bytes:
            return None
        flush_soon = partial(self.context.flush_soon, endpoint.pack_wait_s)
        return Packer(endpoint.pack_bytes, self._send_packed, flush_soon)

    def _send_packed(self, frames: list[bytes]) -> None:
        self._send(b"".join(frames), len(frames))

    def _send(self, data: bytes, frames: int = 1) -> None:
        try:
            self.write(data)
        except OSError as error:
            self._recover(data, frames, error)
        else:
            counters = self.counters
            counters.sent += frames
            counters.bytes_sent += len(data)

    def _count_sent(self, frames: int, size: int) -> None:
        self.counters.sent += frames
        self.counters.bytes_sent += size

    def _recover(self, data: bytes, frames: int, error: OSError) -> None:
        """Handle a failed send: wait for room, retry, or drop the frames."""
        if isinstance(error, BlockingIOError) and self._socket is not None:
            self._use(self._wait)
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
        if self._socket is not None and not isinstance(self.loop, asyncio.SelectorEventLoop):
            # libuv stops watching a socket with an error.
            self.loop.remove_reader(self._socket)
            self.loop.add_reader(self._socket, self._read)

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
        self._use(self._direct)

    def _reader(self, sock: socket.socket) -> Callable[[], None]:
        """Return the function that reads a socket; its names are looked up once, not each time."""
        forwarding, now = self.context.forwarding, self.context.now_us
        if not forwarding.is_compiled:
            return partial(self._read_each, sock)
        work, step = forwarding.work, forwarding.step(self.memory, reads=True)
        on = forwarding.step(self.memory, reads=False)

        def read() -> None:
            now_us = work.now_us = now()
            step()
            if work.status:
                self.go_on(on, now_us)
                self._end_read(sock)
            if not self.trusted:
                self.limit_reads(sock, read, work.read)

        return read

    def _end_read(self, sock: socket.socket) -> None:
        """Handle an error, and keep unread datagrams for a later turn of the loop."""
        forwarding = self.context.forwarding
        if forwarding.work.status & kernel.ERROR:
            self._note_read_error(forwarding.work.error_number)
        if self._socket is sock and (unread := forwarding.unread()):
            self.loop.remove_reader(sock)
            self.loop.call_soon(self._read_later_part, sock, deque(unread))

    def _read_later_part(self, sock: socket.socket, unread: deque[bytes]) -> None:
        """Process datagrams that were read in an earlier turn of the loop."""
        size = 0
        while unread and size < self.context.read_bytes and self._socket is sock:
            size += len(unread[0])
            self.accept_rest(unread.popleft(), self.context.now_us())
        if self._socket is not sock:
            return
        if unread:
            self.loop.call_soon(self._read_later_part, sock, unread)
        else:
            self._read_later(sock, self._read)

    def _read_each(self, sock: socket.socket) -> None:
        """Read a socket without the compiled step."""
        size, most = 0, self.context.read_bytes
        for _ in range(kernel.READS):
            try:
                data, _, flags, address = sock.recvmsg(kernel.MAX_DATAGRAM)
            except OSError as error:
                self._note_read_error(error.errno)
                break
            size += len(data)
            self.counters.cut += bool(flags & socket.MSG_TRUNC)
            self._accept_from(data, address)
            if size >= most or sock.fileno() < 0:
                break
        self.limit_reads(sock, partial(self._read_each, sock), size)

    def _accept_from(self, data: bytes, _address: Address) -> None:
        self.accept_rest(data, self.context.now_us())

    def _note_read_error(self, number: int | None) -> None:
        if number == errno.ECONNREFUSED:
            self._note_refusal()
        elif number is not None and number != errno.EAGAIN:
            self.become("unreachable", OSError(number, os.strerror(number)))


class DatagramPeer(DatagramClient):
    """A client of a listening port.

    The address that a datagram claims to come from may be forged, to make the gateway flood
    somebody else. So a new client is *unproven*, and is sent at most `UNPROVEN_FACTOR` times the
    bytes that were received from it, until a frame depends on one that it was sent: an answer to
    PING or TIMESYNC, or a frame addressed to a system behind the gateway. The kernel drops forged
    datagrams of this machine's addresses, so a client on this machine needs no proof.
    """

    identity: Origin
    """System and component of its first frame."""
    address: Address
    """Host and port of the peer."""
    is_proven = False
    _spent: int = 0
    """Bytes that were sent while it was unproven."""

    def adopt(
        self, sock: socket.socket, write: Write | None = None, *, is_read: bool = True
    ) -> None:
        """Use an open socket from now on."""
        self._send_to_proven = write or sock.send
        super().adopt(sock, write if self.is_proven else self._send_limited, is_read=is_read)

    def prove(self) -> None:
        """Send everything from now on."""
        if self.is_proven:
            return
        self.is_proven = True
        is_held = self.write is not self._direct
        self._direct = self._send_to_proven
        if self._socket is not None:
            self._output = self._socket.fileno()
        self._use(self.write if is_held else self._direct)
        if self.state == UNPROVEN:
            self.become("open")
        self._packer = self._packer_of(self.endpoint)
        self.context.reroute(self)

    def _send_limited(self, data: bytes) -> object:
        """Send a datagram if the allowance of an unproven client suffices; else drop it."""
        message_id, reserve = message_id_of(data), MEASURING_RESERVE
        if message_id in MEASURING:
            reserve = 0
        elif message_id != HEARTBEAT_ID:
            reserve += HEARTBEAT_RESERVE
        allowance = UNPROVEN_FACTOR * self.counters.bytes_received - self._spent
        if allowance < len(data) + reserve:
            self._hold(data)
            return 0
        self._spent += len(data)
        return self._send_to_proven(data)

    def _packer_of(self, endpoint: Endpoint) -> Packer | None:
        # Packed frames would be larger than the allowance.
        return super()._packer_of(endpoint) if self.is_proven else None

    def _revive(self) -> None:
        """Note that the client is reachable after all."""
        self._end_hold()
        super()._revive()
        self._become_open()

    def _become_open(self) -> None:
        """Note that frames are sent, if only a few."""
        self.become("open" if self.is_proven else UNPROVEN)

    def tick(self, now_us: int) -> None:
        """Clear a problem that was not repeated; retry a client that refused."""
        if self._socket is None:
            return
        self._end_hold()
        if self.refused_us is None or now_us - self.refused_us >= RETRY_US:
            self._become_open()

    def _note_refusal(self) -> None:
        """Stop sending until the next tick: a dead client costs more than a live one."""
        super()._note_refusal()
        if self.write is self._direct:
            self._use(self._hold)

    def _hold(self, data: bytes) -> None:
        self.counters.unheard += 1
        self.counters.sent -= 1
        self.counters.bytes_sent -= len(data)

    def _end_hold(self) -> None:
        if self.write == self._hold:
            self._use(self._direct)

    def has_died(self, now_us: int) -> bool:
        """Return whether it failed, or is stale and its machine reports a closed port."""
        if self._socket is None:
            return True
        return self.refused_us is not None and now_us - self.last_us >= STALE_AFTER_US


def gone_clients(
    present: Collection[DatagramPeer], idle_timeout_us: int, now_us: int
) -> list[DatagramPeer]:
    """Return the clients that have gone or have come back on another port."""
    newest: dict[tuple[str, Origin], DatagramPeer] = {}
    for client in present:
        key = (client.host, client.identity)
        if key not in newest or client.last_us > newest[key].last_us:
            newest[key] = client
    return [
        client
        for client in present
        if (idle_us := now_us - client.last_us) >= idle_timeout_us
        or (idle_us >= UNPROVEN_IDLE_US and not client.is_proven)
        or (idle_us >= STALE_AFTER_US and newest[client.host, client.identity] is not client)
    ]


def local_host_of(ancillary: list[tuple[int, int, bytes]]) -> str:
    """Return the address of ours that a datagram was sent to."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.IPPROTO_IP, IP_PKTINFO):
            return socket.inet_ntoa(struct.unpack("=I4s4s", data[:12])[1])
        if (level, kind) == (socket.IPPROTO_IPV6, socket.IPV6_PKTINFO):
            host = socket.inet_ntop(socket.AF_INET6, data[:16])
            interface = struct.unpack("=I", data[16:20])[0]
            return f"{host}%{interface}" if host.startswith("fe80:") else host
    return ""
