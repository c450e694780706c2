"""Frames of clients to checked requests, and the log of the requests that failed.

Invalid frames are counted and dropped. Equal failed requests share one log entry with a count, for
`mavgate status --requests`; the entries are bounded, and the oldest gives way.
"""

import re
from collections import Counter
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import Incoming, LoggedRequest
from gateway.vehicle.actions import Answer, Reply, Request
from gateway.vehicle.encoding import AUTOPILOT_COMPONENT
from gateway.vehicle.signing import Verifier

V1_START: Final = 0xFE
V2_START: Final = 0xFD
SIGNED: Final = 0x01
V1_OVERHEAD: Final = 8
V2_OVERHEAD: Final = 12
BROADCAST: Final = 0
BAD_SIGNATURE: Final = "bad signature"


class RequestReader:
    """Decode frames and check their sender and target.

    Parameters
    ----------
    system_id : int
        The target system of the requests.
    """

    def __init__(self, system_id: int) -> None:
        self.faults: Counter[str] = Counter()
        """Frames dropped, by reason."""
        self.verifier: Verifier | None = None
        """Checks signatures; with one, an unsigned client may only read."""
        self._system_id = system_id
        self._mav: Any = mavlink.MAVLink(None)

    def read(self, incoming: Incoming, now_us: int) -> Request | None:
        """Decode one whole frame.

        Parameters
        ----------
        incoming : Incoming
            MAVLink 1 or 2.
        now_us : int
            Gateway clock.

        Returns
        -------
        Request or None
            None if it is damaged, unknown, forged, or for another system.
        """
        frame = incoming.frame
        message = self._decode(frame)
        if isinstance(message, str):
            self.faults[message] += 1
            return None
        if not self._is_for_us(message):
            return None
        allowed = incoming.trusted
        if self.verifier is not None:
            signed = frame[0] == V2_START and frame[2] & SIGNED
            if signed and not self.verifier.accepts(frame, now_us):
                self.faults[BAD_SIGNATURE] += 1
                return None
            allowed = allowed and bool(signed)
        return Request(
            incoming.client_id,
            message.get_srcSystem(),
            message.get_srcComponent(),
            message,
            allowed,
        )

    def _decode(self, frame: bytes) -> Any:
        """Decode a frame, or return what is wrong with it."""
        if not _is_whole(frame):
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
        return system in (BROADCAST, self._system_id) and component in (
            BROADCAST,
            AUTOPILOT_COMPONENT,
        )


def _is_whole(frame: bytes) -> bool:
    if len(frame) < V1_OVERHEAD:
        return False
    if frame[0] == V1_START:
        return len(frame) == frame[1] + V1_OVERHEAD
    if frame[0] != V2_START or frame[2] & ~SIGNED:
        # An unknown incompatibility flag forbids reading on.
        return False
    signature = 13 if frame[2] & SIGNED else 0
    return len(frame) == frame[1] + V2_OVERHEAD + signature


MAX_ENTRIES: Final = 64
"""Kinds of requests that are kept; a client that sends random ones must not fill the memory."""

_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_@/.? =-]")
_GOOD_RESULTS: Final = (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
_FTP_NAK: Final = 129
_FTP_OPCODE, _FTP_DATA = 3, 12


class RequestLog:
    """The failed requests to one vehicle."""

    def __init__(self, vehicle_id: int) -> None:
        self._vehicle_id = vehicle_id
        self._entries: dict[tuple[int, int, str, str], LoggedRequest] = {}

    @property
    def entries(self) -> tuple[LoggedRequest, ...]:
        """All entries, the newest last."""
        return tuple(self._entries.values())

    def note(self, request: Request, outcome: str, now_us: int) -> None:
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

    def note_answers(self, request: Request, answers: list[Answer], now_us: int) -> None:
        """Add a request if one of its answers is negative."""
        for answer in answers:
            if isinstance(answer, Reply) and answer.client_id == request.client_id:
                outcome = failure_of(answer.message)
                if outcome is not None:
                    self.note(request, outcome, now_us)
                    return


def failure_of(message: Any) -> str | None:
    """Return the reason in a negative answer; None for any other message."""
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
            return f"NACK {message.ack}"
        case "FILE_TRANSFER_PROTOCOL" if message.payload[_FTP_OPCODE] == _FTP_NAK:
            return f"FTP error {message.payload[_FTP_DATA]}"
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
        subject = f"opcode {payload[_FTP_OPCODE]} {path.decode('ascii', 'replace')}"
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
