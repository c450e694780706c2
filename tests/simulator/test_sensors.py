"""Each chip's error is that of its data sheet, and the reported calibration removes it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.records import ImuFlags
from gateway.simulator import sensors
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import Truth

SETTINGS = SimulatorSettings()
SIZE = 20_000


def still(size: int = SIZE, accel: tuple[float, ...] = (0.0, 0.0, -9.80665)) -> Truth:
    time_s = np.arange(size) / SETTINGS.imu_rate_hz
    zeros, vectors = np.zeros(size), np.zeros((size, 3))
    return Truth(
        time_s=time_s,
        lat_deg=zeros,
        lon_deg=zeros,
        alt_amsl_m=zeros + 110.0,
        pos_n_m=vectors,
        vel_n_mps=vectors,
        q_nb=np.tile([1.0, 0.0, 0.0, 0.0], (size, 1)),
        rate_b_radps=vectors,
        accel_b_mps2=np.tile(accel, (size, 1)),
        airspeed_mps=zeros,
    )


class TestMpu6050:
    def test_calibrated_rest_reads_gravity(self, rng: np.random.Generator) -> None:
        imu = sensors.Mpu6050(SETTINGS, rng)
        errors = sensors.errors_of(imu, sensors.Hmc5883l(SETTINGS, rng))
        accel, gyro, _ = imu.sample(still(2000))
        accel_s = accel * (8 * 9.80665 / 32768)
        corrected = (accel_s - errors["accel_bias_mps2"]) @ np.transpose(errors["accel_matrix"])
        accel_b = corrected * sensors.FACE_UP
        np.testing.assert_allclose(accel_b.mean(axis=0), [0.0, 0.0, -9.80665], atol=0.01)
        gyro_s = np.radians(gyro / 32.8)
        np.testing.assert_allclose(gyro_s.mean(axis=0), errors["gyro_bias_radps"], atol=3e-3)

    def test_noise_has_the_density_of_the_data_sheet(self, rng: np.random.Generator) -> None:
        accel, gyro, _ = sensors.Mpu6050(SETTINGS, rng).sample(still(3000))
        # 100 Hz see 50 Hz of noise; the walk adds little in 30 s, rounding 0.3 counts.
        accel_sigma = np.diff(accel, axis=0).std(axis=0) / np.sqrt(2.0)
        gyro_sigma = np.diff(gyro, axis=0).std(axis=0) / np.sqrt(2.0)
        np.testing.assert_allclose(accel_sigma, 400e-6 * np.sqrt(50.0) * 4096, rtol=0.05)
        np.testing.assert_allclose(gyro_sigma, 0.005 * np.sqrt(50.0) * 32.8, rtol=0.08)

    def test_readings_beyond_the_range_are_clipped(self, rng: np.random.Generator) -> None:
        accel, _, flags = sensors.Mpu6050(SETTINGS, rng).sample(still(100, (200.0, 0.0, -9.8)))
        assert (accel[:, 0] == 32767).all()
        assert (flags == ImuFlags.ACCEL_CLIPPED).all()

    def test_temperature_rises_after_the_start(self) -> None:
        degc = sensors.warm_degc(np.array([0.0, 200.0]))
        assert degc[0] == 29.0
        assert 32.0 < degc[1] < 36.0


class TestHmc5883l:
    def test_calibration_brings_the_field_back(self, rng: np.random.Generator) -> None:
        mag = sensors.Hmc5883l(SETTINGS, rng)
        errors = sensors.errors_of(sensors.Mpu6050(SETTINGS, rng), mag)
        attitudes = Rotation.random(2000, rng=rng)
        counts = mag.sample(attitudes.as_quat(scalar_first=True))
        measured_ut = counts * (100.0 / 1090)
        field_b = (measured_ut - errors["mag_hard_iron_ut"]) @ np.transpose(errors["mag_soft_iron"])
        off = field_b * sensors.FACE_UP - attitudes.inv().apply(mag.field_n_ut)
        assert np.abs(off.mean(axis=0)).max() < 0.05
        assert 0.2 < off.std() < 0.35

    def test_field_of_the_default_home_is_that_of_java(self, rng: np.random.Generator) -> None:
        north, east, down = sensors.Hmc5883l(SETTINGS, rng).field_n_ut
        assert np.degrees(np.arctan2(east, north)) == pytest.approx(0.8, abs=0.3)
        assert down < -15.0, "the field points up south of the magnetic equator"
        assert np.linalg.norm([north, east, down]) == pytest.approx(45.0, abs=1.5)

    def test_field_beyond_the_range_reads_as_overflow(self) -> None:
        assert sensors.mag_counts(np.array([[187.0, -190.0, 190.0]]), 1).tolist() == [
            [2038, sensors.MAG_OVERFLOW, sensors.MAG_OVERFLOW]
        ]


class TestBmp180:
    def test_pressure_corresponds_to_the_height(self, rng: np.random.Generator) -> None:
        baro = sensors.Bmp180(SETTINGS, rng)
        pressure_pa, temperature_degc = baro.sample(still(2000))
        expected = sensors.pressure_at(np.array([110.0]), baro.sea_level_pa)[0]
        assert pressure_pa.mean() == pytest.approx(expected, abs=25.0)
        assert 2.5 < np.diff(pressure_pa).std() / np.sqrt(2.0) < 3.5
        assert (pressure_pa == np.rint(pressure_pa)).all()
        assert temperature_degc[0] == 29.0

    @pytest.mark.parametrize(("alt_m", "pascal"), [(0, 101325), (1000, 89874.6), (5000, 54019.9)])
    def test_pressure_is_that_of_the_standard_atmosphere(self, alt_m: float, pascal: float) -> None:
        found = sensors.pressure_at(np.array([alt_m]), 101325.0)[0]
        assert found == pytest.approx(pascal, rel=2e-5)


def test_words() -> None:
    counts, clipped = sensors.to_int16(np.array([[0.4, -0.6, 1.0], [40000.0, 0.0, 0.0]]))
    assert counts.tolist() == [[0, -1, 1], [32767, 0, 0]]
    assert clipped.tolist() == [False, True]
    assert sensors.temperature_counts(np.array([36.53, 25.0])).tolist() == [0, -3920]


class TestNoise:
    def test_wander_keeps_its_spread_and_memory(self, rng: np.random.Generator) -> None:
        values = sensors.wander(rng, 2.0, 10.0, 0.1).draw(200_000)
        np.testing.assert_allclose(values.std(axis=0), 2.0, rtol=0.1)
        lag = 100
        memory = (values[lag:] * values[:-lag]).mean() / values.var()
        assert memory == pytest.approx(np.exp(-1.0), abs=0.05)

    def test_walk_grows_with_the_root_of_time(self) -> None:
        walks = (sensors.walk(np.random.default_rng(seed), 0.5, 0.01) for seed in range(300))
        ends = [walk.draw(400)[-1] for walk in walks]
        assert np.std(ends) == pytest.approx(0.5 * 2.0, rel=0.1)

    @pytest.mark.parametrize(
        "make", [lambda r: sensors.wander(r, 1.0, 5.0, 0.1), lambda r: sensors.walk(r, 1.0, 0.1)]
    )
    def test_pieces_equal_the_whole(self, make) -> None:
        whole = make(np.random.default_rng(3)).draw(1000)
        source = make(np.random.default_rng(3))
        pieces = np.vstack([source.draw(size) for size in (1, 0, 399, 600)])
        np.testing.assert_array_equal(pieces, whole)
