"""MAV_CMDs: each acknowledged once, to its sender, and most of them carried out.

Recording on command is acknowledged when the recorder has started, not when it was requested to:

| command       | recorder                        | answer                                   |
| ------------- | ------------------------------- | ---------------------------------------- |
| LOGGING_START | records already                 | ACCEPTED                                 |
| LOGGING_START | idle                            | IN_PROGRESS; then, as below              |
| LOGGING_STOP  | any                             | ACCEPTED; FAILED to all who wait         |
|               | has opened its files            | ACCEPTED to all who wait                 |
|               | cannot open them                | FAILED to all who wait, and why as text  |
|               | has not reported for 10 s       | FAILED to all who wait                   |

A start that failed stays pending: the recorder retries by itself, and announces when it succeeds.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle.encoding import MAVLINK_MSG_ID_PROTOCOL_VERSION
from gateway.vehicle.plan import DEGE7, GLOBAL_FRAMES
from gateway.vehicle.requests import Answer, RecordingRequest, Reply, Request
from gateway.vehicle.services.intervals import IntervalService

ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
DENIED: Final[int] = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: Final[int] = mavlink.MAV_RESULT_UNSUPPORTED
NOT_NOW: Final[int] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
IN_PROGRESS: Final[int] = mavlink.MAV_RESULT_IN_PROGRESS
FAILED: Final[int] = mavlink.MAV_RESULT_FAILED

NO_PROGRESS: Final = 255
RESPOND_TO_ALL: Final = 2
"""Last parameter of MAV_CMD_REQUEST_MESSAGE."""

REFUSALS: Final = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: "A tracker cannot be armed: it controls nothing",
    mavlink.MAV_CMD_DO_SET_MODE: "A tracker has no modes to switch",
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: "The gateway is restarted on its own machine",
}
"""Commands that are understood but denied, and why."""
SHORTHANDS: Final = {
    mavlink.MAV_CMD_GET_HOME_POSITION: mavlink.MAVLINK_MSG_ID_HOME_POSITION,
    mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES: mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    mavlink.MAV_CMD_REQUEST_PROTOCOL_VERSION: MAVLINK_MSG_ID_PROTOCOL_VERSION,
}
"""Older commands for single messages."""


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG or COMMAND_INT, in one form."""

    request: Request
    number: int
    params: tuple[float, float, float, float]
    lat_deg: float
    """Parameter 5 of a COMMAND_LONG, x of a COMMAND_INT in degrees."""
    lon_deg: float
    height_m: float
    """Parameter 7."""
    frame: int

    def ack(self, result: int, progress: int = NO_PROGRESS) -> Reply:
        """Acknowledge it."""
        done = progress if result == IN_PROGRESS else 0
        return self.request.reply(
            mavlink.MAVLink_command_ack_message(
                self.number,
                result,
                done,
                0,
                self.request.system_id,
                self.request.component_id,
            )
        )

    @property
    def extra(self) -> tuple[float, float]:
        """Parameters 5 and 6, if they are not a position."""
        message = self.request.message
        if message.get_type() == "COMMAND_INT":
            return (float(message.x), float(message.y))
        return (message.param5, message.param6)


Outcome = tuple[int, list[Answer]]
"""Result of a command, and what is sent after its acknowledgement."""

Handler = Callable[[Command, int], Outcome]
Explain = Callable[[str, int], list[Answer]]
"""Announces a text to all at a time: why something was refused."""


def read_command(request: Request) -> Command:
    """Read a command from either message."""
    message = request.message
    params = (message.param1, message.param2, message.param3, message.param4)
    if message.get_type() == "COMMAND_LONG":
        place = (message.param5, message.param6, message.param7)
        frame = int(mavlink.MAV_FRAME_GLOBAL)
    else:
        scale = DEGE7 if message.frame in GLOBAL_FRAMES else 1.0
        place = (message.x / scale, message.y / scale, message.z)
        frame = int(message.frame)
    return Command(request, message.command, params, *place, frame)


def whole(value: float) -> int:
    """Read an integer parameter; NaN is 0."""
    return round(value) if math.isfinite(value) else 0


class CommandService:
    """Dispatch commands by number; one without a handler is UNSUPPORTED."""

    types = ("COMMAND_LONG", "COMMAND_INT", "SET_MODE")

    def __init__(
        self,
        intervals: IntervalService,
        build: Callable[[int, int], list[Any]],
        knows: Callable[[int], bool],
        explain: Explain,
    ) -> None:
        """Start with the commands that need no other service.

        Parameters
        ----------
        intervals : IntervalService
            For the rates of single clients.
        build : callable
            Builds the messages of an id at a time; an empty list if there is nothing yet.
        knows : callable
            Whether a message of that id is ever sent.
        explain : callable
            Announces to all why something was refused.
        """
        self._intervals = intervals
        self._build = build
        self._knows = knows
        self._explain = explain
        self._handlers: dict[int, Handler] = {
            mavlink.MAV_CMD_REQUEST_MESSAGE: self._request_message,
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval,
            mavlink.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
            **{number: self._fixed(message_id) for number, message_id in SHORTHANDS.items()},
        }
        self._changing: set[int] = set(REFUSALS)
        for number in REFUSALS:
            self._handlers[number] = self._decline

    def register(self, number: int, handler: Handler, *, changes_state: bool = True) -> None:
        """Let another service carry out a command."""
        self._handlers[number] = handler
        if changes_state:
            self._changing.add(number)

    def changes_state(self, request: Request) -> bool:
        """Return whether the command would change anything."""
        message = request.message
        return message.get_type() == "SET_MODE" or message.command in self._changing

    def refuse(self, request: Request) -> list[Answer]:
        """Acknowledge as denied."""
        return [self._read(request).ack(DENIED)]

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Carry out a command and acknowledge it."""
        command = self._read(request)
        handler = self._handlers.get(command.number)
        if handler is None:
            return [command.ack(UNSUPPORTED)]
        result, answers = handler(command, now_us)
        return [command.ack(result), *answers]

    def _read(self, request: Request) -> Command:
        if request.message.get_type() != "SET_MODE":
            return read_command(request)
        number = mavlink.MAV_CMD_DO_SET_MODE
        return Command(request, number, (0.0,) * 4, 0.0, 0.0, 0.0, mavlink.MAV_FRAME_GLOBAL)

    def _decline(self, command: Command, now_us: int) -> Outcome:
        return DENIED, self._explain(REFUSALS[command.number], now_us)

    def _request_message(self, command: Command, now_us: int) -> Outcome:
        message_id = whole(command.params[0])
        if message_id == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            return self._report_interval(command, whole(command.params[1]))
        if not self._knows(message_id):
            return UNSUPPORTED, []
        messages = self._build(message_id, now_us)
        # The answer to an untrusted client must not load the links of others.
        everybody = whole(command.height_m) == RESPOND_TO_ALL and command.request.may_change
        answers: list[Answer] = [
            Reply(m, None if everybody else command.request.client_id) for m in messages
        ]
        return (ACCEPTED, answers) if answers else (NOT_NOW, [])

    def _fixed(self, message_id: int) -> Handler:
        def handler(command: Command, now_us: int) -> Outcome:
            messages = self._build(message_id, now_us)
            answers: list[Answer] = [command.request.reply(m) for m in messages]
            return (ACCEPTED, answers) if answers else (NOT_NOW, [])

        return handler

    def _set_interval(self, command: Command, _now_us: int) -> Outcome:
        message_id = whole(command.params[0])
        interval_us = command.params[1]
        if not math.isfinite(interval_us):
            return DENIED, []
        if not self._knows(message_id):
            return UNSUPPORTED, []
        try:
            return ACCEPTED, self._intervals.set_interval(command.request, message_id, interval_us)
        except ValueError:
            return DENIED, []

    def _get_interval(self, command: Command, _now_us: int) -> Outcome:
        return self._report_interval(command, whole(command.params[0]))

    def _report_interval(self, command: Command, message_id: int) -> Outcome:
        client_id = command.request.client_id
        interval_us = self._intervals.interval_us(client_id, message_id)
        answer = mavlink.MAVLink_message_interval_message(message_id & 0xFFFF, interval_us)
        return ACCEPTED, [command.request.reply(answer)]


RECORDER_TIMEOUT_US: Final = 10 * US_PER_S
MAX_WAITING: Final = 16
"""Ground stations that may wait for the recorder."""


class RecordingService:
    """Start and stop the recording.

    Parameters
    ----------
    explain : callable
        Announces to all why something was refused.
    """

    def __init__(self, explain: Explain) -> None:
        self._explain = explain
        self._recording = False
        self._waiting: dict[int, Command] = {}
        """The newest order to start of each client that waits for the outcome."""
        self._due_us: int | None = None

    def register(self, commands: CommandService) -> None:
        """Register the commands that are carried out here."""
        commands.register(mavlink.MAV_CMD_LOGGING_START, self._start)
        commands.register(mavlink.MAV_CMD_LOGGING_STOP, self._stop)

    def update(self, trouble: str, now_us: int, *, recording: bool) -> list[Answer]:
        """Note the state of the recorder."""
        self._recording = recording
        if not self._waiting:
            return []
        if recording:
            return self._end(ACCEPTED)
        if trouble:
            return self._end(FAILED) + self._explain(f"Cannot record: {trouble}", now_us)
        return []

    def poll(self, now_us: int) -> list[Answer]:
        """Report a failure when the recorder does not answer in time."""
        if self._due_us is None or now_us < self._due_us:
            return []
        return self._end(FAILED) + self._explain("Cannot record: no answer from the disk", now_us)

    def next_due_us(self) -> int | None:
        """Return when to give up."""
        return self._due_us

    def remove_client(self, client_id: int) -> None:
        """Discard the requests of a client that has gone."""
        self._waiting.pop(client_id, None)
        self._due_us = self._due_us if self._waiting else None

    def _start(self, command: Command, now_us: int) -> Outcome:
        order: list[Answer] = [RecordingRequest(start=True)]
        if self._recording:
            return ACCEPTED, order
        client_id = command.request.client_id
        if client_id not in self._waiting and len(self._waiting) >= MAX_WAITING:
            return NOT_NOW, []
        self._waiting[client_id] = command
        self._due_us = self._due_us or now_us + RECORDER_TIMEOUT_US
        return IN_PROGRESS, order

    def _stop(self, _command: Command, _now_us: int) -> Outcome:
        return ACCEPTED, [*self._end(FAILED), RecordingRequest(start=False)]

    def _end(self, result: int) -> list[Answer]:
        acks: list[Answer] = [command.ack(result) for command in self._waiting.values()]
        self._waiting.clear()
        self._due_us = None
        return acks


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
        """Answer a request at once."""
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
