"""Home as parameters: one number at a time, stored only on request, and cleared."""

from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import Location, StoredPlan
from gateway.vehicle.service import SavePlan, SettingsChange
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, load_parameters, of_kind, texts
from tests.kit.records import FIX, fix_at

NAMES = ("HOME_SOURCE", "HOME_LAT", "HOME_LON", "HOME_ALT")
NONE, GPS, OPERATOR = 0.0, 1.0, 2.0
FIELD = Location(47.123_456_7, -8.765_432_1, 520.25)
"""Where the fix of the samples is."""
FIELD32: list[float] = np.float32([47.123_456_7, -8.765_432_1, 520.25]).tolist()


def home(station: GroundStation) -> list[float]:
    found = load_parameters(station)
    return [found[name] for name in NAMES]


def sent_homes(messages: list[Any]) -> list[tuple[int, int, int]]:
    found = of_kind(messages, "HOME_POSITION")
    return [(m.latitude, m.longitude, m.altitude) for m in found]


def store(station: GroundStation) -> Location | None:
    """Store the parameters; return the home that is kept then."""
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1)
    plan: StoredPlan = station.of(SavePlan)[-1].plan
    return plan.home


@pytest.fixture
def nowhere(clock: ManualClock) -> GroundStation:
    """A station of a vehicle that has no home yet."""
    return GroundStation(Vehicle(VehicleSettings(), 1), clock)


def test_home_of_the_gps_is_reported_as_parameters(nowhere: GroundStation) -> None:
    assert home(nowhere) == [NONE, 0.0, 0.0, 0.0]
    nowhere.receive(nowhere.vehicle.on_gps(FIX, 0))
    assert set(NAMES) <= {m.param_id for m in of_kind(nowhere.inbox, "PARAM_VALUE")}
    assert home(nowhere) == [GPS, *FIELD32]
    assert nowhere.of(SavePlan) == [], "it is measured again at every start"


def test_one_parameter_moves_home_and_leaves_the_others_exact(station: GroundStation) -> None:
    found = station.set_parameter("HOME_LAT", 47.5)
    assert sent_homes(found) == [(475_000_000, -87_654_321, 520_250)]
    assert home(station)[:2] == [OPERATOR, 47.5]
    assert "HOME_POSITION" in station.broadcasts
    assert station.of(SettingsChange) == [], "it is no setting of another stage"
    station.receive(station.vehicle.put_mark(Location(1.0, 2.0, 3.0), 0))
    assert [save.plan.home for save in station.of(SavePlan)] == [None], "it is not stored yet"
    assert store(station) == pytest.approx(Location(47.5, -8.765_432_1, 520.25))
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2)
    assert home(station)[:2] == [OPERATOR, 47.5], "home has no default"


def test_longitude_keeps_the_resolution_of_a_float(station: GroundStation) -> None:
    sent = float(np.float32(-122.123_456))
    [(_, lon, _)] = sent_homes(station.set_parameter("HOME_LON", sent))
    assert lon / 1e7 == pytest.approx(sent, abs=4e-6)


def test_parameters_written_back_unchanged_do_not_move_home(station: GroundStation) -> None:
    for name, value in zip(NAMES, home(station), strict=True):
        assert sent_homes(station.set_parameter(name, value)) == []
    assert station.vehicle.telemetry.home.location == pytest.approx(FIELD)
    assert home(station)[0] == GPS


@pytest.mark.parametrize("first", ["HOME_LAT", "HOME_LON", "HOME_ALT"])
def test_home_is_set_only_by_its_last_parameter(nowhere: GroundStation, first: str) -> None:
    """Half a home would be thousands of kilometres off; zero is a number like any other."""
    wanted = {"HOME_LAT": 51.5, "HOME_LON": 0.0, "HOME_ALT": 45.0}
    *names, last = [first, *(name for name in wanted if name != first)]
    for name in names:
        found = nowhere.set_parameter(name, wanted[name])
        assert [m.param_value for m in of_kind(found, "PARAM_VALUE")] == [wanted[name]]
        assert sent_homes(found) == []
    assert home(nowhere)[0] == NONE
    assert sent_homes(nowhere.set_parameter(last, wanted[last])) == [(515_000_000, 0, 45_000)]
    assert home(nowhere) == [OPERATOR, 51.5, 0.0, 45.0]


def test_fix_replaces_an_incomplete_home(nowhere: GroundStation) -> None:
    nowhere.set_parameter("HOME_LAT", 1.0)
    nowhere.receive(nowhere.vehicle.on_gps(FIX, 0))
    assert home(nowhere)[:2] == [GPS, FIELD32[0]]


def test_home_of_the_gps_can_be_stored(station: GroundStation) -> None:
    station.set_parameter("HOME_SOURCE", OPERATOR)
    assert store(station) == pytest.approx(FIELD)


def test_cleared_home_is_measured_again(clock: ManualClock) -> None:
    stored = StoredPlan(home=Location(10.0, 20.0, 30.0))
    station = GroundStation(Vehicle(VehicleSettings(), 1, stored=stored), clock)
    assert home(station) == [OPERATOR, 10.0, 20.0, 30.0]
    reported = texts(station.vehicle.on_gps(FIX, 0))
    assert reported == ["Stored home is used, 4927564 m from here", "GPS fix"]
    assert texts(station.vehicle.on_gps(FIX, 1)) == [], "once"
    found = station.set_parameter("HOME_SOURCE", NONE)
    assert [m.param_value for m in found if m.param_id == "HOME_SOURCE"] == [NONE]
    assert home(station) == [NONE, 0.0, 0.0, 0.0]
    assert store(station) is None
    station.receive(station.vehicle.on_gps(fix_at(200_000), 200_000))
    assert home(station)[0] == GPS


def test_source_without_a_home_is_refused(nowhere: GroundStation) -> None:
    for source in (GPS, OPERATOR):
        error, echo = nowhere.set_parameter("HOME_SOURCE", source)
        assert (error.get_type(), echo.param_value) == ("PARAM_ERROR", NONE)
