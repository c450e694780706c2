"""The parameter protocol: list, read, set.

The list goes to the client that requested it, a few at a time, so that it does not overflow the
client's receive buffer or a slow link, and to several clients in turn, to bound the gateway's load.
A change goes to every client that has requested parameters before, so that its table stays up to
date, and to no other: QGroundControl takes the first PARAM_VALUE that it receives for the beginning
of the list, and reads the list before it has the metadata.
"""

from collections.abc import Mapping
from typing import Any, Final, Protocol

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import RECORDED_ONLY
from gateway.settings import Settings
from gateway.vehicle.requests import Answer, Reply, Request, SaveSettings, SettingsChange
from gateway.vehicle.services.commands import (
    ACCEPTED,
    IN_PROGRESS,
    UNSUPPORTED,
    Command,
    Outcome,
    whole,
)
from gateway.vehicle.services.parameters import (
    Parameter,
    ParameterTable,
    decode_value,
    packed_parameters,
)

BATCH: Final = 10
BATCH_INTERVAL_US: Final = 10_000
"""Between batches of this many, for all clients together."""
MAX_LISTENERS: Final = 512
"""Clients that may request lists and be sent changes."""
BY_NAME: Final = -1
PACKED_PATH: Final = "/@PARAM/param.pck"
"""The list as a file, which MAVProxy and Mission Planner read first."""

WRITE: Final = 1
RESET: Final = 2
RESET_CALIBRATION: Final = 3
"""PREFLIGHT_STORAGE_PARAMETER_ACTION."""
CALIBRATION: Final = "calibration"
"""The section that holds the sensors' errors."""

REAL32: Final = mavlink.MAV_PARAM_TYPE_REAL32
UNKNOWN: Final = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
BAD_VALUE: Final = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
FORBIDDEN: Final = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED


class OwnSection(Protocol):
    """Parameters that are not settings: the vehicle itself applies a change."""

    def change(self, settings: Settings, key: str, now_us: int) -> list[Answer]:
        """Apply the change of one of them; ValueError refuses it."""
        ...

    def store(self) -> list[Answer]:
        """Keep the present values over a restart."""
        ...


class ParameterService:
    """Parameters of one vehicle.

    Parameters
    ----------
    vehicle_id : int
        Id in the radio payloads.
    table : ParameterTable
        All of them.
    own : mapping of str to OwnSection
        Sections of the table that are not settings. They have no defaults.
    """

    types = ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET")

    def __init__(
        self, vehicle_id: int, table: ParameterTable, own: Mapping[str, OwnSection]
    ) -> None:
        self.table = table
        self._own = own
        self._vehicle_id = vehicle_id
        self._lists: dict[int, int] = {}
        """The next parameter of each list that is under way; whose turn it is comes first."""
        self._due_us = 0
        self._listeners: dict[int, None] = {}
        """Clients that have requested parameters, and are sent changes."""

    def changes_state(self, request: Request) -> bool:
        """Return whether the request is to set one."""
        return bool(request.message.get_type() == "PARAM_SET")

    def refuse(self, request: Request) -> list[Answer]:
        """Return the unchanged value."""
        parameter = self._named(request.message.param_id)
        if parameter is None:
            return [self._error(request, UNKNOWN)]
        return [self._error(request, FORBIDDEN), request.reply(self._value(parameter))]

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer one request."""
        kind = request.message.get_type()
        self.listen(request.client_id)
        if kind == "PARAM_SET":
            return self._set(request, now_us)
        if kind == "PARAM_REQUEST_READ":
            return self._read(request)
        if request.client_id in self._lists or len(self._lists) < MAX_LISTENERS:
            self._lists[request.client_id] = 0
        return self.poll(now_us)

    def poll(self, now_us: int) -> list[Answer]:
        """Send the next few parameters of the requested lists, in turn."""
        if not self._lists or now_us < self._due_us:
            return []
        answers: list[Answer] = []
        while self._lists and len(answers) < BATCH:
            client_id = next(iter(self._lists))
            index = self._lists.pop(client_id)
            answers.append(Reply(self._value(self.table.parameters[index]), client_id))
            if index + 1 < len(self.table.parameters):
                self._lists[client_id] = index + 1
        self._due_us = now_us + BATCH_INTERVAL_US
        return answers

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self._lists else None

    def remove_client(self, client_id: int) -> None:
        """Stop the list and the changes for a client that has gone."""
        self._lists.pop(client_id, None)
        self._listeners.pop(client_id, None)

    def listen(self, client_id: int) -> None:
        """Send changes to a client from now on."""
        if len(self._listeners) < MAX_LISTENERS:
            self._listeners[client_id] = None

    def store(self, command: Command, _now_us: int) -> Outcome:
        """Carry out MAV_CMD_PREFLIGHT_STORAGE: store, or restore the defaults.

        What is stored is acknowledged by `Vehicle.on_saved`, when the disk has it. The defaults
        leave the sensors' calibration alone: it has its own reset.
        """
        asked = whole(command.params[0])
        if asked == WRITE:
            own = [answer for section in self._own.values() for answer in section.store()]
            return IN_PROGRESS, [SaveSettings(self._vehicle_id, command.request), *own]
        if asked not in (RESET, RESET_CALIBRATION):
            return UNSUPPORTED, []
        before = self._numbers()
        answers: list[Answer] = []
        for key in [key for key in self.table.sections if key not in self._own]:
            if (key == CALIBRATION) == (asked == RESET_CALIBRATION):
                fresh = self.table.reset(key)
                answers.append(SettingsChange(self._vehicle_id, key, fresh, ""))
        return ACCEPTED, answers + self._changed_since(before)

    def values(self) -> list[Answer]:
        """Return every parameter, for all clients."""
        return [Reply(self._value(parameter)) for parameter in self.table.parameters]

    def packed(self, request: Request, query: str) -> bytes:
        """Return the file of ArduPilot's parameters; who reads it is sent changes from then on."""
        self.listen(request.client_id)
        return packed_parameters(self.table, query)

    def _changed(self, parameter: Parameter) -> list[Answer]:
        """Send the value of a parameter to the clients that listen; record it if none does."""
        value = self._value(parameter)
        return [Reply(value, client_id) for client_id in self._listeners or (RECORDED_ONLY,)]

    def take(self, section: str, settings: Any) -> list[Answer]:
        """Apply a section that was changed elsewhere, and send what differs."""
        before = self._numbers()
        self.table.sections[section] = settings
        return self._changed_since(before)

    def _numbers(self) -> list[float]:
        return [self.table.number(parameter) for parameter in self.table.parameters]

    def _changed_since(self, before: list[float]) -> list[Answer]:
        changed = zip(self.table.parameters, before, self._numbers(), strict=True)
        return [
            answer
            for parameter, old, new in changed
            if old != new
            for answer in self._changed(parameter)
        ]

    def _set(self, request: Request, now_us: int) -> list[Answer]:
        message = request.message
        parameter = self._named(message.param_id)
        if parameter is None:
            return [self._error(request, UNKNOWN)]
        number = decode_value(message.param_value, message.param_type)
        before = self.table.sections[parameter.section]
        try:
            settings = self.table.change(parameter, number)
            answers = self._carry_out(parameter, settings, now_us)
        except ValueError:
            self.table.sections[parameter.section] = before
            # The error first: a client that sees only the old value would retry.
            return [self._error(request, BAD_VALUE), request.reply(self._value(parameter))]
        return [*answers, *self._changed(parameter)]

    def _carry_out(self, parameter: Parameter, settings: Settings, now_us: int) -> list[Answer]:
        path = ".".join(parameter.path)
        own = self._own.get(parameter.section)
        if own is not None:
            return own.change(settings, path, now_us)
        return [SettingsChange(self._vehicle_id, parameter.section, settings, path)]

    def _read(self, request: Request) -> list[Answer]:
        index = request.message.param_index
        if index == BY_NAME:
            parameter = self._named(request.message.param_id)
        else:
            known = 0 <= index < len(self.table.parameters)
            parameter = self.table.parameters[index] if known else None
        if parameter is None:
            return [self._error(request, UNKNOWN)]
        return [request.reply(self._value(parameter))]

    def _named(self, name: str) -> Parameter | None:
        index = self.table.index.get(name)
        return None if index is None else self.table.parameters[index]

    def _value(self, parameter: Parameter) -> Any:
        return mavlink.MAVLink_param_value_message(
            parameter.name.encode(),
            self.table.number(parameter),
            REAL32,
            len(self.table.parameters),
            self.table.index[parameter.name],
        )

    def _error(self, request: Request, error: int) -> Reply:
        message = request.message
        return request.reply(
            mavlink.MAVLink_param_error_message(
                request.system_id,
                request.component_id,
                message.param_id.encode("ascii", "replace")[:16],
                getattr(message, "param_index", BY_NAME),
                error,
            )
        )
