"""GPS that is off for seconds, place and velocity in agreement, without the receiver telling."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_ALT,
    GPS_H_ACC,
    GPS_LAT,
    GPS_SPEED_ACC,
    GPS_V_ACC,
    GPS_VEL,
    MAG,
    NAV_ATTITUDE_STD,
    NAV_VEL,
    NAV_VEL_STD,
)
from gateway.estimation.eskf.eskf_settings import EskfSettings
from gateway.estimation.kernel import SampleLog
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.geometry.geodesy import radii_m
from tests.estimation.samples import ALT_M, LAT_DEG
from tests.estimation.test_receiver_noise import FIELD_N_UT
from tests.estimation.test_without_compass import (
    FIXES_HZ,
    REFERENCE,
    correlated,
    estimator_of,
    flight,
    heading_off,
)

BEGINS_S, LASTS_S = 70.0, 8.0
SEEDS = range(6)
METRES_PER_DEG = np.radians(radii_m(LAT_DEG, ALT_M))


def no_glitch(time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Stay where it is."""
    return np.zeros((len(time_s), 3))


def run_off(time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Drift 25 m away, and back."""
    share = np.clip((time_s - BEGINS_S) / LASTS_S, 0.0, 1.0)
    azimuth = rng.uniform(-math.pi, math.pi)
    way = 25.0 * np.sin(math.pi * share) ** 2
    return np.outer(way, (math.cos(azimuth), math.sin(azimuth), 0.5))


def swing(time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Swing by 8 m/s to all sides, and come back."""
    inside = (time_s > BEGINS_S) & (time_s < BEGINS_S + LASTS_S)
    vel = 8.0 * correlated(rng, len(time_s), FIXES_HZ, 1.0, 1.0) * inside[:, None]
    way = np.cumsum(vel, axis=0) / FIXES_HZ
    later = np.maximum(time_s - BEGINS_S - LASTS_S, 0.0)
    return np.asarray(way * np.exp(-later / 2.0)[:, None])


def wild_fix(time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Be 300 m off once; its velocity is that of a step there and back."""
    azimuth = rng.uniform(-math.pi, math.pi)
    once = 300.0 * (np.arange(len(time_s)) == np.searchsorted(time_s, BEGINS_S))
    return np.outer(once, (math.cos(azimuth), math.sin(azimuth), 0.5))


def spoilt(seed: int, how: str) -> tuple[SampleLog, np.ndarray, np.ndarray]:
    """Add a compass and a glitch; tell the true heading, and the fixes without the glitch, too."""
    log, heading = flight(seed, "good")
    rng = np.random.default_rng(2000 + seed)
    imu, gps = log.imu.copy(), log.gps.copy()
    turned = Rotation.from_rotvec(np.outer(-heading, [0.0, 0.0, 1.0]))
    imu[:, MAG : MAG + 3] = turned.apply(FIELD_N_UT) + rng.normal(0.0, 0.5, (len(imu), 3))
    imu[np.arange(len(imu)) % 4 != 0, MAG : MAG + 3] = math.nan
    gps[:, GPS_H_ACC], gps[:, GPS_V_ACC], gps[:, GPS_SPEED_ACC] = 1.2, 1.8, 0.25
    time_s = log.gps_time_us * 1e-6
    off_m = {"run_off": run_off, "swing": swing, "wild_fix": wild_fix, "none": no_glitch}[how](
        time_s, rng
    )
    gps[:, GPS_LAT : GPS_LAT + 2] += off_m[:, :2] / METRES_PER_DEG
    gps[:, GPS_ALT] -= off_m[:, 2]
    gps[:, GPS_VEL : GPS_VEL + 3] += np.gradient(off_m, time_s, axis=0)
    return replace(log, imu=imu, gps=gps), heading, log.gps


@cache
def run(name: str, seed: int, how: str) -> tuple[np.ndarray, ...]:
    """Tell tilt and its standard deviation, rad, the error of heading, rad, and the same of
    velocity, m/s."""
    log, heading, fixes = spoilt(seed, how)
    out = estimator_of(name).run(log)
    time_s = log.imu_time_us * 1e-6
    since = (time_s > BEGINS_S) & (time_s < BEGINS_S + 2.0 * LASTS_S)
    true = [np.interp(time_s, log.gps_time_us * 1e-6, fixes[:, GPS_VEL + k]) for k in range(2)]
    vel = out[:, NAV_VEL : NAV_VEL + 2] - np.column_stack(true)
    q = Rotation.from_quat(out[since, :4], scalar_first=True)
    down_b = q.inv().apply([0.0, 0.0, 1.0])
    tilt = np.arctan2(down_b[:, :2], down_b[:, 2:])
    told = out[since, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 2].mean(axis=1)
    vel_told = out[since, NAV_VEL_STD : NAV_VEL_STD + 2]
    return tilt, told, heading_off(out, heading)[since], vel[since], vel_told


def rms_of(name: str, how: str) -> tuple[float, float, float, float, float]:
    """Tell tilt and heading, deg, speed, m/s, and the shares of tilt and velocity in two sigma."""
    runs = [run(name, seed, how) for seed in SEEDS]
    tilt, told, heading, vel, vel_told = (np.concatenate(x) for x in zip(*runs, strict=True))
    within = float(np.mean(np.abs(tilt) < 2.0 * told[:, None]))
    vel_within = float(np.mean(np.abs(vel) < 2.0 * vel_told))
    pair = math.sqrt(2.0)
    off = [math.sqrt(np.mean(np.square(x))) for x in (tilt * pair, heading, vel * pair)]
    return math.degrees(off[0]), math.degrees(off[1]), off[2], within, vel_within


@pytest.mark.parametrize(
    ("name", "how", "limits"),
    [
        ("eskf", "run_off", (0.8, 2.0, 1.0, 0.9)),
        ("eskf", "swing", (1.5, 2.2, 2.0, 0.9)),
        ("eskf", "wild_fix", (0.5, 1.2, 0.2, 0.95)),
        ("complementary", "run_off", (2.6, 6.0, 6.0, 0.7)),
        ("complementary", "swing", (2.9, 2.6, 7.0, 0.7)),
        ("complementary", "wild_fix", (0.5, 0.6, 0.15, 0.95)),
    ],
)
def test_a_glitch_spoils_neither_level_nor_heading(
    name: str, how: str, limits: tuple[float, float, float, float]
) -> None:
    *off, within, _ = rms_of(name, how)
    assert (np.array(off) < limits[:3]).all()
    assert within > limits[3]


@pytest.mark.parametrize(("how", "share"), [("run_off", 0.9), ("swing", 0.75), ("wild_fix", 0.95)])
def test_a_velocity_that_fixes_contradict_is_told_as_unsure_as_that(how: str, share: float) -> None:
    """Fixes without latency, as a log may hold them, are doubted as well as late ones."""
    assert rms_of("eskf", how)[4] > share


def test_a_velocity_that_is_given_up_is_contradicted_no_more() -> None:
    """GPS ends in the midst of a glitch: the level rests on gravity then."""
    for seed in SEEDS:
        log, _, _ = spoilt(seed, "swing")
        before = log.gps_time_us < (BEGINS_S + 0.5 * LASTS_S) * 1e6
        eskf = EskfSettings(dead_reckoning_s=5.0)
        settings = EstimationSettings(estimator="eskf", eskf=eskf, reference=REFERENCE)
        alone = replace(log, gps_time_us=log.gps_time_us[before], gps=log.gps[before])
        out = make_estimator(settings).run(alone)
        told_deg = np.degrees(out[:, NAV_ATTITUDE_STD])
        ended = int(np.searchsorted(log.imu_time_us, log.gps_time_us[before][-1]))
        assert told_deg[ended] > 4.0
        assert told_deg[-1] < 2.0


def test_errors_that_a_receiver_tells_of_are_taken_to_last() -> None:
    """Velocities 2 m/s off for half a minute, told as that: they do not average out."""
    tilts, headings, within = [], [], []
    for seed in SEEDS:
        log, heading, _ = spoilt(seed, "none")
        rng = np.random.default_rng(3000 + seed)
        time_s = log.gps_time_us * 1e-6
        inside = (time_s > BEGINS_S) & (time_s < BEGINS_S + 30.0)
        off_mps = 2.0 * correlated(rng, len(time_s), FIXES_HZ, 1.0, 5.0) * inside[:, None]
        gps = log.gps.copy()
        gps[:, GPS_VEL : GPS_VEL + 3] += off_mps
        gps[:, GPS_SPEED_ACC] = np.hypot(0.25, 0.7 * np.linalg.norm(off_mps, axis=1))
        out = estimator_of("eskf").run(replace(log, gps=gps))
        since = (log.imu_time_us > BEGINS_S * 1e6) & (log.imu_time_us < (BEGINS_S + 40.0) * 1e6)
        down_b = Rotation.from_quat(out[since, :4], scalar_first=True).inv().apply([0.0, 0.0, 1.0])
        tilt = np.arctan2(down_b[:, :2], down_b[:, 2:])
        told = out[since, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 2].mean(axis=1)
        tilts.append(np.hypot(*tilt.T))
        headings.append(heading_off(out, heading)[since])
        within.append(np.abs(tilt) < 2.0 * told[:, None])
    assert math.degrees(math.sqrt(np.mean(np.square(tilts)))) < 0.8
    assert math.degrees(math.sqrt(np.mean(np.square(headings)))) < 1.6
    assert np.mean(within) > 0.92
