"""The parameter protocol: list, read, set.

The list goes to the client that requested it. A change goes to every client that has requested
parameters before, so that its table stays up to date, and to no other: QGroundControl takes the
first PARAM_VALUE that it receives for the beginning of the list, and reads the list before it has
the metadata.
"""

from collections.abc import Mapping
from itertools import islice
from typing import Any, Final, Generic, TypeVar

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import RECORDED_ONLY
from gateway.vehicle.requested_messages import whole
from gateway.vehicle.service import (
    Answer,
    Reply,
    Request,
    SaveSettings,
    SettingsChange,
    TransferService,
)
from gateway.vehicle.services.commands import ACCEPTED, IN_PROGRESS, UNSUPPORTED, Command, Outcome
from gateway.vehicle.services.parameters import (
    Parameter,
    ParameterTable,
    decode_value,
    packed_parameters,
)
from gateway.vehicle.services.plan_service import PlanService

MAX_LISTENERS: Final = 512
"""Maximum clients that are sent changes."""
BY_NAME: Final = -1
PACKED_PATH: Final = "/@PARAM/param.pck"
"""The list as a file, which MAVProxy and Mission Planner read first."""

WRITE: Final = 1
RESET: Final = 2
RESET_CALIBRATION: Final = 3
"""Values of PREFLIGHT_STORAGE_PARAMETER_ACTION."""
CALIBRATION: Final = "calibration"
"""The section with the calibration of the sensors."""
HOME_SECTION: Final = "home"

UNKNOWN: Final = mavlink.MAV_PARAM_ERROR_DOES_NOT_EXIST
BAD_VALUE: Final = mavlink.MAV_PARAM_ERROR_VALUE_OUT_OF_RANGE
FORBIDDEN: Final = mavlink.MAV_PARAM_ERROR_PERMISSION_DENIED

Entry = TypeVar("Entry")


class ReadOnlyParameters(TransferService, Generic[Entry]):
    """List and read the parameters of a vehicle; refuse to set them."""

    types = ("PARAM_REQUEST_LIST", "PARAM_REQUEST_READ", "PARAM_SET")

    def entries(self) -> Mapping[str, Entry]:
        """Return the parameters by name, in their order."""
        raise NotImplementedError

    def value(self, entry: Entry, client_id: int) -> Answer:
        """Return the PARAM_VALUE of a parameter."""
        raise NotImplementedError

    def changes_state(self, request: Request) -> bool:
        """Return whether the request is to set one."""
        return bool(request.message.get_type() == "PARAM_SET")

    def refuse(self, request: Request, _result: int) -> list[Answer]:
        """Return the unchanged value."""
        return self._reject(request, FORBIDDEN)

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer a request to list or to read."""
        if request.message.get_type() == "PARAM_REQUEST_READ":
            return self._read(request)
        entries, client_id = self.entries(), request.client_id
        if not entries:
            return [_error(request, UNKNOWN)]
        values = (self.value(entry, client_id) for entry in entries.values())
        return self._start(client_id, values, now_us)

    def remove_client(self, client_id: int) -> None:
        """Stop the list for a client that has gone."""
        self._transfers.pop(client_id, None)

    def _read(self, request: Request) -> list[Answer]:
        index, entries = request.message.param_index, self.entries()
        entry = entries.get(request.message.param_id)
        if index != BY_NAME:
            entry = next(islice(entries.values(), index, None), None) if index >= 0 else None
        if entry is None:
            return [_error(request, UNKNOWN)]
        return [self.value(entry, request.client_id)]

    def _reject(self, request: Request, error: int) -> list[Answer]:
        """Refuse to set a parameter, and report its value."""
        entry = self.entries().get(request.message.param_id)
        if entry is None:
            return [_error(request, UNKNOWN)]
        # The error first: a client that receives the old value first would retry.
        return [_error(request, error), self.value(entry, request.client_id)]


class ParameterService(ReadOnlyParameters[Parameter]):
    """Parameters of one vehicle.

    The parameters of home are not settings and have no defaults: the plan applies and stores them.
    """

    def __init__(self, vehicle_id: int, table: ParameterTable, plan: PlanService) -> None:
        super().__init__()
        self.table = table
        self._plan = plan
        self._vehicle_id = vehicle_id
        self._listeners: dict[int, None] = {}
        """Clients that have requested parameters, and are sent changes."""

    def entries(self) -> Mapping[str, Parameter]:
        """Return the parameters by name, in their order."""
        return self.table.parameters

    def value(self, entry: Parameter, client_id: int | None) -> Reply:
        """Return the PARAM_VALUE of a parameter."""
        number, place = self.table.number(entry), (len(self.table.parameters), entry.index)
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        message = mavlink.MAVLink_param_value_message(entry.name.encode(), number, kind, *place)
        return Reply(message, client_id)

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        """Answer one request."""
        self.listen(request.client_id)
        if self.changes_state(request):
            return self._set(request, now_us)
        return super().handle(request, now_us)

    def remove_client(self, client_id: int) -> None:
        """Stop the list and the changes for a client that has gone."""
        super().remove_client(client_id)
        self._listeners.pop(client_id, None)

    def listen(self, client_id: int) -> None:
        """Send changes to a client from now on."""
        if len(self._listeners) < MAX_LISTENERS:
            self._listeners[client_id] = None

    def store(self, command: Command, _now_us: int) -> Outcome:
        """Carry out MAV_CMD_PREFLIGHT_STORAGE: store, or restore the defaults.

        Storing is acknowledged by `Vehicle.on_saved`, once the file is written. The defaults do
        not change the sensors' calibration, which has its own reset.
        """
        asked = whole(command.params[0])
        if asked == WRITE:
            save = SaveSettings(self._vehicle_id, command.request)
            return IN_PROGRESS, [save, *self._plan.store()]
        if asked not in (RESET, RESET_CALIBRATION):
            return UNSUPPORTED, []
        before = self._numbers()
        answers: list[Answer] = [
            SettingsChange(key, self.table.reset(key))
            for key in self.table.sections
            if key != HOME_SECTION and (key == CALIBRATION) == (asked == RESET_CALIBRATION)
        ]
        return ACCEPTED, answers + self._changed_since(before)

    def values(self) -> list[Any]:
        """Return the PARAM_VALUE messages of all parameters."""
        return [self.value(entry, None).message for entry in self.table.parameters.values()]

    def packed(self, request: Request, query: str) -> bytes:
        """Return the file of ArduPilot's parameters; its reader is sent changes from then on."""
        self.listen(request.client_id)
        return packed_parameters(self.table, query)

    def update(self, section: str, settings: Any) -> list[Answer]:
        """Apply a section that was changed elsewhere, and send the values that differ."""
        before = self._numbers()
        self.table.sections[section] = settings
        return self._changed_since(before)

    def _numbers(self) -> dict[str, float]:
        return {name: self.table.number(each) for name, each in self.table.parameters.items()}

    def _changed_since(self, before: Mapping[str, float]) -> list[Answer]:
        """Send the values that differ from `before`."""
        now, parameters = self._numbers(), self.table.parameters
        changed = [each for name, each in parameters.items() if before[name] != now[name]]
        return [answer for each in changed for answer in self._changed(each)]

    def _changed(self, parameter: Parameter) -> list[Answer]:
        """Send the value of a parameter to the listening clients; without any, only record it."""
        clients = self._listeners or (RECORDED_ONLY,)
        return [self.value(parameter, client_id) for client_id in clients]

    def _set(self, request: Request, now_us: int) -> list[Answer]:
        message = request.message
        parameter = self.table.parameters.get(message.param_id)
        if parameter is None:
            return [_error(request, UNKNOWN)]
        section = parameter.section
        number = decode_value(message.param_value, message.param_type)
        before = self.table.sections[section]
        try:
            settings = self.table.change(parameter, number)
            answers: list[Answer] = [SettingsChange(section, settings)]
            if section == HOME_SECTION:
                answers = self._plan.change(settings, parameter.path[0], now_us)
        except ValueError:
            self.table.sections[section] = before
            return self._reject(request, BAD_VALUE)
        return [*answers, *self._changed(parameter)]


def _error(request: Request, error: int) -> Reply:
    message = request.message
    return request.reply(
        mavlink.MAVLink_param_error_message(
            request.system_id,
            request.component_id,
            getattr(message, "param_id", "").encode("ascii", "replace")[:16],
            getattr(message, "param_index", BY_NAME),
            error,
        )
    )
