"""One simulated ATmega328P: libsimavr through the shim."""

import ctypes
import functools
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Final

FIRMWARE: Final = Path(__file__).resolve().parent.parent
LIBRARY: Final = FIRMWARE / "build" / "libshim.so"

POWER_ON: Final = 1 << 0
EXTERNAL: Final = 1 << 1
BROWN_OUT: Final = 1 << 2
WATCHDOG: Final = 1 << 3
"""Bits of MCUSR."""

BUS_ADDRESS, BUS_WRITE, BUS_READ, BUS_STOP = range(4)

_UART_OUT: Final = 4096
_SPI_DATA: Final = 64
_SRAM_OFFSET: Final = 0x800000
_FS_PER_S: Final = 1_000_000_000_000_000
_R2: Final = 2
_RJMP_TO_ITSELF: Final = 0xCFFF

_SPI = ctypes.CFUNCTYPE(ctypes.c_uint8, ctypes.c_uint8)
_TWI = ctypes.CFUNCTYPE(ctypes.c_uint8, ctypes.c_uint8, ctypes.c_uint8)
_PIN = ctypes.CFUNCTYPE(None, ctypes.c_uint8, ctypes.c_uint8)


class CrashedError(RuntimeError):
    """The program left the rails: an invalid opcode or a jump out of the flash."""


@functools.cache
def library() -> ctypes.CDLL:
    """Load the shim that `make -C firmware rig` builds.

    Raises
    ------
    OSError
        If it is not built, or libsimavr is not installed.
    """
    lib = ctypes.CDLL(str(LIBRARY))
    pointer, u8, u16, u32, u64, i64 = (
        ctypes.c_void_p, ctypes.c_uint8, ctypes.c_uint16, ctypes.c_uint32, ctypes.c_uint64,
        ctypes.c_int64,
    )  # fmt: skip
    signatures: dict[str, tuple[type | None, tuple[type, ...]]] = {
        "board_new": (pointer, (u32, i64)),
        "board_free": (None, (pointer,)),
        "board_connect": (None, (pointer, _SPI, _TWI, _PIN, ctypes.c_char_p, ctypes.c_char_p)),
        "board_load": (None, (pointer, ctypes.c_char_p, u32)),
        "board_start_at": (None, (pointer, u32)),
        "board_reset": (None, (pointer, u8)),
        "boards_run": (i64, (ctypes.POINTER(pointer), ctypes.c_int, i64, i64, i64, pointer)),
        "board_now_ps": (i64, (pointer,)),
        "board_halt": (None, (pointer, i64)),
        "board_fail": (None, (pointer,)),
        "board_sound": (ctypes.c_int, (pointer,)),
        "board_cycle": (u64, (pointer,)),
        "board_slept": (u64, (pointer,)),
        "board_resets": (u32, (pointer,)),
        "board_pc": (u32, (pointer,)),
        "board_poke": (None, (pointer, u16, u8)),
        "board_flash_word": (u16, (pointer, u32)),
        "board_patch_flash": (None, (pointer, u32, u16)),
        "board_set_pin": (None, (pointer, ctypes.c_char, u8, u8)),
        "board_pulse": (None, (pointer, u8, u32)),
        "board_twi_answer": (None, (pointer, ctypes.c_char_p, u8)),
        "board_spi_count": (u8, (pointer,)),
        "board_watch_line": (None, (pointer,)),
        "board_hold_sda": (None, (pointer, u8)),
        "board_uart_feed": (None, (pointer, u8, u8)),
        "board_uart_cycles_per_byte": (u32, (pointer,)),
        "board_uart_take": (u32, (pointer, ctypes.c_char_p, ctypes.POINTER(i64))),
    }
    for name, (result, arguments) in signatures.items():
        function = getattr(lib, name)
        function.restype, function.argtypes = result, arguments
    return lib


def read_hex(path: Path) -> tuple[bytes, int]:
    """Read an Intel HEX file: all bytes from address 0 on, and the address of the first record.

    Not with `intelhex`: it refuses optiboot's file, which holds its version twice.
    """
    code, start = bytearray(), None
    for line in path.read_text(encoding="ascii").split():
        record = bytes.fromhex(line[1:])
        size, address, kind = record[0], int.from_bytes(record[1:3], "big"), record[3]
        if kind == 0:
            start = address if start is None else start
            code += b"\xff" * (address + size - len(code))
            code[address : address + size] = record[4 : 4 + size]
    return bytes(code), start or 0


def read_symbols(path: Path) -> dict[str, int]:
    """Read the symbols of an ELF file: flash addresses, or 0x800000 and more for RAM."""
    listing = subprocess.run(
        ["avr-nm", "-C", str(path)], capture_output=True, text=True, check=True, timeout=30
    ).stdout
    found = re.findall(r"^([0-9a-f]+) \w (\S+)$", listing, re.MULTILINE)
    return {name: int(address, 16) for address, name in found}


class Mcu:
    """A chip with a program in it.

    Parameters
    ----------
    program : Path
        The `.hex` file, of a program or a bootloader; the `.elf` of the same name has the symbols.
    frequency_hz : int
        What the program was built for.
    clock_ppm : float
        How much faster than that the crystal runs.
    """

    def __init__(self, program: Path, frequency_hz: int, clock_ppm: float = 0.0) -> None:
        self.program = program
        self.frequency_hz = frequency_hz
        self.on_spi: Callable[[int], tuple[int, bytes]] = lambda _command: (0xFF, b"")
        """Takes a command; returns the answers to it and to the bytes behind it."""
        self.on_twi: Callable[[int, int], int] = lambda _event, _byte: 0
        self.on_port_b: Callable[[int], None] = lambda _value: None
        self.on_turn_c: Callable[[int], None] = lambda _value: None
        self.on_reset: Callable[[], None] = lambda: None
        self.failure: BaseException | None = None
        self._lib = library()
        period_fs = round(_FS_PER_S / (frequency_hz * (1 + clock_ppm * 1e-6)))
        self.board = self._lib.board_new(frequency_hz, period_fs)
        # ctypes keeps no reference to a callback: these must live as long as the board.
        self._callbacks = (_SPI(self._spi), _TWI(self._twi), _PIN(self._pin))
        code, start = read_hex(program)
        self._lib.board_load(self.board, code, len(code))
        # A program that begins elsewhere is a bootloader, where the chip's fuses let it start.
        self._lib.board_start_at(self.board, start)
        self._spi_in, self._spi_out = (ctypes.create_string_buffer(_SPI_DATA) for _ in range(2))
        self._lib.board_connect(self.board, *self._callbacks, self._spi_in, self._spi_out)
        self._bytes = ctypes.create_string_buffer(_UART_OUT)
        self._ends_ps = (ctypes.c_int64 * _UART_OUT)()

    def close(self) -> None:
        """Free the chip."""
        if self.board:
            self._lib.board_free(self.board)
            self.board = None

    def reset(self, cause: int = POWER_ON, through_bootloader: bool = False) -> None:
        """Restart the program; `cause` is the value of MCUSR, behind optiboot that of r2."""
        self._lib.board_reset(self.board, 0 if through_bootloader else cause)
        if through_bootloader:
            self._lib.board_poke(self.board, _R2, cause)

    def check(self) -> None:
        """Raise the exception that a model's callback met, or CrashedError if the program ended."""
        if self._lib.board_sound(self.board):
            return
        if self.failure is not None:
            failure, self.failure = self.failure, None
            raise failure
        raise CrashedError(f"{self.program.stem} stopped at {self._lib.board_pc(self.board):#x}")

    @property
    def now_ps(self) -> int:
        """The chip's present on the bench's time line: within a step it is ahead of the bench's."""
        return int(self._lib.board_now_ps(self.board))

    def halt(self, until_ps: int) -> None:
        """Let time pass until then without a cycle."""
        self._lib.board_halt(self.board, until_ps)

    @property
    def cycle(self) -> int:
        """Cycles since the chip was made; goes on over resets."""
        return int(self._lib.board_cycle(self.board))

    @property
    def slept(self) -> int:
        """Cycles spent asleep."""
        return int(self._lib.board_slept(self.board))

    @property
    def resets(self) -> int:
        """How often it was reset, from outside or by its watchdog."""
        return int(self._lib.board_resets(self.board))

    def set_pin(self, port: str, bit: int, level: bool) -> None:
        """Drive an input pin."""
        self._lib.board_set_pin(self.board, port.encode(), bit, level)

    def pulse(self, bit: int, duration_us: int) -> None:
        """Drive an input pin of port D high for some time."""
        self._lib.board_pulse(self.board, bit, duration_us)

    def spi_data(self) -> bytes:
        """Return the bytes that followed the command since the radio was selected."""
        return self._spi_in[: max(self._lib.board_spi_count(self.board) - 1, 0)]

    def twi_answer(self, data: bytes) -> None:
        """Let the slave that was just addressed send these bytes first."""
        self._lib.board_twi_answer(self.board, data, len(data))

    def watch_line(self) -> None:
        """Have the bench end a step whenever this board's serial line changes."""
        self._lib.board_watch_line(self.board)

    def hold_sda(self, held: bool) -> None:
        """Hold the I2C data line low, or release it."""
        self._lib.board_hold_sda(self.board, held)
        self.set_pin("C", 4, not held)

    def uart_feed(self, byte: int, framing_error: bool = False) -> None:
        """Start one byte on the receive line; the program has it a byte's time later."""
        self._lib.board_uart_feed(self.board, byte, framing_error)

    @property
    def uart_baud(self) -> float:
        """The speed that the program has set."""
        cycles: int = self._lib.board_uart_cycles_per_byte(self.board)
        return 10 * self.frequency_hz / cycles if cycles else 0.0

    def uart_take(self) -> list[tuple[int, int]]:
        """Return the bytes sent since the last call: the end of each stop bit in ps, the byte."""
        count = self._lib.board_uart_take(self.board, self._bytes, self._ends_ps)
        if not count:
            return []
        return list(zip(self._ends_ps[:count], ctypes.string_at(self._bytes, count), strict=True))

    @functools.cached_property
    def symbols(self) -> dict[str, int]:
        """Addresses by name."""
        return read_symbols(self.program.with_suffix(".elf"))

    def write_variable(self, name: str, value: int, size: int) -> None:
        """Set a variable of the program."""
        start = self.symbols[name] - _SRAM_OFFSET
        for i, byte in enumerate(value.to_bytes(size, "little")):
            self._lib.board_poke(self.board, start + i, byte)

    def hang(self, function: str) -> Callable[[], None]:
        """Patch an endless loop into the start of a function; returns the way to take it out."""
        address = self.symbols[function]
        before = self._lib.board_flash_word(self.board, address)
        self._lib.board_patch_flash(self.board, address, _RJMP_TO_ITSELF)
        return lambda: self._lib.board_patch_flash(self.board, address, before)

    def _spi(self, byte: int) -> int:
        try:
            answer, data = self.on_spi(byte)
            self._spi_out[:] = data.ljust(_SPI_DATA, b"\0")
        except BaseException as error:  # noqa: BLE001 - ctypes would swallow it: raised by run()
            self._fail(error)
            return 0xFF
        return answer

    def _twi(self, event: int, byte: int) -> int:
        try:
            return self.on_twi(event, byte)
        except BaseException as error:  # noqa: BLE001 - as above
            self._fail(error)
            return 0

    def _pin(self, port: int, value: int) -> None:
        try:
            if port == ord("B"):
                self.on_port_b(value)
            elif port == ord("C"):
                self.on_turn_c(value)
            else:
                self.on_reset()
        except BaseException as error:  # noqa: BLE001 - as above
            self._fail(error)

    def _fail(self, error: BaseException) -> None:
        self.failure = self.failure or error
        self._lib.board_fail(self.board)
