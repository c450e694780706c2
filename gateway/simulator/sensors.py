"""The sensors of the tracker: convert true motion to counts and messages, by the nodes' clocks.

A sampler runs along a trajectory, for a whole flight at once or second by second. Every source of
noise has its own generator and keeps its state, so that both give bit-identical results.

Sensor axes are those of the chips on a level board: x forward, y left, z up. A body vector (FRD) is
converted by `FACE_UP * v_b`, and so is the inverse. An inertial or magnetic sensor measures
`matrix @ v_s + bias` plus noise; `errors_of` is the calibration that corrects this.

References
----------
.. [1] InvenSense, "MPU-6000 and MPU-6050 Product Specification", rev. 3.4, sections 6.1 and 6.2.
.. [2] Honeywell, "3-Axis Digital Compass IC HMC5883L", 2010.
.. [3] Bosch Sensortec, "BMP180 Digital pressure sensor", rev. 2.5.
.. [4] u-blox, "NEO-M8 Data Sheet": 2.5 m CEP, 0.05 m/s.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from itertools import accumulate
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gateway.geometry.atmosphere import SEA_LEVEL_PA, pressure_at_height
from gateway.geometry.geomagnetism import magnetic_field
from gateway.geometry.rotation import Matrix3
from gateway.records import ImuFlags, Vec3
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import CRUISE_MPS, FloatArray, SensorMotion, Truth, rotate_inverse
from gateway.units import STANDARD_GRAVITY_MPS2, UT_PER_GAUSS
from gateway.wire.payloads import ACCEL_RANGES_G, MAG_LSB_PER_GAUSS

AXES: Final = 3
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]
FACE_UP: Final = np.array([1.0, -1.0, -1.0])
ACCEL_RANGE: Final = 2
"""Range code: +-8 g."""
GYRO_RANGE: Final = 2
"""Range code: +-1000 deg/s."""
MAG_GAIN: Final = 1
GYRO_LSB_PER_DPS: Final = (131.0, 65.5, 32.8, 16.4)
INT16_MIN: Final = -32768
INT16_MAX: Final = 32767
ACCEL_DENSITY: Final = 400e-6 * STANDARD_GRAVITY_MPS2
"""Noise density in m/s2 per root hertz [1]_."""
GYRO_DENSITY: Final = math.radians(0.005)
"""Noise density in rad/s per root hertz [1]_."""
FILTER_HZ: Final = 94.0
"""Noise bandwidth of the chip's low-pass filter in the setting of the firmware."""
ACCEL_BIAS_MPS2: Final = 0.10
GYRO_BIAS_RADPS: Final = math.radians(1.5)
"""Standard deviations of the constant biases, for chips that a user would accept."""
ACCEL_WALK: Final = 0.001
GYRO_WALK: Final = math.radians(0.004)
"""Bias random walks, per root second."""
SCALE_SPREAD: Final = 0.006
MISALIGNMENT_RAD: Final = math.radians(0.4)
GYRO_SHAKING: Final = 0.02
"""Angular rate of the shaking, in rad/s for each m/s2 of shaking."""
START_DEGC: Final = 29.0
WARMING_DEGC: Final = 7.0
WARMING_S: Final = 240.0
MAG_RATE_HZ: Final = 75
MAG_NOISE_UT: Final = 0.25
HARD_IRON_UT: Final = 14.0
SOFT_IRON_SPREAD: Final = 0.05
MAG_LIMIT: Final = 2047
MAG_OVERFLOW: Final = -4096
FIELD_YEAR: Final = 2026.5
SEA_LEVEL_SPREAD_PA: Final = 300.0
BARO_NOISE_PA: Final = 3.0
BARO_DRIFT_PA: Final = 8.0
BARO_DRIFT_S: Final = 300.0
IMU_BOOT_US: Final = 2_718_281
"""Time on the node's clock at the start of the simulation."""
BARO_PHASE_US: Final = 3_300


class Noise:
    """Normal noise on three axes: `x' = retain * x + step`, white by default."""

    def __init__(
        self, rng: np.random.Generator, step: float, retain: float = 0.0, spread: float = 0.0
    ) -> None:
        self._rng, self._step, self._retain = rng, step, retain
        self._last = spread * rng.standard_normal(AXES) if spread else np.zeros(AXES)

    def draw(self, size: int) -> FloatArray:
        """Draw the next values, shape (size, 3)."""
        steps = self._step * self._rng.standard_normal((size, AXES))
        if not self._retain or not size:
            return steps
        columns = [
            list(accumulate(axis, lambda last, step: step + self._retain * last, initial=last))
            for axis, last in zip(steps.T.tolist(), self._last.tolist(), strict=True)
        ]
        values = np.array(columns).T
        self._last = values[-1]
        return values[1:]


def wander(
    rng: np.random.Generator, sigma: float, correlation_s: float, interval_s: float
) -> Noise:
    """Return first-order Gauss-Markov noise of a stationary standard deviation.

    After `correlation_s`, 37 % of a value remains.
    """
    retain = math.exp(-interval_s / correlation_s)
    return Noise(rng, sigma * math.sqrt(1.0 - retain**2), retain, sigma)


def walk(rng: np.random.Generator, sigma_per_sqrt_s: float, interval_s: float) -> Noise:
    """Return a random walk that starts at zero."""
    return Noise(rng, sigma_per_sqrt_s * math.sqrt(interval_s), 1.0)


class Mpu6050:
    """Accelerometer and gyroscope."""

    def __init__(self, settings: SimulatorSettings, rng: np.random.Generator) -> None:
        rate_hz = settings.imu_rate_hz
        noise_hz = min(0.5 * rate_hz, FILTER_HZ)
        accel, gyro, shaking, accel_walk, gyro_walk = rng.spawn(5)
        self.accel_bias_mps2 = ACCEL_BIAS_MPS2 * rng.standard_normal(3)
        self.gyro_bias_radps = GYRO_BIAS_RADPS * rng.standard_normal(3)
        self.accel_matrix = _imperfect(rng)
        self.gyro_matrix = _imperfect(rng)
        self._accel_noise = Noise(accel, ACCEL_DENSITY * math.sqrt(noise_hz))
        self._gyro_noise = Noise(gyro, GYRO_DENSITY * math.sqrt(noise_hz))
        self._accel_shaking = Noise(shaking, settings.vibration_mps2)
        self._gyro_shaking = Noise(shaking.spawn(1)[0], settings.vibration_mps2 * GYRO_SHAKING)
        self._accel_walk = walk(accel_walk, ACCEL_WALK, 1.0 / rate_hz)
        self._gyro_walk = walk(gyro_walk, GYRO_WALK, 1.0 / rate_hz)

    def sample(self, truth: Truth) -> tuple[IntArray, IntArray, IntArray]:
        """Return the registers of accelerometer and gyroscope, and the flags of `inertial_counts`.

        The truth's times must follow those of the previous call.
        """
        size = len(truth.time_s)
        power = (np.minimum(truth.airspeed_mps / CRUISE_MPS, 1.0) ** 2)[:, np.newaxis]
        accel = (truth.accel_b_mps2 * FACE_UP) @ self.accel_matrix.T + self.accel_bias_mps2
        accel += self._accel_walk.draw(size) + self._accel_noise.draw(size)
        accel += power * self._accel_shaking.draw(size)
        gyro = (truth.rate_b_radps * FACE_UP) @ self.gyro_matrix.T + self.gyro_bias_radps
        gyro += self._gyro_walk.draw(size) + self._gyro_noise.draw(size)
        gyro += power * self._gyro_shaking.draw(size)
        return inertial_counts(accel, gyro, ACCEL_RANGE, GYRO_RANGE)


class Hmc5883l:
    """Magnetometer in the Earth's field, with hard and soft iron of the aircraft."""

    def __init__(self, settings: SimulatorSettings, rng: np.random.Generator) -> None:
        field = magnetic_field(
            settings.home_lat_deg, settings.home_lon_deg, settings.home_alt_m, FIELD_YEAR
        )
        level = math.cos(field.inclination_rad)
        self.field_n_ut: FloatArray = field.strength_ut * np.array(
            [
                level * math.cos(field.declination_rad),
                level * math.sin(field.declination_rad),
                math.sin(field.inclination_rad),
            ]
        )
        direction = rng.standard_normal(3)
        self.hard_iron_ut: FloatArray = HARD_IRON_UT * direction / np.linalg.norm(direction)
        spread = SOFT_IRON_SPREAD * rng.standard_normal((3, 3))
        self.soft_iron: FloatArray = np.eye(3) + 0.5 * (spread + spread.T)
        self._noise = Noise(rng.spawn(1)[0], MAG_NOISE_UT)

    def sample(self, q_nb: FloatArray) -> IntArray:
        """Return the registers, shape (N, 3), at attitudes that follow the previous call's, (N, 4).

        An axis out of range reads `MAG_OVERFLOW`.
        """
        field_s = rotate_inverse(q_nb, self.field_n_ut) * FACE_UP
        measured_ut = field_s @ self.soft_iron.T + self.hard_iron_ut + self._noise.draw(len(q_nb))
        return mag_counts(measured_ut, MAG_GAIN)


class Bmp180:
    """Barometer in the standard atmosphere, with the sea-level pressure of the day."""

    def __init__(self, settings: SimulatorSettings, rng: np.random.Generator) -> None:
        self.sea_level_pa = SEA_LEVEL_PA + SEA_LEVEL_SPREAD_PA * float(rng.standard_normal())
        noise, drift = rng.spawn(2)
        self._noise = Noise(noise, BARO_NOISE_PA)
        self._drift = wander(drift, BARO_DRIFT_PA, BARO_DRIFT_S, 1.0 / settings.baro_rate_hz)

    def sample(self, truth: Truth) -> tuple[FloatArray, FloatArray]:
        """Return pressure in whole Pa and temperature in tenths of a degree, shapes (N,)."""
        size = len(truth.time_s)
        pressure_pa = pressure_at(truth.alt_amsl_m, self.sea_level_pa)
        pressure_pa += self._noise.draw(size)[:, 0] + self._drift.draw(size)[:, 0]
        return np.rint(pressure_pa), np.round(warm_degc(truth.time_s), 1)


def errors_of(imu: Mpu6050, mag: Hmc5883l) -> dict[str, Any]:
    """Return the constant errors of two sensors as the fields of their ideal `NodeCalibration`.

    It is `v_b = FACE_UP * (matrix @ (s - bias))`.
    """
    return {
        "accel_bias_mps2": _vec3(imu.accel_bias_mps2),
        "accel_matrix": _inverse(imu.accel_matrix),
        "gyro_bias_radps": _vec3(imu.gyro_bias_radps),
        "mag_hard_iron_ut": _vec3(mag.hard_iron_ut),
        "mag_soft_iron": _inverse(mag.soft_iron),
    }


def pressure_at(alt_m: FloatArray, sea_level_pa: float) -> FloatArray:
    """Return the pressure of the ICAO standard atmosphere at heights in the troposphere."""
    return np.array([pressure_at_height(one_m, sea_level_pa) for one_m in alt_m.tolist()])


def warm_degc(time_s: FloatArray) -> FloatArray:
    """Return the temperature in the closed fuselage, which rises after power-on."""
    return np.asarray(START_DEGC + WARMING_DEGC * (1.0 - np.exp(-time_s / WARMING_S)))


def temperature_counts(temperature_degc: FloatArray) -> IntArray:
    """Convert deg C to counts of the MPU6050's temperature register."""
    return np.rint((temperature_degc - 36.53) * 340.0).astype(np.int64)


def inertial_counts(
    accel_s_mps2: FloatArray, gyro_s_radps: FloatArray, accel_range: int, gyro_range: int
) -> tuple[IntArray, IntArray, IntArray]:
    """Convert to counts of the MPU6050, each (N, 3); also return the flags of rows that saturated.

    The ranges are their codes.
    """
    accel_lsb = (INT16_MAX + 1) / (ACCEL_RANGES_G[accel_range] * STANDARD_GRAVITY_MPS2)
    accel, accel_clipped = to_int16(accel_s_mps2 * accel_lsb)
    gyro, gyro_clipped = to_int16(np.degrees(gyro_s_radps) * GYRO_LSB_PER_DPS[gyro_range])
    flags = accel_clipped * int(ImuFlags.ACCEL_CLIPPED)
    return accel, gyro, flags | gyro_clipped * int(ImuFlags.GYRO_CLIPPED)


def to_int16(values: FloatArray) -> tuple[IntArray, BoolArray]:
    """Round to 16-bit values, shape (N, 3); also return which rows saturated."""
    counts = np.clip(np.rint(values), INT16_MIN, INT16_MAX).astype(np.int64)
    return counts, np.any((counts == INT16_MIN) | (counts == INT16_MAX), axis=1)


def mag_counts(field_ut: FloatArray, gain: int) -> IntArray:
    """Convert µT to counts of the HMC5883L, with its overflow value for an axis out of range."""
    counts = np.rint(field_ut * (MAG_LSB_PER_GAUSS[gain] / UT_PER_GAUSS)).astype(np.int64)
    return np.where(np.abs(counts) > MAG_LIMIT, MAG_OVERFLOW, counts)


def _imperfect(rng: np.random.Generator) -> FloatArray:
    matrix = MISALIGNMENT_RAD * rng.standard_normal((3, 3))
    np.fill_diagonal(matrix, 1.0 + SCALE_SPREAD * rng.standard_normal(3))
    return matrix


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = values.tolist()
    return (x, y, z)


def _inverse(matrix: FloatArray) -> Matrix3:
    a, b, c = np.linalg.inv(matrix).astype(np.float64)
    return (_vec3(a), _vec3(b), _vec3(c))


class Chance(IntEnum):
    """Streams of random numbers, one for each sensor."""

    GUSTS = 0
    IMU = 1
    MAG = 2
    BARO = 3
    GPS = 4
    RADIO = 5
    LINE = 6


def generator(settings: SimulatorSettings, vehicle_id: int, stream: Chance) -> np.random.Generator:
    """Create the generator for one stream of random numbers of one aircraft."""
    return np.random.default_rng([settings.seed, vehicle_id, stream])


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """The clock of a node or receiver, relative to true time."""

    boot_us: int
    """Time on the clock at the start of the simulation."""
    skew_ppm: float

    def at(self, time_s: float) -> int:
        """Return the time on the clock at a true time, in whole µs, not wrapped."""
        return self.boot_us + math.floor(time_s * 1e6 * (1.0 + self.skew_ppm * 1e-6))

    def true_s(self, clock_us: IntArray) -> FloatArray:
        """Return the true times for times on the clock."""
        return (clock_us - self.boot_us) / (1e6 * (1.0 + self.skew_ppm * 1e-6))


class Ticks:
    """Sampling times of one node's timer."""

    def __init__(self, clock: DeviceClock, rate_hz: float, phase_us: int = 0) -> None:
        self._clock = clock
        self._rate_hz = rate_hz
        self._phase_us = phase_us
        self._next = math.ceil((clock.boot_us - phase_us) * rate_hz * 1e-6)

    def take(self, until_s: float) -> tuple[IntArray, FloatArray]:
        """Return the sampling times before a true time, on the node's clock and in true time."""
        end_us = self._clock.at(until_s) - self._phase_us
        end = max(math.ceil(end_us * self._rate_hz * 1e-6), self._next)
        count = np.arange(self._next, end)
        node_us = self._phase_us + np.rint(count * (1e6 / self._rate_hz)).astype(np.int64)
        self._next = end
        return node_us, self._clock.true_s(node_us)


class ImuSamples(NamedTuple):
    """N samples of MPU6050 and HMC5883L; raw arrays are counts in sensor axes."""

    time_s: FloatArray
    """True time since the start, shape (N,)."""
    node_time_us: IntArray
    """Times on the node's clock, not wrapped."""
    accel_raw: IntArray
    """Shape (N, 3)."""
    gyro_raw: IntArray
    mag_raw: IntArray
    """The newest magnetometer reading, held until the next one."""
    temperature_raw: IntArray
    flags: IntArray
    """The `ImuFlags` of each sample."""


class ImuSampler:
    """Sample MPU6050 and HMC5883L along a trajectory at the node's rate."""

    def __init__(
        self, settings: SimulatorSettings, trajectory: SensorMotion, vehicle_id: int
    ) -> None:
        self.clock = DeviceClock(IMU_BOOT_US, settings.clock_skew_ppm)
        self.inertial = Mpu6050(settings, generator(settings, vehicle_id, Chance.IMU))
        self.magnetometer = Hmc5883l(settings, generator(settings, vehicle_id, Chance.MAG))
        self._trajectory = trajectory
        self._ticks = Ticks(self.clock, settings.imu_rate_hz)
        self._mag_tick = -1
        self._mag_raw = np.zeros((1, 3), dtype=np.int64)

    def take(self, until_s: float) -> ImuSamples:
        """Return all samples before a true time that were not returned yet."""
        node_us, time_s = self._ticks.take(until_s)
        truth = self._trajectory.truth_at(time_s)
        accel_raw, gyro_raw, clipped = self.inertial.sample(truth)
        mag_ticks = node_us * MAG_RATE_HZ // 1_000_000
        mag_new = np.diff(mag_ticks, prepend=self._mag_tick) > 0
        mag_time_s = self.clock.true_s(np.rint(mag_ticks * (1e6 / MAG_RATE_HZ)).astype(np.int64))
        fresh = self.magnetometer.sample(self._trajectory.attitude_at(mag_time_s[mag_new]))
        mag_raw = np.vstack([self._mag_raw, fresh])[np.cumsum(mag_new)]
        if len(node_us):
            self._mag_tick = int(mag_ticks[-1])
            self._mag_raw = mag_raw[-1:]
        temperature_raw = temperature_counts(warm_degc(time_s))
        flags = clipped | mag_new * int(ImuFlags.MAG_NEW)
        return ImuSamples(time_s, node_us, accel_raw, gyro_raw, mag_raw, temperature_raw, flags)


class BaroSamples(NamedTuple):
    """N samples of the BMP180, shapes (N,)."""

    time_s: FloatArray
    node_time_us: IntArray
    pressure_pa: FloatArray
    temperature_degc: FloatArray


class BaroSampler:
    """Sample the BMP180, which is on the IMU node, along a trajectory."""

    def __init__(
        self, settings: SimulatorSettings, trajectory: SensorMotion, vehicle_id: int
    ) -> None:
        clock = DeviceClock(IMU_BOOT_US, settings.clock_skew_ppm)
        self.barometer = Bmp180(settings, generator(settings, vehicle_id, Chance.BARO))
        self._trajectory = trajectory
        self._ticks = Ticks(clock, settings.baro_rate_hz, BARO_PHASE_US)

    def take(self, until_s: float) -> BaroSamples:
        """Return all samples before a true time that were not returned yet."""
        node_us, time_s = self._ticks.take(until_s)
        return BaroSamples(
            time_s, node_us, *self.barometer.sample(self._trajectory.truth_at(time_s))
        )
