"""BMP180 at its registers: datasheet BST-BMP180-DS000 revision 2.5."""

from dataclasses import dataclass
from typing import Final

from firmware.rig.bench import PS_PER_S, PS_PER_US
from firmware.rig.i2c import Clock, RegisterDevice, big_endian
from firmware.rig.world import World

_CALIBRATION, _CHIP_ID, _CONTROL, _RESULT = 0xAA, 0xD0, 0xF4, 0xF6
_TEMPERATURE: Final = 0x2E
_CONVERSION_US: Final = (4500, 7500, 13500, 25500)


@dataclass(frozen=True, slots=True)
class Words:
    """Calibration words; the defaults are those of the datasheet's example."""

    ac1: int = 408
    ac2: int = -72
    ac3: int = -14383
    ac4: int = 32741
    ac5: int = 32757
    ac6: int = 23153
    b1: int = 6190
    b2: int = 4
    mb: int = -32768
    mc: int = -8711
    md: int = 2868

    def b5(self, raw: float) -> float:
        """Return the datasheet's B5 of an uncompensated temperature."""
        x1 = (raw - self.ac6) * self.ac5 / 2**15
        return x1 + self.mc * 2**11 / (x1 + self.md)

    def pressure_pa(self, b5: float, raw: float, oversampling: int) -> float:
        """Compensate a pressure in floating point, section 3.5."""
        b6 = b5 - 4000
        x3 = (self.b2 * (b6 * b6 / 2**12)) / 2**11 + self.ac2 * b6 / 2**11
        b3 = ((self.ac1 * 4 + x3) * 2**oversampling + 2) / 4
        x3 = (self.ac3 * b6 / 2**13 + (self.b1 * (b6 * b6 / 2**12)) / 2**16 + 2) / 4
        b4 = self.ac4 * (x3 + 32768) / 2**15
        p = (raw - b3) * (50000 / 2**oversampling) * 2 / b4
        return float(p + ((p / 2**8) ** 2 * 3038 / 2**16 - 7357 * p / 2**16 + 3791) / 2**4)


class Bmp180(RegisterDevice):
    """The chip: a conversion's result is there only when its time has passed."""

    address = 0x77

    def __init__(self, world: World, clock: Clock, words: Words | None = None) -> None:
        super().__init__()
        self._world, self._clock = world, clock
        self.words = words or Words()
        values = [getattr(self.words, name) for name in self.words.__slots__]
        calibration = [byte for value in values for byte in big_endian(value)]
        self._registers = {_CALIBRATION + i: byte for i, byte in enumerate(calibration)}
        self._registers[_CHIP_ID] = 0x55
        self._running: tuple[int, bytes] | None = None
        """When the conversion ends, and what it gives."""

    def read_register(self, register: int) -> int:
        """Return what a register holds."""
        if self._running and self._clock() >= self._running[0]:
            for i, byte in enumerate(self._running[1]):
                self._registers[_RESULT + i] = byte
            self._running = None
        return self._registers.get(register, 0)

    def write_register(self, register: int, value: int) -> None:
        """Set a register; the control register starts a conversion."""
        self._registers[register] = value
        if register != _CONTROL:
            return
        now_ps = self._clock()
        moment = self._world.moment(now_ps / PS_PER_S)
        if value == _TEMPERATURE:
            raw = self._raw_temperature(moment.temperature_degc)
            self._running = now_ps + 4500 * PS_PER_US, raw.to_bytes(2, "big")
        elif value & 0x3F == 0x34:
            oversampling = value >> 6
            b5 = self.words.b5(self._raw_temperature(moment.temperature_degc))
            raw = self._raw_pressure(b5, moment.pressure_pa, oversampling)
            end_ps = now_ps + _CONVERSION_US[oversampling] * PS_PER_US
            self._running = end_ps, (raw << 8 - oversampling).to_bytes(3, "big")

    def _raw_temperature(self, temperature_degc: float) -> int:
        low, high = 15_000, 45_000
        while low < high:
            middle = (low + high) // 2
            low, high = (
                (middle + 1, high)
                if (self.words.b5(middle) + 8) / 160 < temperature_degc
                else (low, middle)
            )
        return low

    def _raw_pressure(self, b5: float, pressure_pa: float, oversampling: int) -> int:
        low, high = 0, 1 << 16 + oversampling
        while low < high:
            middle = (low + high) // 2
            below = self.words.pressure_pa(b5, middle, oversampling) < pressure_pa
            low, high = (middle + 1, high) if below else (low, middle)
        return low
