"""Sensors as a home-made tracker has them: `complementary` finds their errors, or tells them."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import ACCEL, GYRO, NAV_ATTITUDE_STD
from gateway.estimation.complementary.complementary_state import (
    SCALE,
    STATES,
    ComplementarySettings,
    ComplementaryState,
    make_gains,
)
from gateway.estimation.complementary.errors.drift_update import correct_drift
from gateway.estimation.kernel_record import new_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from tests.estimation.test_compass_lag import seen
from tools.flights import Flight, read_flight, simulated_flight
from tools.score_estimators import attitude_scores, outages, run_complementary
from tools.score_honesty import share, two_sigma

SCALES = ((1.03, 0.97, 1.03), (0.97, 1.03, 0.97))
"""The tolerance of an MPU6050, by axis."""


@pytest.fixture(scope="module", params=[503, 504])
def flight(request: pytest.FixtureRequest) -> Flight:
    return simulated_flight(request.param, calibrated=request.param % 2 == 1)


def with_imu(flight: Flight, change: Callable[[np.ndarray], None]) -> Flight:
    imu = flight.log.imu.copy()
    change(imu)
    return replace(flight, log=replace(flight.log, imu=imu))


def scaled(flight: Flight, scale: tuple[float, float, float]) -> Flight:
    def change(imu: np.ndarray) -> None:
        imu[:, GYRO : GYRO + 3] *= scale

    return with_imu(flight, change)


def shaken(flight: Flight) -> Flight:
    def change(imu: np.ndarray) -> None:
        rng = np.random.default_rng(1)
        imu[:, ACCEL : ACCEL + 3] += rng.normal(0.0, 8.0, (len(imu), 3))
        imu[:, GYRO : GYRO + 3] += rng.normal(0.0, 0.1, (len(imu), 3))

    return with_imu(flight, change)


@pytest.mark.parametrize("scale", SCALES)
def test_a_wrong_scale_is_found(flight: Flight, scale: tuple[float, float, float]) -> None:
    off = scaled(flight, scale)
    settings = EstimationSettings(estimator="complementary", reference=flight.reference)
    estimator = make_estimator(settings)
    out = estimator.run(off.log)
    found = attitude_scores(off, out[:, :4])
    assert found["heading"] < 1.2
    assert found["inclination"] < 1.5
    assert min(map(share, two_sigma(off, out).values())) > 0.85
    left = np.array(scale) * (1.0 - np.array(estimator.state.scale_b)) - 1.0
    assert np.abs(left).max() < 0.02


@pytest.mark.parametrize("scale", SCALES)
def test_a_wrong_scale_is_found_in_a_real_flight(
    data_dir: Path, scale: tuple[float, float, float]
) -> None:
    off = scaled(read_flight(data_dir / "arduplane_testlog2.csv.gz"), scale)
    out = run_complementary(off)
    assert attitude_scores(off, out[:, :4])["total"] < 3.0
    within = two_sigma(off, out)
    assert share(within["tilt"]) > 0.8
    assert share(within["heading"]) > 0.88


def tumbled(time_s: np.ndarray) -> np.ndarray:
    """Roll round and round at 5 rad/s, and swing about the other axes."""
    return np.column_stack(
        [
            5.0 * time_s + 0.8 * np.sin(1.3 * time_s),
            0.9 * np.sin(1.1 * time_s),
            1.2 * np.sin(0.9 * time_s) + 0.2 * time_s,
        ]
    )


@pytest.mark.parametrize("scale", [0.98, 1.02])
@pytest.mark.parametrize(
    ("name", "limit_deg", "told"), [("complementary", 17.0, 0.6), ("eskf", 2.5, 0.9)]
)
def test_gravity_outdoes_a_wrong_scale_where_a_hand_spins_it(
    name: str, limit_deg: float, told: float, scale: float
) -> None:
    """`complementary` falls behind by as much as its low-pass is slow; `eskf` finds the scale."""
    log = seen(tumbled, 0.013, seconds=60.0)
    time_s = log.imu_time_us * 1e-6
    true = Rotation.from_euler("zyx", tumbled(time_s)[:, ::-1])
    imu = log.imu.copy()
    shaking = 2.0 * np.sin(5.0 * time_s[:, np.newaxis] + (0.0, 1.0, 2.0))
    imu[:, ACCEL : ACCEL + 3] += true.inv().apply(shaking)
    imu[:, GYRO : GYRO + 3] *= scale
    out = make_estimator(EstimationSettings(estimator=name)).run(replace(log, imu=imu))
    off = (true * Rotation.from_quat(out[:, :4], scalar_first=True).inv()).as_rotvec()
    tilt = np.hypot(off[:, 0], off[:, 1])[time_s > 10.0]
    assert np.degrees(np.sqrt(np.mean(tilt**2))) < limit_deg
    std = np.hypot(*out[time_s > 10.0, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 2].T)
    assert np.mean(tilt < 2.0 * std) > told


def test_a_shaken_flight_is_as_unsure_as_it_is_off(flight: Flight) -> None:
    """With fixes, and where there are none for 10 s."""
    off = shaken(flight)
    assert min(map(share, two_sigma(off, run_complementary(off)).values())) > 0.9
    out, inside, _ = next(outages(off, run_complementary, 10.0))
    for values in two_sigma(off, out).values():
        assert share(values[inside]) > 0.9


def test_what_is_only_considered_is_not_corrected(rng: np.random.Generator) -> None:
    """Its variance stays, and the rest is updated as the gain that is used tells."""
    gains = make_gains(
        ComplementarySettings(), ReferenceSettings(), RestSettings(), CompassSettings()
    )
    s = new_record(ComplementaryState)
    s.level_by_gps, s.q_ei[0] = 1, 1.0
    root = rng.normal(size=(STATES, STATES))
    P, h, noise = root @ root.T * 1e-6, rng.normal(size=STATES), 1e-4
    s.drift_cov[:], s.drift_row[:] = P, h
    correct_drift(s, gains, 1e-3, noise, 10.0, SCALE)
    gain = P @ h / (h @ P @ h + noise)
    gain[SCALE:] = 0.0
    kept = np.eye(STATES) - np.outer(gain, h)
    expected = kept @ P @ kept.T + noise * np.outer(gain, gain)
    np.testing.assert_allclose(s.drift_cov, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(s.bias_b, gain[:3] * 1e-3, rtol=1e-9)
    assert s.scale_b.tolist() == [0.0, 0.0, 0.0]
