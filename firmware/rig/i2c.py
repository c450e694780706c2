"""The I2C bus of the IMU node, and the common part of the sensors on it."""

from collections.abc import Callable, Sequence
from typing import Final

from firmware.rig.mcu import BUS_ADDRESS, BUS_READ, BUS_WRITE, Mcu

_SCL: Final = 1 << 5


class RegisterDevice:
    """A slave of 256 registers: a write sets the pointer first, and every byte moves it on."""

    address: int

    def __init__(self) -> None:
        self.absent = False
        self.refuse_bytes = 0
        """So many of the next written bytes are not acknowledged."""
        self.pointer = 0

    def reachable(self) -> bool:
        """Whether the device is connected to the bus."""
        return not self.absent

    def read_register(self, register: int) -> int:
        """Return the value of a register."""
        raise NotImplementedError

    def burst(self) -> bytes:
        """Return the bytes from the pointer on that belong to one sample, if any."""
        return b""

    def write_register(self, register: int, value: int) -> None:
        """Set a register."""
        raise NotImplementedError


class I2cBus:
    """Joins the slaves to the two-wire interface of a chip."""

    def __init__(self, mcu: Mcu, devices: Sequence[RegisterDevice]) -> None:
        self._mcu, self.devices = mcu, list(devices)
        self._device: RegisterDevice | None = None
        self._pointer_next = False
        self._clocks_left = 0
        self._direction = 0
        mcu.on_twi = self._event
        mcu.on_turn_c = self._turned
        self.restore_lines()

    def hang(self, clocks: int) -> None:
        """Let a slave hold the data line low until it has seen so many clock pulses."""
        self._clocks_left = clocks
        self._mcu.hold_sda(True)

    def restore_lines(self) -> None:
        """Drive the lines again, after a reset of the chip."""
        self._mcu.hold_sda(self._clocks_left > 0)

    def _turned(self, direction: int) -> None:
        rising_scl = self._direction & _SCL and not direction & _SCL
        self._direction = direction
        if rising_scl and self._clocks_left:
            self._clocks_left -= 1
        self.restore_lines()

    def _event(self, event: int, byte: int) -> int:
        if event == BUS_ADDRESS:
            return self._address(byte)
        device = self._device
        if device is None:
            return 0xFF if event == BUS_READ else 0
        if event == BUS_READ:
            value = device.read_register(device.pointer)
            device.pointer = (device.pointer + 1) & 0xFF
            return value
        if event == BUS_WRITE:
            return self._write(device, byte)
        device.pointer = (device.pointer - byte) & 0xFF  # bytes of a burst that were not read
        self._device = None
        return 0

    def _address(self, byte: int) -> int:
        self._device = next(
            (d for d in self.devices if d.address == byte >> 1 and d.reachable()), None
        )
        self._pointer_next = True
        if self._device is None:
            return 0
        if byte & 1 and (data := self._device.burst()):
            self._mcu.twi_answer(data)
            self._device.pointer = (self._device.pointer + len(data)) & 0xFF
        return 1

    def _write(self, device: RegisterDevice, byte: int) -> int:
        if device.refuse_bytes:
            device.refuse_bytes -= 1
            return 0
        if self._pointer_next:
            device.pointer, self._pointer_next = byte, False
        else:
            device.write_register(device.pointer, byte)
            device.pointer = (device.pointer + 1) & 0xFF
        return 1


def big_endian(value: int) -> tuple[int, int]:
    """Split a 16-bit two's complement number into its bytes."""
    return value >> 8 & 0xFF, value & 0xFF


def little_endian(value: int) -> tuple[int, int]:
    """Split a 16-bit two's complement number into its bytes."""
    return value & 0xFF, value >> 8 & 0xFF


def hold(value: float, low: int = -32768, high: int = 32767) -> int:
    """Round to counts and hold at the ends of the range."""
    return max(low, min(high, round(value)))


Clock = Callable[[], int]
"""The present of the board that reads, in ps."""
