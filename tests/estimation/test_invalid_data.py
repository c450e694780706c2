"""Invalid data of sensors: the states stay finite and within physical limits."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gateway.estimation import columns as col
from gateway.estimation.kernel import SampleLog
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import NavFlags
from gateway.units import STANDARD_GRAVITY_MPS2
from tests.estimation.samples import ACCELS, GPS_VELS, GYROS, MAGS, NAV_VELS, selected
from tools.flights import Flight, north_east_m, simulated_flight
from tools.score_estimators import attitude_scores, run_eskf

FASTEST_MPS = 1000.0
Change = Callable[[SampleLog, np.random.Generator], None]


@pytest.fixture(scope="module")
def flight() -> Flight:
    return simulated_flight(2, calibrated=False)


def part(flight: Flight, begin_s: float, length_s: float) -> SampleLog:
    """Copy a part of a flight."""
    end_us = (begin_s + length_s) * 1e6
    return selected(flight.log, lambda us: (us > begin_s * 1e6) & (us < end_us))[0]


def at_rest(length_s: float, speed_mps: float) -> SampleLog:
    """Rest below a receiver that repeats the same fix."""
    imu_us = np.arange(0, round(length_s * 1e6), 10_000)
    gps_us = np.arange(0, round(length_s * 1e6), 200_000)
    imu = np.full((len(imu_us), col.IMU_COLUMNS), np.nan)
    gps = np.full((len(gps_us), col.GPS_COLUMNS), np.nan)
    imu[:, col.ACCEL : col.ACCEL + 6] = np.random.default_rng(5).normal(0.0, 1e-3, (len(imu), 6))
    imu[:, col.ACCEL + 2] -= STANDARD_GRAVITY_MPS2
    imu[:, MAGS] = 21.0, 0.0, 43.0
    imu[:, col.CLIPPED] = 0.0
    gps[:, [col.GPS_USABLE, col.GPS_LAT, col.GPS_LON, col.GPS_ALT]] = 1.0, 47.0, 8.0, 500.0
    gps[:, GPS_VELS] = speed_mps
    return SampleLog(imu_us, imu, imu_us[:0], np.empty(0), gps_us, gps)


def run(flight: Flight, log: SampleLog) -> np.ndarray:
    return run_eskf(replace(flight, log=log))


def check_sane(flight: Flight, log: SampleLog) -> None:
    out = run(flight, log)
    assert np.isfinite(out[100:, col.NAV_QUAT : col.NAV_QUAT + 4]).all()
    assert np.isfinite(out[:, col.NAV_FLAGS]).all()
    vel = out[:, NAV_VELS]
    assert np.abs(vel[np.isfinite(vel)]).max(initial=0.0) < FASTEST_MPS


def noisy_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, MAGS] += rng.normal(0.0, 40.0, (len(log.imu), 3))


def upright_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, col.MAG : col.MAG + 2] = 0.0
    log.imu[:, col.MAG + 2] += rng.normal(0.0, 20.0, len(log.imu))


def swapped_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, MAGS] = log.imu[:, col.MAG + rng.permutation(3)]


def fixes_off_africa(log: SampleLog, rng: np.random.Generator) -> None:
    """Some receivers send the position 0, 0 without a fix."""
    log.gps[rng.random(len(log.gps)) < 0.05, col.GPS_LAT : col.GPS_LON + 1] = 0.0


def fixes_with_gaps(log: SampleLog, rng: np.random.Generator) -> None:
    missing = rng.random(log.gps.shape) < 0.1
    missing[:, 0] = False
    log.gps[missing] = np.nan


def fixes_without_velocity(log: SampleLog, rng: np.random.Generator) -> None:
    log.gps[int(rng.random() * len(log.gps)) + 1 :, GPS_VELS] = np.nan


def wild_fixes(log: SampleLog, rng: np.random.Generator) -> None:
    wild = rng.random(len(log.gps)) < 0.1
    log.gps[wild, 1 : col.GPS_COLUMNS] *= rng.normal(1.0, 1.0, (wild.sum(), col.GPS_COLUMNS - 1))


def samples_with_gaps(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[rng.random(log.imu.shape) < 0.02] = np.nan


def shaken(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, ACCELS] += rng.normal(0.0, 30.0, (len(log.imu), 3))
    log.imu[:, GYROS] += rng.normal(0.0, 1.0, (len(log.imu), 3))


def swapped_rates(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, GYROS] = log.imu[:, col.GYRO + rng.permutation(3)] * rng.choice([-1, 1], 3)


def wild_heights(log: SampleLog, rng: np.random.Generator) -> None:
    wild = rng.random(len(log.baro_alt_m)) < 0.1
    log.baro_alt_m[wild] = rng.normal(0.0, 1e6, wild.sum())


KINDS: tuple[Change, ...] = (
    noisy_field,
    upright_field,
    swapped_field,
    fixes_off_africa,
    fixes_with_gaps,
    fixes_without_velocity,
    wild_fixes,
    samples_with_gaps,
    shaken,
    swapped_rates,
    wild_heights,
)


@pytest.mark.parametrize("how", KINDS, ids=lambda how: how.__name__)
def test_one_kind_of_invalid_data_leaves_states_finite(flight: Flight, how: Change) -> None:
    log = part(flight, 0.0, 60.0)
    how(log, np.random.default_rng(1))
    check_sane(flight, log)


@pytest.mark.parametrize("seed", range(60))
def test_several_kinds_of_invalid_data_leave_states_finite(flight: Flight, seed: int) -> None:
    """The parts begin on the ground or in flight."""
    rng = np.random.default_rng(seed)
    log = part(flight, rng.uniform(0.0, 150.0), 40.0)
    for k in rng.permutation(len(KINDS))[: rng.integers(1, 5)]:
        KINDS[k](log, rng)
    check_sane(flight, log)


@pytest.mark.parametrize("how", ["x", "y", "swapped"])
def test_wrongly_mounted_compass_is_reported_and_not_used(flight: Flight, how: str) -> None:
    log = part(flight, -1.0, 300.0)
    if how == "swapped":
        log.imu[:, col.MAG : col.MAG + 2] = log.imu[:, [col.MAG + 1, col.MAG]]
    else:
        log.imu[:, col.MAG + "xy".index(how)] *= -1.0
    late = replace(flight, counts=log.imu_time_us > 120_000_000)
    out = run(flight, log)
    flags = out[late.counts, col.NAV_FLAGS].astype(int)
    reported = NavFlags.MAG_DISTURBED | NavFlags.MAG_MISPLACED
    assert ((flags & int(reported)) == int(reported)).all()
    assert (flags & int(NavFlags.HEADING_VALID) != 0).mean() > 0.9
    scores = attitude_scores(late, out[:, :4])
    assert scores["heading"] < 4.0
    assert scores["inclination"] < 3.0


@pytest.mark.parametrize("leap_s", [100, 86_400])
@pytest.mark.parametrize("since_s", [4.0, 60.0], ids=["at rest", "in flight"])
def test_clock_jump_is_handled_as_outage(flight: Flight, leap_s: int, since_s: float) -> None:
    """The aircraft may be in any state after the jump; the filter converges again."""
    log = part(flight, -1.0, 300.0)
    for times_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us):
        times_us[times_us > since_s * 1e6] += leap_s * 1_000_000
    late = replace(flight, counts=flight.log.imu_time_us > 120_000_000)
    out = run(flight, log)
    scores = attitude_scores(late, out[:, :4])
    assert max(scores["heading"], scores["inclination"]) < 3.0
    assert np.nanmax(np.abs(out[:, NAV_VELS])) < 100.0


def test_shocks_beyond_accelerometer_range_leave_small_errors(flight: Flight) -> None:
    """Each lasts 40 ms and saturates all axes in either direction."""
    log, rng = part(flight, -1.0, 300.0), np.random.default_rng(11)
    for begin in np.flatnonzero(rng.random(len(log.imu)) < 0.003):
        blow = slice(begin, begin + 4)
        shape = log.imu[blow, ACCELS].shape
        log.imu[blow, ACCELS] = rng.choice([-156.9, 156.9], shape)
        log.imu[blow, col.CLIPPED] = 1.0
    out = run(flight, log)
    off_m = north_east_m(flight, out[:, col.NAV_LAT], out[:, col.NAV_LON]) - flight.pos_ne_m
    late = log.imu_time_us > 60_000_000
    assert np.percentile(np.linalg.norm(off_m[late], axis=1), 95) < 10.0
    scores = attitude_scores(replace(flight, counts=late), out[:, :4])
    assert max(scores["heading"], scores["inclination"]) < 3.0


def test_impossible_jump_of_fixes_gives_no_velocity(flight: Flight) -> None:
    """All later fixes are at the second position, so they are finally accepted."""
    log = part(flight, 30.0, 60.0)
    log.gps[:, GPS_VELS] = np.nan
    log.gps[len(log.gps) // 2 :, col.GPS_LAT : col.GPS_LON + 1] = 0.0
    check_sane(flight, log)


@pytest.mark.parametrize("has_velocity", [True, False])
def test_repeated_fix_is_used_once(flight: Flight, has_velocity: bool) -> None:
    """As in a log that holds each fix until the next one."""
    log = part(flight, 30.0, 60.0)
    if not has_velocity:
        log.gps[:, GPS_VELS] = np.nan
    newest = np.arange(len(log.gps)) // 5 * 5
    once = replace(log, gps_time_us=log.gps_time_us[::5], gps=log.gps[::5])
    out = run(flight, replace(log, gps=log.gps[newest]))
    np.testing.assert_array_equal(out, run(flight, once))


def test_fix_repeated_in_flight_is_handled_as_outage(flight: Flight) -> None:
    """The last fix, repeated, has the same effect as no fix."""
    log = part(flight, 30.0, 60.0)
    stuck = (log.gps_time_us > 60e6) & (log.gps_time_us < 66e6)
    none = replace(log, gps_time_us=log.gps_time_us[~stuck], gps=log.gps[~stuck])
    log.gps[stuck] = log.gps[~stuck][np.sum(log.gps_time_us < 60e6) - 1]
    np.testing.assert_array_equal(run(flight, log), run(flight, none))


@pytest.mark.parametrize("speed_mps", [0.0, np.nan])
def test_repeated_fixes_at_rest_are_accepted(speed_mps: float) -> None:
    """Some receivers hold their position at rest."""
    log = at_rest(20.0, speed_mps)
    estimator: Any = make_estimator(EstimationSettings())
    out = estimator.run(log)
    assert (out[-1000:, col.NAV_FLAGS].astype(int) & NavFlags.POSITION_VALID != 0).all()
    assert (out[-1000:, col.NAV_POS_STD] < 10.0).all()
