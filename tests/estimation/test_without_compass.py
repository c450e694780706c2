"""A first heading without a compass: none while standing, and an honest one in motion."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_ATTITUDE_STD,
    NAV_FLAGS,
)
from gateway.estimation.eskf.eskf_state import EskfState
from gateway.estimation.eskf.recovery import turn_heading
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import NavFlags
from tests.estimation.samples import G, fix_rows, log_of

STANDS_S = 40.0
ENDS_S = 100.0
RATE_HZ = 100
FIXES_HZ = 5
REFERENCE = ReferenceSettings(gps_latency_s=0.0, declination="fixed", declination_deg=0.0)
RECEIVERS = {"good": (0.05, 0.1, 3.0), "drifting": (0.05, 0.3, 15.0), "bad": (0.2, 0.5, 0.7)}
"""White noise of the velocity, m/s; size, m/s, and time, s, of what is correlated."""
SEEDS = range(12)


def correlated(
    rng: np.random.Generator, n: int, rate_hz: float, std: float, tau_s: float
) -> np.ndarray:
    """Make a first-order Gauss-Markov process of three axes, shape (n, 3)."""
    kept = math.exp(-1.0 / (rate_hz * tau_s))
    drive = rng.normal(0.0, std * math.sqrt(1.0 - kept * kept), (n, 3))
    drive[0] = rng.normal(0.0, std, 3)
    found: np.ndarray = lfilter([1.0], [1.0, -kept], drive, axis=0)
    return found


def flight(seed: int, receiver: str) -> tuple[SampleLog, np.ndarray]:
    """Stand, then move as a multirotor does, always level; also tell the true heading, rad."""
    rng, n = np.random.default_rng(seed), round(ENDS_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    flies = (time_s > STANDS_S).astype(float)
    accel_n = correlated(rng, n, RATE_HZ, 1.2, 1.0) * flies[:, None] * (1.0, 1.0, 0.3)
    vel_n = lfilter([1.0 / RATE_HZ], [1.0, -math.exp(-1.0 / (RATE_HZ * 5.0))], accel_n, axis=0)
    accel_n = np.gradient(vel_n, time_s, axis=0)
    yaw_rate = correlated(rng, n, RATE_HZ, 0.3, 2.0)[:, 2] * flies
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(yaw_rate) / RATE_HZ
    shaking = 0.1 + 0.9 * flies[:, None]
    imu = np.zeros((n, IMU_COLUMNS))
    force = Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0])).apply(accel_n - (0.0, 0.0, G))
    imu[:, ACCEL : ACCEL + 3] = force + rng.normal(0.0, 0.4, (n, 3)) * shaking
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.01, (n, 3)) * shaking + rng.normal(0.0, 0.005, 3)
    imu[:, GYRO + 2] += yaw_rate
    imu[:, MAG : MAG + 3] = math.nan
    at = np.arange(RATE_HZ, n, RATE_HZ // FIXES_HZ)
    white, lasting, tau_s = RECEIVERS[receiver]
    place = np.cumsum(vel_n, axis=0)[at] / RATE_HZ + correlated(rng, len(at), FIXES_HZ, 1.0, 30.0)
    told = vel_n[at] + rng.normal(0.0, white, (len(at), 3))
    told += correlated(rng, len(at), FIXES_HZ, lasting, tau_s)
    return log_of(imu, RATE_HZ, at, fix_rows(place, told)), heading


@cache
def headings(name: str, receiver: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tell the heading's errors and standard deviations, rad, and where it is called valid."""
    log, heading = flight(seed, receiver)
    out = estimator_of(name).run(log)
    valid = (out[:, NAV_FLAGS].astype(int) & int(NavFlags.HEADING_VALID)) != 0
    return heading_off(out, heading), out[:, NAV_ATTITUDE_STD + 2], valid


def estimator_of(name: str) -> KernelEstimator[Any, Any]:
    found = make_estimator(EstimationSettings(estimator=name, reference=REFERENCE))
    assert isinstance(found, KernelEstimator)
    return found


def heading_off(out: np.ndarray, heading: np.ndarray) -> np.ndarray:
    w, x, y, z = out[:, :4].T
    found = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return np.abs((found - heading + math.pi) % (2.0 * math.pi) - math.pi)


@pytest.mark.parametrize("receiver", RECEIVERS)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
class TestWithoutCompass:
    def test_what_stands_has_no_heading(self, name: str, receiver: str) -> None:
        """The noise of GPS velocities tells none, however long it adds up."""
        stands = slice(0, round(STANDS_S * RATE_HZ))
        for seed in SEEDS:
            _, std, valid = headings(name, receiver, seed)
            assert not valid[stands].any()
            assert (std[stands] > 0.6).all()

    def test_the_first_heading_is_as_good_as_it_is_told(self, name: str, receiver: str) -> None:
        ratios = []
        for seed in SEEDS:
            off, std, _ = headings(name, receiver, seed)
            first = np.flatnonzero(std < 0.6)[0]
            ratios.append(off[first] / std[first])
        assert np.mean(np.array(ratios) < 2.0) >= 0.9
        assert max(ratios) < 3.0

    def test_it_stays_good(self, name: str, receiver: str) -> None:
        """Of 20 s after it was told valid."""
        errors = []
        for seed in SEEDS:
            off, _, valid = headings(name, receiver, seed)
            later = np.flatnonzero(valid)[0] + 20 * RATE_HZ
            assert valid[later:].all()
            errors.append(off[later:].max())
        assert np.degrees(np.median(errors)) < 15.0
        assert np.degrees(max(errors)) < 30.0


@pytest.mark.parametrize("receiver", RECEIVERS)
@pytest.mark.parametrize("seed", range(4))
def test_a_heading_that_is_wrong_is_taken_anew(receiver: str, seed: int) -> None:
    """Off by 115 deg and sure to 3 to 7 deg, in the midst of the flight."""
    off_deg, _ = flown_on_after(seed, receiver, lambda state: turn_heading(state, 2.0))
    assert off_deg[0] > 90.0
    assert off_deg[10 * RATE_HZ :].max() < 25.0


@pytest.mark.parametrize("seed", range(4))
def test_what_the_sensors_have_shown_by_a_wrong_heading_is_forgotten(seed: int) -> None:
    def spoil(state: EskfState) -> None:
        turn_heading(state, 2.0)
        state.gyro_scale_b, state.accel_bias_b = np.full(3, 0.2), np.full(3, 0.7)

    off_deg, state = flown_on_after(seed, "good", spoil)
    assert off_deg[10 * RATE_HZ :].max() < 25.0
    assert np.abs(state.gyro_scale_b).max() < 0.05
    assert np.abs(state.accel_bias_b).max() < 0.15


def flown_on_after(
    seed: int, receiver: str, change: Callable[[EskfState], None]
) -> tuple[np.ndarray, EskfState]:
    """Change the state of `eskf` in flight; tell how far its heading is off then, deg, and it."""
    log, heading = flight(seed, receiver)
    changed_at = round(75.0 * RATE_HZ)
    fixes = int(np.searchsorted(log.gps_time_us, log.imu_time_us[changed_at]))
    estimator = estimator_of("eskf")
    estimator.run(part(log, slice(0, changed_at), slice(0, fixes)))
    state = estimator.state
    change(state)
    estimator.state = state
    out = estimator.run(part(log, slice(changed_at, None), slice(fixes, None)))
    return np.degrees(heading_off(out, heading[changed_at:])), estimator.state


def part(log: SampleLog, samples: slice, fixes: slice) -> SampleLog:
    return replace(
        log,
        imu_time_us=log.imu_time_us[samples],
        imu=log.imu[samples],
        gps_time_us=log.gps_time_us[fixes],
        gps=log.gps[fixes],
    )
