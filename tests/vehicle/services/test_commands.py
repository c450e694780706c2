"""Commands: home, the mark and the recording; refusals; and the log of failed requests.

No acknowledgement of a recording says more than is true.
"""

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gateway.vehicle.plan import Location
from gateway.vehicle.request_log import MAX_ENTRIES
from gateway.vehicle.request_reader import NOT_TRUSTED
from gateway.vehicle.service import RecordingRequest
from gateway.vehicle.services.commands import MAX_WAITING, RECORDER_TIMEOUT_US
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.kit.conversation import Step, converse, perform
from tests.kit.ground_station import (
    GroundStation,
    command,
    command_int,
    ftp_request,
    kinds,
    of_kind,
    results,
    texts,
    to_vehicle,
)
from tests.kit.records import STATE

ACCEPTED, NOT_NOW, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = 0, 1, 2, 3, 4, 5
SET_HOME = mavlink.MAV_CMD_DO_SET_HOME
START, STOP = mavlink.MAV_CMD_LOGGING_START, mavlink.MAV_CMD_LOGGING_STOP
CHANGING = (179, 195, 197, 201, 224, 241, 245, 246, START, STOP, 400, 176)
"""Commands that only trusted clients may give."""


@pytest.mark.parametrize("component_id", [191, 230, 240])
def test_companion_that_shares_the_system_id_is_answered(
    station: GroundStation, component_id: int
) -> None:
    station.mav.srcSystem, station.mav.srcComponent = 1, component_id
    [ack, version] = station.request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    assert (ack.target_system, ack.target_component) == (1, component_id)
    assert version.get_type() == "AUTOPILOT_VERSION"
    station.mav.srcComponent = 1
    assert station.request(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == []
    assert station.send(to_vehicle("PARAM_REQUEST_LIST")) == []
    assert station.vehicle.faults["own id"] == 2


def test_home_is_set_to_a_location_and_sent_to_all(station: GroundStation) -> None:
    found = station.command(SET_HOME, 0, 0, 0, 0, 47.5, -8.5, 400.0)
    assert kinds(found) == ["COMMAND_ACK", "HOME_POSITION", "STATUSTEXT"]
    assert (found[1].latitude, found[1].altitude) == (475_000_000, 400_000)
    [_, position] = station.request(33)
    assert position.relative_alt == pytest.approx(123_456, abs=1)
    assert station.vehicle.plan.mark.location == pytest.approx(Location(47.5, -8.5, 400.0))
    relative = command_int(SET_HOME, 475_000_000, -85_000_000, -20.0, frame=6)
    assert station.send(relative)[1].altitude == 380_000
    assert station.command(SET_HOME, 1)[1].latitude == round(STATE.lat_deg * 1e7), "here"


def test_home_cannot_be_here_without_a_position(vehicle: Vehicle, clock: ManualClock) -> None:
    assert results(GroundStation(vehicle, clock).command(SET_HOME, 1)) == [NOT_NOW]


@pytest.mark.parametrize(
    "message",
    [
        command(SET_HOME, 0, 0, 0, 0, 91.0, 0.0, 0.0),
        command(SET_HOME, 0, 0, 0, 0, 0.0, 181.0, 0.0),
        command(SET_HOME, 0, 0, 0, 0, math.nan, 0.0, 0.0),
        command(SET_HOME, 0, 0, 0, 0, 47.0, 8.0, math.nan),
        command_int(SET_HOME, 1, 2, 3, frame=mavlink.MAV_FRAME_LOCAL_NED),
    ],
)
def test_home_with_invalid_coordinates_is_denied(station: GroundStation, message: Any) -> None:
    before = station.vehicle.telemetry.home
    assert results(station.send(message)) == [DENIED]
    assert station.vehicle.telemetry.home == before


@pytest.mark.parametrize("number", CHANGING)
def test_command_of_an_untrusted_client_is_denied(station: GroundStation, number: int) -> None:
    station.trusted = False
    assert results(station.command(number, 1)) == [DENIED]
    assert station.actions == []
    assert station.vehicle.refusals == 1


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_command_with_extreme_parameters_is_acknowledged_once(
    station: GroundStation, bad: float
) -> None:
    for number in (512, 511, 510, 410, 519, 520, *CHANGING):
        answered = [n for n, _ in acks(station.command(number, *[bad] * 7))]
        assert answered.count(number) == 1


@pytest.mark.parametrize(
    "location", [(90.1, 0, 0), (0, 180.1, 0), (math.nan, 8, 0), (47, 8, 1e30), (47, 8, -1001)]
)
def test_mark_with_invalid_coordinates_or_height_raises_value_error(
    vehicle: Vehicle, location: tuple[float, float, float]
) -> None:
    with pytest.raises(ValueError, match="must be between"):
        vehicle.put_mark(Location(*location), 0)


def test_mark_of_the_command_line_is_announced_and_sent(station: GroundStation) -> None:
    found = station.receive(station.vehicle.put_mark(Location(47.0, 8.0, math.nan), 0))
    assert texts(found) == ["Marked 47.000000, 8.000000"]
    assert results(station.request(62)) == [ACCEPTED]
    opposite = Location(-STATE.lat_deg, STATE.lon_deg + 180.0, 0.0)
    station.vehicle.put_mark(opposite, 0)
    assert results(station.request(62)) == [ACCEPTED]


def acks(messages: list[Any]) -> list[tuple[int, int]]:
    return [(m.command, m.result) for m in of_kind(messages, "COMMAND_ACK")]


def recorder(trouble: str = "", *, recording: bool = False) -> Any:
    return lambda me: perform("on_recorder", trouble, me.clock(), recording=recording)(me)


def ended(result: int, *reported: str) -> dict[str, Any]:
    return {"COMMAND_ACK": {"command": START, "result": result}, "texts": list(reported)}


START_IT = ("A", command(START), ended(IN_PROGRESS))
BROKEN = "Read-only file system"
RECORDINGS: dict[str, list[Step]] = {
    "is accepted once the files are open": [
        *[START_IT] * 3, ("A", recorder(), {}), ("A", recorder(recording=True), ended(ACCEPTED)),
        ("A", recorder(recording=True), {}), ("A", 20.0, {"COMMAND_ACK": 0}),
        # It records already.
        ("A", command(START), ended(ACCEPTED)),
    ],
    "fails with the reason": [
        ("A", recorder(BROKEN), {}), START_IT,
        ("A", recorder(BROKEN), ended(FAILED, f"Cannot record: {BROKEN}")),
        ("A", recorder(BROKEN), {}),
    ],
    "fails if the disk does not answer": [
        START_IT, ("A", 5.0, {}), START_IT,
        ("A", RECORDER_TIMEOUT_US / 1e6 - 5.001, {"COMMAND_ACK": 0}),
        ("A", 0.002, ended(FAILED, "Cannot record: no answer from the disk")),
    ],
    "fails if it is stopped": [
        START_IT, ("A", command(STOP), {"kinds": ["COMMAND_ACK"] * 2} | ended(FAILED)),
        ("A", recorder(recording=True), {}),
    ],
}  # fmt: skip


@pytest.mark.parametrize("name", RECORDINGS)
def test_start_of_a_recording(vehicle: Vehicle, clock: ManualClock, name: str) -> None:
    stations = converse(vehicle, clock, RECORDINGS[name])
    sent = [action.command for _, action, _ in RECORDINGS[name] if hasattr(action, "command")]
    requested = [RecordingRequest(start=number == START) for number in sent]
    assert stations["A"].of(RecordingRequest) == requested


def test_each_station_that_starts_a_recording_gets_its_own_answer(station: GroundStation) -> None:
    stations = [station.other(100 + n) for n in range(MAX_WAITING + 1)]
    found = [results(each.command(START)) for each in stations]
    assert found == [[IN_PROGRESS]] * MAX_WAITING + [[NOT_NOW]]
    station.vehicle.remove_client(100)
    actions = station.vehicle.on_recorder("", station.clock.now_us, recording=True)
    assert [results(each.receive(actions)) for each in stations[:3]] == [[], [ACCEPTED], [ACCEPTED]]


SET_HOME_POSITION = mavlink.MAVLink_set_home_position_message(1, *[0] * 6, [1, 0, 0, 0], 0, 0, 0)
FTP = "FILE_TRANSFER_PROTOCOL"
REQUESTS: dict[str, tuple[Any, tuple[str, str] | None]] = {
    "message": (command(512, 12_345), ("COMMAND_LONG REQUEST_MESSAGE 12345", "UNSUPPORTED")),
    "name": (
        to_vehicle("PARAM_REQUEST_READ", b"[red]\x1b\n", -1),
        ("PARAM_REQUEST_READ ?red??", "DOES_NOT_EXIST"),
    ),
    "list": (to_vehicle("MISSION_REQUEST_LIST", 7), ("MISSION_REQUEST_LIST", "UNSUPPORTED")),
    "no such file": (ftp_request(4, b"/nothing"), (f"{FTP} OPENFILERO /nothing", "FILENOTFOUND")),
    "home": (SET_HOME_POSITION, ("SET_HOME_POSITION", "no answer")),
    "arm": (command(400, 1), ("COMMAND_LONG COMPONENT_ARM_DISARM", "DENIED")),
    "joystick": (
        to_vehicle("RC_CHANNELS_OVERRIDE", *[1500] * 8),
        ("RC_CHANNELS_OVERRIDE", "no answer"),
    ),
    # The normal end of a protocol is no failure.
    "end of list": (ftp_request(mavlink.MAV_FTP_OPCODE_LISTDIRECTORY, b"/", offset=1000), None),
    "end of session": (ftp_request(mavlink.MAV_FTP_OPCODE_TERMINATESESSION), None),
    "end of logs": (to_vehicle("LOG_REQUEST_END"), None),
    "answer": (mavlink.MAVLink_command_ack_message(32100, 0, 0, 0, 1, 1), None),
}  # fmt: skip


@pytest.mark.parametrize("name", REQUESTS)
def test_failed_request_is_logged_once_with_a_count(station: GroundStation, name: str) -> None:
    message, logged = REQUESTS[name]
    for _ in range(3):
        station.clock.advance(1.0)
        station.send(message)
    entries = station.vehicle.requests.entries
    found = [(entry.request, entry.outcome, entry.count) for entry in entries]
    assert found == ([(*logged, 3)] if logged else [])
    for entry in entries:
        assert (entry.vehicle_id, entry.system_id, entry.component_id) == (1, 255, 190)
        assert entry.time_us == station.clock.now_us


def test_only_failed_requests_are_logged(station: GroundStation) -> None:
    station.request(148)
    station.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    station.send(to_vehicle("PARAM_REQUEST_READ", b"RATE_ATT", -1))
    assert station.vehicle.requests.entries == ()
    station.trusted = False
    station.set_parameter("RATE_ATT", 7.0)
    [entry] = station.vehicle.requests.entries
    assert (entry.request, entry.outcome) == ("PARAM_SET RATE_ATT", f"refused: {NOT_TRUSTED}")


def test_request_log_is_bounded_and_keeps_the_newest(station: GroundStation) -> None:
    for number in range(2 * MAX_ENTRIES):
        station.request(30_000 + number)
    entries = station.vehicle.requests.entries
    assert len(entries) == MAX_ENTRIES
    assert entries[-1].request.endswith(str(30_000 + 2 * MAX_ENTRIES - 1))
