"""HMC5883L at its registers, behind the IMU's bypass: datasheet 900405 revision E."""

from typing import Final

from firmware.rig.bench import PS_PER_S
from firmware.rig.i2c import Clock, RegisterDevice, big_endian, hold
from firmware.rig.imu import Imu
from firmware.rig.world import World

_RATES_HZ: Final = (0.75, 1.5, 3.0, 7.5, 15.0, 30.0, 75.0)
_PER_GAUSS: Final = (1370, 1090, 820, 660, 440, 390, 330, 230)
_UT_PER_GAUSS: Final = 100.0
_OVERFLOW: Final = -4096
_LARGEST: Final = 2047
_CONTINUOUS: Final = 0
_IDENTIFICATION: Final = {0x0A: ord("H"), 0x0B: ord("4"), 0x0C: ord("3")}
_DATA: Final = 0x03
_LAST_DATA: Final = 0x08


class Hmc5883l(RegisterDevice):
    """The chip."""

    address = 0x1E

    def __init__(self, world: World, clock: Clock, behind: Imu) -> None:
        super().__init__()
        self._world, self._clock, self._behind = world, clock, behind
        self.power_cycle()

    def power_cycle(self) -> None:
        """Return to the state after power-on: idle, at its own rate."""
        self._registers = {0: 0x10, 1: 0x20, 2: 0x03} | _IDENTIFICATION

    def reachable(self) -> bool:
        """Whether it hears the bus: only through the bypass."""
        return not self.absent and self._behind.bypass

    def read_register(self, register: int) -> int:
        """Return what a register holds; the first data byte takes the newest measurement."""
        if register == _DATA and self._registers[2] & 3 == _CONTINUOUS:
            self._measure()
        if register == _LAST_DATA:
            self.pointer = _DATA - 1  # the pointer goes back to the data: page 12
        return self._registers.get(register, 0)

    def write_register(self, register: int, value: int) -> None:
        """Set a register."""
        self._registers[register] = value

    def _measure(self) -> None:
        rate_hz = _RATES_HZ[min(self._registers[0] >> 2 & 7, 6)]
        time_s = int(self._clock() / PS_PER_S * rate_hz) / rate_hz
        field_ut = self._world.moment(time_s).mag_ut
        per_gauss = _PER_GAUSS[self._registers[1] >> 5]
        x, y, z = (hold(v / _UT_PER_GAUSS * per_gauss) for v in field_ut)
        for i, counts in enumerate((x, z, y)):
            word = counts if abs(counts) <= _LARGEST else _OVERFLOW
            at = _DATA + 2 * i
            self._registers[at], self._registers[at + 1] = big_endian(word)
