import math

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import Location
from gateway.vehicle.vehicle import Vehicle
from tests.conftest import ManualClock
from tests.vehicle.ground_station import GroundStation, kinds
from tests.vehicle.samples import STATE

ACCEPTED, NOT_NOW, DENIED, UNSUPPORTED = 0, 1, 2, 3
SET_HOME = mavlink.MAV_CMD_DO_SET_HOME


def results(messages: list) -> list[int]:
    return [m.result for m in messages if m.get_type() == "COMMAND_ACK"]


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
    assert station.vehicle.faults["own id"] == 1


def test_home_is_set_to_a_place_and_sent_to_all(station: GroundStation) -> None:
    found = station.command(SET_HOME, 0, 0, 0, 0, 47.5, -8.5, 400.0)
    assert kinds(found) == ["COMMAND_ACK", "HOME_POSITION", "STATUSTEXT"]
    assert (found[1].latitude, found[1].altitude) == (475_000_000, 400_000)
    [_, position] = station.request(33)
    assert position.relative_alt == pytest.approx(123_456, abs=1)
    assert station.vehicle.plan.mark.location == pytest.approx(Location(47.5, -8.5, 400.0))


def test_home_by_integers_relative_to_the_old_one(station: GroundStation) -> None:
    command = mavlink.MAVLink_command_int_message(
        1, 1, 6, SET_HOME, 0, 0, 0, 0, 0, 0, 475_000_000, -85_000_000, -20.0
    )
    assert station.send(command)[1].altitude == 500_250


def test_home_is_set_to_where_the_vehicle_is(station: GroundStation) -> None:
    found = station.command(SET_HOME, 1)
    assert found[1].latitude == round(STATE.lat_deg * 1e7)


def test_home_cannot_be_here_without_a_position(vehicle: Vehicle, clock: ManualClock) -> None:
    assert results(GroundStation(vehicle, clock).command(SET_HOME, 1)) == [NOT_NOW]


@pytest.mark.parametrize(
    "place", [(91.0, 0.0, 0.0), (0.0, 181.0, 0.0), (math.nan, 0.0, 0.0), (47.0, 8.0, math.nan)]
)
def test_home_with_invalid_coordinates_is_denied(
    station: GroundStation, place: tuple[float, ...]
) -> None:
    before = station.vehicle.telemetry.home
    assert results(station.command(SET_HOME, 0, 0, 0, 0, *place)) == [DENIED]
    assert station.vehicle.telemetry.home == before


def test_a_local_frame_is_no_place(station: GroundStation) -> None:
    command = mavlink.MAVLink_command_int_message(1, 1, 1, SET_HOME, 0, 0, 0, 0, 0, 0, 1, 2, 3)
    assert results(station.send(command)) == [DENIED]


@pytest.mark.parametrize(
    "number",
    [
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_DO_SET_ROI,
        mavlink.MAV_CMD_DO_SET_ROI_LOCATION,
        mavlink.MAV_CMD_DO_SET_ROI_NONE,
        mavlink.MAV_CMD_DO_SET_MISSION_CURRENT,
        mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
        mavlink.MAV_CMD_PREFLIGHT_STORAGE,
        mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN,
        mavlink.MAV_CMD_LOGGING_START,
        mavlink.MAV_CMD_LOGGING_STOP,
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
        mavlink.MAV_CMD_DO_SET_MODE,
    ],
)
def test_an_untrusted_client_commands_nothing(station: GroundStation, number: int) -> None:
    station.trusted = False
    found = station.command(number, 1)
    assert results(found) == [DENIED]
    assert station.actions == []
    assert station.vehicle.refusals == 1


def test_refusals_are_reported_but_cannot_flood(station: GroundStation) -> None:
    station.trusted = False
    found = [m for _ in range(200) for m in station.command(mavlink.MAV_CMD_LOGGING_START)]
    assert len(results(found)) == 200
    reported = [m.text for m in found if m.get_type() == "STATUSTEXT"]
    assert 1 <= len(reported) <= 20
    assert set(reported) == {"Refused LOGGING_START of system 255"}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
@pytest.mark.parametrize(
    "number", [512, 511, 510, 179, 195, 201, 241, 245, 224, 2510, 400, 410, 519, 520]
)
def test_odd_parameters_do_no_harm(station: GroundStation, number: int, bad: float) -> None:
    found = station.command(number, *[bad] * 7)
    assert len(results(found)) == 1


@pytest.mark.parametrize("place", [(90.1, 0.0), (0.0, 180.1), (math.nan, 8.0)])
def test_a_mark_that_is_nowhere_is_a_fault_of_the_caller(
    vehicle: Vehicle, place: tuple[float, float]
) -> None:
    with pytest.raises(ValueError, match="must be between"):
        vehicle.put_mark(Location(*place, 0.0), 0)


def test_a_mark_on_the_other_side_of_the_earth(station: GroundStation) -> None:
    state = station.vehicle.telemetry.state
    opposite = Location(-state.lat_deg, state.lon_deg + 180.0, 0.0)
    station.vehicle.put_mark(opposite, 0)
    assert results(station.request(62)) in ([ACCEPTED], [NOT_NOW])


def test_the_mark_of_the_command_line(station: GroundStation) -> None:
    found = station.receive(station.vehicle.put_mark(Location(47.0, 8.0, math.nan), 0))
    assert [m.text for m in found] == ["Marked 47.000000, 8.000000"]
    assert results(station.request(62)) == [ACCEPTED]
