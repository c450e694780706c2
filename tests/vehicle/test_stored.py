"""What a vehicle keeps, as a text, and what it is after a restart."""

import json
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import MAX_ITEMS, Item, Location, StoredPlan, decode_plan, encode_plan
from gateway.vehicle.requests import SavePlan
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.vehicle.ground_station import GroundStation
from tests.vehicle.samples import FIX, sample_at, state_at
from tests.vehicle.services.test_missions import content, download, item, upload

NAN = math.nan
ITEM = Item(3, 16, 1, (0.0, NAN, -math.inf, 0.1), 471_234_567, -87_654_321, 50.5)
VERTEX = Item(0, 5001, 1, (3.0, 0.0, 0.0, 0.0), 470_000_000, 80_000_000, 0.0)
FULL = StoredPlan(
    home=Location(47.123_456_7, -8.765_432_1, 520.25),
    mark=Location(1.0, 2.0, NAN),
    mark_of=2,
    current=1,
    mission=(ITEM, ITEM),
    fence=(VERTEX,) * 3,
    rally=(replace(ITEM, command=5100),),
)


@pytest.mark.parametrize("places", [StoredPlan(), FULL])
def test_round_trip(places: StoredPlan) -> None:
    again = decode_plan(encode_plan(places))
    # NaN is not equal to itself.
    assert repr(again) == repr(places)


@pytest.mark.parametrize("seed", range(5))
def test_round_trip_of_random_items(seed: int) -> None:
    rng = np.random.default_rng(seed)
    numbers = rng.integers(-900_000_000, 900_000_000, (MAX_ITEMS[0], 2))
    floats = rng.standard_normal((MAX_ITEMS[0], 5)).astype(np.float32).astype(float)
    items = tuple(
        Item(3, 16, 1, tuple(f[:4]), int(x), int(y), float(f[4]))
        for (x, y), f in zip(numbers, floats.tolist(), strict=True)
    )
    places = StoredPlan(mission=items)
    assert decode_plan(encode_plan(places)) == places


def changed(**values: object) -> str:
    return json.dumps(msgspec.to_builtins(FULL) | values)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "Expecting value"),
        (encode_plan(FULL)[:200], "Unterminated"),
        ("[1, 2]", "Expected `object`"),
        ("[" * 100_000, "recursion"),
        (changed(version=2), "version"),
        (changed(extra=1), "unknown field `extra`"),
        (changed(home={"lat_deg": 91.0, "lon_deg": 0.0, "alt_amsl_m": 0.0}), "home: latitude"),
        (changed(home={"lat_deg": 9.0, "lon_deg": 0.0, "alt_amsl_m": NAN}), "home: the height"),
        (changed(mark={"lat_deg": NAN, "lon_deg": 0.0, "alt_amsl_m": 0.0}), "mark: latitude"),
        (changed(current=2), "no item 2"),
        (changed(current=-1), "no item -1"),
        (changed(mission=[{"frame": 3}]), "missing required field"),
        (changed(fence=[msgspec.to_builtins(ITEM)]), "fence: item 0"),
        (changed(rally=[msgspec.to_builtins(FULL.rally[0])] * 101), "rally: more than 100"),
    ],
)
def test_a_text_that_nobody_could_have_stored_is_refused(text: str, why: str) -> None:
    with pytest.raises(ValueError, match=why):
        decode_plan(text)


def restarted(station: GroundStation) -> GroundStation:
    """Restart with the plan that was saved last, as read from a file."""
    text = encode_plan(station.of(SavePlan)[-1].plan)
    vehicle = Vehicle(VehicleSettings(), 1, stored=decode_plan(text))
    now_us = station.clock.now_us
    vehicle.on_gps(FIX, now_us)
    vehicle.on_state(state_at(now_us), sample_at(now_us), now_us)
    return GroundStation(vehicle, ManualClock())


@pytest.mark.parametrize("kind", [0, 1, 2])
def test_items_survive_a_restart(station: GroundStation, kind: int) -> None:
    items = [item(seq, kind) for seq in range(5)]
    upload(station, items, kind)
    [save] = station.of(SavePlan)
    assert save.vehicle_id == 1
    found = download(restarted(station), kind)
    assert list(map(content, found)) == list(map(content, items))


def test_nothing_is_kept_of_an_upload_that_is_not_complete(station: GroundStation) -> None:
    station.send(mavlink.MAVLink_mission_count_message(1, 1, 5, 0))
    for seq in range(4):
        station.send(item(seq))
    assert station.of(SavePlan) == []


def test_the_current_item_and_its_mark_survive(station: GroundStation) -> None:
    upload(station, [item(seq) for seq in range(5)])
    station.send(mavlink.MAVLink_mission_set_current_message(1, 1, 3))
    marked = station.vehicle.plan.mark.location
    after = restarted(station)
    assert after.request(42)[1].seq == 3
    assert after.vehicle.plan.mark.location == marked
    after.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))
    assert after.vehicle.plan.mark.location is None, "it still follows the mission"
    assert restarted(after).vehicle.plan.missions.items[0] == ()


def test_a_mark_of_its_own_survives_and_a_cleared_one_does_not(station: GroundStation) -> None:
    station.receive(station.vehicle.put_mark(Location(47.0, 8.0, NAN), 0))
    after = restarted(station)
    assert repr(after.vehicle.plan.mark.location) == repr(Location(47.0, 8.0, NAN))
    after.receive(after.vehicle.put_mark(None, 0))
    assert restarted(after).vehicle.plan.mark.location is None


def test_a_home_that_was_set_survives(station: GroundStation, clock: ManualClock) -> None:
    station.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 47.5, -8.5, 400.0)
    [_, reported] = restarted(station).request(242)
    assert (reported.latitude, reported.longitude, reported.altitude) == (
        475_000_000,
        -85_000_000,
        400_000,
    )
