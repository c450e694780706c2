"""Operator control: which station may change things, and how control passes on."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import Incoming
from gateway.vehicle.request_reader import NOT_TRUSTED
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, command, decode, kinds, results, texts

REQUEST_CONTROL = 32100
ACCEPTED, DENIED, FAILED, NOT_IN_CONTROL = 0, 2, 4, 10
RELEASE, REQUEST = 0, 1


@pytest.fixture
def first(clock: ManualClock) -> GroundStation:
    vehicle = Vehicle(VehicleSettings(operator_control="exclusive"), 1)
    return GroundStation(vehicle, clock, client_id=7, system_id=255)


@pytest.fixture
def second(first: GroundStation) -> GroundStation:
    return first.other(system_id=254)


def control(station: GroundStation, action: int = REQUEST, takeover: int = 0) -> int:
    """Send the command as QGroundControl does; return the result."""
    found = station.command(REQUEST_CONTROL, action, takeover, 10, station.mav.srcSystem)
    return results(found)[0]


def notified(first: GroundStation, second: GroundStation, *params: float) -> Any:
    """Let the second station request control; return what the first is sent."""
    frame = second.frame(command(REQUEST_CONTROL, *params))
    actions = second.vehicle.handle(Incoming(second.client_id, frame, trusted=True), 0)
    [notice] = decode(a for a in actions if a.client_id == first.client_id)
    return notice


def changes(station: GroundStation) -> bool:
    return "PARAM_ERROR" not in kinds(station.set_parameter("RATE_ATT", 7.0))


def statuses(station: GroundStation, since: int = 0) -> list[tuple[int, int]]:
    """Return flags and controlling system of every CONTROL_STATUS that was sent."""
    frames = [f.frame for f in station.frames[since:] if f.message_id == 512]
    return [(frame[10], frame[11] if frame[1] > 1 else 0) for frame in frames]


def test_station_without_control_is_refused(first: GroundStation, second: GroundStation) -> None:
    assert not changes(first)
    assert control(first) == ACCEPTED
    assert changes(first)
    assert not changes(second)
    reason = "of system 254: system 255 is in control"
    assert f"Refused PARAM_SET {reason}" in "".join(texts(second.inbox))
    found = second.command(mavlink.MAV_CMD_LOGGING_START)
    assert (results(found), texts(found)) == ([NOT_IN_CONTROL], [f"Refused LOGGING_START {reason}"])
    assert second.command(512, 148)[0].result == ACCEPTED, "reading stays free"


def test_takeover_needs_the_consent_of_the_station_in_control(
    first: GroundStation, second: GroundStation
) -> None:
    control(first)
    notice = notified(first, second, REQUEST, 1, 10, 254)
    assert (notice.get_type(), notice.command) == ("COMMAND_LONG", REQUEST_CONTROL)
    assert (notice.target_system, notice.target_component) == (255, 190)
    assert (notice.param1, notice.param2, notice.param3, notice.param4) == (1, 1, 10, 254)
    assert control(second) == FAILED
    assert control(first, takeover=1) == ACCEPTED
    assert control(second) == ACCEPTED
    assert changes(second)
    assert not changes(first)


def test_only_the_station_in_control_may_release_it(
    first: GroundStation, second: GroundStation
) -> None:
    control(first)
    assert control(second, RELEASE) == DENIED
    assert control(first, RELEASE) == ACCEPTED
    assert control(second) == ACCEPTED


@pytest.mark.parametrize("how", ["gone", "silent"])
def test_control_ends_with_the_link_of_the_station(
    first: GroundStation, second: GroundStation, how: str
) -> None:
    control(first)
    if how == "gone":
        first.vehicle.remove_client(first.client_id)
    else:
        assert "System 255 lost control: timeout" in texts(second.wait(33.0))
    assert control(second) == ACCEPTED


def test_heartbeats_keep_control(first: GroundStation, second: GroundStation) -> None:
    control(first)
    for _ in range(60):
        first.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
        first.wait(1.0)
    assert control(second) == FAILED


def test_control_status_is_sent_regularly_and_at_every_change(first: GroundStation) -> None:
    first.wait(5.0)
    assert statuses(first)[-1] == (3, 0)
    control(first)
    assert statuses(first)[-1] == (1, 255)
    control(first, takeover=1)
    assert statuses(first)[-1] == (3, 255)
    before = len(statuses(first))
    first.wait(20.0)
    assert len(statuses(first)) - before == pytest.approx(20, abs=1)


def test_control_status_is_not_sent_while_control_is_open(station: GroundStation) -> None:
    station.wait(10.0)
    assert control(station) == ACCEPTED
    assert control(station, RELEASE) == ACCEPTED
    assert statuses(station) == []


def test_untrusted_client_cannot_take_control_or_act_for_another(
    first: GroundStation, second: GroundStation
) -> None:
    second.trusted = False
    assert control(second) == DENIED
    assert texts(second.inbox) == [f"Refused control to system 254: {NOT_TRUSTED}"]
    second.trusted = True
    assert results(second.command(REQUEST_CONTROL, REQUEST, 0, 10, 255)) == [DENIED]


FORMER = (0.0, 1.0, 0.0, 10.0)
"""Request of a definition before 2026-04-15: sender or 0, action, takeover, timeout."""


@pytest.mark.parametrize(
    ("params", "result", "takeover"),
    [
        ((1, 0, 10, 255), ACCEPTED, False),
        ((1, 1, 10, 255), ACCEPTED, True),
        ((1, 1, 10, 0), ACCEPTED, True),
        ((1, 0, 10, 250, 255), ACCEPTED, False),
        ((1, 0, 10, 1, 250), DENIED, False),
        ((1, 0, 10, 254), DENIED, False),
        (FORMER, ACCEPTED, False),
        ((0, 1, 1, 60), ACCEPTED, True),
        ((255, 1, 1, 3), ACCEPTED, True),
        ((254, 1, 1, 3), DENIED, False),
    ],
    ids=str,
)
def test_request_of_either_definition_is_understood(
    first: GroundStation, params: tuple[float, ...], result: int, takeover: bool
) -> None:
    assert results(first.command(REQUEST_CONTROL, *params)) == [result]
    assert changes(first) == (result == ACCEPTED)
    if result == ACCEPTED:
        assert statuses(first)[-1] == (3 if takeover else 1, 255)


@pytest.mark.parametrize(
    "params",
    [(0, 0, 0, 255), (0, 0, 0, 0), (0, 1, 0, 255), (0, 1, 30, 255), (0, 0, 0, 10)],
    ids=str,
)
def test_release_of_either_definition_is_understood(
    first: GroundStation, params: tuple[float, ...]
) -> None:
    control(first)
    assert results(first.command(REQUEST_CONTROL, *params)) == [ACCEPTED]
    assert not changes(first)


def test_ambiguous_request_is_read_by_the_present_definition(first: GroundStation) -> None:
    """System 10 releases control; formerly this was a request with a timeout of 10 s."""
    tenth = first.other(system_id=10)
    control(tenth)
    assert results(tenth.command(REQUEST_CONTROL, 0, 1, 0, 10)) == [ACCEPTED]
    assert not changes(tenth)


@pytest.mark.parametrize(
    ("asked", "params"), [(FORMER, (254, 1, 1, 20)), ((1, 0, 10, 255), (1, 1, 20, 254))]
)
def test_station_in_control_is_notified_in_its_own_order(
    first: GroundStation, second: GroundStation, asked: tuple[float, ...], params: tuple[int, ...]
) -> None:
    first.command(REQUEST_CONTROL, *asked)
    notice = notified(first, second, REQUEST, 1, 20, 254)
    assert (notice.param1, notice.param2, notice.param3, notice.param4) == params
    first.send(mavlink.MAVLink_command_ack_message(REQUEST_CONTROL, 0, 0, 0, 1, 1))
    assert "no answer" not in [entry.outcome for entry in first.vehicle.requests.entries]


@pytest.mark.parametrize("trusted", [False, True])
def test_heartbeats_of_another_client_with_the_same_id_do_not_keep_control(
    first: GroundStation, trusted: bool
) -> None:
    control(first)
    other = first.other(system_id=255, trusted=trusted)
    reported = []
    for _ in range(33):
        other.send(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3))
        reported += texts(other.wait(1.0))
    assert "System 255 lost control: timeout" in reported


def test_station_uses_control_by_the_link_that_requested_it_last(first: GroundStation) -> None:
    control(first)
    other = first.other(system_id=255)
    found = other.command(mavlink.MAV_CMD_LOGGING_START)
    assert results(found) == [NOT_IN_CONTROL]
    assert "by another link; request it again" in texts(found)[0]
    assert control(other) == ACCEPTED
    assert changes(other)
    assert not changes(first)
