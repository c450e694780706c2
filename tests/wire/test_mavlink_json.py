"""Every message as JSON and back, compared with pymavlink's reading of its fields."""

import json
import math
import random
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.wire.mavlink_json import CLASSES, BadMessageError, from_json, template, to_json
from tests.kit.mavlink import packed, random_message, read_back


def as_pymavlink_reads(message: Any) -> dict[str, Any]:
    """Write pymavlink's own `to_dict` in the form of the REST API."""
    found = message.to_dict()
    expected = {"type": found.pop("mavpackettype")}
    for name, value in found.items():
        key = "mavtype" if name == "type" else name
        form = message.fieldtypes[message.fieldnames.index(name)]
        length = message.array_lengths[message.ordered_fieldnames.index(name)]
        if form == "char" and length:
            expected[key] = [*value, *"\0" * (length - len(value))]
        elif isinstance(value, list):
            expected[key] = [as_value(message, name, item) for item in value]
        else:
            expected[key] = as_value(message, name, value)
    return expected


def as_value(message: Any, name: str, item: Any) -> Any:
    enum = message.fieldenums_by_name.get(name)
    if isinstance(item, float) and not math.isfinite(item):
        return None
    if enum is None:
        return item
    if message.fielddisplays_by_name.get(name) == "bitmask":
        return {"bits": item}
    entry = mavlink.enums[enum].get(item)
    return {"type": entry.name} if entry else item


def test_every_message_has_the_fields_that_pymavlink_reads() -> None:
    for name in sorted(CLASSES):
        chance = random.Random(name)
        for _ in range(2):
            message = read_back(packed(random_message(CLASSES[name], chance)))
            converted = to_json(message)
            assert converted == as_pymavlink_reads(message)
            again = json.loads(json.dumps(converted, allow_nan=False))
            assert to_json(read_back(packed(from_json(again)))) == converted


def test_every_template_can_be_sent() -> None:
    for name in sorted(CLASSES):
        assert from_json(template(name)).pack(mavlink.MAVLink(None, 255, 0))
    message = from_json(template("ATTITUDE_QUATERNION"))
    assert {getattr(message, name) for name in ("time_boot_ms", "q1", "yawspeed")} == {0}


def test_heartbeat_has_the_json_of_mavlink2rest() -> None:
    kind, autopilot = mavlink.MAV_TYPE_FIXED_WING, mavlink.MAV_AUTOPILOT_GENERIC
    heartbeat = mavlink.MAVLink_heartbeat_message(kind, autopilot, 81, 7, 4, 3)
    assert to_json(heartbeat) == {
        "type": "HEARTBEAT",
        "mavtype": {"type": "MAV_TYPE_FIXED_WING"},
        "autopilot": {"type": "MAV_AUTOPILOT_GENERIC"},
        "base_mode": {"bits": 81},
        "custom_mode": 7,
        "system_status": {"type": "MAV_STATE_ACTIVE"},
        "mavlink_version": 3,
    }


COMMAND = {
    "type": "COMMAND_LONG",
    "command": {"type": "MAV_CMD_COMPONENT_ARM_DISARM"},
    **{f"param{n}": 0.0 for n in range(1, 8)},
    "target_system": 1,
    "target_component": 1,
    "confirmation": 0,
}


@pytest.mark.parametrize(
    ("field", "value", "number"),
    [
        ("base_mode", "MAV_MODE_FLAG_SAFETY_ARMED | MAV_MODE_FLAG_CUSTOM_MODE_ENABLED", 129),
        ("base_mode", 129, 129),
        ("base_mode", {"bits": 129}, 129),
        ("base_mode", "", 0),
        ("mavtype", "MAV_TYPE_GCS", 6),
        ("mavtype", 6, 6),
        ("custom_mode", 7.0, 7),
    ],
)
def test_alternative_notation_of_value_is_accepted(field: str, value: Any, number: int) -> None:
    message = from_json({**template("HEARTBEAT"), field: value})
    assert getattr(message, field.removeprefix("mav")) == number


@pytest.mark.parametrize("text", ["SPEED", list("SPEED"), list("SPEED") + ["\0"] * 11])
def test_notations_of_a_text_are_read(text: Any) -> None:
    message = from_json({**template("PARAM_SET"), "param_id": text})
    assert read_back(packed(message)).param_id == "SPEED"


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ([], "'type'"),
        ({}, "called None"),
        ({"type": ["ATTITUDE"]}, "called"),
        ({"type": "NO_SUCH"}, "NO_SUCH"),
        ({key: value for key, value in COMMAND.items() if key != "param3"}, "param3 is missing"),
        ({**COMMAND, "command": {"type": "MAV_CMD_FLY"}}, "MAV_CMD_FLY"),
        ({**COMMAND, "command": {}}, "COMMAND_LONG.command"),
        ({**COMMAND, "command": 70_000}, "0 to 65535"),
        ({**COMMAND, "target_system": -1}, "0 to 255"),
        ({**COMMAND, "target_system": 1.5}, "whole number"),
        ({**COMMAND, "target_system": True}, "whole number"),
        ({**COMMAND, "param1": "1"}, "not a number"),
        ({**COMMAND, "param1": 1e300}, "param1"),
        ({**template("PARAM_SET"), "param_id": "A" * 17}, "16 bytes"),
        ({**template("PARAM_SET"), "param_id": [1]}, "param_id"),
        ({**template("HOME_POSITION"), "q": [1, 0, 0]}, "array of 4"),
        ({**template("HOME_POSITION"), "q": 1}, "array of 4"),
    ],
)
def test_invalid_message_is_reported(fields: Any, words: str) -> None:
    with pytest.raises(BadMessageError, match=words):
        from_json(fields)


def test_text_beyond_ascii_is_written_and_read() -> None:
    text = "Höhe 120 m, 罗盘"
    message = mavlink.MAVLink_statustext_message(4, text.encode())
    converted = to_json(read_back(packed(message)))
    assert "".join(converted["text"]).rstrip("\0") == text
    assert to_json(read_back(packed(from_json(converted | {"text": text})))) == converted
