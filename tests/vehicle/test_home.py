"""Home as parameters: one number at a time, stored only on request, and cleared."""

import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import Location, StoredPlan
from gateway.vehicle.requests import SavePlan, SettingsChange
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.vehicle.ground_station import GroundStation
from tests.vehicle.samples import FIX, fix_at, texts
from tests.vehicle.services.test_parameters import set_message, values

NAMES = ("HOME_SOURCE", "HOME_LAT", "HOME_LON", "HOME_ALT")
NONE, GPS, OPERATOR = 0.0, 1.0, 2.0
FIELD = Location(47.123_456_7, -8.765_432_1, 520.25)
"""Where the fix of the samples is."""


def home(station: GroundStation) -> list[float]:
    found = values(station)
    return [found[name] for name in NAMES]


def sent_homes(messages: list[Any]) -> list[tuple[int, int, int]]:
    found = [m for m in messages if m.get_type() == "HOME_POSITION"]
    return [(m.latitude, m.longitude, m.altitude) for m in found]


def float32(value: float) -> float:
    return struct.unpack("<f", struct.pack("<f", value))[0]


def kept(station: GroundStation) -> list[Location | None]:
    return [save.plan.home for save in station.of(SavePlan)]


@pytest.fixture
def nowhere(clock: ManualClock) -> GroundStation:
    """A station of a vehicle that has no home yet."""
    return GroundStation(Vehicle(VehicleSettings(), 1), clock)


def test_the_home_of_the_gps_is_shown_as_parameters(nowhere: GroundStation) -> None:
    assert home(nowhere) == [NONE, 0.0, 0.0, 0.0]
    nowhere.receive(nowhere.vehicle.on_gps(FIX, 0))
    assert set(NAMES) <= {m.param_id for m in nowhere.inbox if m.get_type() == "PARAM_VALUE"}
    assert home(nowhere) == [GPS, *map(float32, (47.123_456_7, -8.765_432_1, 520.25))]
    assert nowhere.of(SavePlan) == [], "it is measured again at every start"


def test_one_number_moves_home_and_leaves_the_others_exact(station: GroundStation) -> None:
    found = station.send(set_message("HOME_LAT", 47.5))
    assert sent_homes(found) == [(475_000_000, -87_654_321, 520_250)]
    assert home(station)[:2] == [OPERATOR, 47.5]
    assert "HOME_POSITION" in station.broadcasts
    assert station.of(SettingsChange) == [], "it is no setting of another stage"


def test_a_latitude_is_as_fine_as_a_float_can_be(station: GroundStation) -> None:
    sent = float32(-122.123_456)
    [(_, lon, _)] = sent_homes(station.send(set_message("HOME_LON", sent)))
    assert lon / 1e7 == pytest.approx(sent, abs=4e-6)


def test_numbers_sent_back_as_they_were_shown_change_nothing(station: GroundStation) -> None:
    for name, value in zip(NAMES, home(station), strict=True):
        assert sent_homes(station.send(set_message(name, value))) == []
    assert station.vehicle.telemetry.home.location == pytest.approx(FIELD)
    assert home(station)[0] == GPS


@pytest.mark.parametrize("first", ["HOME_LAT", "HOME_LON", "HOME_ALT"])
def test_a_home_begins_only_with_its_last_number(nowhere: GroundStation, first: str) -> None:
    """Half a home would be thousands of kilometres off; zero is a number like any other."""
    wanted = {"HOME_LAT": 51.5, "HOME_LON": 0.0, "HOME_ALT": 45.0}
    names = [first, *(name for name in wanted if name != first)]
    for name in names[:-1]:
        found = nowhere.send(set_message(name, wanted[name]))
        assert [m.param_value for m in found if m.get_type() == "PARAM_VALUE"] == [wanted[name]]
        assert sent_homes(found) == []
    assert home(nowhere)[0] == NONE
    found = nowhere.send(set_message(names[-1], wanted[names[-1]]))
    assert sent_homes(found) == [(515_000_000, 0, 45_000)]
    assert home(nowhere) == [OPERATOR, 51.5, 0.0, 45.0]


def test_a_fix_overrides_half_a_home(nowhere: GroundStation) -> None:
    nowhere.send(set_message("HOME_LAT", 1.0))
    nowhere.receive(nowhere.vehicle.on_gps(FIX, 0))
    assert home(nowhere)[0] == GPS
    assert home(nowhere)[1] == float32(47.123_456_7)


@pytest.mark.parametrize(
    ("name", "value"),
    [("HOME_LAT", 90.1), ("HOME_LON", -180.1), ("HOME_ALT", 1e6), ("HOME_SOURCE", 3.0)],
)
def test_invalid_coordinates_are_refused(station: GroundStation, name: str, value: float) -> None:
    before = home(station)
    error, echo = station.send(set_message(name, value))
    assert (error.get_type(), echo.param_value) == ("PARAM_ERROR", before[NAMES.index(name)])
    assert home(station) == before


def test_it_is_kept_when_the_parameters_are_stored(station: GroundStation) -> None:
    station.send(set_message("HOME_LAT", 47.5))
    assert station.of(SavePlan) == []
    station.vehicle.put_mark(None, 0)
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1)
    assert kept(station)[-1] == pytest.approx(Location(47.5, -8.765_432_1, 520.25))


def test_saving_the_plan_does_not_keep_an_unstored_home(station: GroundStation) -> None:
    station.send(set_message("HOME_LAT", 47.5))
    station.receive(station.vehicle.put_mark(Location(1.0, 2.0, 3.0), 0))
    assert kept(station) == [None]


def test_a_command_keeps_it_at_once(station: GroundStation) -> None:
    station.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 47.5, -8.5, 400.0)
    assert kept(station) == [pytest.approx(Location(47.5, -8.5, 400.0))]


def test_the_home_of_the_gps_can_be_kept(station: GroundStation) -> None:
    station.send(set_message("HOME_SOURCE", OPERATOR))
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1)
    assert kept(station) == [pytest.approx(FIELD)]


def test_cleared_home_is_measured_again(clock: ManualClock) -> None:
    stored = StoredPlan(home=Location(10.0, 20.0, 30.0))
    station = GroundStation(Vehicle(VehicleSettings(), 1, stored=stored), clock)
    assert home(station) == [OPERATOR, 10.0, 20.0, 30.0]
    reported = texts(station.vehicle.on_gps(FIX, 0))
    assert reported == ["Stored home is used, 4927564 m from here", "GPS fix"]
    assert texts(station.vehicle.on_gps(FIX, 1)) == [], "once"
    [echo] = [m for m in station.send(set_message("HOME_SOURCE", NONE)) if m.param_id == NAMES[0]]
    assert echo.param_value == NONE
    assert home(station) == [NONE, 0.0, 0.0, 0.0]
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1)
    assert kept(station) == [None]
    station.receive(station.vehicle.on_gps(fix_at(200_000), 200_000))
    assert home(station)[0] == GPS


def test_a_source_without_a_home_is_refused(nowhere: GroundStation) -> None:
    for source in (GPS, OPERATOR):
        error, echo = nowhere.send(set_message("HOME_SOURCE", source))
        assert (error.get_type(), echo.param_value) == ("PARAM_ERROR", NONE)


def test_default_parameters_leave_home_alone(station: GroundStation) -> None:
    station.send(set_message("HOME_LAT", 47.5))
    station.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 2)
    assert home(station)[:2] == [OPERATOR, 47.5]
