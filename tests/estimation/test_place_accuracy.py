"""Whether place and level are as accurate as they are told, with GPS and in outages."""

import math
from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.columns import (
    ACCEL,
    GPS_ALT,
    GPS_COLUMNS,
    GPS_DECLINATION,
    GPS_H_ACC,
    GPS_LAT,
    GPS_SPEED_ACC,
    GPS_USABLE,
    GPS_V_ACC,
    GPS_VEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_ALT,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
)
from gateway.estimation.complementary.accuracy import STEP_S, push_place
from gateway.estimation.complementary.complementary_state import (
    FORCE,
    PLACE,
    SPEED,
    STATES,
    TILT,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift_update import push_state
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import new_record
from gateway.geometry.geodesy import radii_m
from tests.estimation.samples import ALT_M, LAT_DEG, LON_DEG, G
from tests.estimation.test_without_compass import FIXES_HZ, RATE_HZ, correlated, estimator_of
from tools.flights import Flight, north_east_m, read_flight, simulated_flight
from tools.score_estimators import Run, outages, run_complementary, run_eskf, run_smoothed
from tools.score_honesty import share, two_sigma

FIELD_N_UT = (21.0, 0.0, 43.0)
SPEED_MPS = 5.0
FLIES_S = 300.0
SETTLED_S = 40.0
SEEDS = range(12)
BIAS_MPS2 = 0.1
TILT_RAD = 0.01


def levelled() -> ComplementaryState:
    """Return the state of a level attitude that GPS holds, and of which nothing is unsure."""
    s = new_record(ComplementaryState)
    s.level_by_gps, s.q_ei[0], s.q_eb[0] = 1, 1.0, 1.0
    return s


def test_what_pushes_a_state_is_the_matrix_product(rng: np.random.Generator) -> None:
    s, dt = levelled(), 0.1
    root = rng.normal(size=(STATES, STATES))
    P, h = root @ root.T, rng.normal(size=STATES)
    for k in (SPEED, PLACE + 1):
        s.drift_cov[:], s.drift_row[:] = P, h
        push_state(s, k, dt)
        F = np.eye(STATES)
        F[k] += dt * h
        np.testing.assert_allclose(s.drift_cov, F @ P @ F.T, rtol=1e-9, atol=1e-12)


def pushed_m(s: ComplementaryState, seconds: float, turn_radps: float) -> np.ndarray:
    """Carry speed and place on in level flight, straight or in circles."""
    for step in range(round(seconds / STEP_S)):
        half = 0.5 * turn_radps * (step + 0.5) * STEP_S
        s.q_eb[0], s.q_eb[3] = math.cos(half), math.sin(half)
        s.accuracy_force_i[:] = 0.0
        s.integrals[:3] = (0.0, 0.0, -G * STEP_S)
        push_place(s, STEP_S)
    return np.sqrt(np.diag(s.drift_cov)[PLACE : PLACE + 2])


@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_a_tilt_pushes_one_way_for_as_long_as_it_lasts(seconds: float) -> None:
    for turn_radps in (0.0, 0.7):
        s = levelled()
        s.drift_cov[TILT, TILT] = s.drift_cov[TILT + 1, TILT + 1] = TILT_RAD**2
        expected = 0.5 * G * TILT_RAD * seconds**2
        np.testing.assert_allclose(pushed_m(s, seconds, turn_radps), expected, rtol=0.02)


def test_a_bias_of_the_accelerometer_cancels_in_circles() -> None:
    seconds = 20.0
    found = []
    for turn_radps in (0.0, 0.7):
        s = levelled()
        for k in range(3):
            s.drift_cov[FORCE + k, FORCE + k] = BIAS_MPS2**2
        found.append(pushed_m(s, seconds, turn_radps))
    np.testing.assert_allclose(found[0], 0.5 * BIAS_MPS2 * seconds**2, rtol=0.02)
    # Twice the integral of a force that turns: `(exp(iwt) - 1 - iwt) / (iw)**2`.
    turned = 0.7 * seconds
    circle = abs(np.exp(1j * turned) - 1.0 - 1j * turned) / 0.7**2
    np.testing.assert_allclose(found[1], BIAS_MPS2 * circle, rtol=0.02)


def outage_ratio(flight: Flight, run: Run, length_s: float) -> tuple[float, float]:
    """Tell the share of the place in outages within two sigma, and its errors in sigmas."""
    within, ratios = [], []
    for out, inside, _ in outages(flight, run, length_s):
        off = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
        within.append(two_sigma(flight, out)["place"][inside])
        ratios.append((off / out[:, NAV_POS_STD : NAV_POS_STD + 2])[inside])
    return share(np.concatenate(within)), float(np.sqrt(np.nanmean(np.concatenate(ratios) ** 2)))


@pytest.mark.parametrize("length_s", [10.0, 30.0])
def test_a_real_outage_is_as_far_off_as_told(data_dir: Path, length_s: float) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    within, ratio = outage_ratio(flight, run_complementary, length_s)
    assert within > 0.95
    assert 0.7 < ratio < 1.1


@pytest.mark.parametrize("run", [run_complementary, run_eskf, run_smoothed])
def test_a_real_outage_tilts_by_no_more_than_told(data_dir: Path, run: Run) -> None:
    """That aircraft loops and rolls: force turns what its gyroscope tells."""
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    within = [
        two_sigma(flight, out)["tilt"][inside] for out, inside, _ in outages(flight, run, 10.0)
    ]
    assert 0.9 < share(np.concatenate(within)) < 0.98


def test_a_simulated_outage_is_as_far_off_as_told() -> None:
    flight = simulated_flight(505, calibrated=True)
    within, ratio = outage_ratio(flight, run_complementary, 10.0)
    assert within > 0.95
    assert 0.4 < ratio < 1.1


def straight_flight(seed: int) -> SampleLog:
    """Fly north, with the fixes of a receiver whose errors are slow, and told as they are."""
    rng, n = np.random.default_rng(seed), round(FLIES_S * RATE_HZ)
    imu = rng.normal(0.0, 0.3, (n, IMU_COLUMNS))
    imu[:, GYRO : GYRO + 3] *= 0.01
    imu[:, ACCEL + 2] -= G
    imu[:, MAG : MAG + 3] += FIELD_N_UT
    imu[:, MAG + 3 :] = 0.0
    at = np.arange(RATE_HZ, n, RATE_HZ // FIXES_HZ)
    gps = np.full((len(at), GPS_COLUMNS), math.nan)
    gps[:, GPS_USABLE], gps[:, GPS_DECLINATION] = 1.0, 0.0
    off_m = correlated(rng, len(at), FIXES_HZ, 1.0, 45.0) * (0.8, 0.8, 1.5)
    gps[:, GPS_LAT : GPS_LAT + 2] = (LAT_DEG, LON_DEG)
    gps[:, GPS_LAT] += np.degrees(SPEED_MPS * at / RATE_HZ / radii_m(LAT_DEG, 0.0)[0])
    gps[:, GPS_LAT : GPS_LAT + 2] += np.degrees(off_m[:, :2] / radii_m(LAT_DEG, 0.0))
    gps[:, GPS_ALT] = ALT_M + off_m[:, 2]
    gps[:, GPS_VEL : GPS_VEL + 3] = rng.normal(0.0, 0.05, (len(at), 3))
    gps[:, GPS_VEL : GPS_VEL + 3] += correlated(rng, len(at), FIXES_HZ, 1.0, 4.0) * (
        0.04,
        0.04,
        0.08,
    )
    gps[:, GPS_VEL] += SPEED_MPS
    gps[:, GPS_H_ACC], gps[:, GPS_V_ACC], gps[:, GPS_SPEED_ACC] = 1.2, 1.8, 0.12
    us = np.arange(n) * (1_000_000 // RATE_HZ)
    return SampleLog(us, imu, np.empty(0, np.int64), np.empty(0), us[at], gps)


def test_slow_errors_of_a_receiver_are_in_the_place_that_is_told() -> None:
    """Neither its places nor its velocities average out in a minute."""
    off, told = [], []
    meridian_m, parallel_m = radii_m(LAT_DEG, 0.0)
    for seed in SEEDS:
        log = straight_flight(seed)
        out = estimator_of("eskf").run(log)
        north = np.radians(out[:, NAV_LAT] - LAT_DEG) * meridian_m
        north -= SPEED_MPS * log.imu_time_us * 1e-6
        east = np.radians(out[:, NAV_LON] - LON_DEG) * parallel_m
        found = np.column_stack([north, east, out[:, NAV_ALT] - ALT_M])
        settled = log.imu_time_us > SETTLED_S * 1e6
        off.append(found[settled])
        told.append(out[settled, NAV_POS_STD : NAV_POS_STD + 3])
    within = np.mean(np.abs(off) < 2.0 * np.array(told), axis=(0, 1))
    assert (within > 0.9).all()
    # The receiver's own error is 0.8 m: not to be told ten times as large.
    assert np.median(np.array(told)[..., :2]) < 1.0
