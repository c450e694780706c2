"""The layout and the checksum of MAVLink frames, in compiled code."""

from typing import Any, Final

from gateway.compiled import compiled

_V2: Final = 0xFD
_OVERHEAD: Final = 12
_SIGNATURE: Final = 13
_SIGNED: Final = 1
SEQUENCE: Final = 4
"""Offset in a frame of MAVLink 2."""
TIME_SIZE: Final = 8
"""Bytes of the time before a recorded frame."""


@compiled
def crc_step(crc: int, byte: int) -> int:
    """Add one byte to a CRC-16/MCRF4XX, without a table."""
    tmp = (byte ^ crc) & 0xFF
    tmp = (tmp ^ (tmp << 4)) & 0xFF
    return (crc >> 8) ^ (tmp << 8) ^ (tmp << 3) ^ (tmp >> 4)


@compiled
def crc_holds(data: Any, begin: int, end: int, seed: int) -> bool:
    """Return whether two bytes at `end` are the checksum of the bytes from `begin` and a seed."""
    crc = 0xFFFF
    for i in range(begin, end):
        crc = crc_step(crc, int(data[i]))
    crc = crc_step(crc, seed)
    return crc == int(data[end]) | int(data[end + 1]) << 8


@compiled
def frame_size(data: Any, begin: int, end: int) -> int:
    """Return the size of a frame of MAVLink 2 that begins here and is complete, else 0."""
    if end - begin < _OVERHEAD or data[begin] != _V2 or data[begin + 2] > _SIGNED:
        return 0
    size = int(data[begin + 1]) + _OVERHEAD + _SIGNATURE * int(data[begin + 2])
    return size if size <= end - begin else 0


@compiled
def frame_key(data: Any, begin: int) -> int:
    """Return system, component and message of a frame of MAVLink 2: `MavFrame.key`."""
    key = 0
    for i in range(begin + 9, begin + 4, -1):
        key = key << 8 | int(data[i])
    return key


@compiled
def frame_holds(data: Any, begin: int, seed: int) -> bool:
    """Return whether the checksum of a complete frame of MAVLink 2 is correct."""
    return crc_holds(data, begin + 1, begin + int(data[begin + 1]) + _OVERHEAD - 2, seed)
