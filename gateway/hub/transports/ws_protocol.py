"""One WebSocket connection without a socket: bytes in; payload, reply bytes and events out.

MAVLink is sent as binary messages. A page gets one frame per message, or several if they are
packed; received messages are read as a byte stream, so that message boundaries do not matter.

| received                                        | answer                                   |
| ----------------------------------------------- | ---------------------------------------- |
| an upgrade request of an admitted page          | 101, and the connection is open          |
| one of another page                             | 403 and the end                          |
| no upgrade request                              | 400 or 426 and the end                   |
| a binary message, in any number of fragments    | nothing; its bytes are payload           |
| a text message                                  | nothing; it is counted as garbage        |
| a ping                                          | a pong, of several at once the last one  |
| a message beyond `MAX_MESSAGE`                  | close 1009                               |
| unmasked or compressed frames, wrong ones       | close 1002                               |
| a close                                         | a close                                  |

The `websockets` library would cost 3.0 instead of 0.3 us for each sent message, 1.45 times the
present cost of a message in all.

Compression is offered by browsers and never accepted: telemetry does not compress well, and each
connection would need memory for its window.

References
----------
.. [1] RFC 6455, The WebSocket Protocol.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from wsproto import ConnectionType, WSConnection
from wsproto.events import (
    AcceptConnection,
    BytesMessage,
    CloseConnection,
    Event,
    Ping,
    Pong,
    RejectConnection,
    RejectData,
    Request,
    TextMessage,
)
from wsproto.frame_protocol import CloseReason
from wsproto.utilities import ProtocolError

MAX_MESSAGE: Final = 65_536
"""Longest accepted message, bytes: no program packs more into one."""
SUBPROTOCOLS: Final = ("mavlink", "binary")
"""Names that pages request, if any; a browser gives up if none is accepted."""
FINAL_BINARY: Final = b"\x82"
SHORT: Final = 126
"""From this payload size on, the length takes two bytes."""
TWO_BYTES: Final = struct.Struct("!BH")


@dataclass(slots=True)
class WsInput:
    """Result of some received bytes."""

    payload: bytes = b""
    """Bytes of binary messages."""
    text_size: int = 0
    """Bytes of text messages, which are not MAVLink."""
    reply: bytes = b""
    """Bytes to send at once, unchanged."""
    opened: bool = False
    """The handshake is done."""
    ponged: bool = False
    """The peer has answered a ping."""
    ended: str = ""
    """Why the connection is to be closed after the reply; empty if it goes on."""


class WsProtocol:
    """Base of both ends of a connection."""

    def __init__(self, role: ConnectionType) -> None:
        self._wire = WSConnection(role)
        self.hello = b""
        """The first bytes that we send."""
        self._message_size = 0
        self._ended = False

    def feed(self, data: bytes) -> WsInput:
        """Process received bytes; never raises on data."""
        found = WsInput()
        if self._ended or not data:
            return found
        pong: Ping | None = None
        try:
            self._wire.receive_data(data)
            for event in self._wire.events():
                if isinstance(event, Ping):
                    pong = event
                else:
                    self._handle(event, found)
                if found.ended:
                    break
        except ProtocolError as error:
            hint = getattr(error, "event_hint", None)
            self._end(found, f"not a WebSocket: {error}", hint or RejectConnection())
        except UnicodeError as error:
            self._end(found, f"not a WebSocket: {error}", RejectConnection())
        if pong is not None and not found.ended:
            found.reply += self._wire.send(pong.response())
        self._ended = bool(found.ended)
        return found

    def wrap(self, payload: bytes) -> bytes:
        """Build a binary message of some MAVLink."""
        raise NotImplementedError

    def ping(self) -> bytes:
        """Return a ping message."""
        return self._wire.send(Ping())

    def close(self, code: CloseReason) -> bytes:
        """Return a close message, unless one was sent."""
        try:
            return self._wire.send(CloseConnection(code=code))
        except ProtocolError:
            return b""

    def _handle(self, event: Event, found: WsInput) -> None:
        if isinstance(event, BytesMessage):
            found.payload += event.data
            self._measure(len(event.data), found, finished=event.message_finished)
        elif isinstance(event, TextMessage):
            size = len(event.data.encode())
            found.text_size += size
            self._measure(size, found, finished=event.message_finished)
        elif isinstance(event, Pong):
            found.ponged = True
        elif isinstance(event, CloseConnection):
            reason = f"closed: {event.code:d} {event.reason or ''}".rstrip()
            self._end(found, reason, event.response())
        else:
            self._shake_hands(event, found)

    def _measure(self, size: int, found: WsInput, *, finished: bool) -> None:
        self._message_size += size
        if self._message_size > MAX_MESSAGE:
            close = CloseConnection(code=CloseReason.MESSAGE_TOO_BIG)
            self._end(found, f"closed: a message of more than {MAX_MESSAGE} bytes", close)
        if finished:
            self._message_size = 0

    def _shake_hands(self, event: Event, found: WsInput) -> None:
        raise NotImplementedError

    def _end(self, found: WsInput, reason: str, *answers: Event) -> None:
        found.ended = reason
        try:
            for answer in answers:
                found.reply += self._wire.send(answer)
        except ProtocolError:
            # No reply is possible in this state: the peer sent data after its close.
            return


class WsServer(WsProtocol):
    """Our end of a connection by a page or a program; `admits` decides on a page's origin."""

    def __init__(self, admits: Callable[[str], bool]) -> None:
        super().__init__(ConnectionType.SERVER)
        self._admits = admits

    def wrap(self, payload: bytes) -> bytes:
        """Build a binary message; written here for speed, since every frame to a page needs it."""
        size = len(payload)
        if size < SHORT:
            return FINAL_BINARY + size.to_bytes() + payload
        return FINAL_BINARY + TWO_BYTES.pack(SHORT, size) + payload

    def _shake_hands(self, event: Event, found: WsInput) -> None:
        if not isinstance(event, Request):
            return
        origins = [value for name, value in event.extra_headers if name == b"origin"]
        origin = b",".join(origins).decode("latin-1")
        if origins and not self._admits(origin):
            text = f"pages of {origin} may not connect; name them in the endpoint: origins={origin}"
            self._end(
                found,
                f"a page of {origin!r} was refused",
                RejectConnection(
                    status_code=403,
                    headers=[(b"content-type", b"text/plain"), (b"connection", b"close")],
                    has_body=True,
                ),
                RejectData(data=f"{text}\n".encode()),
            )
            return
        agreed = next((name for name in SUBPROTOCOLS if name in event.subprotocols), None)
        found.reply += self._wire.send(AcceptConnection(subprotocol=agreed))
        found.opened = True


class WsCaller(WsProtocol):
    """Our end of a connection that we make."""

    def __init__(self, address: str, path: str) -> None:
        super().__init__(ConnectionType.CLIENT)
        self.hello = self._wire.send(Request(host=address, target=path))

    def wrap(self, payload: bytes) -> bytes:
        """Build a binary message, masked as required of clients."""
        return self._wire.send(BytesMessage(data=payload))

    def _shake_hands(self, event: Event, found: WsInput) -> None:
        if isinstance(event, AcceptConnection):
            found.opened = True
        elif isinstance(event, RejectConnection):
            self._end(found, f"the server answers HTTP {event.status_code}")
