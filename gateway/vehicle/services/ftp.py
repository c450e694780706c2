"""MAVLink FTP, for reading only: the component metadata and the packed parameters.

Everything else is refused with the protocol's own error, with the session, the sequence number and
the opcode of the request echoed: a client that gets a proper refusal goes on at once, one that
gets none retries for a quarter of a minute.

References
----------
.. [1] https://mavlink.io/en/services/ftp.html
"""

import binascii
import re
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.requests import Answer, Reply, Request

HEADER: Final = struct.Struct("<HBBBBBxI")
PAYLOAD_BYTES: Final = 251
MAX_DATA: Final = PAYLOAD_BYTES - HEADER.size
MAX_SESSIONS: Final = 255
MAX_SESSIONS_OF_ONE: Final = 4
"""A client reads one file after the other; its oldest session gives way, and nobody else's."""
MAX_ANSWERS: Final = 512
"""Clients whose last answer is kept."""
BURST: Final = 10
BURST_INTERVAL_US: Final = 10_000
"""Between batches of this many packets, for all clients together."""
MIN_BURST_DATA: Final = 64
"""A burst of single bytes would cost both sides sixty times as much."""

ACK: Final = 128
_SCHEME: Final = re.compile(r"mftp://(?:\[?;comp=\d+\]?)?", re.IGNORECASE)
"""The part before the path in a URI of the component metadata."""
NAK: Final = 129


class Opcode(IntEnum):
    """The requests of the protocol."""

    NONE = 0
    TERMINATE_SESSION = 1
    RESET_SESSIONS = 2
    LIST_DIRECTORY = 3
    OPEN_FILE_RO = 4
    READ_FILE = 5
    CREATE_FILE = 6
    WRITE_FILE = 7
    REMOVE_FILE = 8
    CREATE_DIRECTORY = 9
    REMOVE_DIRECTORY = 10
    OPEN_FILE_WO = 11
    TRUNCATE_FILE = 12
    RENAME = 13
    CALC_FILE_CRC32 = 14
    BURST_READ_FILE = 15


WRITING: Final = frozenset(
    {
        Opcode.CREATE_FILE,
        Opcode.WRITE_FILE,
        Opcode.REMOVE_FILE,
        Opcode.CREATE_DIRECTORY,
        Opcode.REMOVE_DIRECTORY,
        Opcode.OPEN_FILE_WO,
        Opcode.TRUNCATE_FILE,
        Opcode.RENAME,
    }
)


class FtpError(IntEnum):
    """Why a request is refused."""

    INVALID_DATA_SIZE = 3
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


@dataclass(frozen=True, slots=True)
class Packet:
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
        """Lay it out, padded to the payload's full length."""
        head = HEADER.pack(
            self.sequence,
            self.session,
            self.opcode,
            self.size,
            self.request_opcode,
            self.burst_complete,
            self.offset,
        )
        return (head + self.data).ljust(PAYLOAD_BYTES, b"\0")


def decode_packet(payload: bytes) -> Packet:
    """Read a payload."""
    *head, offset = HEADER.unpack_from(payload)
    size = min(head[3], MAX_DATA)
    data = payload[HEADER.size : HEADER.size + size]
    return Packet(head[0], head[1], head[2], head[3], head[4], head[5], offset, data)


@dataclass(slots=True)
class _Session:
    client_id: int
    may_change: bool
    content: bytes


@dataclass(slots=True)
class _Burst:
    request: Request
    packet: Packet
    """The next packet's sequence and offset, and the size that the client requested."""


FileMaker = Callable[[Request, str], bytes]


class FtpService:
    """Files of one vehicle, generated each time they are opened.

    Parameters
    ----------
    files : mapping of str to callable
        Absolute paths, and the functions that generate their content from the request and the
        query of its path, such as `start=50&count=10`.
    """

    types = ("FILE_TRANSFER_PROTOCOL",)

    def __init__(self, files: Mapping[str, FileMaker]) -> None:
        self._files = dict(files)
        self._sessions: dict[int, _Session] = {}
        self._bursts: dict[int, _Burst] = {}
        """By session; whose turn it is comes first."""
        self._due_us = 0
        self._last: dict[int, tuple[Packet, Reply]] = {}
        self._handlers: dict[int, Callable[[Request, Packet], bytes]] = {
            Opcode.NONE: lambda *_: b"",
            Opcode.TERMINATE_SESSION: self._terminate,
            Opcode.RESET_SESSIONS: self._reset,
            Opcode.LIST_DIRECTORY: self._list,
            Opcode.READ_FILE: self._read,
            Opcode.CALC_FILE_CRC32: self._crc32,
        }

    def changes_state(self, _request: Request) -> bool:
        """Return False: files can only be read."""
        return False

    def refuse(self, _request: Request) -> list[Answer]:
        """Return no answer; never called."""
        return []

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer one request; a repeated request gets the same answer again."""
        packet = decode_packet(bytes(request.message.payload))
        known = self._last.get(request.client_id)
        if known is not None and known[0] == packet and packet.opcode != Opcode.BURST_READ_FILE:
            return [known[1]]
        try:
            if packet.opcode == Opcode.BURST_READ_FILE:
                return self._begin_burst(request, packet, now_us)
            answer = _answer(packet, ACK, *self._carry_out(request, packet))
        except _RefusedError as refused:
            answer = _answer(packet, NAK, packet.session, bytes([refused.error]))
        reply = _reply(request, answer)
        self._keep_answer(request.client_id, packet, reply)
        return [reply]

    def poll(self, now_us: int) -> list[Answer]:
        """Send the next packets of the bursts, in turn."""
        if not self._bursts or now_us < self._due_us:
            return []
        answers: list[Answer] = []
        while self._bursts and len(answers) < BURST:
            answers.append(self._continue_burst(next(iter(self._bursts))))
        self._due_us = now_us + BURST_INTERVAL_US
        return answers

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self._bursts else None

    def remove_client(self, client_id: int) -> None:
        """Close the sessions of a client that has gone."""
        self._last.pop(client_id, None)
        for number in [n for n, s in self._sessions.items() if s.client_id == client_id]:
            self._drop(number)

    def _drop(self, number: int) -> None:
        self._sessions.pop(number)
        self._bursts.pop(number, None)

    def _carry_out(self, request: Request, packet: Packet) -> tuple[int, bytes]:
        """Carry out a request; return the session and the data of the answer."""
        if packet.opcode == Opcode.OPEN_FILE_RO:
            return self._open(request, packet)
        if packet.opcode in WRITING:
            raise _RefusedError(FtpError.FILE_PROTECTED)
        handler = self._handlers.get(packet.opcode)
        if handler is None:
            raise _RefusedError(FtpError.UNKNOWN_COMMAND)
        return packet.session, handler(request, packet)

    def _open(self, request: Request, packet: Packet) -> tuple[int, bytes]:
        """Open a session, under the number of the request if that is free.

        The server chooses the number [1]_, but MAVProxy ignores answers with another than its own.
        """
        content = self._content(request, packet)
        self._make_room(request)
        number = packet.session
        if number in self._sessions or number >= MAX_SESSIONS:
            number = next(n for n in range(MAX_SESSIONS) if n not in self._sessions)
        self._sessions[number] = _Session(request.client_id, request.may_change, content)
        return number, struct.pack("<I", len(content))

    def _make_room(self, request: Request) -> None:
        """Close a session left open: the client's own, or for a trusted client an untrusted one."""
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

    def _terminate(self, request: Request, packet: Packet) -> bytes:
        self._session(request, packet)
        self._drop(packet.session)
        return b""

    def _reset(self, request: Request, _packet: Packet) -> bytes:
        # One client's reset must not close another's files.
        self.remove_client(request.client_id)
        return b""

    def _list(self, request: Request, packet: Packet) -> bytes:
        folder = _path(packet)[0].removesuffix("/") + "/"
        found = [path for path in sorted(self._files) if path.rpartition("/")[0] + "/" == folder]
        if not found:
            raise _RefusedError(FtpError.FILE_NOT_FOUND)
        data = b""
        for path in found[packet.offset :]:
            size = len(self._files[path](request, ""))
            entry = f"F{path.removeprefix(folder)}\t{size}\0".encode()
            if len(data) + len(entry) > MAX_DATA:
                break
            data += entry
        if not data:
            raise _RefusedError(FtpError.EOF)
        return data

    def _read(self, request: Request, packet: Packet) -> bytes:
        content = self._session(request, packet).content
        if packet.offset >= len(content):
            raise _RefusedError(FtpError.EOF)
        size = min(packet.size or MAX_DATA, MAX_DATA)
        return content[packet.offset : packet.offset + size]

    def _crc32(self, request: Request, packet: Packet) -> bytes:
        return struct.pack("<I", crc32(self._content(request, packet)))

    def _begin_burst(self, request: Request, packet: Packet, now_us: int) -> list[Answer]:
        content = self._session(request, packet).content
        if packet.offset >= len(content):
            raise _RefusedError(FtpError.EOF)
        first = replace(packet, sequence=(packet.sequence + 1) & 0xFFFF)
        self._bursts[packet.session] = _Burst(request, first)
        return self.poll(now_us)

    def _continue_burst(self, number: int) -> Reply:
        """Build the next packet of a burst, which then queues behind the others."""
        burst = self._bursts.pop(number)
        content, packet = self._sessions[number].content, burst.packet
        size = min(max(packet.size or MAX_DATA, MIN_BURST_DATA), MAX_DATA)
        data = content[packet.offset : packet.offset + size]
        end = packet.offset + len(data)
        last = end >= len(content)
        if not last:
            burst.packet = replace(packet, sequence=(packet.sequence + 1) & 0xFFFF, offset=end)
            self._bursts[number] = burst
        return _reply(
            burst.request,
            Packet(
                packet.sequence, number, ACK, len(data), packet.opcode, last, packet.offset, data
            ),
        )

    def _session(self, request: Request, packet: Packet) -> _Session:
        session = self._sessions.get(packet.session)
        if session is None or session.client_id != request.client_id:
            raise _RefusedError(FtpError.INVALID_SESSION)
        return session

    def _content(self, request: Request, packet: Packet) -> bytes:
        path, query = _path(packet)
        make = self._files.get(path)
        if make is None:
            raise _RefusedError(FtpError.FILE_NOT_FOUND)
        return make(request, query)

    def _keep_answer(self, client_id: int, packet: Packet, reply: Reply) -> None:
        if client_id not in self._last and len(self._last) >= MAX_ANSWERS:
            self._last.pop(next(iter(self._last)))
        self._last[client_id] = (packet, reply)


def crc32(content: bytes) -> int:
    """Compute the CRC-32 of MAVLink FTP: no initial value, no final inversion."""
    return ~binascii.crc32(content, 0xFFFFFFFF) & 0xFFFFFFFF


def _path(packet: Packet) -> tuple[str, str]:
    """Read a path, however the client writes it, and the query behind it.

    QGroundControl makes `//general.json` of `mftp:///general.json`, MAVSDK sends it without a
    slash or as a URI with the component, MAVProxy lists `/`, an empty path or `.`.
    """
    text = packet.data.split(b"\0", 1)[0].decode("utf-8", "replace")
    path, _, query = _SCHEME.sub("", text.strip()).partition("?")
    return "/" + "/".join(part for part in path.split("/") if part not in ("", ".")), query


def _answer(packet: Packet, opcode: int, session: int, data: bytes) -> Packet:
    sequence = (packet.sequence + 1) & 0xFFFF
    return Packet(sequence, session, opcode, len(data), packet.opcode, 0, packet.offset, data)


def _reply(request: Request, packet: Packet) -> Reply:
    message = mavlink.MAVLink_file_transfer_protocol_message(
        0, request.system_id, request.component_id, packet.encode()
    )
    return request.reply(message)
