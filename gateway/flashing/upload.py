"""A board's bootloader, and `avrdude`, which writes and reads the chip's flash through it.

Every access resets the board: its USB adapter does so whenever a program opens the port.
"""

import contextlib
import fcntl
import io
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import serial
from intelhex import HexReaderError, IntelHex

from gateway.flashing.settings_block import (
    BoardSettings,
    Program,
    SettingsBlock,
    SettingsBlockError,
    find_block,
    patch,
)
from gateway.live.serial_port import list_serial_ports, why_not_open

IMAGES: Final = Path(__file__).resolve().parent / "images"
"""Built by `make firmware`, part of the package."""
CLOCKS_MHZ: Final = (16, 8)
CHIP: Final = "atmega328p"

GET_SYNC: Final = b"\x30\x20"
IN_SYNC: Final = b"\x14\x10"
"""STK500 version 1: the request, and the answer of a bootloader."""
RESET_PULSE_S: Final = 0.05
SYNC_TRIES: Final = 12
SYNC_WAIT_S: Final = 0.1
"""Optiboot flashes its LED for 0.3 s before it listens, and waits 1 s for a request."""
AVRDUDE_LIMIT_S: Final = 180.0
AVRDUDE_TRIES: Final = 3
"""A board that restarts slowly can miss the first requests."""


class FlashError(Exception):
    """A board that cannot be flashed or read; the text says why, and what to do."""


@dataclass(frozen=True, slots=True)
class Bootloader:
    """A kind of bootloader, known by the speed at which it answers."""

    name: str
    baud: int
    leaves_watchdog_on: bool
    """After a reset by the watchdog it would be reset again for ever."""


BOOTLOADERS: Final = (
    Bootloader("optiboot (new)", 115_200, leaves_watchdog_on=False),
    Bootloader("ATmegaBOOT (old)", 57_600, leaves_watchdog_on=True),
)


def image_path(program: Program, clock_mhz: int) -> Path:
    """Return the file of a ready-made image.

    Raises
    ------
    FlashError
        If it has not been built.
    """
    path = IMAGES / f"{program.name.lower()}_{clock_mhz}mhz.hex"
    if not path.exists():
        raise FlashError(
            f"{path} is not there: a checkout has to build the images first, `make firmware`"
        )
    return path


def read_image(path: Path) -> IntelHex:
    """Read an Intel HEX file; raises FlashError if it cannot be."""
    try:
        return IntelHex(str(path))
    except (OSError, HexReaderError, UnicodeDecodeError) as error:
        raise FlashError(f"{path}: {error}") from error


def block_of(image: IntelHex) -> SettingsBlock:
    """Find the settings block of an image; raises FlashError if there is none to use."""
    try:
        return find_block(image.tobinstr(start=0))
    except SettingsBlockError as error:
        raise FlashError(str(error)) from error


def with_settings(image: IntelHex, settings: BoardSettings) -> bytes:
    """Return an image as an Intel HEX file, with other settings in it."""
    offset, block = patch(image.tobinstr(start=0), settings)
    image.puts(offset, block)
    text = io.StringIO()
    image.write_hex_file(text)
    return text.getvalue().encode("ascii")


@contextlib.contextmanager
def reserved(device: str) -> Iterator[None]:
    """Keep a port for this program, which a running gateway respects, and avrdude does not.

    Raises
    ------
    FlashError
        If it cannot be opened, or another program has it.
    """
    try:
        file = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError as error:
        raise FlashError(f"{device}: {why_not_open(error, list_serial_ports())}") from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    except BlockingIOError as error:
        raise FlashError(
            f"{device}: another program has it open; end the gateway that reads it, or name "
            "another port with --port"
        ) from error
    finally:
        os.close(file)


def find_bootloader(device: str) -> Bootloader | None:
    """Reset a board and ask its bootloader, at one speed after the other; None if none answers.

    Raises
    ------
    FlashError
        If the port cannot be opened.
    """
    try:
        return next((loader for loader in BOOTLOADERS if _answers(device, loader.baud)), None)
    except (OSError, ValueError) as error:
        raise FlashError(f"{device}: {why_not_open(error, list_serial_ports())}") from error


def _answers(device: str, baud: int) -> bool:
    with serial.Serial(device, baud, timeout=SYNC_WAIT_S, write_timeout=1.0) as port:
        for level in (False, True):
            with contextlib.suppress(OSError):  # a port without these lines
                port.dtr = port.rts = level
            time.sleep(RESET_PULSE_S)
        port.reset_input_buffer()
        heard = b""
        for _ in range(SYNC_TRIES):
            port.write(GET_SYNC)
            heard = (heard + port.read(64))[-64:]
            if IN_SYNC in heard:
                return True
    return False


def require_bootloader(device: str) -> Bootloader:
    """Return a board's bootloader; raises FlashError if none answers."""
    found = find_bootloader(device)
    if found is None:
        raise FlashError(
            f"{device}: no bootloader answers. Is it a Nano or Pro Mini with ATmega328P? "
            "Disconnect the GPS receiver from D0 and D1 while flashing; on a board without "
            "automatic reset, press reset as the command starts. A board without a bootloader "
            "needs an ISP programmer: write the image with --output and avrdude -c usbasp"
        )
    return found


def write_flash(device: str, bootloader: Bootloader, image: bytes) -> None:
    """Write an Intel HEX file to a board and verify it; avrdude shows the progress.

    Raises
    ------
    FlashError
        If avrdude is not installed or fails.
    """
    with tempfile.NamedTemporaryFile(suffix=".hex") as file:
        file.write(image)
        file.flush()
        _avrdude(device, bootloader, "-D", "-U", f"flash:w:{file.name}:i")


def read_flash(device: str, bootloader: Bootloader) -> IntelHex:
    """Read all of a board's flash; raises FlashError as `write_flash`."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "flash.hex"
        _avrdude(device, bootloader, "-U", f"flash:r:{path}:i")
        return read_image(path)


def _avrdude(device: str, bootloader: Bootloader, *what: str) -> None:
    program = shutil.which("avrdude")
    if program is None:
        raise FlashError("avrdude is not installed: sudo apt-get install avrdude")
    speed = ("-b", str(bootloader.baud))
    command = [program, "-c", "arduino", "-p", CHIP, "-P", device, *speed, *what]
    for _ in range(AVRDUDE_TRIES):
        try:
            code = subprocess.run(command, check=False, timeout=AVRDUDE_LIMIT_S).returncode
        except subprocess.TimeoutExpired as error:
            raise FlashError(f"{device}: avrdude took over {AVRDUDE_LIMIT_S:.0f} s") from error
        if code == 0:
            return
    raise FlashError(
        f"{device}: avrdude failed {AVRDUDE_TRIES} times, see above; use a short USB cable, and "
        "disconnect everything else from D0 and D1"
    )
