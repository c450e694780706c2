"""System ids in the fields of messages."""

import re
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_splitter import MavFrame, frame_of, split_datagram
from gateway.wire.system_ids import (
    CARRIERS,
    COMMANDS,
    FIELDS,
    REQUEST_OPERATOR_CONTROL,
    rename_systems,
)
from tests.kit.mavlink import packed

RENAMED = {1: 11, 2: 12}
IS_ID = re.compile(r"(new |vehicle )?sys(tem )?id\b", re.IGNORECASE)
"""Begin of the description of a parameter that is a system id."""


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


def test_ids_in_all_fields_of_every_message_are_renamed_and_no_others() -> None:
    for message_id in FIELDS:
        name = MESSAGE_NAMES[message_id]
        changed = rename_systems(full(message_id, 2), 9, rename)
        assert changed == full(message_id, 12), name
        assert split_datagram(changed.data) == [changed], name
        assert rename_systems(changed, 9, {12: 2, 9: 9}.__getitem__) == full(message_id, 2), name
        for value in (0, 3, 255):
            frame = full(message_id, value)
            assert rename_systems(frame, 9, rename) is frame, (name, value)


def test_every_field_that_is_named_like_a_system_id_is_known() -> None:
    found = {
        name
        for kind in mavlink.mavlink_map.values()
        for name, type_name in zip(kind.fieldnames, kind.fieldtypes, strict=True)
        if type_name == "uint8_t" and ("sys" in name or "gcs" in name or name == "target")
        if name not in FIELDS.get(kind.id, ())
    }
    assert found == {"system_status", "system_status_summary"}, "states, not ids"


def test_every_parameter_that_is_described_as_a_system_id_is_known() -> None:
    described = {
        number: found
        for number, command in mavlink.enums["MAV_CMD"].items()
        if (found := tuple(n for n, text in command.param.items() if IS_ID.match(text)))
    }
    assert described == {n: each for n, each in COMMANDS.items() if n != REQUEST_OPERATOR_CONTROL}


FOLLOW, CONTROL = mavlink.MAV_CMD_DO_FOLLOW, REQUEST_OPERATOR_CONTROL


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize(
    ("command", "before", "after"),
    [
        (FOLLOW, (1, 2, 1, 2, 1), (11, 2, 1, 2, 1)),
        (CONTROL, (1, 1, 10, 1, 2), (1, 1, 10, 11, 12)),
        (CONTROL, (0, 0, 0, 2, 0), (0, 0, 0, 12, 0)),
        # The former order, with the sender and with a timeout of 3 s.
        (CONTROL, (2, 1, 1, 3, 0), (12, 1, 1, 3, 0)),
        (CONTROL, (0, 1, 1, 3, 0), (0, 1, 1, 3, 0)),
    ],
)
@pytest.mark.parametrize("message_id", sorted(CARRIERS), ids=MESSAGE_NAMES.get)
def test_ids_in_the_parameters_of_a_command_are_renamed(
    message_id: int,
    command: int,
    before: tuple[int, ...],
    after: tuple[int, ...],
    version: int,
) -> None:
    def message(system: int, params: tuple[int, ...]) -> Any:
        kind = mavlink.mavlink_map[message_id]
        values = dict.fromkeys(kind.fieldnames, 0) | {"target_system": system, "command": command}
        names = ("param1", "param2", "param3", "param4")
        fifth = "param5" if "param5" in kind.fieldnames else "x"
        return kind(**values | dict(zip((*names, fifth), params, strict=True)))

    given = frame_of(packed(message(2, before), 1, version=version))
    renamed = {1: 11, 2: 12, 3: 13, 10: 20}
    changed = rename_systems(given, 11, lambda system: renamed.get(system, system))
    assert changed == frame_of(packed(message(12, after), 11, version=version))


def test_sender_alone_is_renamed_in_telemetry() -> None:
    frame = frame_of(packed(mavlink.MAVLink_attitude_message(1, 2, 0, 0, 0, 0, 3), 1))
    changed = rename_systems(frame, 11, rename)
    assert changed == edit_frame(frame, system=11)
    assert rename_systems(frame, 1, rename) is frame
