"""Requests that one message answers: clock measurements, and lists that are empty here."""

from collections.abc import Callable
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.vehicle.actions import Answer, Request
from gateway.vehicle.services.commands import Explain

NS_PER_US: Final = 1000
PARAM_EXT_TYPE_UINT8: Final = mavlink.MAV_PARAM_EXT_TYPE_UINT8

SIGNING_SETUP: Final = (
    "Signing is not set up by MAVLink: set vehicle.signing_passphrase in the settings file "
    "and run mavgate reload"
)

Build = Callable[[int, int], list[Any]]


class QueryService:
    """Answer requests that need no state.

    A ground station that gets no answer repeats its request for seconds, so what does not exist
    here is answered too: by an empty list, or by "not available".

    Parameters
    ----------
    build : callable
        Builds the messages of an id at a time, for requests of a single message.
    explain : callable
        Announces to all why something was refused.
    """

    types = (
        "PING", "TIMESYNC", "LOG_REQUEST_LIST", "LOG_REQUEST_DATA", "PARAM_EXT_REQUEST_LIST",
        "PARAM_EXT_REQUEST_READ", "PARAM_EXT_SET", "TERRAIN_CHECK", "AUTOPILOT_VERSION_REQUEST",
        "SET_GPS_GLOBAL_ORIGIN", "SETUP_SIGNING",
    )  # fmt: skip

    def __init__(self, build: Build, explain: Explain) -> None:
        self._build = build
        self._explain = explain

    def changes_state(self, request: Request) -> bool:
        """Return whether the request would change anything if it were supported."""
        return request.message.get_type() in ("SETUP_SIGNING", "PARAM_EXT_SET")

    def refuse(self, request: Request) -> list[Answer]:
        """Return no answer: these messages have none of their own."""
        return [_no_parameter(request)] if request.message.get_type() == "PARAM_EXT_SET" else []

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer a request at once.

        Parameters
        ----------
        request : Request
            A PING with target 0, 0 is a request; one with a target is an answer. A
            TIMESYNC with `tc1` 0 is a request.
        now_us : int
            Gateway clock.

        Returns
        -------
        list of Answer
        """
        message = request.message
        match message.get_type():
            case "PING":
                is_request = (message.target_system, message.target_component) == (0, 0)
                return [_pong(request)] if is_request else []
            case "TIMESYNC":
                if message.tc1 != 0:
                    return []
                answer = mavlink.MAVLink_timesync_message(now_us * NS_PER_US, message.ts1)
                return [request.reply(answer)]
            case "AUTOPILOT_VERSION_REQUEST":
                return self._send(request, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, now_us)
            case "SET_GPS_GLOBAL_ORIGIN":
                # The origin is the first home; the answer has the one in use.
                return self._send(request, mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, now_us)
            case "SETUP_SIGNING":
                return self._explain(SIGNING_SETUP, now_us)
        return [_nothing(request)]

    def _send(self, request: Request, message_id: int, now_us: int) -> list[Answer]:
        return [request.reply(message) for message in self._build(message_id, now_us)]


def _pong(request: Request) -> Answer:
    message = request.message
    return request.reply(
        mavlink.MAVLink_ping_message(
            message.time_usec, message.seq, request.system_id, request.component_id
        )
    )


def _nothing(request: Request) -> Answer:
    """Answer that there are no logs, no extended parameters and no terrain data."""
    message = request.message
    match message.get_type():
        case "LOG_REQUEST_LIST":
            return request.reply(mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0))
        case "LOG_REQUEST_DATA":
            answer = mavlink.MAVLink_log_data_message(message.id, message.ofs, 0, [0] * 90)
            return request.reply(answer)
        case "TERRAIN_CHECK":
            answer = mavlink.MAVLink_terrain_report_message(
                message.lat, message.lon, spacing=0, terrain_height=0.0, current_height=0.0,
                pending=0, loaded=0,
            )  # fmt: skip
            return request.reply(answer)
        case "PARAM_EXT_SET":
            return _no_parameter(request)
    none = mavlink.MAVLink_param_ext_value_message(b"", b"", PARAM_EXT_TYPE_UINT8, 0, 0)
    return request.reply(none)


def _no_parameter(request: Request) -> Answer:
    message = request.message
    return request.reply(
        mavlink.MAVLink_param_ext_ack_message(
            message.param_id.encode("ascii", "replace")[:16],
            b"",
            message.param_type,
            mavlink.PARAM_ACK_FAILED,
        )
    )
