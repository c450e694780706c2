"""Sampling times by the nodes' clocks, and the sensor readings.

A sampler runs along a trajectory, a whole flight at once or second by second: both give the same
numbers, bit for bit.
"""

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from gateway.records import ImuFlags
from gateway.simulator.noise import FloatArray
from gateway.simulator.sensors import (
    ACCEL_RANGE,
    FACE_UP,
    GYRO_LSB_PER_DPS,
    GYRO_RANGE,
    INT16_MAX,
    MAG_GAIN,
    MAG_OVERFLOW,
    MAG_RATE_HZ,
    UT_PER_GAUSS,
    Bmp180,
    BoolArray,
    Hmc5883l,
    IntArray,
    Mpu6050,
)
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import SensorMotion, Truth
from gateway.units import STANDARD_GRAVITY_MPS2
from gateway.wire.payloads import ACCEL_RANGES_G, MAG_LSB_PER_GAUSS

IMU_BOOT_US: Final = 2_718_281
"""The node's clock at the start of the simulation."""
BARO_PHASE_US: Final = 3_300


class Chance(IntEnum):
    """Streams of random numbers; each sensor draws from its own."""

    GUSTS = 0
    IMU = 1
    MAG = 2
    BARO = 3
    GPS = 4
    RADIO = 5
    LINE = 6


def generator(settings: SimulatorSettings, vehicle_id: int, stream: Chance) -> np.random.Generator:
    """Start one stream of random numbers of one aircraft."""
    return np.random.default_rng([settings.seed, vehicle_id, stream])


@dataclass(frozen=True, slots=True)
class DeviceClock:
    """A node's or receiver's own clock against true time."""

    boot_us: int
    """What it shows at the start of the simulation."""
    skew_ppm: float

    def at(self, time_s: float) -> int:
        """Return what the clock shows at a true time, in whole µs, not wrapped."""
        return self.boot_us + math.floor(time_s * 1e6 * (1.0 + self.skew_ppm * 1e-6))

    def true_s(self, clock_us: IntArray) -> FloatArray:
        """Return the true times at which it shows the given times."""
        return (clock_us - self.boot_us) / (1e6 * (1.0 + self.skew_ppm * 1e-6))


class Ticks:
    """Sampling instants of one node's timer."""

    def __init__(self, clock: DeviceClock, rate_hz: float, phase_us: int = 0) -> None:
        self._clock = clock
        self._rate_hz = rate_hz
        self._phase_us = phase_us
        self._next = math.ceil((clock.boot_us - phase_us) * rate_hz * 1e-6)

    def take(self, until_s: float) -> tuple[IntArray, FloatArray]:
        """List the instants before a true time: on the node's clock and in true time."""
        end_us = self._clock.at(until_s) - self._phase_us
        end = max(math.ceil(end_us * self._rate_hz * 1e-6), self._next)
        count = np.arange(self._next, end)
        node_us = self._phase_us + np.rint(count * (1e6 / self._rate_hz)).astype(np.int64)
        self._next = end
        return node_us, self._clock.true_s(node_us)


@dataclass(frozen=True, slots=True)
class ImuSamples:
    """N readings of MPU6050 and HMC5883L; raw arrays in counts and sensor axes."""

    time_s: FloatArray
    """True time since the start, shape (N,)."""
    node_time_us: IntArray
    """On the node's clock, not wrapped."""
    accel_raw: IntArray
    """Shape (N, 3)."""
    gyro_raw: IntArray
    mag_raw: IntArray
    """The newest reading, held until the next one."""
    mag_new: BoolArray
    mag_time_s: FloatArray
    """When the newest magnetometer reading was taken."""
    temperature_raw: IntArray
    flags: IntArray
    """`ImuFlags`."""
    truth: Truth
    """The aircraft at `time_s`."""

    @property
    def accel_b_mps2(self) -> FloatArray:
        """Specific force in body FRD from the counts, not calibrated."""
        scale = ACCEL_RANGES_G[ACCEL_RANGE] * STANDARD_GRAVITY_MPS2 / (INT16_MAX + 1)
        return np.asarray(self.accel_raw * FACE_UP * scale)

    @property
    def gyro_b_radps(self) -> FloatArray:
        """Angular rate in body FRD from the counts, not calibrated."""
        return np.asarray(np.radians(self.gyro_raw * FACE_UP / GYRO_LSB_PER_DPS[GYRO_RANGE]))

    @property
    def mag_b_ut(self) -> FloatArray:
        """Magnetic field in body FRD, not calibrated; NaN unless newly sampled and in range."""
        field = self.mag_raw * FACE_UP * (UT_PER_GAUSS / MAG_LSB_PER_GAUSS[MAG_GAIN])
        usable = self.mag_new & ~np.any(self.mag_raw == MAG_OVERFLOW, axis=1)
        return np.where(usable[:, np.newaxis], field, np.nan)


class ImuSampler:
    """Read MPU6050 and HMC5883L along a trajectory at the node's rate."""

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
        """Run up to a true time and return every sample taken before it."""
        node_us, time_s = self._ticks.take(until_s)
        truth = self._trajectory.truth_at(time_s)
        counts = self.inertial.sample(truth)
        mag_ticks = node_us * MAG_RATE_HZ // 1_000_000
        mag_new = np.diff(mag_ticks, prepend=self._mag_tick) > 0
        mag_time_s = self.clock.true_s(np.rint(mag_ticks * (1e6 / MAG_RATE_HZ)).astype(np.int64))
        fresh = self.magnetometer.sample(self._trajectory.attitude_at(mag_time_s[mag_new]))
        mag_raw = np.vstack([self._mag_raw, fresh])[np.cumsum(mag_new)]
        if len(node_us):
            self._mag_tick = int(mag_ticks[-1])
            self._mag_raw = mag_raw[-1:]
        flags = mag_new * int(ImuFlags.MAG_NEW)
        flags |= counts.accel_clipped * int(ImuFlags.ACCEL_CLIPPED)
        flags |= counts.gyro_clipped * int(ImuFlags.GYRO_CLIPPED)
        return ImuSamples(
            time_s=time_s,
            node_time_us=node_us,
            accel_raw=counts.accel,
            gyro_raw=counts.gyro,
            mag_raw=mag_raw,
            mag_new=mag_new,
            mag_time_s=mag_time_s,
            temperature_raw=counts.temperature,
            flags=flags,
            truth=truth,
        )


@dataclass(frozen=True, slots=True)
class BaroSamples:
    """N readings of the BMP180, shapes (N,)."""

    time_s: FloatArray
    node_time_us: IntArray
    pressure_pa: FloatArray
    temperature_degc: FloatArray
    truth: Truth
    """The aircraft at `time_s`."""


class BaroSampler:
    """Read the BMP180 along a trajectory; it is on the IMU node."""

    def __init__(
        self, settings: SimulatorSettings, trajectory: SensorMotion, vehicle_id: int
    ) -> None:
        clock = DeviceClock(IMU_BOOT_US, settings.clock_skew_ppm)
        self.barometer = Bmp180(settings, generator(settings, vehicle_id, Chance.BARO))
        self._trajectory = trajectory
        self._ticks = Ticks(clock, settings.baro_rate_hz, BARO_PHASE_US)

    def take(self, until_s: float) -> BaroSamples:
        """Run up to a true time and return every sample taken before it."""
        node_us, time_s = self._ticks.take(until_s)
        truth = self._trajectory.truth_at(time_s)
        pressure_pa, temperature_degc = self.barometer.sample(truth)
        return BaroSamples(time_s, node_us, pressure_pa, temperature_degc, truth)
