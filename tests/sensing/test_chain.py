import math

import pytest
from msgspec.structs import replace

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.records import BaroRaw, ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensingSettings, SensorChain

NODE = NodeId(1, 0)
LEVEL = ImuRaw(
    time_us=0,
    node=NODE,
    node_time_us=0,
    accel_raw=(0, 0, 4096),
    gyro_raw=(0, 0, 0),
    mag_raw=(218, 0, -436),
    temperature_raw=0,
    accel_range_g=8,
    gyro_range_dps=1000,
    mag_lsb_per_gauss=1090,
    flags=ImuFlags.MAG_NEW,
)


@pytest.fixture
def chain() -> SensorChain:
    return SensorChain(SensingSettings(), NodeCalibration())


def test_level_board_in_si_and_body_axes(chain: SensorChain) -> None:
    sample = chain.imu(LEVEL)
    assert sample.accel_b_mps2 == pytest.approx((0.0, 0.0, -9.80665))
    assert sample.accel_lowpass_b_mps2 == pytest.approx(sample.accel_b_mps2)
    assert sample.mag_b_ut == pytest.approx((20.0, 0.0, 40.0))
    assert sample.temperature_degc == pytest.approx(36.53)


def test_sensors_without_a_calibration_are_marked(chain: SensorChain) -> None:
    missing = chain.imu(LEVEL).flags ^ ImuFlags.MAG_NEW
    compass, gyroscope, accelerometer = (
        missing ^ SensorChain(SensingSettings(), calibration).imu(LEVEL).flags ^ ImuFlags.MAG_NEW
        for calibration in (
            NodeCalibration(mag_hard_iron_ut=(3.0, 0.0, 0.0)),
            NodeCalibration(gyro_bias_radps=(0.0, 0.0, 0.01)),
            NodeCalibration(accel_bias_mps2=(0.0, 0.1, 0.0)),
        )
    )
    assert compass == ImuFlags.MAG_UNCALIBRATED
    assert gyroscope == ImuFlags.GYRO_UNCALIBRATED
    assert accelerometer == ImuFlags.ACCEL_UNCALIBRATED
    assert missing == compass | gyroscope | accelerometer


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
def test_no_magnetometer_value_where_there_is_none(chain: SensorChain, raw: ImuRaw) -> None:
    assert chain.imu(raw).mag_b_ut is None


def test_a_payload_of_a_sensor_that_was_just_reset_tells_nothing(chain: SensorChain) -> None:
    before = chain.imu(LEVEL)
    sample = chain.imu(replace(LEVEL, time_us=10_000, accel_raw=(0, 0, 0), gyro_raw=(0, 0, 0)))
    assert all(math.isnan(value) for value in (*sample.accel_b_mps2, *sample.gyro_b_radps))
    assert sample.accel_lowpass_b_mps2 == before.accel_lowpass_b_mps2


def test_nothing_is_filtered_twice(chain: SensorChain) -> None:
    flags = ImuFlags.ACCEL_FILTERED | ImuFlags.GYRO_FILTERED
    for i in range(20):
        raw = replace(
            LEVEL, time_us=i * 10_000, accel_raw=(i * 300, 0, 4096), gyro_raw=(i, i, i), flags=flags
        )
        sample = chain.imu(raw)
        assert sample.accel_lowpass_b_mps2 == sample.accel_b_mps2
        assert sample.gyro_highpass_b_radps == sample.gyro_b_radps


def test_filters_where_the_node_has_not(chain: SensorChain) -> None:
    chain.imu(LEVEL)
    sample = chain.imu(replace(LEVEL, time_us=10_000, accel_raw=(4096, 0, 4096)))
    assert 0.0 < sample.accel_lowpass_b_mps2[0] < sample.accel_b_mps2[0]


def test_the_rate_of_a_long_turn_is_kept_unless_it_is_asked_for(chain: SensorChain) -> None:
    highpassed = SensorChain(SensingSettings(gyro_highpass_hz=0.002), NodeCalibration())
    for i in range(3000):
        turning = replace(LEVEL, time_us=i * 10_000, gyro_raw=(0, 0, 500 if i else 0))
        kept, lost = chain.imu(turning), highpassed.imu(turning)
    assert kept.gyro_highpass_b_radps == kept.gyro_b_radps
    assert abs(lost.gyro_highpass_b_radps[2]) < 0.75 * abs(lost.gyro_b_radps[2])


@pytest.mark.parametrize("rate_hz", [50, 200, 1000])
def test_measures_the_rate_and_designs_anew(chain: SensorChain, rate_hz: int) -> None:
    step_us = 1_000_000 // rate_hz
    for i in range(200):
        sample = chain.imu(replace(LEVEL, time_us=i * step_us + (i * 7919) % 300))
        assert sample.accel_lowpass_b_mps2 == pytest.approx((0.0, 0.0, -9.80665), abs=1e-9)
    assert chain.rate_hz == pytest.approx(rate_hz, rel=0.02)


def test_starts_afresh_after_a_gap(chain: SensorChain) -> None:
    chain.imu(LEVEL)
    sample = chain.imu(replace(LEVEL, time_us=5_000_000, accel_raw=(4096, 0, 0)))
    assert sample.accel_lowpass_b_mps2 == pytest.approx(sample.accel_b_mps2)


def test_a_value_that_is_not_finite_stays_out_of_the_filter(chain: SensorChain) -> None:
    zero, flags = (0.0, 0.0, 0.0), ImuFlags(0)
    chain.imu_si(0, (0.0, 0.0, -9.8), zero, None, math.nan, flags)
    bad = chain.imu_si(10_000, (math.nan, 0.0, -9.8), (0.0, math.inf, 0.0), None, math.nan, flags)
    assert bad.accel_lowpass_b_mps2 == pytest.approx((0.0, 0.0, -9.8))
    assert bad.gyro_highpass_b_radps == pytest.approx(zero)
    assert math.isnan(bad.accel_b_mps2[0])
    after = chain.imu_si(20_000, (0.0, 0.0, -9.8), zero, None, math.nan, flags)
    assert after.accel_lowpass_b_mps2 == pytest.approx((0.0, 0.0, -9.8))


@pytest.mark.parametrize(
    ("pressure_pa", "alt_m"), [(101_325.0, 0.0), (89_874.6, 1000.0), (54_019.9, 5000.0)]
)
def test_pressure_altitude_of_the_standard_atmosphere(pressure_pa: float, alt_m: float) -> None:
    assert pressure_altitude_m(pressure_pa) == pytest.approx(alt_m, abs=0.5)


def test_barometer(chain: SensorChain) -> None:
    raw = BaroRaw(time_us=5, node=NODE, node_time_us=5, pressure_pa=0.0, temperature_degc=20.0)
    assert math.isnan(chain.baro(raw).alt_pressure_m)
    assert chain.baro(replace(raw, pressure_pa=101_325.0)).alt_pressure_m == 0.0
