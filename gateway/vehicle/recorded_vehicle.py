"""A recorded vehicle as a MAVLink system: it answers from its log, and declines the rest.

| asked                                | answered                                                |
| ------------------------------------ | ------------------------------------------------------- |
| PARAM_REQUEST_LIST, …_READ           | the recorded values; PARAM_ERROR where there are none   |
| PARAM_SET                            | PARAM_ERROR and the recorded value: it stays            |
| MISSION_REQUEST_LIST and its items   | the recorded items; none where there are none           |
| an upload, MISSION_CLEAR_ALL         | MISSION_ACK denied                                      |
| REQUEST_MESSAGE, GET_HOME_POSITION … | the recorded message; unsupported if it was never sent  |
| SET_MESSAGE_INTERVAL                 | thins what is played to the client that asks            |
| any other command, SET_MODE          | denied: the past cannot be changed                      |
| files, COMPONENT_METADATA            | of own recordings the parameters' metadata              |
| PING, TIMESYNC                       | answered                                                |
"""

import math
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any, Final, Protocol

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.vehicle.encoding import MAVLINK_MSG_ID_COMPONENT_METADATA, Encoder
from gateway.vehicle.plan import MISSION, read_item
from gateway.vehicle.requests import Answer, Reply, Request, RequestReader
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    SHORTHANDS,
    UNSUPPORTED,
    Command,
    QueryService,
    read_command,
    whole,
)
from gateway.vehicle.services.ftp import FtpService
from gateway.vehicle.services.intervals import HEARTBEAT, KEEPS_CLIENTS_US, NONE
from gateway.vehicle.services.missions import KINDS, MissionService
from gateway.vehicle.services.parameter_service import (
    BATCH,
    BATCH_INTERVAL_US,
    BY_NAME,
    FORBIDDEN,
    MAX_LISTENERS,
    UNKNOWN,
)
from gateway.vehicle.services.parameters import Metadata

PARAM_VALUE: Final = mavlink.MAVLINK_MSG_ID_PARAM_VALUE

RecordedAction = Outgoing | ClientInterval


class Answers(Protocol):
    """What a log holds of one vehicle, as of the moment that is played."""

    def has_message(self, message_id: int) -> bool:
        """Return whether the vehicle sent a message at all."""
        ...

    def frames(self, message_id: int) -> list[bytes]:
        """Return the frames that answer a request for a message."""
        ...

    def mission(self, kind: int) -> Sequence[bytes] | None:
        """Return the frames of the items of a mission; None if the log has none."""
        ...

    def parameters(self) -> Mapping[str, bytes]:
        """Return the PARAM_VALUE frames by name, in their order."""
        ...


class RecordedVehicle:
    """One vehicle of a recording.

    Parameters
    ----------
    system_id : int
        Its MAVLink system id, as it is played.
    answers : Answers
        What its log holds.
    metadata : Metadata, optional
        Of the parameters, used where the recorded ones are those.
    """

    def __init__(self, system_id: int, answers: Answers, metadata: Metadata | None = None) -> None:
        self.system_id = system_id
        self._answers = answers
        self._reader = RequestReader(system_id)
        self._encoder = Encoder(system_id)
        self._mavlink: Any = mavlink.MAVLink(None)
        self._missions = MissionService(lambda *_: [], lambda *_: [])
        own = metadata is not None and metadata.describes(answers.parameters())
        self._metadata = metadata if own else None
        self._ftp = FtpService({} if self._metadata is None else self._metadata.files())
        self._queries = QueryService(lambda *_: [], lambda *_: [])
        self._lists: dict[int, list[bytes]] = {}
        self._due_us: int | None = None
        self._handlers = {
            "PARAM_REQUEST_LIST": self._list_parameters,
            "PARAM_REQUEST_READ": self._read_parameter,
            "PARAM_SET": self._refuse_parameter,
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._refuse_mode,
            **dict.fromkeys(self._missions.types, self._mission),
            **dict.fromkeys(self._ftp.types, self._ftp.handle),
            **dict.fromkeys(("PING", "TIMESYNC"), self._queries.handle),
        }

    def handle(self, incoming: Incoming, now_us: int) -> list[RecordedAction]:
        """Answer one frame of a client; ignore one that is not for this vehicle."""
        request = self._reader.read(incoming, now_us)
        if request is None:
            return []
        handler = self._handlers.get(request.message.get_type())
        return [] if handler is None else self._finish(handler(request, now_us))

    def poll(self, now_us: int) -> list[RecordedAction]:
        """Send the next of every list and file that is under way."""
        found: list[Answer] = []
        if self._due_us is not None and now_us >= self._due_us:
            for client_id, frames in list(self._lists.items()):
                found += [Outgoing(frame, PARAM_VALUE, client_id) for frame in frames[:BATCH]]
                del frames[:BATCH]
                if not frames:
                    del self._lists[client_id]
            self._due_us = now_us + BATCH_INTERVAL_US if self._lists else None
        return self._finish([*found, *self._ftp.poll(now_us)])

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        due = (self._due_us, self._ftp.next_due_us())
        return min((time_us for time_us in due if time_us is not None), default=None)

    def remove_client(self, client_id: int) -> None:
        """Drop what was kept for a client that has gone."""
        self._lists.pop(client_id, None)
        self._ftp.remove_client(client_id)

    def _finish(self, answers: Sequence[Answer]) -> list[RecordedAction]:
        found: list[RecordedAction] = []
        for answer in answers:
            if isinstance(answer, Reply):
                found.append(self._encoder.encode(answer.message, answer.client_id))
            elif isinstance(answer, RecordedAction):
                found.append(answer)
        return found

    def _list_parameters(self, request: Request, now_us: int) -> list[Answer]:
        frames = list(self._answers.parameters().values())
        if not frames:
            return [_parameter_error(request, "", UNKNOWN)]
        if request.client_id in self._lists or len(self._lists) < MAX_LISTENERS:
            self._lists[request.client_id] = frames
            self._due_us = now_us
        return []

    def _read_parameter(self, request: Request, _now_us: int) -> list[Answer]:
        name, index = request.message.param_id, request.message.param_index
        parameters = self._answers.parameters()
        frame = parameters.get(name)
        if index != BY_NAME:
            frame = next(islice(parameters.values(), index, None), None) if index >= 0 else None
        if frame is None:
            return [_parameter_error(request, name, UNKNOWN)]
        return [Outgoing(frame, PARAM_VALUE, request.client_id)]

    def _refuse_parameter(self, request: Request, _now_us: int) -> list[Answer]:
        name = request.message.param_id
        frame = self._answers.parameters().get(name)
        if frame is None:
            return [_parameter_error(request, name, UNKNOWN)]
        value = Outgoing(frame, PARAM_VALUE, request.client_id)
        return [_parameter_error(request, name, FORBIDDEN), value]

    def _mission(self, request: Request, now_us: int) -> list[Answer]:
        if self._missions.changes_state(request):
            return self._missions.refuse(request)
        kind = int(getattr(request.message, "mission_type", MISSION))
        if kind in KINDS:
            recorded = self._answers.mission(kind) or ()
            items = (read_item(self._mavlink.decode(bytearray(frame))) for frame in recorded)
            self._missions.items[kind] = tuple(items)
        return self._missions.handle(request, now_us)

    def _command(self, request: Request, _now_us: int) -> list[Answer]:
        command = read_command(request)
        if command.number in SHORTHANDS:
            return self._send(command, SHORTHANDS[command.number])
        if command.number == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return self._send(command, whole(command.params[0]))
        if command.number == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._thin(command)
        return [command.ack(DENIED)]

    def _send(self, command: Command, message_id: int) -> list[Answer]:
        client_id = command.request.client_id
        frames = self._answers.frames(message_id)
        if message_id == MAVLINK_MSG_ID_COMPONENT_METADATA and self._metadata is not None:
            frames = [self._encoder.encode(self._metadata.announcement(0)).frame]
        if not frames:
            return [command.ack(UNSUPPORTED)]
        return [command.ack(ACCEPTED), *(Outgoing(f, message_id, client_id) for f in frames)]

    def _thin(self, command: Command) -> list[Answer]:
        """Grant a rate up to the recorded one; 0 means the default and -1 none, as in MAVLink."""
        message_id, requested_us = whole(command.params[0]), command.params[1]
        if not self._answers.has_message(message_id):
            return [command.ack(UNSUPPORTED)]
        kept = message_id != HEARTBEAT or 0 <= requested_us <= KEEPS_CLIENTS_US
        if not math.isfinite(requested_us) or not kept:
            return [command.ack(DENIED)]
        interval_us = max(round(requested_us), NONE)
        client_id = command.request.client_id
        interval = ClientInterval(client_id, self.system_id, message_id, interval_us)
        return [command.ack(ACCEPTED), interval]

    def _refuse_mode(self, request: Request, _now_us: int) -> list[Answer]:
        ack = mavlink.MAVLink_command_ack_message(mavlink.MAV_CMD_DO_SET_MODE, DENIED)
        return [request.reply(ack)]


def _parameter_error(request: Request, name: str, error: int) -> Reply:
    return request.reply(
        mavlink.MAVLink_param_error_message(
            request.system_id,
            request.component_id,
            name.encode("ascii", "replace")[:16],
            getattr(request.message, "param_index", BY_NAME),
            error,
        )
    )
