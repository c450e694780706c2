"""Firmware of the boards: settings in an image, and reading and writing flash with avrdude.

The settings block is 46 bytes of the program, little-endian and packed, which begin with the word
`mavgate` and end with a CRC-16 of all bytes before it. `firmware/common/settings_block.h` is its
counterpart. Every access resets the board, since opening the port resets it by the USB adapter.
"""

import contextlib
import fcntl
import io
import os
import shutil
import struct
import subprocess
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import msgspec
import serial
from intelhex import HexReaderError, IntelHex

from gateway.live.serial_port import list_serial_ports, why_not_open
from gateway.settings import Settings, setting
from gateway.wire.framing import crc16
from gateway.wire.payloads import ACCEL_RANGES_G, GYRO_RANGES_DPS, PIPES

MAGIC: Final = b"mavgate"
VERSION: Final = 1
POWERS_DBM: Final = (-18, -12, -6, 0)

_LAYOUT: Final = struct.Struct("<7s9BH2BI6B2xBIH5B")
_CRC: Final = struct.Struct("<H")
SIZE: Final = _LAYOUT.size + _CRC.size
PIPES_PER_VEHICLE: Final = 2
Radio = Literal["nrf24", "sx1276"]
RADIOS: Final[tuple[Radio, ...]] = get_args(Radio)
NRF24: Final = ("radio_channel", "radio_kbps", "radio_address", "radio_power_dbm")
SX1276: Final = (
    "lora_frequency_khz",
    "lora_bandwidth_khz",
    "lora_spreading",
    "lora_coding",
    "lora_power_dbm",
    "lora_sync_word",
)
CODED: Final[dict[str, tuple[Any, ...]]] = {
    "radio": RADIOS,
    "radio_power_dbm": POWERS_DBM,
    "accel_range_g": ACCEL_RANGES_G,
    "gyro_range_dps": GYRO_RANGES_DPS,
    **dict.fromkeys(("imu_raw", "soft_restart", "lora_foreign"), (False, True)),
}
"""Settings of which the block contains the position among these values."""
_NODE: Final = ("vehicle_id", "node_id", "radio_pipe", "soft_restart")
IMU_SEND_HZ: Final[dict[Radio, tuple[int, int]]] = {"nrf24": (60, 250), "sx1276": (4, 20)}
"""Minimum and maximum number of IMU samples per second, by radio."""
IMAGES: Final = Path(__file__).resolve().parent / "images"
"""Images in the package, which `make firmware` builds."""
CLOCKS_MHZ: Final = (16, 8)
CHIP: Final = "atmega328p"
GET_SYNC: Final = b"\x30\x20"
IN_SYNC: Final = b"\x14\x10"
"""Answer of a bootloader to the synchronisation request of STK500 version 1."""
RESET_PULSE_S: Final = 0.05
SYNC_TRIES: Final = 12
SYNC_WAIT_S: Final = 0.1
"""Timeout of one request; optiboot flashes its LED for 0.3 s, then waits 1 s for a request."""
AVRDUDE_LIMIT_S: Final = 90.0
"""Timeout of one try, which takes 20 s: after a lost byte avrdude may wait for ever."""
AVRDUDE_TRIES: Final = 3
"""Number of tries: a board that restarts slowly can miss the first requests."""


class FlashError(Exception):
    """A board or an image that cannot be used; the text states the reason and the remedy."""


class Program(IntEnum):
    """The board that an image is for, by its number in the settings block."""

    IMU = 1
    GPS = 2
    RECEIVER = 3


class BoardSettings(Settings, frozen=True):
    """Settings that differ between users, in the order of the block."""

    vehicle_id: Annotated[int, setting("MAVLink system id of the aircraft.", ge=1, le=31)] = 1
    node_id: Annotated[int, setting("Unique within the aircraft.", ge=0, le=7)] = 0
    radio_pipe: Annotated[int, setting("The receiver's pipe that a node sends to.", ge=0, le=5)] = 0
    radio_channel: Annotated[
        int, setting("2400 MHz plus this; the same on all boards.", "MHz", ge=0, le=125)
    ] = 76
    radio_kbps: Annotated[
        Literal[250, 1000, 2000], setting("Data rate on air; the same on all boards.", "kbit/s")
    ] = 1000
    radio_power_dbm: Annotated[Literal[-18, -12, -6, 0], setting("Transmit power.", "dBm")] = 0
    imu_send_hz: Annotated[
        int, setting("IMU samples sent per second; by LoRa at most 20.", "Hz", ge=4, le=250)
    ] = 100
    radio_address: Annotated[
        int, setting("Upper four bytes of every pipe's address.", ge=0, le=0xFFFFFFFF)
    ] = 0xD35AC396
    imu_raw: Annotated[bool, setting("Send averages without the node's filters.")] = False
    accel_range_g: Annotated[Literal[2, 4, 8, 16], setting("Range of the accelerometer.", "g")] = 8
    gyro_range_dps: Annotated[
        Literal[250, 500, 1000, 2000], setting("Range of the gyroscope.", "deg/s")
    ] = 1000
    gps_rate_hz: Annotated[int, setting("GPS fixes per second.", "Hz", ge=1, le=10)] = 5
    gps_dynamic_model: Annotated[
        int, setting("UBX-CFG-NAV5: 6, 7, 8 are airborne below 1, 2, 4 g.", ge=0, le=10)
    ] = 8
    soft_restart: Annotated[
        bool, setting("For a bootloader that leaves the watchdog on: restart without a reset.")
    ] = False
    radio: Annotated[Radio, setting("The radio that the image is built for.")] = "nrf24"
    lora_frequency_khz: Annotated[
        int,
        setting("Centre of the channel; the same on all boards.", "kHz", ge=433_050, le=928_000),
    ] = 868_300
    lora_bandwidth_khz: Annotated[
        Literal[125, 250, 500], setting("Bandwidth of the channel; the same on all boards.", "kHz")
    ] = 250
    lora_spreading: Annotated[
        int, setting("Spreading factor; the same on all boards.", ge=7, le=10)
    ] = 7
    lora_coding: Annotated[int, setting("Coding rate 4/5 to 4/8: 5 to 8.", ge=5, le=8)] = 5
    lora_power_dbm: Annotated[int, setting("Transmit power.", "dBm", ge=2, le=20)] = 14
    lora_sync_word: Annotated[
        int, setting("Sync word of the network; the same on all boards.", ge=0, le=0xFF)
    ] = 0x12
    lora_foreign: Annotated[
        bool, setting("The receiver passes packets of other programs on, as RadioHead's.")
    ] = False


_OF_PROGRAM: Final[dict[Program, tuple[str, ...]]] = {
    Program.IMU: (*_NODE, "imu_send_hz", "accel_range_g", "gyro_range_dps"),
    Program.GPS: (*_NODE, "gps_rate_hz", "gps_dynamic_model"),
    Program.RECEIVER: ("soft_restart",),
}


def used_by(program: Program, radio: Radio) -> tuple[str, ...]:
    """Return the names of the settings that a program reads."""
    names = (*_OF_PROGRAM[program], *(NRF24 if radio == "nrf24" else SX1276))
    if radio == "nrf24" and program is Program.IMU:
        return (*names, "imu_raw")
    return (*names, "lora_foreign") if (program, radio) == (Program.RECEIVER, "sx1276") else names


@dataclass(frozen=True, slots=True)
class SettingsBlock:
    """A settings block found in an image."""

    offset: int
    """Offset of its first byte in the image."""
    program: Program
    clock_mhz: int
    firmware_version: tuple[int, int]
    settings: BoardSettings


def default_pipe(program: Program, vehicle_id: int) -> int:
    """Return a node's default pipe at the receiver: two for each of three vehicles, then shared."""
    return ((vehicle_id - 1) * PIPES_PER_VEHICLE + (program is Program.GPS)) % PIPES


def find_block(image: bytes) -> SettingsBlock:
    """Find and decode the settings block in a program, or in a whole flash memory.

    Raises FlashError if there is none, or it is damaged, of another version or out of range.
    """
    damaged = None
    offset = image.find(MAGIC)
    while offset >= 0:
        block = image[offset : offset + SIZE]
        if len(block) == SIZE and _CRC.unpack(block[-2:])[0] == crc16(block[:-2]):
            return _decode(block, offset)
        damaged = offset if damaged is None else damaged
        offset = image.find(MAGIC, offset + 1)
    if damaged is not None:
        raise FlashError(f"the settings block at {damaged:#x} is damaged (CRC)")
    raise FlashError("no settings block: not a mavgate program")


def _decode(block: bytes, offset: int) -> SettingsBlock:
    values = _LAYOUT.unpack(block[: _LAYOUT.size])
    version, program, clock_mhz, major, minor = values[1:6]
    if version != VERSION:
        text = f"the settings block has version {version}; this mavgate reads {VERSION}"
        raise FlashError(f"{text}: use a newer one")
    found = dict(zip(BoardSettings.__struct_fields__, values[6:], strict=True))
    try:
        found |= {name: values[found[name]] for name, values in CODED.items()}
        settings = msgspec.convert(found, BoardSettings)
        kind = Program(program)
    except (IndexError, ValueError) as error:
        raise FlashError(f"the settings block contains a value out of range: {error}") from (error)
    return SettingsBlock(offset, kind, clock_mhz, (major, minor), settings)


@dataclass(frozen=True, slots=True)
class Bootloader:
    """A type of bootloader, identified by its bit rate."""

    name: str
    baud: int
    leaves_watchdog_on: bool
    """Whether a reset by the watchdog would repeat for ever with this bootloader."""


BOOTLOADERS: Final = (
    Bootloader("optiboot (new)", 115_200, leaves_watchdog_on=False),
    Bootloader("ATmegaBOOT (old)", 57_600, leaves_watchdog_on=True),
)


def image_path(program: Program, clock_mhz: int, radio: Radio = "nrf24") -> Path:
    """Return the file of a ready-made image; raises FlashError if it has not been built."""
    name = program.name.lower() if radio == "nrf24" else f"{program.name.lower()}_{radio}"
    path = IMAGES / f"{name}_{clock_mhz}mhz.hex"
    if not path.exists():
        raise FlashError(
            f"{path} does not exist: in a checkout, build the images first with `make firmware`"
        )
    return path


def read_image(path: Path) -> IntelHex:
    """Read an Intel HEX file; raises FlashError if it is invalid."""
    try:
        return IntelHex(str(path))
    except (OSError, HexReaderError, UnicodeDecodeError) as error:
        raise FlashError(f"{path}: {error}") from error


def block_of(image: IntelHex) -> SettingsBlock:
    """Find the settings block of an image; raises as `find_block`."""
    return find_block(image.tobinstr(start=0))


def with_settings(image: IntelHex, settings: BoardSettings) -> bytes:
    """Return an image with other settings, as an Intel HEX file."""
    block = block_of(image)
    found = msgspec.to_builtins(settings)
    found |= {name: values.index(found[name]) for name, values in CODED.items()}
    head = (VERSION, block.program, block.clock_mhz, *block.firmware_version)
    content = _LAYOUT.pack(MAGIC, *head, *found.values())
    image.puts(block.offset, content + _CRC.pack(crc16(content)))
    text = io.StringIO()
    image.write_hex_file(text)
    return text.getvalue().encode("ascii")


@contextlib.contextmanager
def reserved(device: str) -> Iterator[None]:
    """Lock a port for this program; a running gateway respects the lock, avrdude does not.

    Raises FlashError if it cannot be opened, or another program has locked it.
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
            f"{device}: another program has it open; stop the gateway that reads it, or give "
            "another port with --port"
        ) from error
    finally:
        os.close(file)


def find_bootloader(device: str) -> Bootloader | None:
    """Reset a board and query its bootloader at each bit rate; None if there is no response.

    Raises FlashError if the port cannot be opened.
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
        received = b""
        for _ in range(SYNC_TRIES):
            port.write(GET_SYNC)
            received = (received + port.read(64))[-64:]
            if IN_SYNC in received:
                return True
    return False


def require_bootloader(device: str) -> Bootloader:
    """Return a board's bootloader; raises FlashError if none responds."""
    found = find_bootloader(device)
    if found is None:
        raise FlashError(
            f"{device}: no bootloader responds. Is it a Nano or Pro Mini with ATmega328P? "
            "Disconnect the GPS receiver from D0 and D1 while flashing; on a board without "
            "automatic reset, press reset as the command starts. A board without a bootloader "
            "needs an ISP programmer: write the image with --output and avrdude -c usbasp"
        )
    return found


def write_flash(device: str, bootloader: Bootloader, image: bytes) -> None:
    """Write an Intel HEX file, and verify it; raises FlashError if avrdude is missing or fails."""
    with tempfile.NamedTemporaryFile(suffix=".hex") as file:
        file.write(image)
        file.flush()
        _avrdude(device, bootloader, "-D", "-U", f"flash:w:{file.name}:i")


def read_flash(device: str, bootloader: Bootloader) -> IntelHex:
    """Read the whole flash memory of a board; raises FlashError as `write_flash`."""
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
            if subprocess.run(command, check=False, timeout=AVRDUDE_LIMIT_S).returncode == 0:
                return
        except subprocess.TimeoutExpired:
            continue
    raise FlashError(
        f"{device}: avrdude failed {AVRDUDE_TRIES} times, see above, or took over "
        f"{AVRDUDE_LIMIT_S:.0f} s; use a short USB cable, and disconnect everything else from D0 "
        "and D1"
    )
