"""A measured remainder, absorbed: the same samples come out right."""

import math

import numpy as np
import pytest

from gateway.geometry.quaternion import from_euler, rotate_inverse
from gateway.records import Vec3
from gateway.sensing.calibration import Correction, NodeCalibration
from gateway.sensing.remainder import absorb

SKEWED = NodeCalibration(
    mounting=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    mag_mounting=((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    accel_bias_mps2=(0.1, -0.2, 0.3),
    accel_matrix=((1.01, 0.002, 0.0), (0.0, 0.98, 0.003), (0.001, 0.0, 1.02)),
    gyro_bias_radps=(0.01, 0.02, -0.01),
    mag_hard_iron_ut=(5.0, -3.0, 2.0),
    mag_soft_iron=((1.1, 0.02, 0.0), (0.02, 0.9, 0.01), (0.0, 0.01, 1.05)),
)
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def accel(calibration: NodeCalibration) -> Correction:
    c = calibration
    return Correction(c.mounting, c.accel_matrix, c.accel_bias_mps2)


def gyro(calibration: NodeCalibration) -> Correction:
    return Correction(calibration.mounting, IDENTITY, calibration.gyro_bias_radps)


def mag(calibration: NodeCalibration) -> Correction:
    c = calibration
    return Correction(c.mag_mounting, c.mag_soft_iron, c.mag_hard_iron_ut)


@pytest.mark.parametrize(("kind", "correction"), [("accel", accel), ("gyro", gyro), ("mag", mag)])
@pytest.mark.parametrize("seed", range(3))
def test_the_offset_is_gone_from_every_sample(kind: str, correction, seed: int) -> None:
    rng = np.random.default_rng(seed)
    error: Vec3 = tuple(rng.normal(size=3).tolist())
    sample: Vec3 = tuple(rng.normal(scale=10.0, size=3).tolist())
    before = correction(SKEWED).apply(sample)
    after = correction(absorb(SKEWED, kind, error)).apply(sample)
    assert np.subtract(before, after) == pytest.approx(error)


@pytest.mark.parametrize(("roll_deg", "pitch_deg"), [(3.0, 0.0), (0.0, -4.0), (5.0, 2.0)])
def test_a_level_aircraft_reads_level_afterwards(roll_deg: float, pitch_deg: float) -> None:
    shown = (math.radians(roll_deg), math.radians(pitch_deg), 0.0)
    seen_b = rotate_inverse(from_euler(*shown), (0.0, 0.0, -9.8))
    # What the sensor itself must have read to be shown like this.
    sensor = np.linalg.solve(np.array(NodeCalibration().mounting), np.array(seen_b)).tolist()
    level = absorb(NodeCalibration(), "level", shown)
    assert accel(level).apply(tuple(sensor)) == pytest.approx((0.0, 0.0, -9.8), abs=1e-9)
    assert level.mag_mounting == level.mounting


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(ValueError, match="'baro'"):
        absorb(SKEWED, "baro", (0.0, 0.0, 0.0))
