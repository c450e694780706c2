"""The parameters of an aircraft over MAVLink, and their metadata, read by MAVLink FTP.

References
----------
.. [1] https://mavlink.io/en/services/ftp.html
"""

import json
import lzma
import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import msgspec
import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle.services.ftp import ACK, MAX_DATA, NAK, FtpError, Opcode, Packet, decode_packet
from gateway.vehicle.services.parameters import INTEGER_CODES, decode_value

RETRY_US: Final = US_PER_S // 2
"""Timeout of the first attempt; it doubles with each further one."""
MAX_READS: Final = 6
"""Maximum attempts: half a minute, the length of a radio outage."""
MAX_FILE: Final = 4_000_000
"""Maximum bytes of a file: metadata of the largest autopilots has 2 MB."""
GENERAL_PATHS: Final = ("/general.json", "/etc/extras/component_general.json.xz")
"""Default paths of the general metadata file."""
TYPE_PARAMETER: Final = 1
MAX_PLAIN: Final = 16_000_000
"""Maximum bytes of an unpacked metadata file, against decompression bombs."""
RENAMED: Final = {
    "short": "shortDesc", "long": "longDesc", "unit": "units", "low": "min", "high": "max",
    "choices": "values",
}  # fmt: skip
QUIET_US: Final = US_PER_S
MISSING_AT_ONCE: Final = 20
MAX_ATTEMPTS: Final = 5
MAX_PARAMETERS: Final = 5000
"""Maximum parameters: large autopilots have some 1500; more are forged."""
NOT_REQUESTED: Final = 65_535
"""The index of a value that was not requested by its index."""
AUTOPILOT: Final = mavlink.MAV_COMP_ID_AUTOPILOT1
ERRORS: Final = {
    mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST: "there is no such parameter",
    mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE: "the value is out of range",
    mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED: "this client may not change parameters",
    mavlink.MAV_PARAM_ERROR_READ_ONLY: "it is read-only",
}


class FileClient:
    """Read a file of one vehicle, one at a time."""

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self.content: bytes | None = None
        """The last file; None while it is read, or if it cannot be read."""
        self._read = bytearray()
        self._session: int | None = None
        self._size = 0
        self._sequence = 0
        self._request: Packet | None = None
        self._attempts = 0
        self._due_us = 0

    @property
    def busy(self) -> bool:
        """Whether a file is being read."""
        return self._request is not None

    def read(self, path: str, now_us: int) -> list[Any]:
        """Start reading a file; return the messages to send."""
        self.content, self._read, self._session = None, bytearray(), None
        return self._ask(Opcode.OPEN_FILE_RO, 0, 0, path.encode(), now_us)

    def handle(self, message: Any, now_us: int) -> list[Any]:
        """Handle one message of the vehicle; return the messages to send."""
        if message.get_type() != "FILE_TRANSFER_PROTOCOL" or self._request is None:
            return []
        packet = decode_packet(bytes(message.payload))
        expected = (self._request.sequence + 1) & 0xFFFF, self._request.opcode
        if (packet.sequence, packet.request_opcode) != expected:
            return []
        if packet.opcode == ACK:
            return self._on_ack(packet, now_us)
        ended = packet.data[:1] == bytes([FtpError.EOF]) and self._session is not None
        return self._end(now_us, read=ended) if packet.opcode == NAK else []

    def poll(self, now_us: int) -> list[Any]:
        """Repeat a request, or give up; return the messages to send."""
        if self._request is None or now_us < self._due_us:
            return []
        if self._attempts >= MAX_READS:
            return self._end(now_us, read=False)
        self._due_us = now_us + (RETRY_US << self._attempts)
        self._attempts += 1
        return [self._message(self._request)]

    def _on_ack(self, packet: Packet, now_us: int) -> list[Any]:
        have = self._read
        if packet.request_opcode == Opcode.OPEN_FILE_RO:
            self._session = packet.session
            self._size = struct.unpack("<I", packet.data.ljust(4, b"\0")[:4])[0]
            if self._size > MAX_FILE:
                return self._end(now_us, read=False)
        elif packet.request_opcode == Opcode.READ_FILE:
            if packet.offset == len(have):
                have += packet.data
            if not packet.data:
                return self._end(now_us, read=False)
        if len(have) >= self._size:
            return self._end(now_us, read=True)
        size = min(MAX_DATA, self._size - len(have))
        return self._ask(Opcode.READ_FILE, self._session or 0, len(have), b"", now_us, size=size)

    def _end(self, now_us: int, *, read: bool) -> list[Any]:
        self.content = bytes(self._read) if read else None
        found = []
        if self._session is not None:
            found = self._ask(Opcode.TERMINATE_SESSION, self._session, 0, b"", now_us)
        # Not repeated if it is lost: the server closes old sessions by itself.
        self._request = None
        return found

    def _ask(
        self, opcode: Opcode, session: int, offset: int, data: bytes, now_us: int, *, size: int = 0
    ) -> list[Any]:
        self._sequence = (self._sequence + 2) & 0xFFFF
        self._request = Packet(
            self._sequence, session, opcode, size or len(data), 0, 0, offset, data
        )
        self._attempts, self._due_us = 1, now_us + RETRY_US
        return [self._message(self._request)]

    def _message(self, packet: Packet) -> Any:
        return mavlink.MAVLink_file_transfer_protocol_message(
            0, self.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, packet.encode()
        )


class ParameterChoice(msgspec.Struct, frozen=True):
    """One value of a parameter, and its meaning."""

    value: float
    description: str = ""


class ParameterMeta(msgspec.Struct, frozen=True, kw_only=True, rename=RENAMED):
    """Metadata of one parameter, under the names of MAVLink's parameter metadata."""

    name: str
    group: str = ""
    category: str = ""
    short: str = ""
    long: str = ""
    unit: str = ""
    default: float = NAN
    low: float = NAN
    high: float = NAN
    choices: tuple[ParameterChoice, ...] = ()
    """The allowed values; empty allows any number."""


def parameter_path(general: bytes) -> str | None:
    """Return the path of the parameters' file on the vehicle, from the general file."""
    for kind in _items(_parsed(general), "metadataTypes"):
        uri = str(kind.get("uri", ""))
        if kind.get("type") == TYPE_PARAMETER and uri.startswith("mftp://"):
            path = "/" + uri.removeprefix("mftp://").lstrip("/")
            return None if path in GENERAL_PATHS else path
    return None


def parse_parameters(content: bytes) -> dict[str, ParameterMeta]:
    """Read a parameters' file; unreadable entries are left out."""
    found: dict[str, ParameterMeta] = {}
    for item in _items(_parsed(content), "parameters"):
        with suppress(msgspec.ValidationError):
            meta = msgspec.convert(item, ParameterMeta)
            found[meta.name] = meta
    return found


def _parsed(content: bytes) -> Any:
    try:
        if content[:6] == b"\xfd7zXZ\0":
            content = lzma.LZMADecompressor().decompress(content, MAX_PLAIN)
        return json.loads(content)
    except (ValueError, RecursionError, lzma.LZMAError):
        return {}


def _items(tree: Any, key: str) -> list[Mapping[str, Any]]:
    items = tree.get(key, []) if isinstance(tree, dict) else []
    return [item for item in items if isinstance(item, dict)] if isinstance(items, list) else []


class ListState(StrEnum):
    """Progress of the list."""

    UNKNOWN = "unknown"
    LOADING = "loading"
    COMPLETE = "complete"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class ParameterEntry:
    """One parameter as the vehicle sent it."""

    name: str
    value: float
    kind: int
    """MAV_PARAM_TYPE."""
    index: int


@dataclass(slots=True)
class _Change:
    value: float
    due_us: int
    attempts: int = 1
    newer: float | None = None
    """The value to send once this one is answered."""


def is_same_value(value: float, other: float) -> bool:
    """Compare with the precision of a transmitted parameter, which has 32 bits."""
    return math.isclose(value, other, rel_tol=1e-6, abs_tol=1e-12)


class ParameterClient:
    """Parameters of one vehicle."""

    def __init__(self, system_id: int) -> None:
        self.system_id = system_id
        self.state = ListState.UNKNOWN
        self.count = 0
        """Number of parameters, as reported by the vehicle."""
        self.entries: dict[str, ParameterEntry] = {}
        self.refused: dict[str, str] = {}
        """The reasons why last changes failed, by parameter, until it is changed again."""
        self.bytewise = False
        """Whether integers are encoded byte-wise (PX4) and not as numbers (ArduPilot)."""
        self._indices: set[int] = set()
        self._changes: dict[str, _Change] = {}
        self._attempts = 0
        self._due_us: int | None = None

    @property
    def pending(self) -> frozenset[str]:
        """Names of changed parameters that are not confirmed yet."""
        return frozenset(self._changes)

    @property
    def values(self) -> dict[str, float]:
        """The values by name."""
        return {name: entry.value for name, entry in self.entries.items()}

    def load(self, now_us: int) -> list[Any]:
        """Request all parameters; return the messages to send."""
        self.state, self._attempts = ListState.LOADING, 0
        self._due_us = now_us + QUIET_US
        return [mavlink.MAVLink_param_request_list_message(self.system_id, AUTOPILOT)]

    def change(self, name: str, value: float, now_us: int) -> list[Any]:
        """Set a parameter; return the messages to send now, none until its last change is answered.

        Raises ValueError if there is no such parameter, or the value is not a number that fits.
        """
        entry = self.entries.get(name)
        if entry is None:
            raise ValueError(f"aircraft {self.system_id} has no parameter {name}")
        if not math.isfinite(value):
            raise ValueError(f"{name}: {value} is not a number")
        message = self._set_message(entry, value)
        self.refused.pop(name, None)
        if (unanswered := self._changes.get(name)) is not None:
            unanswered.newer = value
            return []
        self._changes[name] = _Change(value, now_us + QUIET_US)
        return [message]

    def handle(self, message: Any, now_us: int) -> None:
        """Handle one message of the vehicle; others than those about parameters are ignored."""
        match message.get_type():
            case "PARAM_VALUE":
                self._handle_value(message, now_us)
            case "PARAM_ERROR":
                name = message.param_id
                if self._answered(name, now_us) is not None:
                    self.refused[name] = ERRORS.get(message.error, f"error {message.error}")
            case "AUTOPILOT_VERSION":
                bytewise = mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
                self.bytewise = bool(message.capabilities & bytewise)
            case "HEARTBEAT":
                self.bytewise |= message.autopilot == mavlink.MAV_AUTOPILOT_PX4

    def poll(self, now_us: int) -> list[Any]:
        """Repeat requests without an answer; return the messages to send."""
        return self._poll_list(now_us) + self._poll_changes(now_us)

    def _handle_value(self, message: Any, now_us: int) -> None:
        name, kind = message.param_id, message.param_type
        if name not in self.entries and len(self.entries) >= MAX_PARAMETERS:
            return
        value = self._decoded(message.param_value, kind)
        known = self.entries.get(name)
        index = message.param_index
        if index == NOT_REQUESTED and known is not None:
            index = known.index
        self.entries[name] = ParameterEntry(name, value, kind, index)
        if index != NOT_REQUESTED:
            self._indices.add(index)
        self.count = min(message.param_count, MAX_PARAMETERS) or self.count
        wanted = self._answered(name, now_us)
        if wanted is not None and not is_same_value(value, wanted):
            self.refused[name] = f"the aircraft keeps {value:g}"
        if self.state is ListState.LOADING:
            self._due_us = now_us + QUIET_US
            if len(self._indices) >= self.count:
                self.state, self._due_us = ListState.COMPLETE, None

    def _answered(self, name: str, now_us: int) -> float | None:
        """Return the answered value; None if no answer was due or a newer value follows."""
        change = self._changes.pop(name, None)
        if change is None:
            return None
        if change.newer is None:
            return change.value
        self._changes[name] = _Change(change.newer, now_us, attempts=0)
        return None

    def _poll_list(self, now_us: int) -> list[Any]:
        if self._due_us is None or now_us < self._due_us:
            return []
        self._attempts += 1
        self._due_us = now_us + QUIET_US
        if self._attempts > MAX_ATTEMPTS + self.count // MISSING_AT_ONCE:
            self.state, self._due_us = ListState.FAILED, None
            return []
        if not self.count:
            return [mavlink.MAVLink_param_request_list_message(self.system_id, AUTOPILOT)]
        missing = [n for n in range(self.count) if n not in self._indices][:MISSING_AT_ONCE]
        return [
            mavlink.MAVLink_param_request_read_message(self.system_id, AUTOPILOT, b"", index)
            for index in missing
        ]

    def _poll_changes(self, now_us: int) -> list[Any]:
        found = []
        for name, change in list(self._changes.items()):
            if now_us < change.due_us:
                continue
            if change.attempts >= MAX_ATTEMPTS:
                del self._changes[name]
                self.refused[name] = "no answer"
                continue
            if change.newer is not None:
                change.value, change.newer = change.newer, None
            change.attempts += 1
            change.due_us = now_us + QUIET_US
            try:
                found.append(self._set_message(self.entries[name], change.value))
            except ValueError as error:
                # The vehicle has reported another type since.
                del self._changes[name]
                self.refused[name] = str(error)
        return found

    def _decoded(self, value: float, kind: int) -> float:
        if self.bytewise:
            return decode_value(value, kind)
        # Adding zero removes the sign of a negative zero.
        return float(str(np.float32(value))) + 0.0

    def _set_message(self, entry: ParameterEntry, value: float) -> Any:
        code = INTEGER_CODES.get(entry.kind) if self.bytewise else None
        try:
            packed = struct.pack(code, round(value)) if code else struct.pack("<f", value)
        except (struct.error, OverflowError):
            raise ValueError(f"{entry.name} cannot hold {value:g}") from None
        value = struct.unpack("<f", packed)[0]
        return mavlink.MAVLink_param_set_message(
            self.system_id, AUTOPILOT, entry.name.encode(), value, entry.kind
        )
