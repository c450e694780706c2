"""Client of MAVLink FTP, for reading one small file after the other.

References
----------
.. [1] https://mavlink.io/en/services/ftp.html
"""

import struct
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle.services.ftp import ACK, MAX_DATA, NAK, FtpError, Opcode, Packet, decode_packet

RETRY_US: Final = US_PER_S // 2
"""After the first attempt, and twice as long after each further one."""
MAX_ATTEMPTS: Final = 6
"""Half a minute: a radio link may be silent for so long."""
MAX_FILE: Final = 4_000_000
"""Metadata of the largest autopilots has two; more is refused."""


@dataclass(slots=True)
class _Reading:
    path: str
    session: int | None = None
    size: int = 0
    content: bytearray = field(default_factory=bytearray)


class FileClient:
    """Read files of one vehicle; results are in `files` and `refused`.

    Parameters
    ----------
    system_id : int
        Whose.
    """

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self.files: dict[str, bytes] = {}
        self.refused: set[str] = set()
        """Files that do not exist, or could not be read."""
        self._wanted: list[str] = []
        self._reading: _Reading | None = None
        self._sequence = 0
        self._asked: Packet | None = None
        self._attempts = 0
        self._due_us = 0

    @property
    def busy(self) -> bool:
        """Whether a file is being read."""
        return self._reading is not None

    def read(self, path: str, now_us: int) -> list[Any]:
        """Start reading a file, or queue it; return the messages to send."""
        self._wanted.append(path)
        return [] if self.busy else self._next(now_us)

    def take(self, message: Any, now_us: int) -> list[Any]:
        """Process one message of the vehicle; return the messages to send."""
        if message.get_type() != "FILE_TRANSFER_PROTOCOL" or self._asked is None:
            return []
        packet = decode_packet(bytes(message.payload))
        if packet.sequence != (self._asked.sequence + 1) & 0xFFFF:
            return []
        if packet.request_opcode != self._asked.opcode or self._reading is None:
            return []
        if packet.opcode == ACK:
            return self._on_ack(self._reading, packet, now_us)
        ended = packet.data[:1] == bytes([FtpError.EOF]) and self._reading.session is not None
        return self._end(now_us, read=ended) if packet.opcode == NAK else []

    def poll(self, now_us: int) -> list[Any]:
        """Repeat a request, or give up; return the messages to send."""
        if self._asked is None or now_us < self._due_us:
            return []
        if self._attempts >= MAX_ATTEMPTS:
            return self._end(now_us, read=False)
        self._due_us = now_us + (RETRY_US << self._attempts)
        self._attempts += 1
        return [self._message(self._asked)]

    def _on_ack(self, reading: _Reading, packet: Packet, now_us: int) -> list[Any]:
        if packet.request_opcode == Opcode.OPEN_FILE_RO:
            reading.session = packet.session
            reading.size = struct.unpack("<I", packet.data.ljust(4, b"\0")[:4])[0]
            if reading.size > MAX_FILE:
                return self._end(now_us, read=False)
        elif packet.request_opcode == Opcode.READ_FILE:
            if packet.offset == len(reading.content):
                reading.content += packet.data
            if not packet.data:
                return self._end(now_us, read=False)
        if len(reading.content) >= reading.size:
            return self._end(now_us, read=True)
        offset, session = len(reading.content), reading.session or 0
        size = min(MAX_DATA, reading.size - offset)
        return self._ask(Opcode.READ_FILE, session, offset, b"", now_us, size=size)

    def _end(self, now_us: int, *, read: bool) -> list[Any]:
        reading, self._reading, self._asked = self._reading, None, None
        found: list[Any] = []
        if reading is not None:
            if read:
                self.files[reading.path] = bytes(reading.content)
            else:
                self.refused.add(reading.path)
            if reading.session is not None:
                found += self._ask(Opcode.TERMINATE_SESSION, reading.session, 0, b"", now_us)
                # Whether it arrived does not matter: the server makes room by itself.
                self._asked = None
        return found + self._next(now_us)

    def _next(self, now_us: int) -> list[Any]:
        if not self._wanted:
            return []
        path = self._wanted.pop(0)
        self._reading = _Reading(path)
        return self._ask(Opcode.OPEN_FILE_RO, 0, 0, path.encode(), now_us)

    def _ask(
        self, opcode: Opcode, session: int, offset: int, data: bytes, now_us: int, *, size: int = 0
    ) -> list[Any]:
        self._sequence = (self._sequence + 2) & 0xFFFF
        self._asked = Packet(self._sequence, session, opcode, size or len(data), 0, 0, offset, data)
        self._attempts, self._due_us = 1, now_us + RETRY_US
        return [self._message(self._asked)]

    def _message(self, packet: Packet) -> Any:
        return mavlink.MAVLink_file_transfer_protocol_message(
            0, self.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, packet.encode()
        )
