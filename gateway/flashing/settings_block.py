"""The settings block of a firmware image: where it is, its layout and its checksum.

The block is 34 bytes of the program that begin with the word `mavgate` and end with a CRC-16 of all
before it, little-endian and packed. `firmware/common/settings_block.h` is the other side.
"""

import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Annotated, Final, Literal

import msgspec

from gateway.settings import Settings, setting
from gateway.wire.framing import crc16
from gateway.wire.payloads import ACCEL_RANGES_G, GYRO_RANGES_DPS, PIPES

MAGIC: Final = b"mavgate"
VERSION: Final = 1
POWERS_DBM: Final = (-18, -12, -6, 0)

_LAYOUT: Final = struct.Struct("<7s9BH2BI6B2x")
_CRC: Final = struct.Struct("<H")
SIZE: Final = _LAYOUT.size + _CRC.size
PIPES_PER_VEHICLE: Final = 2


class SettingsBlockError(ValueError):
    """An image without a settings block, or with one that cannot be used; the text says why."""


class Program(IntEnum):
    """Which of the three programs an image is."""

    IMU = 1
    GPS = 2
    RECEIVER = 3


class BoardSettings(Settings, frozen=True):
    """What differs between users, in the order of the block."""

    vehicle_id: Annotated[int, setting("MAVLink system id of the aircraft.", ge=1, le=31)] = 1
    node_id: Annotated[int, setting("Unique within the aircraft.", ge=0, le=7)] = 0
    radio_pipe: Annotated[int, setting("The receiver's pipe that a node sends to.", ge=0, le=5)] = 0
    radio_channel: Annotated[
        int, setting("2400 MHz plus this; the same on all boards.", "MHz", ge=0, le=125)
    ] = 76
    radio_kbps: Annotated[
        Literal[250, 1000, 2000], setting("On the air; the same on all boards.", "kbit/s")
    ] = 1000
    radio_power_dbm: Annotated[Literal[-18, -12, -6, 0], setting("Of the transmitter.", "dBm")] = 0
    imu_send_hz: Annotated[int, setting("IMU samples sent per second.", "Hz", ge=60, le=250)] = 100
    radio_address: Annotated[
        int, setting("Upper four bytes of every pipe's address.", ge=0, le=0xFFFFFFFF)
    ] = 0xD35AC396
    imu_raw: Annotated[bool, setting("Means without the node's filters.")] = False
    accel_range_g: Annotated[Literal[2, 4, 8, 16], setting("Of the accelerometer.", "g")] = 8
    gyro_range_dps: Annotated[
        Literal[250, 500, 1000, 2000], setting("Of the gyroscope.", "deg/s")
    ] = 1000
    gps_rate_hz: Annotated[int, setting("GPS fixes per second.", "Hz", ge=1, le=10)] = 5
    gps_dynamic_model: Annotated[
        int, setting("UBX-CFG-NAV5: 6, 7, 8 are airborne below 1, 2, 4 g.", ge=0, le=10)
    ] = 8
    soft_restart: Annotated[
        bool, setting("For a bootloader that leaves the watchdog on: restart without a reset.")
    ] = False


COMMON: Final = ("radio_channel", "radio_kbps", "radio_address", "radio_power_dbm", "soft_restart")
NODE: Final = ("vehicle_id", "node_id", "radio_pipe", *COMMON)
USED_BY: Final[dict[Program, tuple[str, ...]]] = {
    Program.IMU: (*NODE, "imu_send_hz", "imu_raw", "accel_range_g", "gyro_range_dps"),
    Program.GPS: (*NODE, "gps_rate_hz", "gps_dynamic_model"),
    Program.RECEIVER: COMMON,
}
"""The settings that each program reads."""


@dataclass(frozen=True, slots=True)
class SettingsBlock:
    """A settings block that was found in an image."""

    offset: int
    """Its first byte in the image."""
    program: Program
    clock_mhz: int
    firmware_version: tuple[int, int]
    settings: BoardSettings


def default_pipe(program: Program, vehicle_id: int) -> int:
    """Return the receiver's pipe of a node: two for each of three vehicles, then shared."""
    return ((vehicle_id - 1) * PIPES_PER_VEHICLE + (program is Program.GPS)) % PIPES


def find_block(image: bytes) -> SettingsBlock:
    """Find and decode the settings block of an image.

    Parameters
    ----------
    image : bytes
        A program, or all that was read from a chip.

    Returns
    -------
    SettingsBlock

    Raises
    ------
    SettingsBlockError
        If there is none, or one that is damaged, of another version or out of range.
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
        raise SettingsBlockError(f"the settings block at {damaged:#x} is damaged (CRC)")
    raise SettingsBlockError("no settings block: not a mavgate program, or one before version 1.1")


def patch(image: bytes, settings: BoardSettings) -> tuple[int, bytes]:
    """Return the offset and the new bytes of an image's settings block.

    Raises
    ------
    SettingsBlockError
        As `find_block`.
    """
    block = find_block(image)
    return block.offset, _encode(block, settings)


def _decode(block: bytes, offset: int) -> SettingsBlock:
    values = _LAYOUT.unpack(block[: _LAYOUT.size])
    version, program, clock_mhz, major, minor = values[1:6]
    if version != VERSION:
        raise SettingsBlockError(
            f"the settings block has version {version}, this mavgate knows {VERSION}"
        )
    names = BoardSettings.__struct_fields__
    found = dict(zip(names, values[6:], strict=True))
    try:
        found["radio_power_dbm"] = POWERS_DBM[found["radio_power_dbm"]]
        found["accel_range_g"] = round(ACCEL_RANGES_G[found["accel_range_g"]])
        found["gyro_range_dps"] = round(GYRO_RANGES_DPS[found["gyro_range_dps"]])
        for name in ("imu_raw", "soft_restart"):
            found[name] = bool(found[name])
        settings = msgspec.convert(found, BoardSettings)
        kind = Program(program)
    except (IndexError, ValueError) as error:
        raise SettingsBlockError(f"the settings block holds a value out of range: {error}") from (
            error
        )
    return SettingsBlock(offset, kind, clock_mhz, (major, minor), settings)


def _encode(block: SettingsBlock, settings: BoardSettings) -> bytes:
    found = msgspec.to_builtins(settings)
    found["radio_power_dbm"] = POWERS_DBM.index(settings.radio_power_dbm)
    found["accel_range_g"] = ACCEL_RANGES_G.index(settings.accel_range_g)
    found["gyro_range_dps"] = GYRO_RANGES_DPS.index(settings.gyro_range_dps)
    head = (VERSION, block.program, block.clock_mhz, *block.firmware_version)
    content = _LAYOUT.pack(MAGIC, *head, *found.values())
    return content + _CRC.pack(crc16(content))
