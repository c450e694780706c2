"""The stored plan of a vehicle: its text, and the vehicle after a restart."""

import json
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import MAX_ITEMS, Item, Location, StoredPlan, decode_plan, encode_plan
from gateway.vehicle.service import SavePlan
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation, content, count, download, item, upload
from tests.kit.records import FIX, sample_at, state_at

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


def random_plan(seed: int) -> StoredPlan:
    rng = np.random.default_rng(seed)
    numbers = rng.integers(-900_000_000, 900_000_000, (MAX_ITEMS[0], 2)).tolist()
    floats = rng.standard_normal((MAX_ITEMS[0], 5)).astype(np.float32).astype(float).tolist()
    pairs = zip(numbers, floats, strict=True)
    items = [Item(3, 16, 1, (*f[:4],), x, y, f[4]) for (x, y), f in pairs]
    return StoredPlan(mission=tuple(items))


@pytest.mark.parametrize(
    "plan",
    [StoredPlan(), FULL, *map(random_plan, range(2))],
    ids=["empty", "full", "long", "other"],
)
def test_decoded_plan_equals_the_encoded_one(plan: StoredPlan) -> None:
    # NaN is not equal to itself.
    assert repr(decode_plan(encode_plan(plan))) == repr(plan)


def changed(**values: object) -> str:
    return json.dumps(msgspec.to_builtins(FULL) | values)


def location(lat_deg: float, alt_amsl_m: float = 0.0) -> dict[str, float]:
    return {"lat_deg": lat_deg, "lon_deg": 0.0, "alt_amsl_m": alt_amsl_m}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("", "Expecting value"),
        (encode_plan(FULL)[:200], "Unterminated"),
        ("[1, 2]", "Expected `object`"),
        ("[" * 100_000, "recursion"),
        (changed(version=2), "version"),
        (changed(extra=1), "unknown field `extra`"),
        (changed(home=location(91.0)), "home: latitude"),
        (changed(home=location(9.0, NAN)), "home: the height"),
        (changed(mark=location(NAN)), "mark: latitude"),
        (changed(current=2), "no item 2"),
        (changed(current=-1), "no item -1"),
        (changed(mission=[{"frame": 3}]), "missing required field"),
        (changed(fence=[msgspec.to_builtins(ITEM)]), "fence: item 0"),
        (changed(rally=[msgspec.to_builtins(FULL.rally[0])] * 101), "rally: more than 100"),
    ],
)
def test_invalid_text_of_a_plan_is_refused(text: str, why: str) -> None:
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
    station.send(count(5))
    for seq in range(4):
        station.send(item(seq))
    assert station.of(SavePlan) == [], "an upload that is not complete"
    upload(station, items, kind)
    [save] = station.of(SavePlan)
    assert save.vehicle_id == 1
    found = download(restarted(station), kind)
    assert list(map(content, found)) == list(map(content, items))


def test_current_item_and_its_mark_survive_a_restart(station: GroundStation) -> None:
    upload(station, [item(seq) for seq in range(5)])
    station.send(mavlink.MAVLink_mission_set_current_message(1, 1, 3))
    marked = station.vehicle.plan.mark.location
    after = restarted(station)
    assert after.request(42)[1].seq == 3
    assert after.vehicle.plan.mark.location == marked
    after.send(mavlink.MAVLink_mission_clear_all_message(1, 1, 0))
    assert after.vehicle.plan.mark.location is None, "it still follows the mission"
    assert restarted(after).vehicle.plan.missions.items[0] == ()


def test_home_and_mark_set_by_an_operator_survive_a_restart(station: GroundStation) -> None:
    station.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 47.5, -8.5, 400.0)
    station.receive(station.vehicle.put_mark(Location(47.0, 8.0, NAN), 0))
    after = restarted(station)
    assert repr(after.vehicle.plan.mark.location) == repr(Location(47.0, 8.0, NAN))
    [_, home] = after.request(242)
    assert (home.latitude, home.longitude, home.altitude) == (475_000_000, -85_000_000, 400_000)
    after.receive(after.vehicle.put_mark(None, 0))
    assert restarted(after).vehicle.plan.mark.location is None
