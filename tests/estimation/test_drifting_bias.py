"""A gyroscope whose bias changes in flight: a sensor that warms up, or a bias that jumps."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import GYRO, MAG, NAV_ATTITUDE_STD
from gateway.estimation.filtering.bias_evidence import (
    SETTLED_S,
    BiasEvidenceState,
    note_bias_correction,
    unexpected_bias_density,
    watch_bias_corrections,
)
from gateway.geometry.angle import wrap_pi
from tools.flights import Flight, simulated_flight
from tools.score_estimators import OWN

SEEDS = range(31, 34)
NO_IRON_UT = (0.0, 0.0, 0.0)
IRON_UT = (25.0, -18.0, 10.0)
"""As much as one learns in flight: what the compass says of the bias does not count then."""
CHANGED_RADPS = np.radians([1.5, -1.0, 0.8])
BEGINS_S, LASTS_S = 60.0, 80.0


def warms_up(since_s: np.ndarray) -> np.ndarray:
    """Tell the share of the change."""
    return np.asarray(1.0 - np.exp(-since_s / 30.0))


def jumps(since_s: np.ndarray) -> np.ndarray:
    return np.asarray(since_s > 0.0)


@cache
def flown(seed: int) -> Flight:
    return simulated_flight(seed, calibrated=True)


@cache
def off_and_within(
    name: str, how: Callable[[np.ndarray], np.ndarray], iron_b: tuple[float, float, float]
) -> tuple[float, ...]:
    """Tell tilt and heading in deg rms, and the shares of both within two sigma."""
    tilts, headings, told_tilts, told_headings = [], [], [], []
    for seed in SEEDS:
        flight = flown(seed)
        time_s = flight.log.imu_time_us * 1e-6
        imu = flight.log.imu.copy()
        imu[:, GYRO : GYRO + 3] += np.outer(how(np.maximum(time_s - BEGINS_S, 0.0)), CHANGED_RADPS)
        imu[:, MAG : MAG + 3] += iron_b
        out = OWN[name](replace(flight, log=replace(flight.log, imu=imu)))
        use = (time_s > BEGINS_S) & (time_s < BEGINS_S + LASTS_S)
        true = Rotation.from_quat(flight.q_nb[use], scalar_first=True)
        off = true * Rotation.from_quat(out[use, :4], scalar_first=True).inv()
        w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
        told = out[use, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
        tilts.append(2.0 * np.arccos(np.hypot(w, z).clip(max=1.0)))
        headings.append(np.abs(wrap_pi(2.0 * np.arctan2(z, w))))
        told_tilts.append(np.hypot(told[:, 0], told[:, 1]))
        told_headings.append(told[:, 2])
    tilt, heading = np.concatenate(tilts), np.concatenate(headings)
    return (
        math.degrees(math.sqrt(np.mean(tilt**2))),
        math.degrees(math.sqrt(np.mean(heading**2))),
        float(np.mean(tilt < 2.0 * np.concatenate(told_tilts))),
        float(np.mean(heading < 2.0 * np.concatenate(told_headings))),
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "how", "iron_b", "most_deg", "least_share"),
    [
        ("complementary", warms_up, NO_IRON_UT, (4.5, 6.2), (0.55, 0.58)),
        ("complementary", warms_up, IRON_UT, (4.5, 7.0), (0.5, 0.42)),
        ("complementary", jumps, NO_IRON_UT, (5.6, 8.0), (0.45, 0.3)),
        ("complementary", jumps, IRON_UT, (5.6, 8.8), (0.45, 0.28)),
        ("eskf", warms_up, NO_IRON_UT, (2.5, 4.5), (0.65, 0.42)),
        ("eskf", jumps, NO_IRON_UT, (4.4, 6.5), (0.48, 0.5)),
    ],
)
def test_a_bias_that_changes_in_flight_is_followed(
    name: str,
    how: Callable[[np.ndarray], np.ndarray],
    iron_b: tuple[float, float, float],
    most_deg: tuple[float, float],
    least_share: tuple[float, float],
) -> None:
    tilt_deg, heading_deg, tilts_within, headings_within = off_and_within(name, how, iron_b)
    assert tilt_deg < most_deg[0]
    assert heading_deg < most_deg[1]
    assert tilts_within > least_share[0]
    assert headings_within > least_share[1]


def test_corrections_to_and_fro_say_nothing_of_the_bias(rng: np.random.Generator) -> None:
    to_and_fro, one_way = BiasEvidenceState(), BiasEvidenceState()
    for s in (to_and_fro, one_way):
        s.bias_corrected, s.bias_corrected_var = np.zeros(3), np.zeros(3)
        s.bias_watched_s = s.sound_s = SETTLED_S
    chance = 0
    for off in rng.normal(0.0, 1.0, 6000):
        note_bias_correction(to_and_fro, 0, off, 1e-4)
        note_bias_correction(one_way, 0, off + 1.0, 1e-4)
        for s in (to_and_fro, one_way):
            watch_bias_corrections(s, known=True, dt=0.1)
        chance += unexpected_bias_density(to_and_fro, 0) > 0.0
    assert chance < 0.05 * 6000
    assert unexpected_bias_density(one_way, 0) > 0.0
    watch_bias_corrections(one_way, known=False, dt=0.1)
    assert unexpected_bias_density(one_way, 0) == 0.0
