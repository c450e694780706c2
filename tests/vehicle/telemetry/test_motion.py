import math

import pytest
from msgspec.structs import replace

from gateway.records import NavFlags
from gateway.vehicle.telemetry.telemetry import IN_AIR, ON_GROUND, UNDEFINED, Motion
from tests.kit.records import STATE, state_at


def run(motion: Motion, start_s: float, seconds: float, speed: float, height: float) -> int:
    for n in range(round(seconds * 50) + 1):
        time_us = round((start_s + n / 50) * 1e6)
        state = state_at(time_us, vel_n_mps=(speed, 0.0, 0.0), alt_amsl_m=500.0 + height)
        motion.update(state, 500.0)
    return motion.landed_state


def test_a_flight() -> None:
    motion = Motion(5.0, 10.0)
    assert run(motion, 0, 1.9, 0.0, 0.0) == UNDEFINED
    assert run(motion, 2, 1, 0.0, 0.0) == ON_GROUND
    assert run(motion, 3, 10, 3.0, 0.0) == ON_GROUND, "taxiing"
    assert run(motion, 13, 1.5, 12.0, 1.0) == ON_GROUND, "a gust"
    assert run(motion, 14.5, 1, 12.0, 5.0) == IN_AIR
    assert run(motion, 20, 30, 0.5, 60.0) == IN_AIR, "hovering"
    assert run(motion, 50, 4, 0.5, 0.0) == IN_AIR, "touch and go"
    assert run(motion, 54, 4, 12.0, 5.0) == IN_AIR
    assert run(motion, 60, 6, 1.0, 0.5) == ON_GROUND


def test_nothing_is_known_without_velocity() -> None:
    motion = Motion(5.0, 10.0)
    for n in range(500):
        motion.update(replace(STATE, time_us=n * 20_000, flags=NavFlags.ATTITUDE_VALID), 500.0)
    assert motion.landed_state == UNDEFINED


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_odd_values_do_no_harm(bad: float) -> None:
    motion = Motion(5.0, 10.0)
    for n in range(500):
        state = state_at(n * 20_000, vel_n_mps=(bad, 0.0, 0.0), alt_amsl_m=bad)
        motion.update(state, math.nan)
    assert motion.landed_state in (UNDEFINED, IN_AIR)
