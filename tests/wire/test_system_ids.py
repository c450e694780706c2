"""System ids in the fields of messages."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of, split_datagram
from gateway.wire.system_ids import FIELDS, rename_systems
from tests.kit.mavlink import packed

RENAMED = {1: 11, 2: 12}


def rename(system_id: int) -> int:
    return RENAMED.get(system_id, system_id)


def full(message_id: int, value: int) -> MavFrame:
    """Return a frame of system 9 whose fields with a system id all have one value."""
    size = layout_of(message_id).itemsize
    head = bytes((0xFD, size, 0, 0, 0, 9, 1)) + message_id.to_bytes(3, "little")
    blank = frame_of(head + bytes(size) + b"\0\0")
    frame = edit_frame(blank, fields=dict.fromkeys(FIELDS[message_id], value))
    assert frame is not None
    return frame


@pytest.mark.parametrize("message_id", sorted(FIELDS), ids=MESSAGE_NAMES.get)
def test_ids_in_all_fields_of_every_message_are_renamed(message_id: int) -> None:
    changed = rename_systems(full(message_id, 2), 9, rename)
    assert changed == full(message_id, 12)
    assert split_datagram(changed.data) == [changed]
    assert rename_systems(changed, 9, {12: 2, 9: 9}.__getitem__) == full(message_id, 2)


@pytest.mark.parametrize("value", [0, 3, 255])
@pytest.mark.parametrize("message_id", sorted(FIELDS), ids=MESSAGE_NAMES.get)
def test_frame_without_a_renamed_id_is_returned_itself(message_id: int, value: int) -> None:
    frame = full(message_id, value)
    assert rename_systems(frame, 9, rename) is frame


def test_every_field_that_is_named_like_a_system_id_is_known() -> None:
    found = {
        name
        for kind in mavlink.mavlink_map.values()
        for name, type_name in zip(kind.fieldnames, kind.fieldtypes, strict=True)
        if type_name == "uint8_t" and ("sys" in name or "gcs" in name or name == "target")
        if name not in FIELDS.get(kind.id, ())
    }
    assert found == {"system_status", "system_status_summary"}, "states, not ids"


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    "kind",
    [
        mavlink.MAVLink_command_long_message,
        mavlink.MAVLink_command_int_message,
        mavlink.MAVLink_command_long_stamped_message,
        mavlink.MAVLink_command_int_stamped_message,
        mavlink.MAVLink_mission_item_message,
        mavlink.MAVLink_mission_item_int_message,
    ],
)
def test_id_in_a_parameter_of_a_command_is_renamed(kind: Any, version: int) -> None:
    follow = {"command": mavlink.MAV_CMD_DO_FOLLOW, "param1": 1.0, "param2": 2.0}
    values = dict.fromkeys(kind.fieldnames, 0) | {"target_system": 2} | follow
    frame = frame_of(packed(kind(**values), 1, version=version))
    changed = rename_systems(frame, 11, rename)
    assert changed is not None
    got = mavlink.MAVLink(None).decode(bytearray(changed.data))
    assert (got.get_srcSystem(), got.target_system, got.param1, got.param2) == (11, 12, 11.0, 2.0)


def test_sender_alone_is_renamed_in_telemetry() -> None:
    frame = frame_of(packed(mavlink.MAVLink_attitude_message(1, 2, 0, 0, 0, 0, 3), 1))
    changed = rename_systems(frame, 11, rename)
    assert changed == edit_frame(frame, system=11)
    assert rename_systems(frame, 1, rename) is frame
