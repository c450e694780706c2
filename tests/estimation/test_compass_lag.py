"""How late a compass is, learned from the field and the gyroscope alone."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import IMU_COLUMNS
from gateway.estimation.compass_lag import LAG_SPREAD_S, USUAL_LAG_S
from gateway.estimation.kernel import KernelEstimator, SampleLog
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.units import STANDARD_GRAVITY_MPS2

FILTERS = ("complementary", "eskf")
RATE_HZ = 100
FIELD_N_UT = np.array([20.0, 1.0, 43.0])
Turning = Callable[[NDArray[np.float64]], NDArray[np.float64]]


def swung(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn to and fro about all axes, up to 150 deg/s."""
    phase = np.multiply.outer(time_s, 2.0 * math.pi * np.array([0.5, 0.37, 0.61]))
    return np.asarray(np.array([0.5, 0.4, 0.7]) * np.sin(phase))


def still(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros((len(time_s), 3))


def seen(
    turning: Turning,
    lag_s: float,
    seconds: float = 30.0,
    iron_b_ut: tuple[float, float, float] = (0.0, 0.0, 0.0),
    mag_every: int = 4,
    seed: int = 1,
) -> SampleLog:
    """Return what the sensors of a turning tracker see, the compass late and not quite clean."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(1, round(seconds * RATE_HZ)) / RATE_HZ

    def attitude(at_s: NDArray[np.float64]) -> Rotation:
        return Rotation.from_euler("zyx", turning(at_s)[:, ::-1])

    now, before = attitude(time_s), attitude(time_s - 1.0 / RATE_HZ)
    n = len(time_s)
    imu = np.zeros((n, IMU_COLUMNS))
    imu[:, :3] = now.inv().apply([0.0, 0.0, -STANDARD_GRAVITY_MPS2])
    imu[:, 3:6] = (before.inv() * now).as_rotvec() * RATE_HZ
    imu[:, :3] += 0.05 * rng.standard_normal((n, 3))
    imu[:, 3:6] += 0.002 * rng.standard_normal((n, 3))
    field = attitude(time_s - lag_s).inv().apply(FIELD_N_UT) + iron_b_ut
    imu[:, 6:9] = np.nan
    imu[::mag_every, 6:9] = (field + 0.4 * rng.standard_normal((n, 3)))[::mag_every]
    none = np.empty(0, np.int64)
    return SampleLog(
        imu_time_us=np.round(time_s * 1e6).astype(np.int64),
        imu=imu,
        baro_time_us=none,
        baro_alt_m=np.empty(0),
        gps_time_us=none,
        gps=np.empty((0, 12)),
    )


def flown(name: str, log: SampleLog) -> tuple[float, float]:
    """Run a filter, and return the lag that it found and its standard deviation, s."""
    estimator = make_estimator(EstimationSettings(estimator=name))
    assert isinstance(estimator, KernelEstimator)
    estimator.run(log)
    state: Any = estimator.state
    return float(state.compass_lag_s), math.sqrt(state.compass_lag_var)


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("lag_s", [0.0, 0.013, 0.047, 0.08])
def test_the_lag_is_found(name: str, lag_s: float) -> None:
    found_s, std_s = flown(name, seen(swung, lag_s))
    assert found_s == pytest.approx(lag_s, abs=0.004)
    assert std_s < 0.004


@pytest.mark.parametrize("mag_every", [1, 10])
def test_at_every_rate_of_the_compass(mag_every: int) -> None:
    found_s, _ = flown("eskf", seen(swung, 0.03, mag_every=mag_every))
    assert found_s == pytest.approx(0.03, abs=0.004)


def test_iron_is_no_lag() -> None:
    found_s, _ = flown("complementary", seen(swung, 0.03, iron_b_ut=(6.0, -4.0, 5.0)))
    assert found_s == pytest.approx(0.03, abs=0.006)


def test_a_magnet_that_comes_and_goes_is_no_lag() -> None:
    log = seen(swung, 0.03)
    imu = log.imu.copy()
    time_s = log.imu_time_us * 1e-6
    imu[:, 6:9] += np.where(np.sin(3.0 * time_s) > 0.8, 40.0, 0.0)[:, np.newaxis]
    found_s, _ = flown("complementary", replace(log, imu=imu))
    assert found_s == pytest.approx(0.03, abs=0.01)


@pytest.mark.parametrize("name", FILTERS)
def test_what_does_not_turn_shows_none(name: str) -> None:
    found_s, std_s = flown(name, seen(still, 0.05))
    assert found_s == pytest.approx(USUAL_LAG_S)
    assert std_s == pytest.approx(LAG_SPREAD_S)


def heading_error_deg(log: SampleLog, turning: Turning) -> float:
    """Return the RMS by which the heading of `eskf` is off, from 10 s on."""
    estimator = make_estimator(EstimationSettings(estimator="eskf"))
    assert isinstance(estimator, KernelEstimator)
    out = estimator.run(log)
    time_s = log.imu_time_us * 1e-6
    true = Rotation.from_euler("zyx", turning(time_s)[:, ::-1])
    magnetic = Rotation.from_euler("z", math.atan2(FIELD_N_UT[1], FIELD_N_UT[0]))
    off = Rotation.from_quat(out[:, :4], scalar_first=True) * (magnetic.inv() * true).inv()
    after = off.as_rotvec()[time_s > 10.0, 2]
    return float(np.degrees(np.sqrt(np.mean(after**2))))


def spun(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn round and round at up to 200 deg/s, faster and slower."""
    angle = 2.5 * time_s + 0.6 * np.sin(1.7 * time_s)
    rocking = 0.15 * np.sin(2.9 * time_s)
    return np.column_stack([rocking, 0.5 * rocking, angle])


def test_a_late_compass_turns_no_heading() -> None:
    late = seen(spun, 0.05)
    assert heading_error_deg(late, spun) < 2.5
