import functools
import math
import operator

import pytest
from msgspec.structs import replace

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.records import BaroRaw, ImuFlags, ImuRaw
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from tests.kit.records import IMU_NODE, RAW

LEVEL = replace(RAW, mag_raw=(218, 0, -436), temperature_raw=0)


@pytest.fixture
def chain() -> SensorChain:
    return SensorChain(NodeCalibration())


def test_sample_of_a_level_board_is_in_si_and_body_axes(chain: SensorChain) -> None:
    sample = chain.imu(LEVEL)
    assert sample.accel_b_mps2 == pytest.approx((0.0, 0.0, -9.80665))
    assert sample.mag_b_ut == pytest.approx((20.0, 0.0, 40.0))
    assert sample.temperature_degc == pytest.approx(36.53)


def test_sensors_without_a_calibration_are_marked(chain: SensorChain) -> None:
    missing = chain.imu(LEVEL).flags ^ (ImuFlags.MAG_NEW | ImuFlags.MEANS)
    marks = {
        ImuFlags.MAG_UNCALIBRATED: NodeCalibration(mag_hard_iron_ut=(3.0, 0.0, 0.0)),
        ImuFlags.GYRO_UNCALIBRATED: NodeCalibration(gyro_bias_radps=(0.0, 0.0, 0.01)),
        ImuFlags.ACCEL_UNCALIBRATED: NodeCalibration(accel_bias_mps2=(0.0, 0.1, 0.0)),
    }
    for mark, calibration in marks.items():
        assert (
            missing ^ SensorChain(calibration).imu(LEVEL).flags
            == mark | ImuFlags.MAG_NEW | ImuFlags.MEANS
        )
    assert missing == functools.reduce(operator.or_, marks)


@pytest.mark.parametrize(
    "raw",
    [
        replace(LEVEL, flags=ImuFlags(0)),
        replace(LEVEL, flags=ImuFlags.MAG_NEW | ImuFlags.MAG_ABSENT),
        replace(LEVEL, mag_raw=(0, -4096, 0)),
        replace(LEVEL, mag_raw=(0, 0, 0)),
    ],
    ids=["old", "absent", "overflow", "blank"],
)
def test_sample_without_a_new_field_has_no_magnetic_value(chain: SensorChain, raw: ImuRaw) -> None:
    assert chain.imu(raw).mag_b_ut is None


def test_payload_after_a_sensor_reset_has_no_values(chain: SensorChain) -> None:
    sample = chain.imu(replace(LEVEL, time_us=10_000, accel_raw=(0, 0, 0), gyro_raw=(0, 0, 0)))
    assert all(math.isnan(value) for value in (*sample.accel_b_mps2, *sample.gyro_b_radps))


@pytest.mark.parametrize(("pascal", "alt_m"), [(101_325, 0), (89_874.6, 1000), (54_019.9, 5000)])
def test_pressure_altitude_is_that_of_standard_atmosphere(pascal: float, alt_m: float) -> None:
    assert pressure_altitude_m(pascal) == pytest.approx(alt_m, abs=0.5)


def test_pressure_altitude_is_unknown_without_a_pressure(chain: SensorChain) -> None:
    raw = BaroRaw(time_us=5, node=IMU_NODE, node_time_us=5, pressure_pa=0.0, temperature_degc=20.0)
    assert math.isnan(chain.baro(raw).alt_pressure_m)
    assert chain.baro(replace(raw, pressure_pa=101_325.0)).alt_pressure_m == 0.0
