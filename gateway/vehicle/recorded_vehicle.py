"""A recorded vehicle as a MAVLink system: it answers from its log, and denies other requests.

| request                              | answer                                                  |
| ------------------------------------ | ------------------------------------------------------- |
| PARAM_REQUEST_LIST, …_READ           | the recorded values; PARAM_ERROR without any            |
| PARAM_SET                            | PARAM_ERROR and the unchanged value                     |
| MISSION_REQUEST_LIST and its items   | the recorded items, if any                              |
| an upload, MISSION_CLEAR_ALL         | MISSION_ACK denied                                      |
| REQUEST_MESSAGE, GET_HOME_POSITION … | the recorded messages that it selects; denied if it      |
|                                      | selects none, unsupported if there are none             |
| SET_MESSAGE_INTERVAL                 | fewer messages are played to the client that asks       |
| any other command, SET_MODE          | denied: the past cannot be changed                      |
| logs, terrain, extended parameters   | empty lists                                             |
| files, COMPONENT_METADATA            | for own recordings, the parameters' metadata            |
| PING, TIMESYNC, PROTOCOL_VERSION     | answered, as the player is the sender                   |

Each component of a recorded system answers for itself. A station that tries to change something is
also sent a text.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.plan import KINDS, MISSION, read_item
from gateway.vehicle.request_log import UNANSWERED
from gateway.vehicle.request_reader import VEHICLE, RequestReader
from gateway.vehicle.requested_messages import DISTINGUISHED_BY, MessageRequest, whole
from gateway.vehicle.service import NOTICE, Answer, Reply, Request, Service, StatusText
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    GET_INTERVAL,
    HEARTBEAT,
    KEEPS_CLIENTS_US,
    NONE,
    NOT_NOW,
    SET_INTERVAL,
    UNSUPPORTED,
    Command,
    CommandService,
    QueryService,
    read_command,
)
from gateway.vehicle.services.ftp import FtpService
from gateway.vehicle.services.missions import MissionService
from gateway.vehicle.services.parameter_service import ReadOnlyParameters
from gateway.vehicle.services.parameters import Metadata
from gateway.vehicle.telemetry.announcements import Announcer
from gateway.vehicle.telemetry.messages import protocol_version
from gateway.wire.mavlink_messages import COMPONENT_METADATA, PROTOCOL_VERSION

PARAM_VALUE: Final = mavlink.MAVLINK_MSG_ID_PARAM_VALUE
AVAILABLE_MODES: Final = mavlink.MAVLINK_MSG_ID_AVAILABLE_MODES
THE_PAST: Final = StatusText(NOTICE, "This is a recording: nothing can be changed in it")
TEXTS_AT_ONCE: Final = 3
TEXT_INTERVAL_US: Final = 20 * US_PER_S
STREAMED: Final = frozenset({"MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"})
"""Messages that a ground station with a joystick sends many times a second."""

_MAVLINK: Final[Any] = mavlink.MAVLink(None)
RecordedAction = Outgoing | ClientInterval


class Answers(Protocol):
    """The recorded answers of one vehicle, as of the moment that is played."""

    def has_message(self, message_id: int) -> bool:
        """Return whether the component sent a message at all that a station may request."""
        ...

    def frames(self, message_id: int) -> list[bytes]:
        """Return the frames of a message that are known now, among which a request selects."""
        ...

    def mission(self, kind: int) -> Sequence[bytes] | None:
        """Return the frames of the items of a mission; None if the log has none."""
        ...

    def parameters(self) -> Mapping[str, bytes]:
        """Return the PARAM_VALUE frames by name, in their order."""
        ...


class _Parameters(ReadOnlyParameters[bytes]):
    def __init__(self, answers: Answers) -> None:
        super().__init__()
        self._answers = answers

    def entries(self) -> Mapping[str, bytes]:
        return self._answers.parameters()

    def value(self, entry: bytes, client_id: int) -> Outgoing:
        return Outgoing(entry, PARAM_VALUE, client_id)


class _Missions(MissionService):
    """The recorded items, as of the moment of the request."""

    def __init__(self, answers: Answers) -> None:
        super().__init__(lambda *_: [], lambda *_: [])
        self._answers = answers
        self._read: dict[int, Sequence[bytes]] = {}

    def handle(self, request: Request, now_us: int) -> list[Answer]:
        kind = int(getattr(request.message, "mission_type", MISSION))
        recorded = self._answers.mission(kind) or ()
        if kind in KINDS and self._read.get(kind) is not recorded:
            self._read[kind] = recorded
            items = (read_item(_MAVLINK.decode(bytearray(frame))) for frame in recorded)
            self.items[kind] = tuple(items)
        return super().handle(request, now_us)


class _Commands(Service):
    """Requests of recorded messages and of rates; every other command is denied."""

    types = CommandService.types

    def __init__(self, system_id: int, answers: Answers, metadata: Metadata | None) -> None:
        self._system_id = system_id
        self._answers = answers
        self._metadata = metadata

    def changes_state(self, request: Request) -> bool:
        command = read_command(request)
        is_query = command.number in (SET_INTERVAL, GET_INTERVAL)
        return not is_query and command.wanted is None

    def refuse(self, request: Request, result: int) -> list[Answer]:
        return [read_command(request).ack(result)]

    def handle(self, request: Request, _now_us: int) -> list[Answer]:
        command = read_command(request)
        if command.number == SET_INTERVAL:
            return self._thin(command)
        wanted = command.wanted
        return [command.ack(UNSUPPORTED)] if wanted is None else self._send(command, wanted)

    def _send(self, command: Command, wanted: MessageRequest) -> list[Answer]:
        message_id, request = wanted.message_id, command.request
        frames = self._answers.frames(message_id)
        chosen = frames if message_id not in DISTINGUISHED_BY else self._chosen(frames, wanted)
        found: list[Answer] = [Outgoing(frame, message_id, request.client_id) for frame in chosen]
        if message_id == COMPONENT_METADATA.id and self._metadata is not None:
            found = [request.reply(self._metadata.announcement(None, 0))]
        elif message_id == PROTOCOL_VERSION.id and not frames:
            found = [request.reply(protocol_version())]
        if found:
            return [command.ack(ACCEPTED), *found]
        is_known = self._answers.has_message(message_id)
        return [command.ack(DENIED if frames else NOT_NOW if is_known else UNSUPPORTED)]

    def _chosen(self, frames: Sequence[bytes], wanted: MessageRequest) -> list[bytes]:
        """Return the frames that a request selects, in the order of their numbers."""
        read = [(_MAVLINK.decode(bytearray(frame)), frame) for frame in frames]
        chosen = [(message, frame) for message, frame in read if wanted.selects(message)]
        if (
            wanted.message_id == AVAILABLE_MODES
            and not any(map(whole, wanted.selectors))
            and chosen
        ):
            # A station that requests all of them waits until the last one has come.
            is_complete = len(chosen) >= chosen[0][0].number_modes
            chosen = chosen if is_complete else []
        fields = DISTINGUISHED_BY[wanted.message_id]
        chosen.sort(key=lambda each: [getattr(each[0], field) for field in fields])
        return [frame for _, frame in chosen]

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
        interval = ClientInterval(client_id, self._system_id, message_id, interval_us)
        return [command.ack(ACCEPTED), interval]


class RecordedVehicle:
    """One component of a recording, under the system id with which it is played.

    `components` are its own id and further ones for which it answers; see `RequestReader`.
    Metadata of the parameters is used if it describes the recorded ones.
    """

    def __init__(
        self,
        system_id: int,
        answers: Answers,
        metadata: Metadata | None = None,
        files: FtpService | None = None,
        components: Sequence[int] = VEHICLE,
    ) -> None:
        self.system_id = system_id
        self.metadata = metadata
        """Metadata of the recorded parameters; None if they are of another version."""
        if metadata is not None and not metadata.describes(answers.parameters()):
            self.metadata = None
        self._reader = RequestReader(system_id, components)
        self._encoder = Encoder(system_id, components[0])
        self._services: tuple[Service, ...] = (
            _Commands(system_id, answers, self.metadata),
            _Parameters(answers),
            _Missions(answers),
            files or FtpService({} if self.metadata is None else self.metadata.files),
        )
        self._answers = answers
        self._texts = Announcer(TEXTS_AT_ONCE, TEXT_INTERVAL_US)
        queries = QueryService(self._recorded, lambda *_: [])
        self._by_message: dict[str, Service] = {
            kind: service for service in (queries, *self._services) for kind in service.types
        }

    def handle(self, incoming: Incoming, now_us: int) -> list[RecordedAction]:
        """Answer one frame of a client; ignore one that is not for this vehicle."""
        request = self._reader.read(incoming, now_us)
        if request is None:
            return []
        kind = request.message.get_type()
        service = self._by_message.get(kind)
        if service is None:
            is_asked = getattr(request.message, "target_system", None) == self.system_id
            is_ignored = not is_asked or kind in UNANSWERED | STREAMED
            return [] if is_ignored else self._finish(self._explain(request, now_us))
        if service.changes_state(request):
            answers = service.refuse(request, DENIED)
            return self._finish([*answers, *self._explain(request, now_us)])
        return self._finish(service.handle(request, now_us))

    def _explain(self, request: Request, now_us: int) -> list[Answer]:
        """Return the text for a station that requests a change."""
        found = self._texts.announce(THE_PAST, now_us)
        return [request.reply(each.message) for each in found if isinstance(each, Reply)]

    def _recorded(self, message_id: int, _now_us: int) -> Any:
        frames = self._answers.frames(message_id)
        return _MAVLINK.decode(bytearray(frames[0])) if frames else None

    def poll(self, now_us: int) -> list[RecordedAction]:
        """Send the next answers of every list and file."""
        return self._finish([answer for each in self._services for answer in each.poll(now_us)])

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        due = (service.next_due_us() for service in self._services)
        return min((time_us for time_us in due if time_us is not None), default=None)

    def remove_client(self, client_id: int) -> None:
        """Discard the state of a client that has gone."""
        for service in self._services:
            service.remove_client(client_id)

    def _finish(self, answers: Sequence[Answer]) -> list[RecordedAction]:
        found: list[RecordedAction] = []
        for answer in answers:
            if isinstance(answer, Reply):
                found.append(self._encoder.encode(answer.message, answer.client_id))
            elif isinstance(answer, RecordedAction):
                found.append(answer)
        return found
