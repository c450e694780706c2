"""A gyroscope that nobody has calibrated: an MPU6050 may tell 20 deg/s of a turn at rest."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GYRO,
    GYRO_UNCALIBRATED,
    IMU_COLUMNS,
    MAG,
    NAV_FLAGS,
    NAV_RATE,
)
from gateway.estimation.kernel import SampleLog
from gateway.records import NavFlags
from tests.estimation.samples import G, log_of
from tests.estimation.test_steady_motion import FIELD_N_UT, TURN_RADPS
from tests.estimation.test_without_compass import RATE_HZ, estimator_of
from tools.flights import Flight, simulated_flight
from tools.score_estimators import OWN, attitude_scores
from tools.score_honesty import share, two_sigma
from tools.spoil_flight import mid_air

BIASES_DEGPS = ((7.5, -2.0, 1.0), (-3.0, 12.0, -9.0), (2.0, 1.0, -17.0), (18.0, -16.0, 14.0))
NAMES = ("complementary", "eskf")
LIKELY_DEGPS = ((4.0, -3.0, 5.0), (-5.0, 4.0, -3.0))
SEEDS = (41, 42)
FOUND_S = 12.0
"""At the latest, with a compass."""
TURNS_S, STANDS_S = 75.0, 120.0


@cache
def flown(seed: int, *, fixes: bool) -> Flight:
    flight = simulated_flight(seed, calibrated=True)
    return flight if fixes else flight.with_gps(np.zeros(len(flight.log.gps), bool))


def errors(name: str, flight: Flight, bias_degps: tuple[float, ...]) -> np.ndarray:
    """Tell tilt and heading off in deg, (n, 2); NaN where no attitude is told."""
    imu = flight.log.imu.copy()
    imu[:, GYRO : GYRO + 3] += np.radians(bias_degps)
    out = OWN[name](replace(flight, log=replace(flight.log, imu=imu)))
    off = np.full((len(out), 2), math.nan)
    told = (out[:, NAV_FLAGS].astype(int) & NavFlags.ATTITUDE_VALID) != 0
    true = Rotation.from_quat(flight.q_nb[told], scalar_first=True)
    x, y, z = (true * Rotation.from_quat(out[told, :4], scalar_first=True).inv()).as_rotvec().T
    off[told] = np.degrees(np.column_stack([np.hypot(x, y), np.abs(z)]))
    return off


@pytest.mark.slow
@pytest.mark.parametrize("bias_degps", BIASES_DEGPS)
@pytest.mark.parametrize("fixes", [True, False])
@pytest.mark.parametrize("name", NAMES)
def test_it_is_found_at_rest(name: str, fixes: bool, bias_degps: tuple[float, ...]) -> None:
    for seed in SEEDS:
        flight = flown(seed, fixes=fixes)
        later = flight.log.imu_time_us > FOUND_S * 1e6
        usual, off = (errors(name, flight, bias) for bias in ((0.0, 0.0, 0.0), bias_degps))
        assert np.nanmax(off[~later, 0]) < 5.0, "told before it was found"
        assert np.isfinite(off[later]).all()
        rms, usual_rms = (np.sqrt(np.mean(x[later] ** 2, axis=0)) for x in (off, usual))
        assert (rms < usual_rms + 1.5).all()


def standing(bias_degps: tuple[float, ...] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Stand without a compass; the rows of the IMU."""
    rng, n = np.random.default_rng(8), round(STANDS_S * RATE_HZ)
    imu = np.full((n, IMU_COLUMNS), 0.0)
    imu[:, ACCEL : ACCEL + 3] = rng.normal((0.0, 0.0, -G), 0.03, (n, 3))
    imu[:, GYRO : GYRO + 3] = rng.normal(np.radians(bias_degps), 0.003, (n, 3))
    imu[:, MAG : MAG + 3] = math.nan
    return imu


def rests(out: np.ndarray) -> np.ndarray:
    """Tell where it stands, with a rate of nearly nothing and level."""
    still = np.degrees(np.abs(out[:, NAV_RATE : NAV_RATE + 3]).max(axis=1)) < 2.0
    level = np.degrees(2.0 * np.hypot(*out[:, 1:3].T)) < 1.5
    return ((out[:, NAV_FLAGS].astype(int) & NavFlags.AT_REST) != 0) & still & level


@pytest.mark.parametrize(
    ("bias_degps", "found_s"), [((9.0, -14.0, 3.0), 6.0), ((2.0, 1.0, -17.0), 60.0)]
)
@pytest.mark.parametrize("name", NAMES)
def test_it_is_found_without_a_compass(
    name: str, bias_degps: tuple[float, ...], found_s: float
) -> None:
    """About the vertical it seems to turn in circles first."""
    out = estimator_of(name).run(log_of(standing(bias_degps), RATE_HZ))
    assert rests(out)[round(found_s * RATE_HZ) :].all()


def begun_in_the_air(seed: int, bias_degps: tuple[float, ...]) -> Flight:
    """Each sample says that nobody has calibrated the gyroscope."""
    begun = mid_air(flown(seed, fixes=True)).flight
    imu, time_us = begun.log.imu.copy(), begun.log.imu_time_us
    imu[:, GYRO_UNCALIBRATED] = 1.0
    imu[:, GYRO : GYRO + 3] += np.radians(bias_degps)
    later = time_us > time_us[0] + FOUND_S * 1e6
    return replace(begun, log=replace(begun.log, imu=imu), counts=later)


@pytest.mark.slow
@pytest.mark.parametrize("bias_degps", LIKELY_DEGPS)
def test_it_is_expected_where_a_flight_begins_in_the_air(bias_degps: tuple[float, ...]) -> None:
    for seed in SEEDS:
        flight = begun_in_the_air(seed, bias_degps)
        out = OWN["eskf"](flight)
        found = attitude_scores(flight, out[:, :4])
        assert found["inclination"] < 2.0
        assert found["heading"] < 2.5
        assert share(two_sigma(flight, out)["heading"]) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("bias_degps", LIKELY_DEGPS)
@pytest.mark.parametrize("name", NAMES)
def test_a_level_begun_so_without_gps_is_told_as_unsure(
    name: str, bias_degps: tuple[float, ...]
) -> None:
    shares = []
    for seed in SEEDS:
        flight = begun_in_the_air(seed, bias_degps)
        alone = flight.with_gps(np.zeros(len(flight.log.gps), bool))
        shares.append(share(two_sigma(alone, OWN[name](alone))["tilt"]))
    assert np.mean(shares) > 0.65


def turning(rate_radps: float) -> SampleLog:
    """Roll round a circle on a smooth road from the first sample on, with a compass and no GPS."""
    rng, n = np.random.default_rng(7), round(TURNS_S * RATE_HZ)
    heading_rad = rate_radps * np.arange(n) / RATE_HZ
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, ACCEL : ACCEL + 3] = rng.normal((0.0, 8.0 * rate_radps, -G), 0.03, (n, 3))
    imu[:, GYRO : GYRO + 3] = rng.normal((0.0, 0.0, rate_radps), 0.003, (n, 3))
    back = Rotation.from_rotvec(np.outer(-heading_rad, [0.0, 0.0, 1.0]))
    imu[:, MAG : MAG + 3] = back.apply(FIELD_N_UT) + rng.normal(0.0, 0.4, (n, 3))
    return log_of(imu, RATE_HZ)


@pytest.mark.parametrize("name", NAMES)
def test_a_turn_that_passed_for_a_bias_is_found_out_at_rest(name: str) -> None:
    """No compass and no GPS contradict it, and the air is calm."""
    turns = turning(5.0 * TURN_RADPS).imu
    turns[:, MAG : MAG + 3] = math.nan
    out = estimator_of(name).run(log_of(np.concatenate([turns, standing()]), RATE_HZ))
    taken = (out[: len(turns), NAV_FLAGS].astype(int) & NavFlags.AT_REST) != 0
    assert taken[-1]
    assert rests(out)[-20 * RATE_HZ :].all()


@pytest.mark.parametrize("times", [2.5, -4.0, 6.0])
@pytest.mark.parametrize("name", NAMES)
def test_a_turn_in_which_it_begins_is_none(name: str, times: float) -> None:
    out = estimator_of(name).run(turning(times * TURN_RADPS))
    assert not (out[:, NAV_FLAGS].astype(int) & NavFlags.AT_REST).any()
