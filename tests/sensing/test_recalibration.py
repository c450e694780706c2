import numpy as np
import pytest

from gateway.geometry.quaternion import from_euler, rotate_inverse
from gateway.sensing import recalibration
from gateway.sensing.calibration import IDENTITY3, Correction, NodeCalibration

CALIBRATION = NodeCalibration(
    mounting=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    accel_bias_mps2=(0.1, -0.2, 0.3),
    accel_matrix=((1.1, 0.02, 0.0), (0.0, 0.9, 0.01), (0.0, 0.0, 1.05)),
    gyro_bias_radps=(0.01, 0.02, 0.03),
    mag_hard_iron_ut=(5.0, 6.0, 7.0),
    mag_soft_iron=((1.0, 0.1, 0.0), (0.1, 1.2, 0.0), (0.0, 0.0, 0.8)),
)
ERROR = (0.25, -0.5, 0.125)


def corrections(cal: NodeCalibration) -> dict[str, Correction]:
    return {
        "accel": Correction(cal.mounting, cal.accel_matrix, cal.accel_bias_mps2),
        "gyro": Correction(cal.mounting, IDENTITY3, cal.gyro_bias_radps),
        "mag": Correction(cal.mag_mounting, cal.mag_soft_iron, cal.mag_hard_iron_ut),
    }


@pytest.mark.parametrize("sensor", ["accel", "gyro", "mag"])
def test_the_error_vanishes_from_this_sensor_alone(sensor: str, rng: np.random.Generator) -> None:
    corrected = getattr(recalibration, f"remove_{sensor}_error")(CALIBRATION, ERROR)
    before, after = corrections(CALIBRATION), corrections(corrected)
    raw = tuple(rng.normal(size=3).tolist())
    for name, correction in after.items():
        gone = np.array(before[name].apply(raw)) - np.array(correction.apply(raw))
        assert gone == pytest.approx(np.array(ERROR if name == sensor else (0.0,) * 3), abs=1e-12)


def test_what_seemed_tilted_is_level() -> None:
    level = (0.0, 0.0, -9.80665)
    tilt = (0.1, -0.05, 0.0)
    seen = rotate_inverse(from_euler(*tilt), level)
    raw = np.array(CALIBRATION.mounting).T @ np.array(seen)
    turned = recalibration.remove_tilt(CALIBRATION, tilt)
    assert np.array(turned.mounting) @ raw == pytest.approx(np.array(level), abs=1e-12)
    assert np.array(turned.mag_mounting) @ np.array(turned.mag_mounting).T == pytest.approx(
        np.eye(3), abs=1e-12
    )
