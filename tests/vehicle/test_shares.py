"""Load of many or greedy clients: each gets its share, and the others go on."""

from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.request_reader import NOT_TRUSTED
from gateway.vehicle.services.ftp import Opcode
from tests.kit.ground_station import FtpClient, GroundStation, load_parameters, of_kind, texts

LIST = mavlink.MAVLink_param_request_list_message(1, 1)
FRAMES_A_SECOND = 1000
"""Of parameters, and as many of files; each at most a few percent of a processor."""


@pytest.fixture
def crowd(station: GroundStation) -> list[GroundStation]:
    """Thirty-one untrusted clients."""
    return [station.other(100 + n, trusted=False) for n in range(31)]


def sent_to(crowd: list[GroundStation], greedy: Callable[[int], Any], kind: int) -> int:
    """Return the frames of a kind that two seconds of twenty requests a second lead to."""
    vehicle = crowd[0].other(1)
    for _ in range(40):
        for number in range(len(crowd)):
            greedy(number)
        vehicle.wait(0.05)
    return sum(f.message_id == kind for each in (vehicle, *crowd) for f in each.frames)


def test_parameter_lists_of_many_clients_share_one_rate_limit(
    station: GroundStation, crowd: list[GroundStation]
) -> None:
    sent = sent_to(crowd, lambda n: crowd[n].send(LIST), mavlink.MAVLINK_MSG_ID_PARAM_VALUE)
    assert sent <= 2 * FRAMES_A_SECOND + 10
    assert load_parameters(station)["TUNING_CUTOFF"] == 10.0, "also while others request it"


def test_ftp_bursts_of_many_clients_share_one_rate_limit(crowd: list[GroundStation]) -> None:
    clients = [FtpClient(each) for each in crowd]
    sessions = [client.open(b"/parameter.json.xz").session for client in clients]
    for each in crowd:
        each.frames.clear()

    def greedy(n: int) -> None:
        client = clients[n]
        client.send(client.packet(Opcode.BURST_READ_FILE, session=sessions[n], size=1))

    kind = mavlink.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL
    assert sent_to(crowd, greedy, kind) <= 2 * FRAMES_A_SECOND + 10


def test_repeated_list_requests_restart_one_transfer(station: GroundStation) -> None:
    for _ in range(1000):
        station.send(LIST)
    station.inbox.clear()
    found = of_kind(station.wait(60.0), "PARAM_VALUE")
    assert len(found) <= found[-1].param_count
    assert found[-1].param_index == found[-1].param_count - 1


@pytest.mark.parametrize("trusted", [True, False])
def test_only_trusted_client_has_answers_sent_to_all(station: GroundStation, trusted: bool) -> None:
    station.trusted = trusted
    version = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
    station.command(mavlink.MAV_CMD_REQUEST_MESSAGE, version, 0, 0, 0, 0, 0, 2)
    to_all = [f.client_id is None for f in station.frames if f.message_id == version]
    assert to_all == [trusted]


def test_refusals_of_untrusted_clients_are_reported_slowly(station: GroundStation) -> None:
    station.trusted = False
    for _ in range(60 * 20):
        station.command(mavlink.MAV_CMD_LOGGING_START)
        station.wait(0.05)
    reported = [text for text in texts(station.frames) if text.startswith("Refused")]
    assert 3 <= len(reported) <= 8
    assert set(reported) == {f"Refused LOGGING_START of system 255: {NOT_TRUSTED}"}
