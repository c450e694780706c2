"""MPU6050 and its successors at their registers.

Register maps RM-MPU-6000A revision 4.2, RM-MPU-6500A revision 2.1, DS-000143 (ICM-20689).
"""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from firmware.rig.bench import PS_PER_S, Bench
from firmware.rig.i2c import RegisterDevice, big_endian, hold
from firmware.rig.world import World

SELF_TEST, SMPLRT_DIV, CONFIG, GYRO_CONFIG, ACCEL_CONFIG = 0x0D, 0x19, 0x1A, 0x1B, 0x1C
_ACCEL_CONFIG_2, _LATER_GYRO_CODES = 0x1D, 0x00
INT_PIN_CFG, INT_ENABLE, DATA, PWR_MGMT_1, WHO_AM_I = 0x37, 0x38, 0x3B, 0x6B, 0x75

_ASLEEP: Final = 0x40
_RESET: Final = 0x80
_GRAVITY_MPS2: Final = 9.80665
_PER_DPS: Final = (131.0, 65.5, 32.8, 16.4)
_DLPF_HZ: Final = (260, 184, 94, 44, 21, 10, 5)
_INT_PULSE_US: Final = 50
_SAMPLE_SIZE: Final = 14
_NOISE_COUNTS: Final = 1.5
_TRIM_CODES: Final = (14, 17, 20)
"""Factory codes of all six axes of the MPU6050, taken in turn."""
_LATER_CODES: Final = (60, 80, 100)
"""Factory codes of each sensor of the later chips."""


def accel_trim_g(code: int) -> float:
    """Return the factory trim of the accelerometer, section 4.1."""
    return float(0.34 * (0.92 / 0.34) ** ((code - 1) / 30))


def gyro_trim_dps(code: int) -> float:
    """Return the factory trim of the gyroscope, section 4.1."""
    return float(25 * 1.046 ** (code - 1))


def later_trim(code: int) -> float:
    """Return a factory trim of the MPU6500 and later, in counts at +-2 g or +-250 deg/s."""
    return float(2620 * 1.01 ** (code - 1))


def _mpu6050_codes() -> dict[int, int]:
    a, g = _TRIM_CODES, _TRIM_CODES[::-1]
    codes = {SELF_TEST + axis: a[axis] >> 2 << 5 | g[axis] for axis in range(3)}
    return codes | {SELF_TEST + 3: (a[0] & 3) << 4 | (a[1] & 3) << 2 | a[2] & 3}


def _later_codes() -> dict[int, int]:
    starts = (SELF_TEST, _LATER_GYRO_CODES)
    return {start + axis: _LATER_CODES[axis] for start in starts for axis in range(3)}


@dataclass(frozen=True, slots=True)
class ImuChip:
    """How a chip with the MPU6050's register map differs from it."""

    who_am_i: int
    later: bool = False
    """Self-test codes and accelerometer filter as in the MPU6500 and its successors."""
    power_on: int = _ASLEEP
    """PWR_MGMT_1 after power-on."""
    counts_per_degc: float = 340.0
    degc_at_zero: float = 36.53
    keeps_ranges: bool = True
    """False: a broken chip, which ignores writes to its range registers."""
    measures: bool = True
    """False: a broken chip, whose data never change."""


IMU_CHIPS: Final = {
    "MPU6050": ImuChip(0x68),
    "MPU6500": ImuChip(0x70, True, 0x01, 333.87, 21.0),
    "MPU9250": ImuChip(0x71, True, 0x01, 333.87, 21.0),
    "MPU9255": ImuChip(0x73, True, 0x01, 333.87, 21.0),
    "ICM-20689": ImuChip(0x98, True, 0x41, 326.8, 25.0),
    "ICM-20602": ImuChip(0x12, True, 0x41, 326.8, 25.0),
    "MPU6886": ImuChip(0x19, True, 0x41, 326.8, 25.0),
    "clone 0x72": ImuChip(0x72),
    "clone 0x00": ImuChip(0x00),
    "ignores its ranges": ImuChip(0x68, keeps_ranges=False),
    "constant data": ImuChip(0x68, measures=False),
}
"""By the names that the node report is shown with."""


@functools.cache
def _first_order_gain(code: int, period_ps: int) -> float:
    """Return the gain of a sample for a code of the DLPF's cut-off frequency."""
    return 1 - math.exp(-2 * math.pi * _DLPF_HZ[min(code, 6)] * period_ps / PS_PER_S)


class Imu(RegisterDevice):
    """The chip; it samples the world by its own clock and pulses its interrupt line."""

    address = 0x68

    def __init__(
        self,
        bench: Bench,
        world: World,
        rng: np.random.Generator,
        pulse_irq: Callable[[int], None],
        chip: ImuChip,
        noise: bool = True,
    ) -> None:
        super().__init__()
        self._bench, self._world, self._rng, self._pulse_irq = bench, world, rng, pulse_irq
        self._chip = chip
        self._noise = _NOISE_COUNTS if noise else 0.0
        self.self_test_works = self.interrupt_works = True
        self.sampled_ps: list[int] = []
        """When the samples were taken: the start of every latency."""
        self._generation = 0
        self.power_cycle()

    def power_cycle(self) -> None:
        """Return to the state after power-on."""
        self._registers = {PWR_MGMT_1: self._chip.power_on, WHO_AM_I: self._chip.who_am_i}
        self._registers |= _later_codes() if self._chip.later else _mpu6050_codes()
        accel_g, gyro_dps = (
            (
                [later_trim(c) / 16384 for c in _LATER_CODES],
                [later_trim(c) / 131 for c in _LATER_CODES],
            )
            if self._chip.later
            else (
                [accel_trim_g(c) for c in _TRIM_CODES],
                [gyro_trim_dps(c) for c in _TRIM_CODES[::-1]],
            )
        )
        # The gyroscope's y axis answers with the opposite sign: RM-MPU-6000A, section 4.1.
        self._trims = accel_g, [gyro_dps[0], -gyro_dps[1], gyro_dps[2]]
        self._filtered: list[float] | None = None
        self._restart()

    @property
    def bypass(self) -> bool:
        """Whether the magnetometer behind the chip is on the bus."""
        return bool(self._registers.get(INT_PIN_CFG, 0) & 2) and not self.absent

    def read_register(self, register: int) -> int:
        """Return the value of a register."""
        return self._registers.get(register, 0)

    def burst(self) -> bytes:
        """Return a whole sample: acceleration, temperature, rates."""
        if self.pointer != DATA:
            return b""
        return bytes(self._registers.get(DATA + i, 0) for i in range(_SAMPLE_SIZE))

    def write_register(self, register: int, value: int) -> None:
        """Set a register; rate and sleep restart the sampling."""
        if register == PWR_MGMT_1 and value & _RESET:
            self.power_cycle()
            return
        if register in (GYRO_CONFIG, ACCEL_CONFIG) and not self._chip.keeps_ranges:
            return
        self._registers[register] = value
        if register in (PWR_MGMT_1, SMPLRT_DIV, CONFIG):
            self._restart()

    @property
    def _period_ps(self) -> int:
        base_hz = 8000 if self._registers.get(CONFIG, 0) & 7 in (0, 7) else 1000
        return (1 + self._registers.get(SMPLRT_DIV, 0)) * PS_PER_S // base_hz

    def _restart(self) -> None:
        self._generation += 1
        if self._registers[PWR_MGMT_1] & _ASLEEP:
            return
        generation = self._generation

        def sample() -> None:
            if generation == self._generation:
                self._sample()
                self._bench.at(self._bench.now_ps + self._period_ps, sample)

        self._bench.at(self._bench.now_ps + self._period_ps, sample)

    def _sample(self) -> None:
        if self.absent:
            return
        now_ps = self._bench.now_ps
        moment = self._world.moment(now_ps / PS_PER_S)
        values = self._low_pass([*moment.accel_mps2, *moment.gyro_radps])
        if self._chip.measures:
            self._store(values, moment.temperature_degc)
        if self._registers.get(INT_ENABLE, 0) & 1:
            self.sampled_ps.append(now_ps)
            if self.interrupt_works:
                self._pulse_irq(_INT_PULSE_US)

    def _low_pass(self, values: list[float]) -> list[float]:
        """Filter as the chip's DLPF would, to first order."""
        accel = self._filter_gain(_ACCEL_CONFIG_2 if self._chip.later else CONFIG)
        gyro = self._filter_gain(CONFIG)
        before = values if self._filtered is None else self._filtered
        gains = (accel, accel, accel, gyro, gyro, gyro)
        self._filtered = [
            b + gain * (v - b) for b, v, gain in zip(before, values, gains, strict=True)
        ]
        return self._filtered

    def _filter_gain(self, register: int) -> float:
        return _first_order_gain(self._registers.get(register, 0) & 7, self._period_ps)

    def _store(self, values: list[float], temperature_degc: float) -> None:
        accel_config = self._registers.get(ACCEL_CONFIG, 0)
        gyro_config = self._registers.get(GYRO_CONFIG, 0)
        per_g = 16384 >> (accel_config >> 3 & 3)
        per_dps = _PER_DPS[gyro_config >> 3 & 3]
        noise = self._rng.normal(0.0, self._noise, 6).tolist() if self._noise else [0.0] * 6
        scales = [per_g / _GRAVITY_MPS2] * 3 + [math.degrees(per_dps)] * 3
        counts = [v * scale + n for v, scale, n in zip(values, scales, noise, strict=True)]
        if self.self_test_works:
            for axis in range(3):
                counts[axis] += per_g * self._trims[0][axis] * bool(accel_config & 0x80 >> axis)
                counts[3 + axis] += (
                    per_dps * self._trims[1][axis] * bool(gyro_config & 0x80 >> axis)
                )
        temperature = (temperature_degc - self._chip.degc_at_zero) * self._chip.counts_per_degc
        words = [hold(value) for value in (*counts[:3], temperature, *counts[3:])]
        for i, word in enumerate(words):
            self._registers[DATA + 2 * i], self._registers[DATA + 2 * i + 1] = big_endian(word)
