import math

import msgspec
import numpy as np
import pytest

from gateway.sensing import calibration as cal


@pytest.mark.parametrize(("range_g", "counts"), [(2, 16384), (4, 8192), (8, 4096), (16, 2048)])
def test_one_g_is_converted_at_every_range(range_g: int, counts: int) -> None:
    assert counts * cal.accel_scale(range_g) == pytest.approx(9.80665)


@pytest.mark.parametrize(("dps", "lsb"), [(250, 131), (500, 65.5), (1000, 32.8), (2000, 16.4)])
def test_ten_degrees_a_second_are_read_at_every_range(dps: int, lsb: float) -> None:
    assert 10 * lsb * cal.gyro_scale(dps) == pytest.approx(math.radians(10.0))


def test_magnetometer_is_scaled_by_its_gain_and_none_on_overflow() -> None:
    assert cal.mag_from_counts((1090, -545, 0), 1090) == pytest.approx((100.0, -50.0, 0.0))
    assert cal.mag_from_counts((1090, -4096, 0), 1090) is None
    assert cal.mag_from_counts((1, 1, 1), 0) is None


def test_temperature_word_is_converted_to_degrees() -> None:
    assert cal.temperature_from_counts(-3920) == pytest.approx(25.0, abs=0.01)


def test_level_board_face_up_reads_minus_g_in_body() -> None:
    correction = cal.Correction(cal.FACE_UP, cal.IDENTITY3, (0.0, 0.0, 0.0))
    assert correction.apply((0.0, 0.0, 9.8)) == (0.0, 0.0, -9.8)


@pytest.mark.parametrize("seed", range(5))
def test_correction_is_mounting_times_matrix_times_unbiased(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mounting, matrix = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    bias, v = rng.normal(size=3), rng.normal(size=3)
    rows = [tuple(map(tuple, m.tolist())) for m in (mounting, matrix)]
    got = cal.Correction(rows[0], rows[1], tuple(bias.tolist())).apply(tuple(v.tolist()))
    np.testing.assert_allclose(got, mounting @ matrix @ (v - bias), rtol=1e-12)
    np.testing.assert_allclose(cal.compose(rows[0], rows[1]), mounting @ matrix, rtol=1e-12)


def test_calibration_is_read_from_toml() -> None:
    text = "gyro_bias_radps = [0.01, -0.02, 0.03]\nmounting = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]"
    calibration = msgspec.toml.decode(text, type=cal.NodeCalibration)
    assert calibration.gyro_bias_radps == (0.01, -0.02, 0.03)
    assert calibration.mounting[0] == (0.0, 1.0, 0.0)
    assert calibration.accel_matrix == cal.IDENTITY3
    with pytest.raises(msgspec.ValidationError, match="giro_bias"):
        msgspec.toml.decode(b"giro_bias = 1", type=cal.NodeCalibration)
