"""What a heading and a level are off by that nothing but GPS can tell: it must be told as sigma."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GPS_ALT,
    GPS_COLUMNS,
    GPS_DECLINATION,
    GPS_LAT,
    GPS_USABLE,
    GPS_VEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_ATTITUDE_STD,
    NAV_COLUMNS,
    NAV_FLAGS,
)
from gateway.estimation.eskf.covariance import GYRO_BY_FORCE, propagate
from gateway.estimation.eskf.eskf_output import write_output
from gateway.estimation.eskf.eskf_settings import EskfSettings, make_gains
from gateway.estimation.eskf.eskf_state import ACCEL_BIAS, STATES, TILT, EskfState
from gateway.estimation.eskf.level_doubt import doubt_level
from gateway.estimation.eskf.measure import update_by_velocity
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import NO_DECLINATION_RAD, ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.geometry.geomagnetism import magnetic_field
from gateway.records import NavFlags
from tests.estimation.samples import ALT_M, LAT_DEG, LON_DEG, G
from tests.estimation.test_without_compass import FIXES_HZ, RATE_HZ, estimator_of, flight, part

SEEDS = range(24)
STANDS_S = 30.0
SETTLED_S = 15.0
FIELD_N_UT = np.array([21.0, 0.0, 43.0])
IRON_UT = 0.5
"""What the calibration of an aircraft's compass leaves along each axis."""
MOUNTING_RAD = math.radians(1.0)
LEFT_MPS2 = 0.04
"""The same of its accelerometer."""


def standing(seed: int, *, fixes: bool) -> SampleLog:
    """Stand level and towards north, with calibrated sensors."""
    rng, n = np.random.default_rng(seed), round(STANDS_S * RATE_HZ)
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, ACCEL : ACCEL + 3] = rng.normal(0.0, LEFT_MPS2, 3) + rng.normal(0.0, 0.05, (n, 3))
    imu[:, ACCEL + 2] -= G
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.005, 3) + rng.normal(0.0, 0.002, (n, 3))
    turn = Rotation.from_rotvec([0.0, 0.0, rng.normal(0.0, MOUNTING_RAD)])
    imu[:, MAG : MAG + 3] = turn.apply(FIELD_N_UT) + rng.normal(0.0, IRON_UT, 3)
    imu[:, MAG : MAG + 3] += rng.normal(0.0, 0.4, (n, 3))
    us = np.arange(n) * (1_000_000 // RATE_HZ)
    at = np.arange(RATE_HZ, n if fixes else RATE_HZ, RATE_HZ // FIXES_HZ)
    gps = np.full((len(at), GPS_COLUMNS), math.nan)
    gps[:, GPS_USABLE], gps[:, GPS_DECLINATION] = 1.0, 0.0
    gps[:, GPS_LAT : GPS_ALT + 1] = (LAT_DEG, LON_DEG, ALT_M)
    gps[:, GPS_VEL : GPS_VEL + 3] = rng.normal(0.0, 0.05, (len(at), 3))
    return SampleLog(us, imu, np.empty(0, np.int64), np.empty(0), us[at], gps)


@pytest.mark.parametrize("fixes", [True, False], ids=["gps", "without"])
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_what_stands_is_as_level_and_as_well_headed_as_told(name: str, fixes: bool) -> None:
    off, told = [], []
    for seed in SEEDS:
        out = estimator_of(name).run(standing(seed, fixes=fixes))[round(SETTLED_S * RATE_HZ) :]
        # The truth is no turn at all, and the errors are small.
        off.append(2.0 * out[:, 1:4])
        told.append(out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3])
    ratios = np.sqrt(np.mean(np.square(off), axis=(0, 1)) / np.mean(np.square(told), axis=(0, 1)))
    assert (ratios > 0.3).all()
    assert (ratios < 1.2).all()
    assert (np.mean(np.abs(off) < 2.0 * np.array(told), axis=(0, 1)) >= 0.9).all()


@pytest.mark.parametrize("offset_mps2", [(0.0, 0.0, -0.8), (0.5, 0.5, -0.5)])
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_force_beyond_gravity_at_rest_is_the_accelerometers_and_no_turn(
    name: str, offset_mps2: tuple[float, float, float]
) -> None:
    """An MPU6050 that nobody has calibrated may be off by so much."""
    log = standing(0, fixes=False)
    log.imu[:, ACCEL : ACCEL + 3] += offset_mps2
    flags = estimator_of(name).run(log)[2 * RATE_HZ :, NAV_FLAGS].astype(int)
    assert (flags & int(NavFlags.ATTITUDE_VALID) != 0).all()


def test_doubt_of_the_level_leaves_what_gravity_showed(rng: np.random.Generator) -> None:
    """A bias and the tilt by it together change no force that the accelerometer has shown."""
    gains = make_gains(EskfSettings(), ReferenceSettings(), RestSettings(), CompassSettings())
    s = new_record(EskfState)
    q = rng.normal(size=4)
    s.q_nb[:] = q / np.linalg.norm(q)
    doubt_level(s, gains)
    w, x, y, z = s.q_nb
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        ]
    )
    rows = np.zeros((2, len(s.P)))
    # The level force that is left: `tilt x (0, 0, -g) - R bias`.
    rows[0, TILT + 1], rows[1, TILT] = -G, G
    rows[:, ACCEL_BIAS : ACCEL_BIAS + 3] = -R
    np.testing.assert_allclose(rows @ s.P @ rows.T, 0.0, atol=1e-12)
    assert math.degrees(math.sqrt(s.P[TILT, TILT])) > 0.2
    assert np.linalg.eigvalsh(s.P).min() > -1e-12


def test_what_force_turns_is_told_until_it_is_found_out() -> None:
    """It changes nothing else: the tilt's covariance, and so the estimate, is the same."""
    gains = make_gains(EskfSettings(), ReferenceSettings(), RestSettings(), CompassSettings())
    seconds, accel_mps2, runs = 5.0, 2.0 * G, []
    for accel in (0.0, accel_mps2):
        s, row = new_record(EskfState), np.zeros(NAV_COLUMNS)
        s.started, s.aided_before, s.level_shown, s.q_nb[0] = 1, 1, 1, 1.0
        s.P[:] = 1e-4 * np.eye(STATES)
        s.pending_s, s.pending_accel_sq = seconds, accel * accel * seconds
        s.pending_force_n[:] = (0.0, 0.0, -G * seconds)
        propagate(s, gains)
        level, told = s.P[TILT, TILT], []
        for _ in range(2):
            write_output(s, row)
            told.append(row[NAV_ATTITUDE_STD] ** 2 - s.P[TILT, TILT])
            update_by_velocity(s, gains, 0.1)
        runs.append((level, *told))
    assert runs[0] == (runs[1][0], pytest.approx(0.0, abs=1e-15), pytest.approx(0.0, abs=1e-15))
    assert runs[1][1] == pytest.approx((GYRO_BY_FORCE * accel_mps2) ** 2 * seconds)
    assert 0.0 < runs[1][2] < 0.7 * runs[1][1]


def test_a_speed_of_about_zero_tells_no_heading(rng: np.random.Generator) -> None:
    """However hard it accelerates: it would be about zero for any heading."""
    gains = make_gains(EskfSettings(), ReferenceSettings(), RestSettings(), CompassSettings())
    s, dt, heading_var = new_record(EskfState), 0.1, 0.1**2
    s.started, s.q_nb[0] = 1, 1.0
    s.P[TILT + 2, TILT + 2] = heading_var
    for _ in range(100):
        accel = rng.normal(0.0, 5.0, 3) * (1.0, 1.0, 0.0)
        s.vel_n += accel * dt
        s.pending_s, s.pending_turn[:] = dt, dt * np.eye(3)
        s.pending_force_n[:] = (accel - (0.0, 0.0, G)) * dt
        update_by_velocity(s, gains, 0.2)
    assert abs(2.0 * s.q_nb[3]) < 0.01
    assert s.P[TILT + 2, TILT + 2] > heading_var


def test_a_heading_without_declination_is_as_good_as_told() -> None:
    """Over the globe up to 60 deg, by area."""
    square, weight = 0.0, 0.0
    for lat_deg in range(-60, 61, 10):
        share = math.cos(math.radians(lat_deg))
        for lon_deg in range(-180, 180, 20):
            field = magnetic_field(float(lat_deg), float(lon_deg), 0.0, 2026.5)
            square, weight = square + share * field.declination_rad**2, weight + share
    assert math.sqrt(square / weight) == pytest.approx(NO_DECLINATION_RAD, rel=0.1)


@pytest.mark.parametrize("receiver", ["good", "bad"])
@pytest.mark.parametrize("seed", range(3))
def test_a_compass_that_is_turned_on_its_board_turns_the_heading_by_what_is_told(
    seed: int, receiver: str
) -> None:
    """The more GPS has told in motion, the less."""
    log, heading = flight(seed, receiver)
    headings, shares = [], []
    for turned_rad in (0.0, MOUNTING_RAD):
        imu, read = log.imu.copy(), heading + turned_rad
        imu[:, MAG] = FIELD_N_UT[0] * np.cos(read)
        imu[:, MAG + 1] = -FIELD_N_UT[0] * np.sin(read)
        imu[:, MAG + 2] = FIELD_N_UT[2]
        estimator = estimator_of("eskf")
        found: list[float] = []
        for begin, end in pairwise([0.0, STANDS_S, 45.0, 60.0, 80.0, 100.0]):
            rows, fixes = (
                slice(*np.searchsorted(us, [begin * 1e6, end * 1e6]).tolist())
                for us in (log.imu_time_us, log.gps_time_us)
            )
            out = estimator.run(part(replace(log, imu=imu), rows, fixes))
            w, x, y, z = out[-1, :4]
            found.append(math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
            shares.append(estimator.state.compass_share)
        headings.append(np.array(found))
    turned = np.remainder(headings[1] - headings[0] + math.pi, 2.0 * math.pi) - math.pi
    off = np.abs(turned / MOUNTING_RAD - shares[: len(turned)])
    assert off.mean() < 0.25
    assert off[-1] < 0.2
