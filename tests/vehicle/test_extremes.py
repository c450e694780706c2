"""Impossible values in every record: frames stay well-formed."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from msgspec.structs import fields, replace

from gateway.records import NavFlags
from gateway.vehicle.plan import Location
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.kit.ground_station import kinds
from tests.kit.records import BARO, FIX, SAMPLE, STATE, link, report, status

FLOATS = [math.nan, math.inf, -math.inf, 0.0, -0.0, 1e-300, 1e300, -1e300, 3.5e38, -7.0, 90.0]
INTEGERS = [0, 1, 255, 256, 65_535, 65_536, 2**31, 2**32, -1, -(2**31) - 1, 2**40]


def scrambled(record: Any, rng: np.random.Generator) -> Any:
    """Put odd numbers into a record, its times excepted."""
    changes: dict[str, Any] = {}
    for field in fields(record):
        value = getattr(record, field.name)
        if field.name in ("time_us", "node") or rng.random() < 0.5:
            continue
        if isinstance(value, tuple) and value and isinstance(value[0], float):
            changes[field.name] = tuple(FLOATS[n] for n in rng.integers(0, len(FLOATS), len(value)))
        elif isinstance(value, float):
            changes[field.name] = FLOATS[rng.integers(len(FLOATS))]
        elif type(value) is int:
            changes[field.name] = INTEGERS[rng.integers(len(INTEGERS))]
        elif isinstance(value, msgspec.Struct):
            changes[field.name] = scrambled(value, rng)
        elif isinstance(value, NavFlags):
            changes[field.name] = NavFlags(int(rng.integers(1 << 14)))
    return replace(record, **changes)


@pytest.mark.parametrize("seed", range(6))
def test_telemetry_continues_with_extreme_values_in_every_record(seed: int) -> None:
    rng = np.random.default_rng(seed)
    vehicle = Vehicle(VehicleSettings(home_satellites=4), 1)
    frames = vehicle.put_mark(Location(47.0, -8.0, math.nan), 0)
    for n in range(400):
        time_us = n * 20_000

        def odd(record: Any, time_us: int = time_us) -> Any:
            return scrambled(replace(record, time_us=time_us), rng)

        frames += vehicle.on_state(odd(STATE), odd(SAMPLE), time_us)
        frames += vehicle.on_gps(odd(FIX), time_us)
        frames += vehicle.on_baro(odd(BARO), time_us)
        frames += vehicle.on_node_status(odd(status()), time_us)
        links = [scrambled(link(last_time_us=time_us), rng)]
        frames += vehicle.on_link(report(*links, time_us=time_us), time_us)
        frames += vehicle.poll(time_us)
    found = set(kinds(frames))
    assert {"ATTITUDE_QUATERNION", "GPS_RAW_INT", "SYS_STATUS", "HEARTBEAT"} <= found
