"""Requests that were refused, failed or had no answer, for `mavgate status --requests`.

Equal requests share one entry with a count. Entries are bounded; the oldest gives way.
"""

import re
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import LoggedRequest
from gateway.vehicle.actions import Answer, Reply, Request

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
