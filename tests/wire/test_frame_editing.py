"""Edited frames, read back by pymavlink, which checks their checksums and signatures."""

import struct
from functools import partial
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.frame_editing import edit_frame, renumbered
from gateway.wire.mavlink_messages import CRC_EXTRA, MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_signing import signature
from gateway.wire.mavlink_splitter import MavFrame, frame_of, to_mavlink1
from tests.kit.mavlink import KEY, frames_in, packed, read_back

ATTITUDE = mavlink.MAVLink_attitude_message(5, 0.5, 0, 0, 0, 0, 0.25)
POSITION = mavlink.MAVLink_global_position_int_message(7, 470000000, 85000000, 9, 8, 1, 2, 3, 0)
TEXT = mavlink.MAVLink_statustext_message(4, b"Armed by system 255")
BATTERY = mavlink.MAVLink_battery_status_message(0, 0, 0, 0, [4200] * 10, 100, 1, 1, 50)
COMMAND = mavlink.MAVLink_command_long_message(9, 3, 400, 0, 1, 0, 0, 0, 0, 0, 7)
SIGNING = (KEY, 3, 123_456)
UNKNOWN = frame_of(b"\xfd\x02\x00\x00\x05\x07\x01\xff\xff\x7f\x01\x02\xaa\xbb")


def frame(message: Any, version: int = 2, *, signed: bool = False) -> MavFrame:
    return frame_of(packed(message, version=version, signing=SIGNING if signed else None))


def read(edited: MavFrame | None, key: bytes | None = None) -> Any:
    """Read a frame back; raises if the checksum, the signature or the header's copy is wrong."""
    assert edited is not None
    assert frame_of(edited.data) == edited
    return read_back(edited.data, key)


@pytest.mark.parametrize(
    "changes",
    [
        *({"sequence": 200}, {"system": 42}),
        {"sequence": 255, "system": 250},
    ],
    ids=str,
)
@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("message", [ATTITUDE, COMMAND, TEXT])
def test_header_fields_change_alone(message: Any, version: int, changes: dict[str, int]) -> None:
    before = frame(message, version)
    edited = edit_frame(before, **changes)
    got, was = read(edited), read(before)
    assert got.to_dict() == was.to_dict()
    header = {"sequence": was.get_seq(), "system": 1} | changes
    assert (got.get_seq(), got.get_srcSystem()) == (*header.values(),)
    assert got.get_srcComponent() == was.get_srcComponent()
    assert edit_frame(edited, sequence=0, system=1) == before
    if "sequence" in changes:
        assert renumbered(edited, 7) == edit_frame(edited, sequence=7)


FIELDS: dict[str, tuple[Any, dict[str, Any], dict[str, Any]]] = {
    "numbers": (POSITION, {"lat": -1, "lon": 2}, {}),
    "zero": (POSITION, {"lat": 0, "lon": 0}, {}),
    "cut off": (ATTITUDE, {"pitchspeed": 1.5}, {}),
    "beyond the cut": (mavlink.MAVLink_ping_message(0, 0, 0, 0), {"target_component": 9}, {}),
    "last": (ATTITUDE, {"yawspeed": 0.0}, {}),
    "text": (TEXT, {"text": "anonymous"}, {}),
    "bytes": (TEXT, {"text": b"abc"}, {"text": "abc"}),
    "array": (BATTERY, {"voltages": list(range(10))}, {}),
    "one number for an array": (BATTERY, {"voltages": 5}, {"voltages": [5] * 10}),
    "target": (COMMAND, {"target_system": 8}, {}),
}


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("name", FIELDS)
def test_payload_fields_change_alone(name: str, version: int) -> None:
    message, fields, differs = FIELDS[name]
    before = frame(message, version)
    edited = edit_frame(before, fields=fields)
    assert read(edited).to_dict() == read(before).to_dict() | fields | differs
    assert edited is not None
    assert frames_in(edited.data) == [edited.data]


def test_extension_field_is_added_in_version_2_and_skipped_in_version_1() -> None:
    fields = {"id": 7, "chunk_seq": 2}
    before = frame(TEXT)
    assert read(edit_frame(before, fields=fields)).to_dict() == read(before).to_dict() | fields
    old = frame_of(to_mavlink1(before.data) or b"")
    assert edit_frame(old, fields=fields) == old


def test_bytes_of_other_fields_are_preserved() -> None:
    """A signalling NaN is another one after a conversion to a Python float and back."""
    data = bytearray(packed(mavlink.MAVLink_param_value_message(b"COUNT", 1.0, 6, 3, 900)))
    data[10:14] = struct.pack("<I", 0x7FA00001)
    edited = edit_frame(frame_of(bytes(data)), fields={"param_index": 0})
    assert edited is not None
    assert edited.data[10:14] == data[10:14]


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"latitude": 1}, "GLOBAL_POSITION_INT has no field latitude"),
        ({"lat": 1 << 40}, "GLOBAL_POSITION_INT.lat: 1099511627776"),
        ({"lat": float("nan")}, "GLOBAL_POSITION_INT.lat: nan"),
        ({"lat": "north"}, "GLOBAL_POSITION_INT.lat: 'north'"),
        ({"lat": [1, 2]}, r"GLOBAL_POSITION_INT.lat: \[1, 2\]"),
    ],
)
def test_field_that_is_absent_or_too_large_is_an_error(fields: dict[str, Any], error: str) -> None:
    with pytest.raises(ValueError, match=error):
        edit_frame(frame(POSITION), fields=fields)


class TestSignature:
    def test_signed_frame_is_not_edited_without_a_decision(self) -> None:
        signed = frame(ATTITUDE, signed=True)
        assert edit_frame(signed, sequence=3) is None
        assert renumbered(signed, 3) is signed

    def test_dropped_signature_leaves_an_unsigned_frame(self) -> None:
        edited = edit_frame(frame(ATTITUDE, signed=True), system=42, drop_signature=True)
        assert edited == edit_frame(frame(ATTITUDE), system=42)
        assert not read(edited).get_signed()

    @pytest.mark.parametrize("was_signed", [False, True])
    def test_edited_frame_is_signed(self, was_signed: bool) -> None:
        sign = partial(signature, KEY, 7, 200_000)
        edited = edit_frame(frame(ATTITUDE, signed=was_signed), fields={"roll": 1.0}, sign=sign)
        assert read(edited, KEY).get_signed()
        assert edited is not None
        assert edited.data[-13:-6] == bytes((7,)) + (200_000).to_bytes(6, "little")

    def test_version_1_is_edited_and_not_signed(self) -> None:
        edited = edit_frame(frame(ATTITUDE, 1), sequence=9, sign=partial(signature, KEY, 7, 1))
        assert (read(edited).get_seq(), read(edited).get_signed()) == (9, False)


def test_unknown_message_is_not_edited() -> None:
    for drop_signature in (False, True):
        assert edit_frame(UNKNOWN, system=9, drop_signature=drop_signature) is None


def test_layouts_have_the_offsets_of_the_dialect() -> None:
    for message_id, kind in mavlink.mavlink_map.items():
        layout = layout_of(message_id)
        assert layout.itemsize == kind.unpacker.size, kind.msgname
        assert list(layout.names or ()) == kind.ordered_fieldnames, kind.msgname


@pytest.mark.parametrize("message_id", [300, 397, 512])
def test_layout_of_a_missing_message_gives_its_checksum_seed(message_id: int) -> None:
    types = {"|u1": "uint8_t", "<u2": "uint16_t", "<u4": "uint32_t"}
    seed = mavlink.x25crc(f"{MESSAGE_NAMES[message_id]} ".encode())
    layout = layout_of(message_id)
    for name in layout.names or ():
        kind = layout[name]
        text = types.get(kind.base.str, "char")
        size = kind.itemsize if kind.base.kind == "S" else sum(kind.shape)
        seed.accumulate(f"{text} {name} ".encode())
        seed.accumulate(bytes((size,)) if size else b"")
    assert bytes(((seed.crc & 0xFF) ^ (seed.crc >> 8),)) == CRC_EXTRA[message_id]
