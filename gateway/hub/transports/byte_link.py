"""A transport of the hub for bytes that are not MAVLink: those of an output or a source."""

import socket
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, Final

from gateway.hub.transports.base import Client, HubContext
from gateway.hub.transports.datagram import DatagramClient
from gateway.hub.transports.listener import Listener
from gateway.hub.transports.sockets import bound_socket
from gateway.wire.mavlink_splitter import MavFrame

MAX_DATAGRAM: Final = 65_536


class ByteLink:
    """Acts as the hub for one transport: its peers are not clients of the hub.

    The transport is opened, and opened again, by `tick`.
    """

    link: "Client | Listener[Any]"

    def __init__(self, hub: HubContext) -> None:
        self._hub = hub
        self.peers: dict[int, Client] = {}

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the hub that a transport uses."""
        return getattr(self._hub, name)

    @property
    def state(self) -> str:
        """State of the transport; see `ClientStats.state`."""
        return self.link.state if isinstance(self.link, Client) else self.link.stats().state

    @property
    def reason(self) -> str:
        """Reason why it is not open."""
        return self.link.reason

    def take(self, data: bytes, now_us: int) -> None:
        """Process received bytes; by default they are dropped."""

    def tick(self, now_us: int) -> None:
        """Open the transport if it is closed."""
        self.link.tick(now_us)

    def close(self) -> None:
        """Close the transport."""
        self.link.close()

    def fail(self, error: Exception) -> None:
        """Close the transport after an unexpected error; `tick` opens it again."""
        self.link.fail(error)

    def appear(self, client: Client) -> None:
        """Add a peer."""
        client.sink = self.take
        self.peers[client.client_id] = client

    def vanish(self, client: Client) -> None:
        """Remove a peer and close it."""
        self.peers.pop(client.client_id, None)
        client.close()

    def greet(self, client_id: int) -> None:
        """Do nothing when a peer is connected."""

    def deliver(self, client: Client, frame: MavFrame, now_us: int) -> None:
        """Drop a received frame."""


class UdpReceiver(DatagramClient):
    """A port that takes the datagrams of every sender, and answers none.

    `split` divides a large datagram, whose parts are processed in several turns of the loop.
    """

    split: Callable[[bytes], list[bytes]]

    def tick(self, now_us: int) -> None:
        """Bind if that has not succeeded yet."""
        if self._socket is not None or not self._is_retry_due(now_us):
            return
        try:
            sock = bound_socket((self.endpoint.host, self.endpoint.port), shared=False)
        except OSError as error:
            self.become("unreachable", error)
            return
        self.adopt(sock)
        self.context.greet(self.client_id)

    def _reader(self, sock: socket.socket) -> Callable[[], None]:
        return partial(self._read_one, sock)

    def _read_one(self, sock: socket.socket) -> None:
        """Read one datagram, which may be larger than any of MAVLink."""
        try:
            data = sock.recv(MAX_DATAGRAM)
        except OSError as error:
            self._note_read_error(error.errno)
            return
        self._go_on(sock, deque(self.split(data)))

    def _go_on(self, sock: socket.socket, parts: deque[bytes]) -> None:
        """Process a part of a datagram; the next datagram is read after its last one."""
        if self._socket is not sock:
            return
        if parts:
            self.sink_bytes(parts.popleft(), self.context.now_us())
        if parts:
            self.loop.remove_reader(sock)
            self.loop.call_soon(self._go_on, sock, parts)
        else:
            self.loop.add_reader(sock, self._read)
