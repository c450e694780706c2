"""Facts of a flight from its positions and states."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from gateway.recordings.flight_facts import (
    NODE_WRAP_US,
    FlightFacts,
    FlightTally,
    gps_outages_us,
    lost_share,
)
from gateway.records import NAN
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import Position

LAT, LON = 47.0, 8.0


def fly(
    heights_m: Iterable[float],
    speeds_mps: Iterable[float],
    *,
    home: bool = True,
    armed: tuple[int, int] | None = None,
    landed: tuple[int, int] | None = None,
    surface: bool = False,
) -> FlightFacts:
    """Fly north at one position a second, 400 m above the sea at a height of zero.

    `armed` and `landed` are the seconds from and to which the vehicle is armed and in the air.
    """
    tally, north_m = FlightTally(), 0.0
    tally.is_surface = surface
    for second, (height_m, speed_mps) in enumerate(zip(heights_m, speeds_mps, strict=True)):
        time_us = (1000 + second) * US_PER_S
        if armed is not None:
            tally.add_armed(time_us, armed=armed[0] <= second < armed[1])
        if landed is not None:
            tally.landed = float(landed[0] <= second < landed[1])
        north_m += speed_mps
        alt_home_m = height_m if home else NAN
        at = Position(LAT + north_m / 111_170.0, LON, 400.0 + height_m, alt_home_m, speed_mps)
        tally.add_position(time_us, at)
    return tally.facts()


LEVEL = [96.0] * 60
GROUND = [0.0] * 60
HOP = [*GROUND[:20], *[9.0] * 2, *GROUND[:38]]


@pytest.mark.parametrize(
    ("heights_m", "speed_mps", "known", "airborne_s"),
    [
        (LEVEL, 20.0, {"home": False}, 59.0),
        (LEVEL, 0.0, {}, 59.0),
        (LEVEL, 0.0, {"home": False}, 0.0),
        ([5.0] * 60, 0.0, {}, 0.0),
        ([5.0] * 60, 0.0, {"armed": (0, 60)}, 59.0),
        (LEVEL, 20.0, {"armed": (10, 40)}, 30.0),
        (LEVEL, 0.5, {"landed": (20, 30)}, 10.0),
        ([1.0] * 60, 0.0, {"landed": (0, 60), "armed": (10, 60)}, 50.0),
        (LEVEL, 20.0, {"surface": True}, 0.0),
        ([1.0] * 60, 20.0, {}, 0.0),
        (GROUND, 20.0, {"armed": (0, 60)}, 59.0),
        ([-20.0] * 60, 0.0, {}, 59.0),
        (GROUND, 1.5, {"armed": (0, 60)}, 0.0),
        (HOP, 0.0, {"armed": (0, 60)}, 0.0),
    ],
    ids=[
        "begun in the air", "hover above home", "hover without home", "drift at rest",
        "low hover while armed", "armed for a part", "landed state", "landed state and arming",
        "surface vehicle", "fast on the ground", "low pass while armed", "below home",
        "carried", "hop",
    ],
)  # fmt: skip
def test_time_in_the_air(
    heights_m: list[float], speed_mps: float, known: dict[str, Any], airborne_s: float
) -> None:
    facts = fly(heights_m, [speed_mps] * 60, **known)
    assert facts.airborne_s == pytest.approx(airborne_s)


@pytest.mark.parametrize(
    ("home", "highest_m", "above"), [(True, 57.0, "home"), (False, 20.0, "first position")]
)
def test_height_is_above_home_or_else_above_the_first_position(
    *, home: bool, highest_m: float, above: str
) -> None:
    facts = fly([37.0, 57.0, 47.0], [5.0] * 3, home=home)
    assert (facts.highest_m, facts.height_above) == (pytest.approx(highest_m), above)
    assert (facts.distance_m, facts.farthest_m) == pytest.approx((10.0, 10.0), rel=0.01)
    assert facts.take_off is None


def test_take_off_is_the_last_position_on_the_ground() -> None:
    facts = fly([*[0.0] * 10, *[20.0] * 10], [0.0] * 20, armed=(5, 20))
    assert facts.take_off == (LAT, LON)
    assert (facts.airborne_s, facts.armed_s) == (10.0, 14.0)


def test_sender_that_fills_its_height_with_zeros_has_no_home() -> None:
    tally = FlightTally()
    for second, alt_m in enumerate((400.0, 430.0)):
        tally.add_position(second * US_PER_S, Position(LAT, LON, alt_m, 0.0, 0.0))
    assert (tally.facts().highest_m, tally.facts().height_above) == (30.0, "first position")


def test_facts_without_positions_are_unknown() -> None:
    facts = FlightTally().facts()
    assert (facts.distance_m, facts.airborne_s, facts.armed_s, facts.highest_m) == (None,) * 4


TEN = [*range(0, 100, 10)]


@pytest.mark.parametrize(
    ("times", "share"),
    [
        (TEN, 0.0),
        ([0, 10, 20, 50, 60], 2 / 7),
        ([*TEN, 5, 15, 25], 0.0),
        ([NODE_WRAP_US - 20, NODE_WRAP_US - 10, 0, 20, 30], 1 / 6),
        ([0, 10, 20, 20 + 70 * US_PER_S, 30 + 70 * US_PER_S], 0.0),
        ([0, 0, 10, 20, 40], 1 / 6),
    ],
    ids=["steady", "gap", "restart", "wrap", "switched off", "same time twice"],
)
def test_lost_samples_are_gaps_of_the_usual_interval(times: list[int], share: float) -> None:
    assert lost_share(np.array(times)) == pytest.approx(share)


def test_loss_of_a_single_sample_is_unknown() -> None:
    assert lost_share(np.array([1])) is None


def outages(seconds: list[float], without: tuple[int, ...] = (), end_s: float = 0.0) -> object:
    times = np.array([round(s * US_PER_S) for s in seconds])
    fixed = np.array([k not in without for k in range(len(seconds))], bool)
    found = gps_outages_us(times, fixed, round(end_s * US_PER_S))
    return found and [(begin / US_PER_S, end / US_PER_S) for begin, end in found]


def test_outage_is_a_long_gap_between_fixes() -> None:
    assert outages([0, 0.2, 0.4, 0.6]) == []
    assert outages([0, 0.2, 2.0, 2.2]) == [(0.2, 2.0)]
    assert outages([0, 0.5, 1.0, 1.5, 2.0], without=(1, 2, 3)) == [(0.0, 2.0)]
    assert outages([0, 0.2, 0.4], end_s=5.0) == [(0.4, 5.0)]
    assert outages([0, 0.2, 0.4], without=(0, 1, 2)) is None


def test_slow_rate_of_fixes_and_jump_of_the_clock_are_no_outage() -> None:
    assert outages([0, 5, 10, 15, 30, 35]) == [(15.0, 30.0)]
    assert outages([0, 1, 2, 200_000, 200_001]) == []
