"""Frames of clients to checked requests, the actions that answer them, and a log of failed ones.

Invalid frames are counted and dropped. Equal failed requests share one log entry with a count, for
`mavgate status --requests`; the entries are bounded, and the oldest gives way.
"""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval, Incoming, LoggedRequest, Outgoing
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Settings
from gateway.vehicle.encoding import AUTOPILOT_COMPONENT
from gateway.vehicle.plan import StoredPlan
from gateway.wire.mavlink_signing import Verifier
from gateway.wire.mavlink_splitter import SIGNED, START_V2


class Reply(msgspec.Struct, frozen=True, gc=False):
    """A message before it is encoded: to the client that asked, or to all."""

    message: Any
    client_id: int | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """One checked message of a client to this vehicle."""

    client_id: int
    system_id: int
    component_id: int
    message: Any
    may_change: bool
    """Whether the client may change state: trusted, and signed where a key is set."""
    reason: str = ""
    """Why it may not, and the remedy."""
    is_rejected: bool = False
    """Whether its signature is wrong, so that it is not handled at all."""

    def reply(self, message: Any) -> Reply:
        """Answer the client that asked."""
        return Reply(message, self.client_id)


CRITICAL: Final = mavlink.MAV_SEVERITY_CRITICAL
WARNING: Final = mavlink.MAV_SEVERITY_WARNING
NOTICE: Final = mavlink.MAV_SEVERITY_NOTICE
INFO: Final = mavlink.MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text and its severity."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class SettingsChange:
    """A section of this vehicle's settings has a new, already checked value: apply it live."""

    section: str
    """Key of the section, as it was given to the vehicle."""
    settings: Settings


@dataclass(frozen=True, slots=True)
class SaveSettings:
    """Store what differs from the settings file, and report the outcome to the vehicle."""

    vehicle_id: int
    request: Request
    """Who waits for the outcome."""


@dataclass(frozen=True, slots=True)
class SavePlan:
    """Keep missions, mark and home for the next start."""

    vehicle_id: int
    plan: StoredPlan


@dataclass(frozen=True, slots=True)
class RecordingRequest:
    """Start or stop the recording."""

    start: bool


@dataclass(frozen=True, slots=True)
class LogWarning:
    """Write a line to the log."""

    text: str


@dataclass(frozen=True, slots=True)
class CalibrationMeasured:
    """A calibration of the calibrated samples, which the aircraft's own is then joined with."""

    correction: NodeCalibration
    """In body axes; see `gateway.sensing.calibrating.corrected_by`."""


Action = (
    Outgoing
    | ClientInterval
    | SettingsChange
    | SaveSettings
    | SavePlan
    | RecordingRequest
    | LogWarning
    | CalibrationMeasured
)

Answer = Reply | Action


class Service:
    """One group of requests; by default it changes nothing and sends nothing by itself."""

    types: ClassVar[tuple[str, ...]] = ()
    """Names of the messages that it handles."""

    def changes_state(self, _request: Request) -> bool:
        """Return whether only a trusted client may send this request."""
        return False

    def handle(self, _request: Request, _now_us: int) -> list[Answer]:
        """Answer a request."""
        return []

    def refuse(self, _request: Request, _result: int) -> list[Answer]:
        """Answer a client that may not send this request; the result is a command's."""
        return []

    def poll(self, _now_us: int) -> list[Answer]:
        """Return what is due by time."""
        return []

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to do."""
        return None

    def remove_client(self, client_id: int) -> None:
        """Discard what was kept for a client that has gone."""


BATCH: Final = 10
BATCH_INTERVAL_US: Final = 10_000
"""Between batches of this many answers, for all transfers of a service together."""
MAX_TRANSFERS: Final = 512


class TransferService(Service):
    """A service that sends lists and files: a few answers at a time, each transfer in turn.

    That bounds the load of the gateway, and overflows neither a receive buffer nor a slow link.
    """

    def __init__(self) -> None:
        self._transfers: dict[int, Iterator[Answer]] = {}
        """The answers that are left of each; whose turn it is comes first."""
        self._due_us = 0

    def poll(self, now_us: int) -> list[Answer]:
        """Return the next answers of the transfers."""
        found: list[Answer] = []
        if not self._transfers or now_us < self._due_us:
            return found
        while self._transfers and len(found) < BATCH:
            key = next(iter(self._transfers))
            answers = self._transfers.pop(key)
            if (answer := next(answers, None)) is not None:
                found.append(answer)
                self._transfers[key] = answers
        self._due_us = now_us + BATCH_INTERVAL_US
        return found

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self._transfers else None

    def _start(self, key: int, answers: Iterator[Answer], now_us: int) -> list[Answer]:
        """Start a transfer, or start it again; return what is sent at once."""
        if key in self._transfers or len(self._transfers) < MAX_TRANSFERS:
            self._transfers[key] = answers
        return self.poll(now_us)


BROADCAST: Final = 0
BAD_SIGNATURE: Final = "bad signature"
NOT_TRUSTED: Final = "not trusted; set trusted=yes at its endpoint"
NOT_SIGNED: Final = "not signed; set the signing passphrase in the ground station"


class RequestReader:
    """Decode frames and check their sender and target."""

    def __init__(self, system_id: int) -> None:
        self.faults: Counter[str] = Counter()
        """Frames dropped, by reason."""
        self.verifier: Verifier | None = None
        """Checks signatures; with one, an unsigned client may only read."""
        self._system_id = system_id
        self._mav: Any = mavlink.MAVLink(None)

    def read(self, incoming: Incoming, now_us: int) -> Request | None:
        """Decode one whole frame; None if it is damaged, unknown, or for others."""
        frame = incoming.frame
        message = self._decode(frame)
        if isinstance(message, str):
            self.faults[message] += 1
            return None
        if not self._is_for_us(message):
            return None
        allowed, reason = incoming.trusted, "" if incoming.trusted else NOT_TRUSTED
        is_rejected = False
        if self.verifier is not None:
            signed = frame[0] == START_V2 and frame[2] & SIGNED
            if signed and (rejection := self.verifier.rejection(frame, now_us)):
                self.faults[BAD_SIGNATURE] += 1
                allowed, reason, is_rejected = False, rejection, True
            if allowed and not signed:
                allowed, reason = False, NOT_SIGNED
        sender = (message.get_srcSystem(), message.get_srcComponent())
        return Request(incoming.client_id, *sender, message, allowed, reason, is_rejected)

    def _decode(self, frame: bytes) -> Any:
        """Decode a frame, or return what is wrong with it."""
        # An unknown incompatibility flag forbids reading on.
        if not frame or (frame[0] == START_V2 and frame[2:] and frame[2] & ~SIGNED):
            return "malformed"
        try:
            message = self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            return "broken"
        if message.get_type().startswith("UNKNOWN"):
            return "unknown"
        # Only the pair is ours: a companion computer shares the system id of its vehicle.
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._system_id, AUTOPILOT_COMPONENT):
            return "own id"
        return message

    def _is_for_us(self, message: Any) -> bool:
        system = getattr(message, "target_system", BROADCAST)
        component = getattr(message, "target_component", BROADCAST)
        is_ours = component in (BROADCAST, AUTOPILOT_COMPONENT)
        return is_ours and system in (BROADCAST, self._system_id)


MAX_ENTRIES: Final = 64
"""Kinds of requests that are kept; a client that sends random ones must not fill the memory."""

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_@/.? =-]")
_GOOD_RESULTS: Final = (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
_FTP_OPCODE, _FTP_DATA = 3, 12
_FTP_ENDS: Final = (mavlink.MAV_FTP_OPCODE_TERMINATESESSION, mavlink.MAV_FTP_OPCODE_RESETSESSION)
_CONTROL_NACKS: Final = {
    1: "wrong passkey",
    2: "unsupported passkey encryption",
    3: "under another's control",
}
UNANSWERED: Final = frozenset({"LOG_REQUEST_END", "COMMAND_ACK", "MISSION_ACK", "LOGGING_ACK"})
"""Messages to a vehicle to which the protocols have no answer."""


class RequestLog:
    """The failed requests to one vehicle."""

    def __init__(self, vehicle_id: int) -> None:
        self._vehicle_id = vehicle_id
        self._entries: dict[tuple[int, int, str, str], LoggedRequest] = {}

    @property
    def entries(self) -> tuple[LoggedRequest, ...]:
        """All entries, the newest last."""
        return tuple(self._entries.values())

    def add(self, request: Request, outcome: str, now_us: int) -> None:
        """Add a request that failed."""
        sender = (request.system_id, request.component_id)
        key = (*sender, describe(request.message), outcome)
        known = self._entries.pop(key, None)
        count = 1 if known is None else known.count + 1
        if len(self._entries) >= MAX_ENTRIES:
            self._entries.pop(next(iter(self._entries)))
        self._entries[key] = LoggedRequest(
            self._vehicle_id, *sender, key[2], outcome, count, now_us
        )

    def add_failed(self, request: Request, answers: list[Answer], now_us: int) -> None:
        """Add a request if one of its answers is negative."""
        for answer in answers:
            if isinstance(answer, Reply) and answer.client_id == request.client_id:
                outcome = failure_of(answer.message, request.message)
                if outcome is not None:
                    self.add(request, outcome, now_us)
                    return


def failure_of(message: Any, request: Any) -> str | None:
    """Return the reason in a negative answer; None for any other message.

    The end of a file or a list, and the end of a session that has ended already, are no failures.
    """
    match message.get_type():
        case "COMMAND_ACK" if message.result not in _GOOD_RESULTS:
            return _name("MAV_RESULT", message.result)
        case "MISSION_ACK" if message.type != mavlink.MAV_MISSION_ACCEPTED:
            return _name("MAV_MISSION_RESULT", message.type, "MAV_MISSION_")
        case "PARAM_ERROR":
            return _name("MAV_PARAM_ERROR", message.error)
        case "PARAM_EXT_ACK" if message.param_result != mavlink.PARAM_ACK_ACCEPTED:
            return _name("PARAM_ACK", message.param_result)
        case "CHANGE_OPERATOR_CONTROL_ACK" if message.ack:
            return _CONTROL_NACKS.get(message.ack, f"NACK {message.ack}")
        case "FILE_TRANSFER_PROTOCOL" if message.payload[_FTP_OPCODE] == mavlink.MAV_FTP_OPCODE_NAK:
            error, asked = message.payload[_FTP_DATA], request.payload[_FTP_OPCODE]
            if error != mavlink.MAV_FTP_ERR_EOF and asked not in _FTP_ENDS:
                return _name("MAV_FTP_ERR", error)
    return None


def describe(message: Any) -> str:
    """Describe a request by its message and its subject, in safe characters."""
    kind: str = message.get_type()
    subject = ""
    if kind in ("COMMAND_LONG", "COMMAND_INT"):
        subject = _name("MAV_CMD", message.command)
        if message.command in _ABOUT_MESSAGES:
            subject += f" {message.param1:.0f}"
    elif kind.startswith("PARAM_"):
        index = getattr(message, "param_index", -1)
        subject = getattr(message, "param_id", "") if index < 0 else str(index)
    elif kind == "FILE_TRANSFER_PROTOCOL":
        payload = bytes(message.payload)
        path = payload[_FTP_DATA : _FTP_DATA + payload[4]].partition(b"\0")[0]
        opcode = _name("MAV_FTP_OPCODE", payload[_FTP_OPCODE])
        subject = f"{opcode} {path.decode(errors='replace')}"
    return _UNSAFE.sub("?", f"{kind} {subject}".strip())


_ABOUT_MESSAGES: Final = (
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL,
)


def _name(enum: str, value: int, prefix: str | None = None) -> str:
    entry = mavlink.enums[enum].get(value)
    if entry is None:
        return str(value)
    return str(entry.name).removeprefix(f"{enum}_" if prefix is None else prefix)
