"""The settings block: found, decoded, patched and refused."""

import io
import itertools
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from intelhex import IntelHex

from gateway.flashing.boards import (
    MAGIC,
    RADIOS,
    SIZE,
    BoardSettings,
    FlashError,
    Program,
    default_pipe,
    find_block,
    used_by,
    with_settings,
)
from gateway.wire.framing import crc16

HEAD = "01 10 01 02 05 03 02 50 fa00 01 3c 04030201 01 03 00 0a 06 01 0000"
"""Program, MHz, firmware 1.2, and the fields up to those of LoRa."""
LORA = "01 7aa10600 f401 09 08 11 34 01"
BLOCK = MAGIC + b"\x01" + bytes.fromhex(HEAD + LORA)
NRF24_BLOCK = MAGIC + b"\x01" + bytes.fromhex(HEAD + "00" + LORA[2:])
"""Written by hand from firmware/common/settings_block.h."""
SETTINGS = BoardSettings(
    vehicle_id=5,
    node_id=3,
    radio_pipe=2,
    radio_channel=80,
    radio_kbps=250,
    radio_power_dbm=-12,
    imu_send_hz=60,
    radio_address=0x01020304,
    imu_raw=True,
    accel_range_g=16,
    gyro_range_dps=250,
    gps_rate_hz=10,
    gps_dynamic_model=6,
    soft_restart=True,
    radio="sx1276",
    lora_frequency_khz=434_554,
    lora_bandwidth_khz=500,
    lora_spreading=9,
    lora_coding=8,
    lora_power_dbm=17,
    lora_sync_word=0x34,
    lora_foreign=True,
)


def with_crc(block: bytes) -> bytes:
    return block + crc16(block).to_bytes(2, "little")


def image_with(block: bytes) -> bytes:
    return b"\x0c\x94" * 52 + block + b"\xff" * 300


def test_block_is_found_and_every_field_decoded() -> None:
    found = find_block(image_with(with_crc(BLOCK)))
    assert (found.offset, found.program) == (104, Program.IMU)
    assert (found.clock_mhz, found.firmware_version) == (16, (1, 2))
    assert found.settings == SETTINGS


def values_of(kind: Any) -> st.SearchStrategy[Any]:
    """Return the valid values of a field."""
    kind = getattr(kind, "type", kind)
    if isinstance(kind, msgspec.inspect.LiteralType):
        return st.sampled_from(kind.values)
    is_number = isinstance(kind, msgspec.inspect.IntType)
    return st.integers(kind.ge, kind.le) if is_number else st.booleans()


BLOCK_TYPE: Any = msgspec.inspect.type_info(BoardSettings)


@given(st.builds(BoardSettings, **{each.name: values_of(each.type) for each in BLOCK_TYPE.fields}))
def test_any_settings_change_the_block_alone_and_read_back(settings: BoardSettings) -> None:
    before = image_with(with_crc(BLOCK))
    image = IntelHex()
    image.frombytes(before)
    written = IntelHex(io.StringIO(with_settings(image, settings).decode())).tobinstr()
    assert (written[:104], written[104 + SIZE :]) == (before[:104], before[104 + SIZE :])
    found = find_block(written)
    assert (found.settings, found.firmware_version) == (settings, (1, 2))


def test_any_damaged_byte_is_detected() -> None:
    block = with_crc(BLOCK)
    for place in range(SIZE):
        damaged = bytearray(block)
        damaged[place] ^= 0x10
        with pytest.raises(FlashError, match=r"damaged|no settings block"):
            find_block(image_with(bytes(damaged)))


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (b"", "no settings block"),
        (b"\xff" * 32768, "no settings block"),
        (MAGIC, "damaged"),
        (with_crc(BLOCK[:7] + b"\x03" + BLOCK[8:]), "version 3"),
        (with_crc(BLOCK[:8] + b"\x09" + BLOCK[9:]), "out of range"),
        (with_crc(BLOCK[:12] + b"\x20" + BLOCK[13:]), "out of range"),
        (with_crc(BLOCK[:18] + b"\x04" + BLOCK[19:]), "out of range"),
    ],
    ids=["empty", "erased", "cut", "version", "program", "vehicle", "power"],
)
def test_unusable_block_is_refused_with_the_reason(image: bytes, message: str) -> None:
    with pytest.raises(FlashError, match=message):
        find_block(image)


def test_magic_word_elsewhere_does_not_hide_the_block() -> None:
    image = b"see mavgate.example " + image_with(with_crc(BLOCK))
    assert find_block(image).settings == SETTINGS


def test_pipes_of_three_vehicles_differ() -> None:
    kinds = (Program.IMU, Program.GPS)
    pipes = [default_pipe(kind, vehicle) for vehicle in (1, 2, 3) for kind in kinds]
    assert pipes == [0, 1, 2, 3, 4, 5]
    assert {default_pipe(kind, n) for kind, n in itertools.product(kinds, range(1, 32))} == {*pipes}


def test_every_setting_is_used_by_a_program() -> None:
    used = {name for pair in itertools.product(Program, RADIOS) for name in used_by(*pair)}
    assert used | {"radio"} == {field.name for field in msgspec.structs.fields(BoardSettings)}
