"""The failed requests to a vehicle, for `mavgate status --requests`.

Equal ones share an entry with a count; the number of entries is bounded, and the oldest is removed.
"""

import re
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import LoggedRequest
from gateway.vehicle.service import Answer, Reply, Request

MAX_ENTRIES: Final = 64
"""Maximum kinds of requests: a client that sends random ones must not fill the memory."""
_UNSAFE: Final = re.compile(r"[^A-Za-z0-9_@/.? =-]")
_GOOD_RESULTS: Final = (mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_IN_PROGRESS)
_FTP_OPCODE, _FTP_DATA = 3, 12
_FTP_ENDS: Final = (mavlink.MAV_FTP_OPCODE_TERMINATESESSION, mavlink.MAV_FTP_OPCODE_RESETSESSION)
_ABOUT_MESSAGES: Final = (
    mavlink.MAV_CMD_REQUEST_MESSAGE,
    mavlink.MAV_CMD_SET_MESSAGE_INTERVAL,
    mavlink.MAV_CMD_GET_MESSAGE_INTERVAL,
)
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

    The end of a file or a list, and ending a session that has ended already, are not failures.
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


def _name(enum: str, value: int, prefix: str | None = None) -> str:
    entry = mavlink.enums[enum].get(value)
    if entry is None:
        return str(value)
    return str(entry.name).removeprefix(f"{enum}_" if prefix is None else prefix)
