import math

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.quaternion import from_euler
from gateway.panel.state.fleet import MAX_VEHICLES, FleetState
from gateway.panel.state.vehicle import VehicleState
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location
from tests.panel.messages import decoded, fix, heartbeat, position

HERE = (47.0, 8.0)


@pytest.fixture
def vehicle() -> VehicleState:
    return VehicleState(1)


def test_values_that_were_never_sent_are_unknown(vehicle: VehicleState) -> None:
    now = vehicle.instant(0)
    assert math.isinf(now.silent_s)
    assert all(math.isnan(value) for value in (*now.q_nb, now.lat_deg, now.groundspeed_mps))
    assert (now.model, now.fix, now.home, now.mark) == ("none", None, None, None)


def test_newest_attitude_of_either_message_is_used(vehicle: VehicleState) -> None:
    q_nb = from_euler(0.3, -0.1, 1.5)
    vehicle.update(decoded(mavlink.MAVLink_attitude_quaternion_message(0, *q_nb, 0.1, 0, 0)), 0)
    assert vehicle.instant(0).q_nb == pytest.approx(q_nb, abs=1e-6)
    later = mavlink.MAVLink_attitude_message(0, -0.4, 0.2, 0.1, 0, 0, 0)
    vehicle.update(decoded(later), 2 * US_PER_S)
    now = vehicle.instant(2 * US_PER_S)
    assert now.q_nb == pytest.approx(from_euler(-0.4, 0.2, 0.1), abs=1e-6)


def test_position_is_in_si(vehicle: VehicleState) -> None:
    vehicle.update(position(*HERE, 431.5), 7)
    now = vehicle.instant(7)
    assert (now.lat_deg, now.lon_deg, now.alt_amsl_m) == pytest.approx((*HERE, 431.5))
    assert now.vel_n_mps == (12.0, -5.0, -1.0)
    assert (now.alt_home_m, now.heading_deg, now.time_us) == (5.0, 90.0, 7)


def test_path_has_a_few_points_a_second_and_fixes_apart(vehicle: VehicleState) -> None:
    for step in range(50):
        vehicle.update(position(HERE[0] + step * 1e-5, HERE[1]), step * 20_000)
    for step in (0, 0, 1):
        vehicle.update(fix(HERE[0] + step * 1e-4, HERE[1]), step)
    assert len(vehicle.history) == len(vehicle.history.track()) == 5
    assert vehicle.history.columns["alt_amsl_m"][0] == pytest.approx(100.0)
    assert len(vehicle.fixes) == 2, "one that is repeated counts once"
    vehicle.restart_path()
    assert len(vehicle.history) == 0
    vehicle.update(fix(HERE[0], HERE[1]), 2)
    vehicle.update(fix(HERE[0] + 1e-4, HERE[1]), 3)
    assert [point.lat_deg for point in vehicle.fixes] == pytest.approx([47.0, 47.0001])


def test_satellites_that_are_not_counted_are_unknown(vehicle: VehicleState) -> None:
    assert math.isnan(vehicle.instant(0).satellites)
    vehicle.update(fix(*HERE, satellites=255), 0)
    assert math.isnan(vehicle.instant(0).satellites)
    vehicle.update(fix(*HERE, satellites=7), 1)
    assert vehicle.instant(1).satellites == 7
    # As in a log that has none.
    vehicle.update(fix(*HERE, satellites=0), 2)
    assert math.isnan(vehicle.instant(2).satellites)
    vehicle.update(fix(*HERE, kind=mavlink.GPS_FIX_TYPE_NO_FIX, satellites=0), 3)
    assert vehicle.instant(3).satellites == 0


def test_mark_is_computed_from_distance_and_bearing(vehicle: VehicleState) -> None:
    vehicle.update(position(0.0, 179.999), 0)
    way = mavlink.MAVLink_nav_controller_output_message(
        math.nan, math.nan, 90, 90, 1113, math.nan, 0, math.nan
    )
    vehicle.update(decoded(way), 0)
    now = vehicle.instant(0)
    assert now.mark is not None
    assert (now.mark.lat_deg, now.mark.lon_deg) == pytest.approx((0.0, -179.991), abs=1e-4)
    # The field saturates.
    vehicle.update(
        decoded(mavlink.MAVLink_nav_controller_output_message(*(0,) * 4, 65535, 0, 0, 0)), 0
    )
    assert vehicle.instant(0).mark is None
    vehicle.exact_mark = Location(1.0, 2.0, 3.0)
    assert vehicle.instant(0).mark == Location(1.0, 2.0, 3.0)


def test_impossible_values_are_unknown(vehicle: VehicleState) -> None:
    vehicle.update(decoded(mavlink.MAVLink_attitude_message(0, math.inf, 0, 0, 1, 0, 0)), 0)
    vehicle.update(position(*HERE), 0)
    vehicle.update(position(214.0, 8.0), 0)
    way = mavlink.MAVLink_nav_controller_output_message(0, 0, 90, 90, 1113, 0, 0, 0)
    vehicle.update(decoded(way), 0)
    now = vehicle.instant(0)
    assert all(math.isnan(value) for value in now.q_nb)
    assert now.rate_b_radps == (1, 0, 0)
    assert now.mark is not None
    assert now.lat_deg == pytest.approx(47.0)


@pytest.mark.parametrize(
    ("kind", "model"),
    [(1, "plane"), (2, "copter"), (13, "copter"), (4, "heli"), (19, "plane"), (26, "none")],
)
def test_model_follows_the_vehicle_type(vehicle: VehicleState, kind: int, model: str) -> None:
    vehicle.update(heartbeat(kind), 0)
    assert vehicle.model == model


@pytest.mark.parametrize(
    ("chunks", "later_s", "shown"),
    [
        (("a" * 50, "b" * 50, "c"), 0, ["a" * 50 + "b" * 50 + "c"]),
        (("a" * 50, ""), 0, ["a" * 50]),
        (("a" * 49 + " ",), 0, []),
        (("a" * 49 + " ",), 4, ["a" * 49 + "…"]),
    ],
    ids=["three", "an empty last one", "last one to come", "last one lost"],
)
def test_chunks_of_a_text_are_joined(
    vehicle: VehicleState, chunks: tuple[str, ...], later_s: int, shown: list[str]
) -> None:
    for number, text in enumerate(chunks):
        vehicle.update(decoded(mavlink.MAVLink_statustext_message(4, text.encode(), 9, number)), 0)
    vehicle.update(heartbeat(), later_s * US_PER_S)
    assert [entry.text for entry in vehicle.texts.all] == shown
    vehicle.update(decoded(mavlink.MAVLink_statustext_message(2, b"next")), later_s * US_PER_S)
    newest = vehicle.texts.all[-1]
    assert (newest.number, newest.severity, newest.text) == (len(vehicle.texts.all), 2, "next")


def test_position_before_the_first_fix_is_unknown(vehicle: VehicleState) -> None:
    vehicle.update(position(0.0, 0.0), 7)
    for kind in (3, mavlink.GPS_FIX_TYPE_NO_FIX):
        vehicle.update(fix(0.0, 0.0, kind=kind, satellites=255), 7)
    now = vehicle.instant(7)
    assert math.isnan(now.lat_deg)
    assert (now.fix, len(vehicle.history), len(vehicle.fixes)) == (None, 0, 0)


def test_position_of_a_poorer_source_is_used_without_a_better_one(vehicle: VehicleState) -> None:
    vehicle.update(fix(47.5, 8.0), 0)
    assert vehicle.instant(0).lat_deg == pytest.approx(47.5)
    assert len(vehicle.history) == 1
    vehicle.update(position(*HERE), 10)
    vehicle.update(fix(47.5, 8.0), 20)
    assert vehicle.instant(20).lat_deg == pytest.approx(47.0)
    vehicle.update(fix(47.5, 8.0), 5 * US_PER_S)
    assert vehicle.instant(5 * US_PER_S).lat_deg == pytest.approx(47.5)


def test_aircraft_are_separate_and_other_components_ignored() -> None:
    fleet, heard = FleetState(), []
    leave = fleet.listen(lambda system_id, message, _: heard.append(system_id))
    fleet.update(position(*HERE, system_id=3), 0)
    fleet.update(position(1.0, 2.0, system_id=4), 0)
    fleet.update(heartbeat(system_id=255), 0)
    fleet.update(heartbeat(system_id=3, component_id=100), 0)
    leave()
    fleet.update(heartbeat(system_id=3), 0)
    assert sorted(fleet.vehicles) == [3, 4]
    assert heard == [3, 4]
    now = fleet.vehicles[4].instant(0)
    assert (now.lat_deg, now.title) == (pytest.approx(1.0), "Aircraft 4")


def test_vehicle_is_the_component_with_an_autopilots_heartbeat() -> None:
    fleet = FleetState()
    camera = mavlink.MAVLink_heartbeat_message(30, 8, 0, 0, 4, 3)
    fleet.update(decoded(camera, 3, 100), 0)
    fleet.update(position(1.0, 2.0, system_id=3, component_id=100), 0)
    assert fleet.vehicles == {}
    fleet.update(heartbeat(system_id=3, component_id=5), 0)
    fleet.update(position(*HERE, system_id=3, component_id=5), 0)
    assert fleet.vehicles[3].instant(0).lat_deg == pytest.approx(HERE[0])
    fleet.update(position(1.0, 2.0, system_id=3), 0)
    assert fleet.vehicles[3].instant(0).lat_deg == pytest.approx(1.0)


def test_number_of_forged_systems_is_bounded() -> None:
    fleet = FleetState()
    for system_id in range(1, 200):
        fleet.update(heartbeat(system_id=system_id), 0)
    assert len(fleet.vehicles) == MAX_VEHICLES
