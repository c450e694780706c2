"""A live vehicle of another system, answered for from the answers that it has given before.

| request                            | answered here                              | otherwise  |
| ---------------------------------- | ------------------------------------------ | ---------- |
| PARAM_REQUEST_LIST                 | if all but a few parameters are known      | passed on  |
| PARAM_REQUEST_READ                 | if it is known; never the checksum         | passed on  |
| MISSION_REQUEST_LIST and its items | if the whole mission is known              | passed on  |
| REQUEST_MESSAGE                    | version and metadata                       | passed on  |
| files                              | if they were read before                   | passed on  |
| anything that changes something    | never                                      | passed on  |
"""

from typing import Final

from gateway.answers.live_answers import LiveAnswers
from gateway.records import Incoming, Outgoing
from gateway.vehicle.plan import ACCEPTED
from gateway.vehicle.recorded_vehicle import PARAM_VALUE, RecordedVehicle
from gateway.vehicle.service import Request
from gateway.vehicle.services.commands import read_command
from gateway.vehicle.services.ftp import FtpService, Opcode, decode_packet, full_path
from gateway.vehicle.services.parameter_service import BY_NAME

MOST_MISSING: Final = 16
"""Most parameters that may be missing from a list; stations request these one by one."""
MAX_DOWNLOADS: Final = 64
IN_SESSION: Final = (Opcode.TERMINATE_SESSION, Opcode.READ_FILE, Opcode.BURST_READ_FILE)


class _Files(FtpService):
    """Files whose content also depends on the query."""

    def __init__(self, answers: LiveAnswers) -> None:
        super().__init__({})
        self._answers = answers

    def holds(self, request: Request) -> bool:
        """Return whether a file request can be answered here; if not, end the client's session."""
        packet = decode_packet(bytes(request.message.payload))
        if packet.opcode in IN_SESSION:
            return self.has_session(request, packet)
        if packet.opcode == Opcode.OPEN_FILE_RO and full_path(packet) in self._answers.files:
            return True
        self.remove_client(request.client_id)
        return False

    def _generate(self, path: str, query: str, _request: Request) -> bytes:
        return self._answers.files["?".join(filter(None, (path, query)))]


class CachedVehicle(RecordedVehicle):
    """Answer requests for one autopilot from kept answers."""

    def __init__(self, system_id: int, answers: LiveAnswers) -> None:
        self._held = answers
        self._files = _Files(answers)
        super().__init__(system_id, answers, files=self._files)
        self._downloads: dict[tuple[int, int, int, int], bool] = {}
        """Mission downloads in progress: client, system, component and kind."""
        self.other_lists = False
        """Whether other components of the system have parameters too."""

    def read(self, incoming: Incoming, now_us: int) -> Request | None:
        """Read a request; None if it is not for this vehicle."""
        return self._reader.read(incoming, now_us)

    def answer(self, request: Request, now_us: int) -> list[Outgoing] | None:
        """Answer a request; None if only the vehicle can answer it."""
        kind = request.message.get_type()
        service = self._by_message.get(kind)
        if service is None or not self._holds(request):
            return None
        if kind == "MISSION_ACK":
            return []
        answers = service.handle(request, now_us)
        found = [each for each in self._finish(answers) if isinstance(each, Outgoing)]
        if kind == "PARAM_REQUEST_LIST" and self._held.hash_frame is not None:
            found.insert(0, Outgoing(self._held.hash_frame, PARAM_VALUE, request.client_id))
        return found

    def _holds(self, request: Request) -> bool:
        message, missing = request.message, self._held.missing
        match message.get_type():
            case "PARAM_REQUEST_LIST":
                is_for_others = self.other_lists and not message.target_component
                return missing is not None and missing <= MOST_MISSING and not is_for_others
            case "PARAM_REQUEST_READ" if message.param_index == BY_NAME:
                return message.param_id in self._held.parameters()
            case "PARAM_REQUEST_READ":
                return missing == 0 and message.param_index < len(self._held.parameters())
            case "MISSION_REQUEST_LIST" | "MISSION_REQUEST" | "MISSION_REQUEST_INT":
                return self._holds_mission(request)
            case "MISSION_ACK" if message.type == ACCEPTED:
                return self._downloads.pop(_download(request), False)
            case "COMMAND_LONG" | "COMMAND_INT":
                wanted = read_command(request).wanted
                return wanted is not None and self._held.has_message(wanted.message_id)
            case "FILE_TRANSFER_PROTOCOL":
                return self._files.holds(request)
        return False

    def _holds_mission(self, request: Request) -> bool:
        if self._held.mission(request.message.mission_type) is None:
            # The vehicle continues the download that was begun here, and receives its confirmation.
            self._downloads.pop(_download(request), None)
            return False
        if request.message.get_type() == "MISSION_REQUEST_LIST":
            if len(self._downloads) >= MAX_DOWNLOADS:
                self._downloads.pop(next(iter(self._downloads)))
            self._downloads[_download(request)] = True
        return True


def _download(request: Request) -> tuple[int, int, int, int]:
    kind = request.message.mission_type
    return request.client_id, request.system_id, request.component_id, kind
