"""What many or greedy clients may cause: everybody's share, and nobody else's harm."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Outgoing
from gateway.vehicle.services import ftp as ftp_service
from gateway.vehicle.services.ftp import ACK, FtpError, Opcode
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.vehicle.ground_station import GroundStation
from tests.vehicle.services.test_ftp import Ftp
from tests.vehicle.services.test_parameters import values

STATUSTEXT = mavlink.MAVLINK_MSG_ID_STATUSTEXT
FRAMES_A_SECOND = 1000
"""Of parameters, and as many of files; each at most a few percent of a processor."""


@pytest.fixture
def crowd(vehicle: Vehicle, clock: ManualClock) -> list[GroundStation]:
    """Thirty-one clients that nobody trusts."""
    return [GroundStation(vehicle, clock, client_id=100 + n, trusted=False) for n in range(31)]


def frames_of(stations: list[GroundStation], kind: int) -> int:
    return sum(frame.message_id == kind for each in stations for frame in each.frames)


def run_for(crowd: list[GroundStation], greedy: Any, seconds: int, station: GroundStation) -> None:
    """Let everybody be greedy twenty times a second."""
    for _ in range(20 * seconds):
        for each in crowd:
            greedy(each)
        station.wait(0.05)


def test_lists_of_parameters_for_a_crowd_are_no_more_work_than_for_one(
    station: GroundStation, crowd: list[GroundStation]
) -> None:
    request = mavlink.MAVLink_param_request_list_message(1, 1)
    run_for(crowd, lambda each: each.send(request), 2, station)
    sent = frames_of([station, *crowd], mavlink.MAVLINK_MSG_ID_PARAM_VALUE)
    assert sent <= 2 * FRAMES_A_SECOND + 10


def test_parameter_list_arrives_while_many_other_clients_request_it(
    station: GroundStation, crowd: list[GroundStation]
) -> None:
    for each in crowd:
        each.send(mavlink.MAVLink_param_request_list_message(1, 1))
    assert values(station)["TUNING_CUTOFF"] == 10.0


def test_bursts_of_single_bytes_for_a_crowd_are_no_more_work_than_for_one(
    station: GroundStation, crowd: list[GroundStation]
) -> None:
    clients = {each.client_id: Ftp(each) for each in crowd}
    sessions = {
        key: client.ask(Opcode.OPEN_FILE_RO, b"/parameter.json.xz").session
        for key, client in clients.items()
    }
    for each in crowd:
        each.frames.clear()

    def greedy(each: GroundStation) -> None:
        client = clients[each.client_id]
        session = sessions[each.client_id]
        client.send(client.packet(Opcode.BURST_READ_FILE, session=session, size=1))

    run_for(crowd, greedy, 2, station)
    kind = mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
    assert frames_of([station, *crowd], kind) <= 2 * FRAMES_A_SECOND + 10


def test_sessions_of_an_untrusted_client_close_no_others(station: GroundStation) -> None:
    mine = Ftp(station)
    session = mine.ask(Opcode.OPEN_FILE_RO, b"/general.json").session
    untrusted = Ftp(GroundStation(station.vehicle, station.clock, client_id=8, trusted=False))
    for _ in range(100):
        assert untrusted.ask(Opcode.OPEN_FILE_RO, b"/parameter.json.xz").opcode == ACK
    assert mine.ask(Opcode.READ_FILE, session=session, size=9).opcode == ACK


def test_untrusted_sessions_give_way_to_a_trusted_client(
    station: GroundStation, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ftp_service, "MAX_SESSIONS", 12)
    vehicle, clock = station.vehicle, station.clock
    for client_id in range(100, 103):
        untrusted = Ftp(GroundStation(vehicle, clock, client_id=client_id, trusted=False))
        for _ in range(4):
            assert untrusted.ask(Opcode.OPEN_FILE_RO, b"/general.json").opcode == ACK
    late = Ftp(GroundStation(vehicle, clock, client_id=103, trusted=False))
    refused = late.ask(Opcode.OPEN_FILE_RO, b"/general.json")
    assert refused.data == bytes([FtpError.NO_SESSIONS])
    assert Ftp(station).ask(Opcode.OPEN_FILE_RO, b"/general.json").opcode == ACK


@pytest.mark.parametrize("trusted", [True, False])
def test_only_the_trusted_may_have_an_answer_sent_to_all(
    station: GroundStation, trusted: bool
) -> None:
    station.trusted = trusted
    version = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, version, 0, 0, 0, 0, 0, 2)
    to_all = [f.client_id is None for f in station.frames if f.message_id == version]
    assert to_all == [trusted]


def test_refusals_of_untrusted_clients_are_reported_at_a_limited_rate(
    station: GroundStation,
) -> None:
    untrusted = GroundStation(station.vehicle, station.clock, client_id=8, trusted=False)
    for _ in range(60 * 20):
        untrusted.command(mavlink.MAV_CMD_LOGGING_START)
        untrusted.wait(0.05)
    reported = [
        f for f in untrusted.frames if isinstance(f, Outgoing) and f.message_id == STATUSTEXT
    ]
    assert 3 <= len(reported) <= 8
