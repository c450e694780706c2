"""Hours of weaving flight: rounding must not wear a filter out."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import GPS_COLUMNS, IMU_COLUMNS, NAV_ATTITUDE_STD
from gateway.estimation.kernel import SampleLog
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.geometry.geodesy import radii_m
from gateway.units import STANDARD_GRAVITY_MPS2

HOURS = 2.0
RATE_HZ = 50
SPEED_MPS = 20.0
LAT_DEG, LON_DEG, ALT_M = 47.0, 8.0, 500.0
FIELD_N_UT = (20.0, 0.0, 40.0)
REFERENCE = ReferenceSettings(gps_latency_s=0.16, declination="fixed", declination_deg=0.0)


@pytest.fixture(scope="module")
def flight() -> tuple[SampleLog, Rotation]:
    """Fly coordinated turns left and right on a gyroscope 1 % off scale."""
    rng = np.random.default_rng(1)
    n = round(HOURS * 3600 * RATE_HZ)
    t = np.arange(n) / RATE_HZ
    turn_radps = 0.2 * np.sin(t / 7.0) + 0.05 * np.sin(t / 31.0)
    yaw = np.cumsum(turn_radps) / RATE_HZ
    level = np.zeros(n)
    roll = np.arctan2(SPEED_MPS * turn_radps, STANDARD_GRAVITY_MPS2)
    attitude = Rotation.from_euler("ZYX", np.column_stack([yaw, level, roll]))
    vel = SPEED_MPS * np.column_stack([np.cos(yaw), np.sin(yaw), level])
    force_n = np.cross([0.0, 0.0, 1.0], vel) * turn_radps[:, np.newaxis]
    force_n[:, 2] = -STANDARD_GRAVITY_MPS2
    rate = (attitude[:-1].inv() * attitude[1:]).as_rotvec() * RATE_HZ
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, :3] = attitude.inv().apply(force_n) + rng.normal(0.0, 0.1, (n, 3))
    imu[1:, 3:6] = 1.01 * rate
    imu[:, 3:6] += rng.normal(0.0, 0.003, (n, 3))
    imu[:, 6:9] = attitude.inv().apply(FIELD_N_UT) + rng.normal(0.0, 0.3, (n, 3))
    time_us = np.round(t * 1e6).astype(np.int64)
    at = np.arange(0, n, RATE_HZ // 5)
    meridian_m, parallel_m = radii_m(LAT_DEG, ALT_M)
    north, east = (np.cumsum(vel, axis=0)[at, :2] / RATE_HZ + rng.normal(0.0, 0.3, (len(at), 2))).T
    gps = np.full((len(at), GPS_COLUMNS), np.nan)
    gps[:, 0] = 1.0
    gps[:, 1] = LAT_DEG + np.degrees(north / meridian_m)
    gps[:, 2] = LON_DEG + np.degrees(east / parallel_m)
    gps[:, 3] = ALT_M
    gps[:, 4:7] = vel[at]
    gps[:, 10] = 0.0
    baro_m = np.full(len(at), ALT_M)
    return SampleLog(time_us, imu, time_us[at], baro_m, time_us[at] + 160_000, gps), attitude


@pytest.mark.slow
@pytest.mark.parametrize(("name", "limit_deg"), [("eskf", 0.4), ("complementary", 3.0)])
def test_the_last_ten_minutes_are_as_good_as_the_first(
    flight: tuple[SampleLog, Rotation], name: str, limit_deg: float
) -> None:
    log, attitude = flight
    out = make_estimator(EstimationSettings(estimator=name, reference=REFERENCE)).run(log)
    found = Rotation.from_quat(out[:, :4], scalar_first=True)
    off_deg = np.degrees((found * attitude.inv()).magnitude())
    span = 600 * RATE_HZ
    assert off_deg[-span:].mean() < limit_deg
    assert off_deg[-span:].mean() < 1.5 * off_deg[span : 2 * span].mean()
    stds = out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
    if name == "eskf":
        assert (stds[-span:].mean(axis=0) < 1.2 * stds[span : 2 * span].mean(axis=0)).all()
