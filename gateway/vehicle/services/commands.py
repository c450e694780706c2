"""Commands, each acknowledged once to its sender; message rates of single clients; queries.

Recording on command is acknowledged when the recorder has started, not at the request:

| command       | recorder                        | answer                                   |
| ------------- | ------------------------------- | ---------------------------------------- |
| LOGGING_START | is recording                    | ACCEPTED                                 |
| LOGGING_START | idle                            | IN_PROGRESS, then one of the next three  |
|               | has opened its files            | ACCEPTED to all waiting clients          |
|               | cannot open them                | FAILED to them, and a text with a reason |
|               | has not reported for 10 s       | FAILED to all waiting clients            |
| LOGGING_STOP  | any                             | ACCEPTED; FAILED to all waiting clients  |

A start that failed stays pending: the recorder retries by itself, and announces when it succeeds.
"""

import math
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval
from gateway.units import DEGE7_PER_DEG, NS_PER_US, US_PER_S
from gateway.vehicle.plan import GLOBAL_FRAMES
from gateway.vehicle.requested_messages import (
    REQUEST_MESSAGE,
    SHORTHANDS,
    MessageRequest,
    read_request,
    whole,
)
from gateway.vehicle.service import Answer, RecordingRequest, Reply, Request, Service
from gateway.vehicle.telemetry.streams import OFF, Stream
from gateway.vehicle.telemetry.telemetry import CARRIED_MESSAGES, Telemetry
from gateway.wire.mavlink_messages import MESSAGE_IDS

ACCEPTED: Final[int] = mavlink.MAV_RESULT_ACCEPTED
DENIED: Final[int] = mavlink.MAV_RESULT_DENIED
UNSUPPORTED: Final[int] = mavlink.MAV_RESULT_UNSUPPORTED
NOT_NOW: Final[int] = mavlink.MAV_RESULT_TEMPORARILY_REJECTED
IN_PROGRESS: Final[int] = mavlink.MAV_RESULT_IN_PROGRESS
FAILED: Final[int] = mavlink.MAV_RESULT_FAILED
NOT_IN_CONTROL: Final = 10
"""MAV_RESULT_NOT_IN_CONTROL of MAVLink's common.xml, which pymavlink's dialects lack."""

NO_PROGRESS: Final = 255
SET_INTERVAL: Final = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
GET_INTERVAL: Final = mavlink.MAV_CMD_GET_MESSAGE_INTERVAL
RESPOND_TO_ALL: Final = 2
"""Value of the last parameter of MAV_CMD_REQUEST_MESSAGE: answer to all clients."""

REFUSALS: Final = {
    mavlink.MAV_CMD_COMPONENT_ARM_DISARM: "A tracker cannot be armed: it controls nothing",
    mavlink.MAV_CMD_DO_SET_MODE: "A tracker has no modes to switch",
    mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: "The gateway is restarted on its own machine",
}
"""Commands that are understood but denied, with the reason."""
Outcome = tuple[int, list[Answer]]
"""Result of a command, and the answers after its acknowledgement."""
Explain = Callable[[str, int], list[Answer]]
"""Announces to all clients, at a time, the reason of a refusal."""
Build = Callable[[int, int], Any]
"""Builds the message of an id at a time; None if there is nothing yet."""
MAX_FAST_STREAMS: Final = 64
"""Maximum separate streams, since each message of one is encoded separately."""
MIN_INTERVAL_US: Final = 1000
MIN_TIMED_INTERVAL_US: Final = 20_000
"""Least interval of messages that no sample carries: more often they would repeat the same."""
MAX_REQUESTED: Final = 1024
"""Maximum requested intervals, since clients come and go; the oldest are discarded first."""
KEEPS_CLIENTS_US: Final = US_PER_S
"""Longest interval of heartbeats: with a longer one, a client reports the vehicle as lost."""
DEFAULT: Final = 0
NONE: Final = -1
HEARTBEAT: Final = mavlink.MAVLINK_MSG_ID_HEARTBEAT
_GROUPS: Final[dict[int, tuple[str, ...]]] = {
    mavlink.MAV_DATA_STREAM_RAW_SENSORS: ("HIGHRES_IMU", "SCALED_PRESSURE"),
    mavlink.MAV_DATA_STREAM_EXTENDED_STATUS: ("SYS_STATUS", "GPS_RAW_INT", "NAV_CONTROLLER_OUTPUT"),
    mavlink.MAV_DATA_STREAM_POSITION: ("GLOBAL_POSITION_INT",),
    mavlink.MAV_DATA_STREAM_EXTRA1: ("ATTITUDE", "ATTITUDE_QUATERNION"),
    mavlink.MAV_DATA_STREAM_EXTRA2: ("VFR_HUD",),
}
DATA_STREAMS: Final = _GROUPS | {mavlink.MAV_DATA_STREAM_ALL: tuple(sum(_GROUPS.values(), ()))}
"""REQUEST_DATA_STREAM's groups, as autopilots fill them."""
RECORDER_TIMEOUT_US: Final = 10 * US_PER_S
MAX_WAITING: Final = 16
"""Ground stations that may wait for the recorder."""
SIGNING_SETUP: Final = (
    "Signing is not set up by MAVLink: set vehicle.signing_passphrase in the settings file "
    "and run mavgate clients reload"
)
SINGLE: Final = {
    "AUTOPILOT_VERSION_REQUEST": mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION,
    "SET_GPS_GLOBAL_ORIGIN": mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
}
"""Older requests of one message. SET_GPS_GLOBAL_ORIGIN changes nothing: the origin is the first
home, and the answer contains it."""


@dataclass(frozen=True, slots=True)
class Command:
    """COMMAND_LONG, COMMAND_INT or SET_MODE, in one form."""

    request: Request
    number: int
    params: tuple[float, ...]
    """All seven parameters; the fifth and sixth of a COMMAND_INT are its x and y."""
    frame: int = mavlink.MAV_FRAME_GLOBAL

    @property
    def wanted(self) -> MessageRequest | None:
        """The message that it requests; None if it is another command."""
        return read_request(self.number, self.params)

    @property
    def location(self) -> tuple[float, float, float]:
        """Latitude and longitude in deg, and height in m in its frame."""
        is_scaled = self.request.message.get_type() == "COMMAND_INT" and self.frame in GLOBAL_FRAMES
        scale = DEGE7_PER_DEG if is_scaled else 1.0
        x, y, z = self.params[4:]
        return x / scale, y / scale, z

    def ack(self, result: int, progress: int = NO_PROGRESS) -> Reply:
        """Acknowledge it."""
        request, done = self.request, progress if result == IN_PROGRESS else 0
        return request.reply(
            mavlink.MAVLink_command_ack_message(
                self.number, result, done, 0, request.system_id, request.component_id
            )
        )


Handler = Callable[[Command, int], Outcome]


def read_command(request: Request) -> Command:
    """Read a command from any of its messages."""
    m = request.message
    if m.get_type() == "SET_MODE":
        return Command(request, mavlink.MAV_CMD_DO_SET_MODE, (0.0,) * 7)
    first = (m.param1, m.param2, m.param3, m.param4)
    if m.get_type() == "COMMAND_INT":
        return Command(request, m.command, (*first, m.x, m.y, m.z), m.frame)
    return Command(request, m.command, (*first, m.param5, m.param6, m.param7))


class IntervalService(Service):
    """Message rates that a client requests for itself alone.

    A request for fewer messages thins the common stream at the hub. A request for more gives the
    client a separate stream instead of the common one. That costs CPU time, so only clients that
    may change things get it.
    """

    types = ("REQUEST_DATA_STREAM",)

    def __init__(self, system_id: int, telemetry: Telemetry) -> None:
        self._system_id = system_id
        self._telemetry = telemetry
        self._requested: dict[tuple[int, int], int] = {}
        self._fast: dict[tuple[int, int], Stream] = {}
        self.commands: dict[int, Handler] = {SET_INTERVAL: self._set, GET_INTERVAL: self._get}

    def handle(self, request: Request, _now_us: int) -> list[Answer]:
        """Thin a group of messages by REQUEST_DATA_STREAM, which has no answer.

        It only lowers rates: a rate is for whole groups, and raising all of their messages would
        flood the client.
        """
        message = request.message
        wanted_us = NONE
        if message.start_stop and message.req_message_rate:
            wanted_us = US_PER_S // message.req_message_rate
        answers: list[Answer] = []
        for name in DATA_STREAMS.get(message.req_stream_id, ()):
            message_id = MESSAGE_IDS[name]
            common_us = self._telemetry.streams[message_id].interval_us
            faster = 0 <= wanted_us <= common_us
            answers += self._apply(request.client_id, message_id, DEFAULT if faster else wanted_us)
        return answers

    def _set(self, command: Command, _now_us: int) -> Outcome:
        message_id, interval_us = whole(command.params[0]), command.params[1]
        if not math.isfinite(interval_us):
            return DENIED, []
        if not self._telemetry.knows(message_id):
            return UNSUPPORTED, []
        stream, requested_us = self._telemetry.streams.get(message_id), round(interval_us)
        if stream is None:
            return DENIED, []
        if message_id == HEARTBEAT and requested_us != DEFAULT:
            # A vehicle without heartbeats disappears from ground stations.
            if not 0 < requested_us <= KEEPS_CLIENTS_US:
                return DENIED, []
            requested_us = DEFAULT
        if requested_us > 0:
            carried = message_id in CARRIED_MESSAGES
            requested_us = max(MIN_INTERVAL_US if carried else MIN_TIMED_INTERVAL_US, requested_us)
        requested_us = max(requested_us, NONE)
        if _is_faster(requested_us, stream.interval_us) and not command.request.may_change:
            return DENIED, []
        return ACCEPTED, self._apply(command.request.client_id, message_id, requested_us)

    def _get(self, command: Command, _now_us: int) -> Outcome:
        """Report a client's interval: -1 if it gets none, 0 if the message is never sent."""
        message_id, request = whole(command.params[0]), command.request
        stream, interval_us = self._telemetry.streams.get(message_id), DEFAULT
        if stream is not None:
            key = (request.client_id, message_id)
            interval_us = self._requested.get(key, stream.interval_us)
        answer = mavlink.MAVLink_message_interval_message(message_id & 0xFFFF, interval_us)
        return ACCEPTED, [request.reply(answer)]

    def remove_client(self, client_id: int) -> None:
        """Discard the rates of a client that has gone."""
        for table in (self._requested, self._fast):
            for key in [key for key in table if key[0] == client_id]:
                del table[key]

    def on_state(self, time_us: int) -> list[Answer]:
        """Send the messages of an IMU sample to the clients that requested more."""
        return self._due(CARRIED_MESSAGES, time_us, Stream.offer) if self._fast else []

    def poll(self, now_us: int) -> list[Answer]:
        """Send the timed messages to the clients that requested more."""
        timed = [m for _, m in self._fast if m not in CARRIED_MESSAGES]
        return self._due(timed, now_us, Stream.tick)

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        due = [s.due_us or 0 for (_, m), s in self._fast.items() if m not in CARRIED_MESSAGES]
        return min(due, default=None)

    def _apply(self, client_id: int, message_id: int, requested_us: int) -> list[Answer]:
        key = (client_id, message_id)
        self._fast.pop(key, None)
        self._requested.pop(key, None)
        common_us = self._telemetry.streams[message_id].interval_us
        if requested_us != DEFAULT:
            if len(self._requested) >= MAX_REQUESTED:
                self._requested.pop(next(iter(self._requested)))
            self._requested[key] = requested_us
        if _is_faster(requested_us, common_us) and len(self._fast) < MAX_FAST_STREAMS:
            self._fast[key] = Stream(requested_us)
            requested_us = NONE
        return [ClientInterval(client_id, self._system_id, message_id, requested_us)]

    def _due(self, wanted: Container[int], time_us: int, ask: Any) -> list[Answer]:
        found: list[Answer] = []
        for (client_id, message_id), stream in self._fast.items():
            if message_id in wanted and ask(stream, time_us):
                message = self._telemetry.build(message_id, time_us)
                if message is not None:
                    found.append(Reply(message, client_id))
        return found


def _is_faster(requested_us: int, common_us: int) -> bool:
    return requested_us > 0 and (common_us == OFF or requested_us < common_us)


class CommandService(Service):
    """Dispatch commands by number; one without a handler is UNSUPPORTED."""

    types = ("COMMAND_LONG", "COMMAND_INT", "SET_MODE")

    def __init__(
        self,
        telemetry: Telemetry,
        explain: Explain,
        changing: Mapping[int, Handler],
        reading: Mapping[int, Handler],
    ) -> None:
        """Let other services carry out commands: those that change something, and the others."""
        self._telemetry = telemetry
        self._handlers: dict[int, Handler] = {
            **dict.fromkeys((REQUEST_MESSAGE, *SHORTHANDS), self._request_message),
            **dict.fromkeys(
                REFUSALS,
                lambda command, now_us: (DENIED, explain(REFUSALS[command.number], now_us)),
            ),
            **changing,
            **reading,
        }
        self._changing = REFUSALS.keys() | changing.keys()

    def changes_state(self, request: Request) -> bool:
        """Return whether the command would change anything."""
        return read_command(request).number in self._changing

    def refuse(self, request: Request, result: int) -> list[Answer]:
        """Acknowledge with this result."""
        return [read_command(request).ack(result)]

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Carry out a command and acknowledge it."""
        command = read_command(request)
        handler = self._handlers.get(command.number)
        if handler is None:
            return [command.ack(UNSUPPORTED)]
        result, answers = handler(command, now_us)
        return [command.ack(result), *answers]

    def _request_message(self, command: Command, now_us: int) -> Outcome:
        wanted, request = command.wanted, command.request
        message_id = -1 if wanted is None else wanted.message_id
        if message_id == mavlink.MAVLINK_MSG_ID_MESSAGE_INTERVAL:
            # The second parameter is the message whose interval is requested.
            shifted = replace(command, params=(*command.params[1:], 0.0))
            return self._handlers[GET_INTERVAL](shifted, now_us)
        if wanted is None or not self._telemetry.knows(message_id):
            return UNSUPPORTED, []
        # The answer to an untrusted client must not load the links of others.
        to_all = command.number == REQUEST_MESSAGE and whole(command.params[6]) == RESPOND_TO_ALL
        client_id = None if to_all and request.may_change else request.client_id
        message = self._telemetry.build(message_id, now_us)
        if message is None:
            return NOT_NOW, []
        return (ACCEPTED, [Reply(message, client_id)]) if wanted.selects(message) else (DENIED, [])


class RecordingService(Service):
    """Start and stop the recording."""

    def __init__(self, explain: Explain) -> None:
        self._explain = explain
        self._recording = False
        self._waiting: dict[int, Command] = {}
        """The newest start command of each client that waits for the outcome."""
        self._due_us: int | None = None
        self.commands: dict[int, Handler] = {
            mavlink.MAV_CMD_LOGGING_START: self._start,
            mavlink.MAV_CMD_LOGGING_STOP: self._stop,
        }

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
        """Return the time of the timeout."""
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


def _no_extended_parameter(_request: Any) -> Any:
    return mavlink.MAVLink_param_ext_value_message(b"", b"", mavlink.MAV_PARAM_EXT_TYPE_UINT8, 0, 0)


def _extended_parameter_refused(request: Any) -> Any:
    name = request.param_id.encode("ascii", "replace")[:16]
    failed = mavlink.PARAM_ACK_FAILED
    return mavlink.MAVLink_param_ext_ack_message(name, b"", request.param_type, failed)


NOTHING: Final[dict[str, Callable[[Any], Any]]] = {
    "LOG_REQUEST_LIST": lambda _: mavlink.MAVLink_log_entry_message(0, 0, 0, 0, 0),
    "LOG_REQUEST_DATA": lambda m: mavlink.MAVLink_log_data_message(m.id, m.ofs, 0, [0] * 90),
    "TERRAIN_CHECK": lambda m: mavlink.MAVLink_terrain_report_message(
        m.lat, m.lon, spacing=0, terrain_height=0.0, current_height=0.0, pending=0, loaded=0
    ),
    "PARAM_EXT_REQUEST_LIST": _no_extended_parameter,
    "PARAM_EXT_REQUEST_READ": _no_extended_parameter,
    "PARAM_EXT_SET": _extended_parameter_refused,
}
"""Answers for requests of logs, terrain data and extended parameters, which do not exist."""


class QueryService(Service):
    """Answer requests that need no state.

    A ground station without an answer repeats its request for seconds, so requests of data that
    does not exist here are answered too.
    """

    types = ("PING", "TIMESYNC", "SETUP_SIGNING", *SINGLE, *NOTHING)

    def __init__(self, build: Build, explain: Explain) -> None:
        self._build = build
        self._explain = explain

    def changes_state(self, request: Request) -> bool:
        """Return whether the request would change anything if it were supported."""
        return request.message.get_type() in ("SETUP_SIGNING", "PARAM_EXT_SET")

    def refuse(self, request: Request, _result: int) -> list[Answer]:
        """Refuse to set a parameter; the other messages have no answer of their own."""
        is_parameter = request.message.get_type() == "PARAM_EXT_SET"
        return [request.reply(_extended_parameter_refused(request.message))] if is_parameter else []

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer a request at once."""
        message = request.message
        kind = message.get_type()
        if kind == "SETUP_SIGNING":
            return self._explain(SIGNING_SETUP, now_us)
        if kind in SINGLE:
            found = [self._build(SINGLE[kind], now_us)]
        elif kind in NOTHING:
            found = [NOTHING[kind](message)]
        elif kind == "TIMESYNC":
            sync = mavlink.MAVLink_timesync_message(now_us * NS_PER_US, message.ts1)
            found = [] if message.tc1 else [sync]
        else:
            sender = (request.system_id, request.component_id)
            pong = mavlink.MAVLink_ping_message(message.time_usec, message.seq, *sender)
            # A message with a target is an answer.
            found = [] if message.target_system or message.target_component else [pong]
        return [request.reply(answer) for answer in found if answer is not None]
