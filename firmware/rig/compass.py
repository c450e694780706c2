"""The compass chips at their registers, behind the IMU's bypass.

Datasheets: HMC5883L 900405 revision E, QMC5883L 13-52-04 revision A, QMC5883P 13-52-19 revision C.
The world's field is on the axes of the HMC5883L; each chip turns it to its own.
"""

from typing import Final

from firmware.rig.bench import PS_PER_S
from firmware.rig.i2c import Clock, RegisterDevice, big_endian, hold, little_endian
from firmware.rig.imu import Imu
from firmware.rig.world import Vec3, World

_UT_PER_GAUSS: Final = 100.0
_NEW_DATA: Final = 0x01
"""Bits of the QMC status registers."""
_OVERFLOW: Final = 0x02


class Compass(RegisterDevice):
    """Common part of the chips."""

    _registers: dict[int, int]
    """By address, set by `power_cycle`."""

    def __init__(self, world: World, clock: Clock, behind: Imu) -> None:
        super().__init__()
        self._world, self._clock, self._behind = world, clock, behind
        self.power_cycle()

    def power_cycle(self) -> None:
        """Return to the state after power-on: idle."""
        raise NotImplementedError

    def reachable(self) -> bool:
        """Whether the device is connected to the bus: only through the bypass."""
        return not self.absent and self._behind.bypass

    def write_register(self, register: int, value: int) -> None:
        """Set a register."""
        self._registers[register] = value

    def _field_gauss(self, rate_hz: float) -> Vec3:
        """Return the newest measurement at a rate."""
        time_s = int(self._clock() / PS_PER_S * rate_hz) / rate_hz
        x, y, z = (v / _UT_PER_GAUSS for v in self._world.moment(time_s).mag_ut)
        return x, y, z


class Hmc5883l(Compass):
    """HMC5883L, and the differences of its relatives.

    Parameters
    ----------
    status_ready : bool
        False: a DA5883, whose status register never shows new data.
    """

    address = 0x1E
    _RATES_HZ: Final = (0.75, 1.5, 3.0, 7.5, 15.0, 30.0, 75.0)
    _PER_GAUSS: Final = (1370, 1090, 820, 660, 440, 390, 330, 230)
    _OVERFLOW_WORD: Final = -4096
    _LARGEST: Final = 2047
    _DATA, _LAST_DATA, _STATUS = 0x03, 0x08, 0x09
    _CONTINUOUS: Final = 0

    def __init__(
        self, world: World, clock: Clock, behind: Imu, *, status_ready: bool = True
    ) -> None:
        self._status_ready = status_ready
        super().__init__(world, clock, behind)

    def power_cycle(self) -> None:
        """Return to the state after power-on: idle, at its own rate."""
        identification = {0x0A: ord("H"), 0x0B: ord("4"), 0x0C: ord("3")}
        self._registers = {0: 0x10, 1: 0x20, 2: 0x03} | identification

    def read_register(self, register: int) -> int:
        """Return the value of a register; the first data byte takes the newest measurement."""
        if register == self._STATUS:
            return int(self._status_ready)
        if register == self._DATA and self._registers[2] & 3 == self._CONTINUOUS:
            self._measure()
        if register == self._LAST_DATA:
            self.pointer = self._DATA - 1  # the pointer goes back to the data: page 12
        return self._registers.get(register, 0)

    def _measure(self) -> None:
        x, y, z = self._field_gauss(self._RATES_HZ[min(self._registers[0] >> 2 & 7, 6)])
        per_gauss = self._PER_GAUSS[self._registers[1] >> 5]
        for i, gauss in enumerate((x, z, y)):
            counts = hold(gauss * per_gauss)
            word = counts if abs(counts) <= self._LARGEST else self._OVERFLOW_WORD
            at = self._DATA + 2 * i
            self._registers[at], self._registers[at + 1] = big_endian(word)


class _Qmc(Compass):
    """Common part of the two QMC chips, which differ in the addresses of the registers."""

    _RATES_HZ: Final = (10.0, 50.0, 100.0, 200.0)
    _DATA: int
    _STATUS: int

    def _running(self) -> bool:
        raise NotImplementedError

    def _per_gauss_and_range(self) -> tuple[float, float]:
        raise NotImplementedError

    def _rate_hz(self) -> float:
        raise NotImplementedError

    def _own_axes(self, field: Vec3) -> Vec3:
        return field

    def read_register(self, register: int) -> int:
        """Return the value of a register; the first data byte takes the newest measurement."""
        if register == self._DATA and self._running():
            self._measure()
        value = self._registers.get(register, 0)
        if register == self._STATUS:
            self._registers[register] = 0
        return value

    def _measure(self) -> None:
        per_gauss, range_gauss = self._per_gauss_and_range()
        field = self._own_axes(self._field_gauss(self._rate_hz()))
        for i, gauss in enumerate(field):
            at = self._DATA + 2 * i
            self._registers[at], self._registers[at + 1] = little_endian(hold(gauss * per_gauss))
        beyond = any(abs(gauss) > range_gauss for gauss in field)
        self._registers[self._STATUS] = _NEW_DATA | (_OVERFLOW if beyond else 0)


class Qmc5883l(_Qmc):
    """QMC5883L: the axes of the HMC5883L."""

    address = 0x0D
    _DATA, _STATUS = 0x00, 0x06
    _CONTROL_1, _CONTROL_2, _ID = 0x09, 0x0A, 0x0D

    def power_cycle(self) -> None:
        """Return to the state after power-on: standby."""
        self._registers = {self._ID: 0xFF}

    def write_register(self, register: int, value: int) -> None:
        """Set a register; bit 7 of the second control register resets the chip."""
        if register == self._CONTROL_2 and value & 0x80:
            self.power_cycle()
        elif register != self._ID:
            self._registers[register] = value

    def _running(self) -> bool:
        return self._registers.get(self._CONTROL_1, 0) & 3 == 1

    def _rate_hz(self) -> float:
        return self._RATES_HZ[self._registers[self._CONTROL_1] >> 2 & 3]

    def _per_gauss_and_range(self) -> tuple[float, float]:
        return (3000.0, 8.0) if self._registers[self._CONTROL_1] >> 4 & 3 else (12_000.0, 2.0)


class Qmc5883p(_Qmc):
    """QMC5883P: x and y exchanged against the HMC5883L, and all of them turned round."""

    address = 0x2C
    _DATA, _STATUS = 0x01, 0x09
    _ID, _CONTROL_1, _CONTROL_2, _SIGNS = 0x00, 0x0A, 0x0B, 0x29

    def power_cycle(self) -> None:
        """Return to the state after power-on: suspended."""
        self._registers = {self._ID: 0x80}

    def write_register(self, register: int, value: int) -> None:
        """Set a register; bit 7 of the second control register resets the chip."""
        if register == self._CONTROL_2 and value & 0x80:
            self.power_cycle()
        elif register != self._ID:
            self._registers[register] = value

    def _running(self) -> bool:
        return self._registers.get(self._CONTROL_1, 0) & 3 in (1, 3)

    def _rate_hz(self) -> float:
        return self._RATES_HZ[self._registers[self._CONTROL_1] >> 2 & 3]

    def _per_gauss_and_range(self) -> tuple[float, float]:
        ranges = ((1000.0, 30.0), (2500.0, 12.0), (3750.0, 8.0), (15_000.0, 2.0))
        return ranges[self._registers.get(self._CONTROL_2, 0) >> 2 & 3]

    def _own_axes(self, field: Vec3) -> Vec3:
        x, y, z = field
        # The signs before the datasheet's write to 0x29 are not documented: here, all are reversed.
        sign = 1.0 if self._registers.get(self._SIGNS) == 0x06 else -1.0
        return -y * sign, -x * sign, -z * sign


COMPASSES: Final = ("HMC5883L", "HMC5983", "DA5883", "QMC5883L", "QMC5883P")


def make_compass(name: str, world: World, clock: Clock, behind: Imu) -> Compass:
    """Build the chip of a name in `COMPASSES`."""
    if name == "QMC5883L":
        return Qmc5883l(world, clock, behind)
    if name == "QMC5883P":
        return Qmc5883p(world, clock, behind)
    if name in COMPASSES:
        return Hmc5883l(world, clock, behind, status_ready=name != "DA5883")
    raise ValueError(f"no such compass: {name!r}, only {', '.join(COMPASSES)}")
