"""Iron that a compass carries along: what shows it, and what a filter makes of that."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    MAG_UNCALIBRATED,
    NAV_ATTITUDE_STD,
)
from gateway.estimation.complementary.complementary_state import (
    COMPASS,
    HEADING,
    IRON,
    SCALE,
    ComplementarySettings,
    ComplementaryState,
    make_gains,
)
from gateway.estimation.complementary.errors.carried_iron import (
    AIDED_IRON_UT,
    expect_iron,
    follow_iron,
    update_by_dip,
)
from gateway.estimation.complementary.errors.drift import begin_drift, doubt_sensors
from gateway.estimation.complementary.errors.drift_update import (
    UNCLIPPED,
    cleared_row,
    correct_drift,
    expected_variance,
)
from gateway.estimation.filtering.iron_evidence import (
    IronState,
    compare_strength,
    dip_by_iron,
    heading_by_iron,
    mean_strengthening,
    unexplained_iron_sq,
)
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.records import Quat, Vec3
from tests.estimation.samples import G, fix_rows, log_of
from tests.estimation.test_without_compass import (
    FIXES_HZ,
    RATE_HZ,
    correlated,
    estimator_of,
    heading_off,
)

GAINS = make_gains(ComplementarySettings(), ReferenceSettings(), RestSettings(), CompassSettings())
EARTH_N_UT = np.array([20.0, 6.0, 40.0])
IRON_UT = np.array([8.0, -6.0, 3.0])
CAR_IRON_UT = (5.0, 12.0, 5.0)
STANDS_S, LEARNED_S, DRIVES_S = 15.0, 25.0, 160.0


def heading_of(field: np.ndarray) -> float:
    return -math.atan2(field[1], field[0])


def dip_of(field: np.ndarray) -> float:
    return math.atan2(field[2], math.hypot(field[0], field[1]))


@pytest.mark.parametrize(
    ("told", "slopes", "sign"), [(heading_of, heading_by_iron, 1.0), (dip_of, dip_by_iron, -1.0)]
)
def test_what_iron_along_each_axis_does_to_heading_and_dip(
    rng: np.random.Generator,
    told: Callable[[np.ndarray], float],
    slopes: Callable[[Quat, Vec3], Vec3],
    sign: float,
) -> None:
    attitude = Rotation.from_quat(rng.normal(size=4), scalar_first=True)
    found = slopes(tuple(attitude.as_quat(scalar_first=True)), tuple(EARTH_N_UT))
    for k in range(3):
        bent = EARTH_N_UT + sign * attitude.apply(1e-6 * np.eye(3)[k])
        assert found[k] == pytest.approx((told(bent) - told(EARTH_N_UT)) / 1e-6, rel=1e-4)


def tumbled(s: IronState, known: np.ndarray) -> None:
    """Turn a compass that carries iron about all axes for a minute."""
    for attitude in Rotation.from_euler("ZYX", np.outer(np.arange(1200), (0.034, 0.021, 0.013))):
        raw = attitude.inv().apply(EARTH_N_UT) + IRON_UT
        compare_strength(s, tuple(raw), tuple(known), 0.05)


def test_the_strength_differs_by_the_iron_that_is_not_known() -> None:
    s = new_record(IronState)
    tumbled(s, IRON_UT)
    assert unexplained_iron_sq(s) == 0.0
    assert s.iron_misfit < 0.3**2
    assert s.iron_norm - mean_strengthening(s, tuple(IRON_UT)) == pytest.approx(
        np.linalg.norm(EARTH_N_UT), rel=0.01
    )
    tumbled(s, np.zeros(3))
    # What lies along the field shows, one axis of three.
    shown = math.sqrt(s.iron_misfit) / np.linalg.norm(IRON_UT)
    assert shown == pytest.approx(math.sqrt(1.0 / 3.0), rel=0.3)
    assert unexplained_iron_sq(s) > 0.0


def test_each_axis_of_the_iron_strengthens_the_field_as_it_is_told_to() -> None:
    s = new_record(IronState)
    tumbled(s, IRON_UT)
    turned = Rotation.from_rotvec([0.4, -1.1, 0.7]).inv().apply(EARTH_N_UT)
    off, along = compare_strength(s, tuple(turned + IRON_UT), (0.0, 0.0, 0.0), 1e-6)
    assert off == pytest.approx(np.dot(along, IRON_UT), abs=0.5)


def begun(iron_ut: float) -> ComplementaryState:
    """Make a filter whose compass has told the heading, and which GPS aids from now on."""
    s = new_record(ComplementaryState)
    s.q_eb[0] = s.q_ei[0] = 1.0
    begin_drift(s, GAINS)
    s.level_by_gps = 1
    s.iron_var = iron_ut**2
    for k in range(IRON, IRON + 3):
        s.drift_cov[k, k] = iron_ut**2
    return s


def measure(s: ComplementaryState, row: np.ndarray, told: float, std: float) -> None:
    """Let the filter take a number that depends on heading, compass and iron."""
    known = np.zeros(len(row))
    known[HEADING], known[COMPASS] = s.heading_rad, s.compass_rad
    known[IRON : IRON + 3] = s.iron_b
    cleared_row(s)[:] = row
    correct_drift(s, GAINS, told - row @ known, std * std, UNCLIPPED, SCALE)


def test_iron_that_is_expected_later_counts_as_if_it_had_been_from_the_start() -> None:
    wide, widened = begun(6.0), begun(AIDED_IRON_UT)
    for s in (wide, widened):
        told = np.random.default_rng(4)
        for _ in range(5):
            row = np.zeros(len(s.drift_row))
            row[HEADING] = row[COMPASS] = 1.0
            row[IRON : IRON + 3] = told.normal(0.0, 0.03, 3)
            measure(s, row, told.normal(0.2, 0.1), 0.05)
    expect_iron(widened, GAINS, 6.0**2)
    np.testing.assert_allclose(widened.drift_cov, wide.drift_cov, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(widened.iron_b, wide.iron_b, rtol=1e-6)
    assert widened.heading_rad == pytest.approx(wide.heading_rad)
    assert np.linalg.norm(wide.iron_b) > 0.5


def test_an_expectation_may_grow_by_the_least_that_a_number_can() -> None:
    s = begun(90.5)
    before = s.drift_cov.copy()
    expect_iron(s, GAINS, math.nextafter(90.5**2, math.inf))
    np.testing.assert_allclose(s.drift_cov, before, rtol=1e-9, atol=1e-12)


def test_iron_that_a_wrong_attitude_has_shown_is_forgotten_whole() -> None:
    """Left in, it would count as found with certainty, and grow with each new expectation."""
    s = begun(AIDED_IRON_UT)
    s.iron_b[:] = IRON_UT
    doubt_sensors(s, GAINS)
    expect_iron(s, GAINS, 6.0**2)
    assert not s.iron_b.any()


def test_the_dip_tells_iron_no_better_than_the_dip_itself_is_known() -> None:
    s = begun(15.0)
    s.earth_dip_rad = dip_of(EARTH_N_UT)
    iron = np.array([0.0, 0.0, -12.0])
    for _ in range(500):
        update_by_dip(s, GAINS, tuple(EARTH_N_UT + iron - s.iron_b), 0.05)
    left = dip_of(EARTH_N_UT + iron - s.iron_b) - s.earth_dip_rad
    assert abs(left) < math.radians(2.0)
    cleared_row(s)[IRON : IRON + 3] = dip_by_iron(tuple(s.q_eb), tuple(EARTH_N_UT))
    assert math.radians(2.0) < math.sqrt(expected_variance(s)) < math.radians(3.5)


def test_a_field_that_proves_less_level_is_no_evidence_of_iron_across_it() -> None:
    """A heading that followed the compass agrees with it, whatever the iron is."""
    s, field = begun(3.0), np.array([31.0, 5.0, 28.0])
    turned = np.array(heading_by_iron(tuple(s.q_eb), tuple(field)))
    P = s.drift_cov
    P[HEADING, HEADING] = P[COMPASS, COMPASS] + 9.0 * turned @ turned
    P[HEADING, COMPASS] = P[COMPASS, HEADING] = -P[COMPASS, COMPASS]
    P[HEADING, IRON : IRON + 3] = P[IRON : IRON + 3, HEADING] = -9.0 * turned
    lost = np.array([31.0, 5.0, 0.0]) / 3.0
    s.iron_b[:] = lost
    follow_iron(s, tuple(field), tuple(field), 0.0)
    row = cleared_row(s)
    row[HEADING] = row[COMPASS] = 1.0
    row[IRON : IRON + 3] = heading_by_iron(tuple(s.q_eb), tuple(field - lost))
    assert expected_variance(s) < 1e-9


def driven(seed: int) -> tuple[SampleLog, np.ndarray]:
    """Stand, then drive through a town with iron at the compass; also tell the heading, rad."""
    rng, n = np.random.default_rng(seed), round(DRIVES_S * RATE_HZ)
    time_s = np.arange(n) / RATE_HZ
    drives = np.clip((time_s - STANDS_S) / 3.0, 0.0, 1.0)
    speed = np.abs(8.0 + correlated(rng, n, RATE_HZ, 3.0, 6.0)[:, 0]) * drives
    speed = gaussian_filter1d(speed, RATE_HZ)
    rate = gaussian_filter1d(correlated(rng, n, RATE_HZ, 0.25, 2.0)[:, 0] * drives, RATE_HZ)
    heading = rng.uniform(-math.pi, math.pi) + np.cumsum(rate) / RATE_HZ
    imu = np.zeros((n, IMU_COLUMNS))
    shaken = 0.05 + 0.4 * drives[:, None]
    imu[:, ACCEL : ACCEL + 3] = rng.normal(0.0, 1.0, (n, 3)) * shaken - (0.0, 0.0, G)
    imu[:, ACCEL] += np.gradient(speed, time_s)
    imu[:, ACCEL + 1] += speed * rate
    imu[:, GYRO : GYRO + 3] = rng.normal(0.0, 0.003, (n, 3)) + rng.normal(0.0, 0.005, 3)
    imu[:, GYRO + 2] += rate
    back = Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0]))
    earth = np.tile([math.hypot(*EARTH_N_UT[:2]), 0.0, EARTH_N_UT[2]], (n, 1))
    imu[:, MAG : MAG + 3] = back.apply(earth) + CAR_IRON_UT + rng.normal(0.0, 0.4, (n, 3))
    at = np.arange(RATE_HZ, n, RATE_HZ // FIXES_HZ)
    vel_n = np.column_stack([speed * np.cos(heading), speed * np.sin(heading), 0.0 * speed])
    place = np.cumsum(vel_n, axis=0)[at] / RATE_HZ
    fixes = fix_rows(place, vel_n[at] + rng.normal(0.0, 0.1, (len(at), 3)))
    return log_of(imu, RATE_HZ, at, fixes), heading


@pytest.mark.parametrize(
    ("marked", "most_deg", "share"),
    [(False, 6.5, 0.77), (True, 2.5, 0.93)],
    ids=["unmarked", "marked"],
)
@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_a_compass_that_nobody_has_calibrated_is_found_out_by_driving(
    name: str, marked: bool, most_deg: float, share: float
) -> None:
    """Iron that turns it by 30 deg; the velocities of GPS tell the heading, and so the iron.

    Where it is marked as never calibrated, the first turns do.
    """
    off, told = [], []
    for seed in range(6):
        log, heading = driven(seed)
        log.imu[:, MAG_UNCALIBRATED] = marked
        out = estimator_of(name).run(log)[round(LEARNED_S * RATE_HZ) :]
        off.append(heading_off(out, heading[-len(out) :]))
        told.append(out[:, NAV_ATTITUDE_STD + 2])
    assert np.degrees(np.sqrt(np.mean(np.square(off)))) < most_deg
    assert np.mean(np.array(off) < 2.0 * np.array(told)) > share


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_iron_that_was_found_is_forgotten_once_the_compass_is_calibrated(name: str) -> None:
    log, heading = driven(0)
    calibrated = np.arange(len(heading)) >= round(DRIVES_S / 2 * RATE_HZ)
    log.imu[:, MAG_UNCALIBRATED] = ~calibrated
    log.imu[calibrated, MAG : MAG + 3] -= CAR_IRON_UT
    out = estimator_of(name).run(log)[calibrated]
    assert np.degrees(heading_off(out, heading[calibrated]).max()) < 5.0


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_without_gps_a_compass_that_nobody_has_calibrated_is_told_as_unsure(name: str) -> None:
    for seed in range(6):
        log, heading = driven(seed)
        log.imu[:, MAG_UNCALIBRATED] = 1.0
        out = estimator_of(name).run(log_of(log.imu, RATE_HZ))[round(LEARNED_S * RATE_HZ) :]
        off = heading_off(out, heading[-len(out) :])
        assert np.mean(off < 2.0 * out[:, NAV_ATTITUDE_STD + 2]) > 0.9
