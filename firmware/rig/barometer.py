"""The barometers at their registers.

Datasheets BST-BMP180-DS000 revision 2.5, BST-BMP280-DS001 revision 1.14, BST-BME280-DS002.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from firmware.rig.bench import PS_PER_S, PS_PER_US
from firmware.rig.i2c import Clock, RegisterDevice, big_endian, little_endian
from firmware.rig.world import World

_CALIBRATION, _CHIP_ID, _CONTROL, _RESULT = 0xAA, 0xD0, 0xF4, 0xF6
_TEMPERATURE: Final = 0x2E
_CONVERSION_US: Final = (4500, 7500, 13500, 25500)


@dataclass(frozen=True, slots=True)
class Words:
    """Calibration words of a BMP180; the defaults are those of the datasheet's example."""

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
        """Return the value of a register."""
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
        return _first(
            15_000, 45_000, lambda raw: (self.words.b5(raw) + 8) / 160 >= temperature_degc
        )

    def _raw_pressure(self, b5: float, pressure_pa: float, oversampling: int) -> int:
        return _first(
            0,
            1 << 16 + oversampling,
            lambda raw: self.words.pressure_pa(b5, raw, oversampling) >= pressure_pa,
        )


@dataclass(frozen=True, slots=True)
class Bmp280Words:
    """Calibration words of a BMP280; the defaults are those of the datasheet's example."""

    t1: int = 27504
    t2: int = 26435
    t3: int = -1000
    p1: int = 36477
    p2: int = -10685
    p3: int = 3024
    p4: int = 2855
    p5: int = 140
    p6: int = -7
    p7: int = 15500
    p8: int = -14600
    p9: int = 6000

    def t_fine(self, raw: float) -> float:
        """Return the datasheet's t_fine in floating point, appendix 8.1."""
        linear = (raw / 16384 - self.t1 / 1024) * self.t2
        return float(linear + (raw / 131072 - self.t1 / 8192) ** 2 * self.t3)

    def pressure_pa(self, t_fine: float, raw: float) -> float:
        """Compensate a pressure in floating point, appendix 8.1."""
        t = t_fine / 2 - 64000
        offset = (t * t * self.p6 / 32768 + t * self.p5 * 2) / 4 + self.p4 * 65536
        gain = (1 + (self.p3 * t * t / 524288 + self.p2 * t) / 524288 / 32768) * self.p1
        p = (1048576 - raw - offset / 4096) * 6250 / gain
        return float(p + (self.p9 * p * p / 2147483648 + p * self.p8 / 32768 + self.p7) / 16)


class Bmp280(RegisterDevice):
    """BMP280 or BME280 in forced mode: asleep between measurements."""

    _CALIBRATION, _CONTROL, _RESULT = 0x88, 0xF4, 0xF7

    def __init__(self, world: World, clock: Clock, chip_id: int, address: int = 0x76) -> None:
        super().__init__()
        self.address = address
        self._world, self._clock = world, clock
        self.words = Bmp280Words()
        values = [getattr(self.words, name) for name in self.words.__slots__]
        calibration = [byte for value in values for byte in little_endian(value)]
        self._registers = {self._CALIBRATION + i: byte for i, byte in enumerate(calibration)}
        self._registers[_CHIP_ID] = chip_id
        self._set_result(0x80000, 0x80000)
        self._running: tuple[int, int, int] | None = None
        """End of the measurement, and its raw pressure and temperature."""

    def read_register(self, register: int) -> int:
        """Return the value of a register."""
        if self._running and self._clock() >= self._running[0]:
            self._set_result(*self._running[1:])
            self._registers[self._CONTROL] &= ~3
            self._running = None
        return self._registers.get(register, 0)

    def write_register(self, register: int, value: int) -> None:
        """Set a register; the control register starts a measurement."""
        self._registers[register] = value
        if register != self._CONTROL or value & 3 not in (1, 2):
            return
        now_ps = self._clock()
        moment = self._world.moment(now_ps / PS_PER_S)
        temperature_code, pressure_code = value >> 5, value >> 2 & 7
        times = (1 << min(temperature_code, 5)) // 2 + (1 << min(pressure_code, 5)) // 2
        raw_temperature = raw_pressure = 0x80000
        if temperature_code:
            degc = moment.temperature_degc
            raw_temperature = _first(0, 1 << 20, lambda raw: self.words.t_fine(raw) / 5120 >= degc)
            if pressure_code:
                t_fine, pa = self.words.t_fine(raw_temperature), moment.pressure_pa
                # The raw value falls with the pressure.
                raw_pressure = _first(
                    0, 1 << 20, lambda raw: self.words.pressure_pa(t_fine, raw) <= pa
                )
        # Typical times, BME280 appendix 9.1.
        duration_us = 1000 + 2000 * times + (500 if pressure_code else 0)
        self._running = now_ps + duration_us * PS_PER_US, raw_pressure, raw_temperature

    def _set_result(self, raw_pressure: int, raw_temperature: int) -> None:
        for at, raw in ((self._RESULT, raw_pressure), (self._RESULT + 3, raw_temperature)):
            for i, byte in enumerate((raw << 4).to_bytes(3, "big")):
                self._registers[at + i] = byte


def _first(low: int, high: int, reached: Callable[[int], bool]) -> int:
    """Return the least number at which a monotonous condition holds."""
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle + 1, high)
    return low


BAROMETERS: Final = ("BMP180", "BMP280", "BME280", "BMP280 at 0x77")


def make_barometer(name: str, world: World, clock: Clock) -> RegisterDevice:
    """Build the chip of a name in `BAROMETERS`."""
    match name:
        case "BMP180":
            return Bmp180(world, clock)
        case "BMP280":
            return Bmp280(world, clock, 0x58)
        case "BME280":
            return Bmp280(world, clock, 0x60)
        case "BMP280 at 0x77":
            return Bmp280(world, clock, 0x58, 0x77)
    raise ValueError(f"no such barometer: {name!r}, only {', '.join(BAROMETERS)}")
