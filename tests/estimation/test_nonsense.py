"""Sensors that tell nonsense: whatever comes, the states stay finite and within reason."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from gateway.estimation.alignment.gps_velocity import forget_way, is_zero_refuted
from gateway.estimation.columns import (
    ACCEL,
    CLIPPED,
    GPS_ALT,
    GPS_COLUMNS,
    GPS_LAT,
    GPS_LON,
    GPS_USABLE,
    GPS_VEL,
    GYRO,
    IMU_COLUMNS,
    MAG,
    NAV_ALT,
    NAV_FLAGS,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_QUAT,
    NAV_VEL,
)
from gateway.estimation.complementary.complementary_state import ComplementaryState
from gateway.estimation.complementary.intake import velocity_from_position
from gateway.estimation.kernel import SampleLog
from gateway.estimation.kernel_record import new_record
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import NavFlags
from gateway.units import STANDARD_GRAVITY_MPS2
from tools.flights import Flight, north_east_m, simulated_flight
from tools.score_estimators import attitude_scores

ESTIMATORS = ("complementary", "eskf")
FASTEST_MPS = 1000.0
Nonsense = Callable[[SampleLog, np.random.Generator], None]


@pytest.fixture(scope="module")
def flight() -> Flight:
    return simulated_flight(2, calibrated=False)


def part(flight: Flight, begin_s: float, length_s: float) -> SampleLog:
    """Copy a part of a flight."""
    log = flight.log
    imu, baro, gps = (
        (times > begin_s * 1e6) & (times < (begin_s + length_s) * 1e6)
        for times in (log.imu_time_us, log.baro_time_us, log.gps_time_us)
    )
    return SampleLog(
        log.imu_time_us[imu].copy(),
        log.imu[imu].copy(),
        log.baro_time_us[baro].copy(),
        log.baro_alt_m[baro].copy(),
        log.gps_time_us[gps].copy(),
        log.gps[gps].copy(),
    )


def at_rest(length_s: float, speed_mps: float) -> SampleLog:
    """Lie still below a receiver that tells the same over and over."""
    imu_us = np.arange(0, round(length_s * 1e6), 10_000)
    gps_us = np.arange(0, round(length_s * 1e6), 200_000)
    imu, gps = (
        np.full((len(imu_us), IMU_COLUMNS), np.nan),
        np.full((len(gps_us), GPS_COLUMNS), np.nan),
    )
    imu[:, ACCEL : ACCEL + 6] = np.random.default_rng(5).normal(0.0, 1e-3, (len(imu), 6))
    imu[:, ACCEL + 2] -= STANDARD_GRAVITY_MPS2
    imu[:, MAG : MAG + 3] = 21.0, 0.0, 43.0
    imu[:, CLIPPED] = 0.0
    gps[:, [GPS_USABLE, GPS_LAT, GPS_LON, GPS_ALT]] = 1.0, 47.0, 8.0, 500.0
    gps[:, GPS_VEL : GPS_VEL + 3] = speed_mps
    return SampleLog(imu_us, imu, imu_us[:0], np.empty(0), gps_us, gps)


def run(flight: Flight, name: str, log: SampleLog) -> np.ndarray:
    settings = EstimationSettings(estimator=name, reference=flight.reference)
    return make_estimator(settings).run(log)


def check_sane(flight: Flight, name: str, log: SampleLog) -> None:
    out = run(flight, name, log)
    assert np.isfinite(out[100:, NAV_QUAT : NAV_QUAT + 4]).all()
    assert np.isfinite(out[:, NAV_FLAGS]).all()
    vel = out[:, NAV_VEL : NAV_VEL + 3]
    assert np.abs(vel[np.isfinite(vel)]).max(initial=0.0) < FASTEST_MPS


def noisy_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, MAG : MAG + 3] += rng.normal(0.0, 40.0, (len(log.imu), 3))


def upright_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, MAG : MAG + 2] = 0.0
    log.imu[:, MAG + 2] += rng.normal(0.0, 20.0, len(log.imu))


def swapped_field(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, MAG : MAG + 3] = log.imu[:, MAG + rng.permutation(3)]


def fixes_off_africa(log: SampleLog, rng: np.random.Generator) -> None:
    """Some receivers tell the place 0, 0 while they know none."""
    log.gps[rng.random(len(log.gps)) < 0.05, GPS_LAT : GPS_LON + 1] = 0.0


def fixes_with_holes(log: SampleLog, rng: np.random.Generator) -> None:
    holes = rng.random(log.gps.shape) < 0.1
    holes[:, 0] = False
    log.gps[holes] = np.nan


def fixes_without_velocity(log: SampleLog, rng: np.random.Generator) -> None:
    log.gps[rng.random() * len(log.gps) < np.arange(len(log.gps)), GPS_VEL : GPS_VEL + 3] = np.nan


def wild_fixes(log: SampleLog, rng: np.random.Generator) -> None:
    wild = rng.random(len(log.gps)) < 0.1
    log.gps[wild, 1:GPS_COLUMNS] *= rng.normal(1.0, 1.0, (wild.sum(), GPS_COLUMNS - 1))


def samples_with_holes(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[rng.random(log.imu.shape) < 0.02] = np.nan


def shaken(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, ACCEL : ACCEL + 3] += rng.normal(0.0, 30.0, (len(log.imu), 3))
    log.imu[:, GYRO : GYRO + 3] += rng.normal(0.0, 1.0, (len(log.imu), 3))


def swapped_rates(log: SampleLog, rng: np.random.Generator) -> None:
    log.imu[:, GYRO : GYRO + 3] = log.imu[:, GYRO + rng.permutation(3)] * rng.choice([-1, 1], 3)


def wild_heights(log: SampleLog, rng: np.random.Generator) -> None:
    wild = rng.random(len(log.baro_alt_m)) < 0.1
    log.baro_alt_m[wild] = rng.normal(0.0, 1e6, wild.sum())


NONSENSE: tuple[Nonsense, ...] = (
    noisy_field,
    upright_field,
    swapped_field,
    fixes_off_africa,
    fixes_with_holes,
    fixes_without_velocity,
    wild_fixes,
    samples_with_holes,
    shaken,
    swapped_rates,
    wild_heights,
)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("how", NONSENSE, ids=lambda how: how.__name__)
def test_of_one_kind(flight: Flight, name: str, how: Nonsense) -> None:
    log = part(flight, 0.0, 60.0)
    how(log, np.random.default_rng(1))
    check_sane(flight, name, log)


@pytest.mark.parametrize("seed", range(60))
def test_of_several_kinds(flight: Flight, seed: int) -> None:
    """From the ground or in the air."""
    rng = np.random.default_rng(seed)
    log = part(flight, rng.uniform(0.0, 150.0), 40.0)
    for k in rng.permutation(len(NONSENSE))[: rng.integers(1, 5)]:
        NONSENSE[k](log, rng)
    for name in ESTIMATORS:
        check_sane(flight, name, log)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("how", ["x", "y", "swapped"])
def test_a_compass_that_is_mounted_wrongly_is_done_without(
    flight: Flight, name: str, how: str
) -> None:
    log = part(flight, -1.0, 300.0)
    if how == "swapped":
        log.imu[:, MAG : MAG + 2] = log.imu[:, [MAG + 1, MAG]]
    else:
        log.imu[:, MAG + "xy".index(how)] *= -1.0
    late = replace(flight, counts=log.imu_time_us > 120_000_000)
    out = run(flight, name, log)
    flags = out[late.counts, NAV_FLAGS].astype(int)
    told = NavFlags.MAG_DISTURBED | NavFlags.MAG_MISPLACED
    assert ((flags & int(told)) == int(told)).all()
    assert (flags & int(NavFlags.HEADING_VALID)).all()
    scores = attitude_scores(late, out[:, :4])
    assert scores["heading"] < 4.0
    assert scores["inclination"] < 3.0


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("leap_s", [100, 86_400])
@pytest.mark.parametrize("since_s", [4.0, 60.0], ids=["at rest", "in flight"])
def test_a_clock_that_leaps_ahead_is_a_silence(
    flight: Flight, name: str, leap_s: int, since_s: float
) -> None:
    """Its end may find the aircraft anywhere, but the filter sane."""
    log = part(flight, -1.0, 300.0)
    for times_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us):
        times_us[times_us > since_s * 1e6] += leap_s * 1_000_000
    late = replace(flight, counts=flight.log.imu_time_us > 120_000_000)
    out = run(flight, name, log)
    scores = attitude_scores(late, out[:, :4])
    assert max(scores["heading"], scores["inclination"]) < 3.0
    assert np.nanmax(np.abs(out[:, NAV_VEL : NAV_VEL + 3])) < 100.0


@pytest.mark.parametrize(("name", "place_m"), [("complementary", 25.0), ("eskf", 10.0)])
def test_blows_beyond_the_range_of_the_accelerometer_are_got_over(
    flight: Flight, name: str, place_m: float
) -> None:
    """Some 40 ms long each, in either direction of each axis: what it reads is not what it was."""
    log, rng = part(flight, -1.0, 300.0), np.random.default_rng(11)
    for begin in np.flatnonzero(rng.random(len(log.imu)) < 0.003):
        blow = slice(begin, begin + 4)
        shape = log.imu[blow, ACCEL : ACCEL + 3].shape
        log.imu[blow, ACCEL : ACCEL + 3] = rng.choice([-156.9, 156.9], shape)
        log.imu[blow, CLIPPED] = 1.0
    out = run(flight, name, log)
    off_m = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
    late = log.imu_time_us > 60_000_000
    assert np.percentile(np.linalg.norm(off_m[late], axis=1), 95) < place_m
    scores = attitude_scores(replace(flight, counts=late), out[:, :4])
    assert max(scores["heading"], scores["inclination"]) < 3.0


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_place_that_nothing_flies_to_tells_no_velocity(flight: Flight, name: str) -> None:
    """All fixes come to lie there, so that they are believed in the end."""
    log = part(flight, 30.0, 60.0)
    log.gps[:, GPS_VEL : GPS_VEL + 3] = np.nan
    log.gps[len(log.gps) // 2 :, GPS_LAT : GPS_LON + 1] = 0.0
    check_sane(flight, name, log)


@pytest.mark.parametrize("name", ["complementary", "eskf"])
def test_zeros_that_the_fixes_refute_are_no_velocity(flight: Flight, name: str) -> None:
    """As of a receiver that measures none, or a log that holds none."""
    log = part(flight, 0.0, 120.0)
    log.gps[:, GPS_VEL : GPS_VEL + 3] = 0.0
    out, late = run(flight, name, log), log.imu_time_us > 60_000_000
    counted = replace(flight, counts=late, q_nb=flight.q_nb[: len(out)])
    scores = attitude_scores(counted, out[:, :4])
    assert max(scores["heading"], scores["inclination"]) < 3.5


def test_what_stands_may_tell_zeros(rng: np.random.Generator) -> None:
    s = new_record(ComplementaryState)
    forget_way(s)
    zero, refuted = (0.0, 0.0, 0.0), []
    for k in range(600):
        north_m, east_m = 2.0 * rng.standard_normal(2)
        if k >= 300:
            north_m += 1.5 * (k - 300)
        refuted.append(is_zero_refuted(s, 0.2 * k, (north_m, east_m, 0.0), zero))
    assert not any(refuted[:300])
    assert all(refuted[330:])
    assert not is_zero_refuted(s, 120.0, zero, (0.1, 0.0, 0.0))
    assert not is_zero_refuted(s, 120.2, zero, zero)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("has_velocity", [True, False])
def test_a_fix_that_is_told_again_and_again_counts_once(
    flight: Flight, name: str, has_velocity: bool
) -> None:
    """As in a log that holds each fix until the next one."""
    log = part(flight, 30.0, 60.0)
    if not has_velocity:
        log.gps[:, GPS_VEL : GPS_VEL + 3] = np.nan
    newest = np.arange(len(log.gps)) // 5 * 5
    once = replace(log, gps_time_us=log.gps_time_us[::5], gps=log.gps[::5])
    out = run(flight, name, replace(log, gps=log.gps[newest]))
    np.testing.assert_array_equal(out, run(flight, name, once))


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_receiver_that_is_stuck_in_flight_is_none(flight: Flight, name: str) -> None:
    """Its last words, over and over, move the place no more than if it told nothing."""
    log = part(flight, 30.0, 60.0)
    stuck = (log.gps_time_us > 60e6) & (log.gps_time_us < 66e6)
    none = replace(log, gps_time_us=log.gps_time_us[~stuck], gps=log.gps[~stuck])
    log.gps[stuck] = log.gps[~stuck][np.sum(log.gps_time_us < 60e6) - 1]
    np.testing.assert_array_equal(run(flight, name, log), run(flight, name, none))


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("speed_mps", [0.0, np.nan])
def test_a_receiver_that_repeats_itself_at_rest_is_believed(name: str, speed_mps: float) -> None:
    """Some hold their place while they stand."""
    log = at_rest(20.0, speed_mps)
    out = make_estimator(EstimationSettings(estimator=name)).run(log)
    assert (out[-1000:, NAV_FLAGS].astype(int) & NavFlags.POSITION_VALID != 0).all()
    assert (out[-1000:, NAV_POS_STD] < 10.0).all()


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("kinds", [("baro",), ("gps",), ("baro", "gps")], ids="-".join)
def test_a_first_height_that_is_wrong_is_undone(
    flight: Flight, name: str, kinds: tuple[str, ...]
) -> None:
    """The barometer alone, GPS alone, and both."""
    log, spoilt = part(flight, 30.0, 20.0), part(flight, 30.0, 20.0)
    spoilt.baro_alt_m[0] += 9000.0
    spoilt.gps[0, GPS_ALT] += 9000.0
    expected, found = (
        run(
            flight,
            name,
            SampleLog(
                each.imu_time_us,
                each.imu,
                each.baro_time_us if "baro" in kinds else each.baro_time_us[:0],
                each.baro_alt_m if "baro" in kinds else each.baro_alt_m[:0],
                each.gps_time_us if "gps" in kinds else each.gps_time_us[:0],
                each.gps if "gps" in kinds else each.gps[:0],
            ),
        )[-1, NAV_ALT]
        for each in (log, spoilt)
    )
    assert found == pytest.approx(expected, abs=2.0)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_single_heights_of_fixes_are_left_out(flight: Flight, name: str) -> None:
    log, spoilt = part(flight, 30.0, 30.0), part(flight, 30.0, 30.0)
    spoilt.gps[20::13, GPS_ALT] += 9000.0
    off_m = run(flight, name, spoilt)[:, NAV_ALT] - run(flight, name, log)[:, NAV_ALT]
    assert np.nanmax(np.abs(off_m)) < 2.0


@pytest.mark.parametrize(("name", "most_m"), [("complementary", 18.0), ("eskf", 4.0)])
def test_heights_that_leave_the_barometer_for_a_while_are_doubted(
    flight: Flight, name: str, most_m: float
) -> None:
    log, spoilt = part(flight, 30.0, 80.0), part(flight, 30.0, 80.0)
    since_s = (spoilt.gps_time_us - spoilt.gps_time_us[0]) * 1e-6
    spoilt.gps[(since_s > 30.0) & (since_s < 50.0), GPS_ALT] += 50.0
    off_m = run(flight, name, spoilt)[:, NAV_ALT] - run(flight, name, log)[:, NAV_ALT]
    assert np.nanmax(np.abs(off_m)) < most_m


@pytest.mark.parametrize(("north_m", "speed_mps"), [(2.0, 5.0), (1e7, 3.0)])
def test_only_a_way_that_can_be_flown_adds_to_the_velocity(
    north_m: float, speed_mps: float
) -> None:
    state = new_record(ComplementaryState)
    state.time_s, state.fix_s = 10.0, 9.5
    past = ((0.0, 0.0, 0.0), (3.0, 0.0, 0.0))
    assert velocity_from_position(state, (north_m, 0.0, 0.0), past) == (speed_mps, 0.0, 0.0)
