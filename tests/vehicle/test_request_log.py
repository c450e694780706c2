"""The log of failed requests, as `mavgate status --requests` shows it."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from gateway.vehicle.requests import MAX_ENTRIES
from tests.vehicle.ground_station import GroundStation
from tests.vehicle.test_microservices import ftp

ME = (1, 1)


@pytest.mark.parametrize(
    ("message", "request_text", "outcome"),
    [
        (
            mavlink.MAVLink_command_long_message(*ME, 512, 0, 12_345, 0, 0, 0, 0, 0, 0),
            "COMMAND_LONG REQUEST_MESSAGE 12345",
            "UNSUPPORTED",
        ),
        (
            mavlink.MAVLink_param_request_read_message(*ME, b"[red]\x1b\n", -1),
            "PARAM_REQUEST_READ ?red??",
            "DOES_NOT_EXIST",
        ),
        (
            mavlink.MAVLink_mission_request_list_message(*ME, 7),
            "MISSION_REQUEST_LIST",
            "UNSUPPORTED",
        ),
        (ftp(4, b"/nothing")(), "FILE_TRANSFER_PROTOCOL opcode 4 /nothing", "FTP error 10"),
        (
            mavlink.MAVLink_set_home_position_message(1, 0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0),
            "SET_HOME_POSITION",
            "no answer",
        ),
        (
            mavlink.MAVLink_command_long_message(*ME, 400, 0, 1, 0, 0, 0, 0, 0, 0),
            "COMMAND_LONG COMPONENT_ARM_DISARM",
            "DENIED",
        ),
    ],
)
def test_failed_request_is_logged_once_with_a_count(
    station: GroundStation, message: mavlink.MAVLink_message, request_text: str, outcome: str
) -> None:
    for _ in range(3):
        station.clock.advance(1.0)
        station.send(message)
    [entry] = station.vehicle.requests.entries
    assert (entry.request, entry.outcome, entry.count) == (request_text, outcome, 3)
    assert (entry.vehicle_id, entry.system_id, entry.component_id) == (1, 255, 190)
    assert entry.time_us == station.clock.now_us


def test_refused_request_of_an_untrusted_client_is_logged(station: GroundStation) -> None:
    station.trusted = False
    station.send(mavlink.MAVLink_param_set_message(*ME, b"RATE_ATT", 7.0, 9))
    [entry] = station.vehicle.requests.entries
    assert (entry.request, entry.outcome) == ("PARAM_SET RATE_ATT", "refused: not trusted")


def test_answered_requests_and_broadcasts_are_not_logged(station: GroundStation) -> None:
    station.request(148)
    station.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
    station.send(mavlink.MAVLink_param_request_read_message(*ME, b"RATE_ATT", -1))
    assert station.vehicle.requests.entries == ()


def test_log_is_bounded_and_keeps_the_newest(station: GroundStation) -> None:
    for number in range(2 * MAX_ENTRIES):
        station.request(30_000 + number)
    entries = station.vehicle.requests.entries
    assert len(entries) == MAX_ENTRIES
    assert entries[-1].request.endswith(str(30_000 + 2 * MAX_ENTRIES - 1))
