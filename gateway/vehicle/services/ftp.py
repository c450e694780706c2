"""MAVLink FTP, for reading only: the component metadata and the packed parameters.

Everything else is refused with the protocol's own error, with the session, the sequence number and
the opcode of the request echoed: a client that gets a proper refusal continues at once, one that
gets none retries for 15 s.

References
----------
.. [1] https://mavlink.io/en/services/ftp.html
"""

import binascii
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.service import Answer, Reply, Request, TransferService

HEADER: Final = struct.Struct("<HBBBBBxI")
PAYLOAD_BYTES: Final = 251
MAX_DATA: Final = PAYLOAD_BYTES - HEADER.size
MAX_SESSIONS: Final = 255
MAX_SESSIONS_OF_ONE: Final = 4
"""Maximum sessions of a client, which reads one file after the other; for a further one, its own
oldest session is closed."""
MAX_ANSWERS: Final = 512
"""Maximum clients whose last answer is stored."""
MIN_BURST_DATA: Final = 64
"""Least data per packet of a burst, bytes: single bytes would cost both sides 60 times as much."""

_SCHEME: Final = re.compile(r"mftp://(?:\[?;comp=\d+\]?)?", re.IGNORECASE)
"""The part before the path in a URI of the component metadata."""

ACK: Final = mavlink.MAV_FTP_OPCODE_ACK
NAK: Final = mavlink.MAV_FTP_OPCODE_NAK
WRITING: Final = range(mavlink.MAV_FTP_OPCODE_CREATEFILE, mavlink.MAV_FTP_OPCODE_RENAME + 1)
File = bytes | Callable[[Request, str], bytes]
"""Content, or a function of the request and the query of its path, such as `withdefaults=1`."""


class Opcode(IntEnum):
    """The requests that only read; those from 6 to 13 write."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15


class FtpError(IntEnum):
    """Why a request is refused."""

    INVALID_SESSION = 4
    NO_SESSIONS = 5
    EOF = 6
    UNKNOWN_COMMAND = 7
    FILE_PROTECTED = 9
    FILE_NOT_FOUND = 10


class _RefusedError(Exception):
    def __init__(self, error: FtpError) -> None:
        super().__init__(error.name)
        self.error = error


class Packet(NamedTuple):
    """The payload of FILE_TRANSFER_PROTOCOL."""

    sequence: int
    session: int
    opcode: int
    size: int
    request_opcode: int
    burst_complete: int
    offset: int
    data: bytes

    def encode(self) -> bytes:
        """Encode it, padded to the payload's full length."""
        *head, data = self
        return (HEADER.pack(*head) + data).ljust(PAYLOAD_BYTES, b"\0")

    def answer(self, opcode: int, session: int, data: bytes) -> "Packet":
        """Return the answer to this request."""
        sequence = (self.sequence + 1) & 0xFFFF
        return Packet(sequence, session, opcode, len(data), self.opcode, 0, self.offset, data)


def decode_packet(payload: bytes) -> Packet:
    """Read a payload."""
    data_size = min(payload[4], MAX_DATA)
    fields = (*HEADER.unpack_from(payload), payload[HEADER.size : HEADER.size + data_size])
    return Packet._make(fields)


@dataclass(frozen=True, slots=True)
class _Session:
    client_id: int
    may_change: bool
    content: bytes


class FtpService(TransferService):
    """Files of one vehicle, by their absolute paths."""

    types = ("FILE_TRANSFER_PROTOCOL",)

    def __init__(self, files: Mapping[str, File]) -> None:
        super().__init__()
        self._files = dict(files)
        self._sessions: dict[int, _Session] = {}
        self._last: dict[int, tuple[Packet, Reply]] = {}

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer one request; a repeated request gets the same answer again."""
        packet = decode_packet(bytes(request.message.payload))
        known = self._last.get(request.client_id)
        if known is not None and known[0] == packet and packet.opcode != Opcode.BURST_READ_FILE:
            return [known[1]]
        try:
            if packet.opcode == Opcode.BURST_READ_FILE:
                content = self._content_from(request, packet)
                return self._start(packet.session, _burst(request, packet, content), now_us)
            answer = packet.answer(ACK, *self._carry_out(request, packet))
        except _RefusedError as refused:
            answer = packet.answer(NAK, packet.session, bytes([refused.error]))
        reply = _reply(request, answer)
        if request.client_id not in self._last and len(self._last) >= MAX_ANSWERS:
            self._last.pop(next(iter(self._last)))
        self._last[request.client_id] = (packet, reply)
        return [reply]

    def remove_client(self, client_id: int) -> None:
        """Close the sessions of a client that has gone."""
        self._last.pop(client_id, None)
        for number in [n for n, s in self._sessions.items() if s.client_id == client_id]:
            self._drop(number)

    def has_session(self, request: Request, packet: Packet) -> bool:
        """Return whether the session of a request is one of the client's own."""
        session = self._sessions.get(packet.session)
        return session is not None and session.client_id == request.client_id

    def _drop(self, number: int) -> None:
        self._sessions.pop(number)
        self._transfers.pop(number, None)

    def _carry_out(self, request: Request, packet: Packet) -> tuple[int, bytes]:
        """Carry out a request; return the session and the data of the answer."""
        session, data = packet.session, b""
        match packet.opcode:
            case Opcode.OPEN_FILE_RO:
                return self._open(request, packet)
            case Opcode.NONE:
                pass
            case Opcode.TERMINATE_SESSION:
                self._content(request, packet)
                self._drop(session)
            case Opcode.RESET_SESSIONS:
                # A client's reset must not close the files of others.
                self.remove_client(request.client_id)
            case Opcode.LIST_DIRECTORY:
                data = self._list(request, packet)
            case Opcode.READ_FILE:
                size = min(packet.size or MAX_DATA, MAX_DATA)
                data = self._content_from(request, packet)[:size]
            case Opcode.CALC_FILE_CRC32:
                data = struct.pack("<I", crc32(self._generate(*_path(packet), request)))
            case opcode:
                is_protected = opcode in WRITING
                error = FtpError.FILE_PROTECTED if is_protected else FtpError.UNKNOWN_COMMAND
                raise _RefusedError(error)
        return session, data

    def _open(self, request: Request, packet: Packet) -> tuple[int, bytes]:
        """Open a session, under the number of the request if that is free.

        The server chooses the number [1]_, but MAVProxy ignores answers whose number differs from
        that of its request.
        """
        content = self._generate(*_path(packet), request)
        self._make_room(request)
        number = packet.session
        if number in self._sessions or number >= MAX_SESSIONS:
            number = next(n for n in range(MAX_SESSIONS) if n not in self._sessions)
        self._sessions[number] = _Session(request.client_id, request.may_change, content)
        return number, struct.pack("<I", len(content))

    def _make_room(self, request: Request) -> None:
        """Close a session if there are too many: its own, or for a trusted one another."""
        own = [n for n, s in self._sessions.items() if s.client_id == request.client_id]
        if len(own) >= MAX_SESSIONS_OF_ONE:
            self._drop(own[0])
        if len(self._sessions) < MAX_SESSIONS:
            return
        untrusted = (n for n, s in self._sessions.items() if not s.may_change)
        oldest = next(untrusted, None) if request.may_change else None
        if oldest is None:
            raise _RefusedError(FtpError.NO_SESSIONS)
        self._drop(oldest)

    def _list(self, request: Request, packet: Packet) -> bytes:
        folder = _path(packet)[0].removesuffix("/") + "/"
        found = [path for path in sorted(self._files) if path.rpartition("/")[0] + "/" == folder]
        if not found:
            raise _RefusedError(FtpError.FILE_NOT_FOUND)
        data = b""
        for path in found[packet.offset :]:
            size = len(self._generate(path, "", request))
            entry = f"F{path.removeprefix(folder)}\t{size}\0".encode()
            if len(data) + len(entry) > MAX_DATA:
                break
            data += entry
        if not data:
            raise _RefusedError(FtpError.EOF)
        return data

    def _content(self, request: Request, packet: Packet) -> bytes:
        if not self.has_session(request, packet):
            raise _RefusedError(FtpError.INVALID_SESSION)
        return self._sessions[packet.session].content

    def _content_from(self, request: Request, packet: Packet) -> bytes:
        rest = self._content(request, packet)[packet.offset :]
        if not rest:
            raise _RefusedError(FtpError.EOF)
        return rest

    def _generate(self, path: str, query: str, request: Request) -> bytes:
        file = self._files.get(path)
        if file is None:
            raise _RefusedError(FtpError.FILE_NOT_FOUND)
        return file if isinstance(file, bytes) else file(request, query)


def _burst(request: Request, packet: Packet, content: bytes) -> Iterator[Reply]:
    """Build the packets of a burst with the rest of the content."""
    size = min(max(packet.size or MAX_DATA, MIN_BURST_DATA), MAX_DATA)
    for number, start in enumerate(range(0, len(content), size)):
        asked = packet._replace(sequence=packet.sequence + number, offset=packet.offset + start)
        answer = asked.answer(ACK, packet.session, content[start : start + size])
        yield _reply(request, answer._replace(burst_complete=start + size >= len(content)))


def crc32(content: bytes) -> int:
    """Compute the CRC-32 of MAVLink FTP: no initial value, no final inversion."""
    return ~binascii.crc32(content, 0xFFFFFFFF) & 0xFFFFFFFF


def _path(packet: Packet) -> tuple[str, str]:
    """Read a path, in any spelling of a client, and the query after it.

    For `mftp:///general.json` QGroundControl sends `//general.json`; MAVSDK sends it without a
    slash or as a URI with the component; MAVProxy lists `/`, an empty path or `.`.
    """
    text = packet.data.split(b"\0", 1)[0].decode("utf-8", "replace")
    path, _, query = _SCHEME.sub("", text.strip()).partition("?")
    return "/" + "/".join(part for part in path.split("/") if part not in ("", ".")), query


def full_path(packet: Packet) -> str:
    """Return the path of a request, with the query after it."""
    return "?".join(filter(None, _path(packet)))


def _reply(request: Request, packet: Packet) -> Reply:
    message = mavlink.MAVLink_file_transfer_protocol_message(
        0, request.system_id, request.component_id, packet.encode()
    )
    return request.reply(message)
