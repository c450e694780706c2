"""A recorded vehicle answers with the contents of its log, and declines the rest."""

from collections.abc import Sequence
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import Incoming
from gateway.vehicle.recorded_vehicle import RecordedVehicle
from tests.conftest import ManualClock
from tests.kit.ground_station import FtpClient, GroundStation, command, kinds, results, texts
from tests.kit.mavlink import packed

SYSTEM = 3
ME = (SYSTEM, 1)
MISSION, FENCE = mavlink.MAV_MISSION_TYPE_MISSION, mavlink.MAV_MISSION_TYPE_FENCE
HOME = mavlink.MAVLINK_MSG_ID_HOME_POSITION
VERSION = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE
ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
LIST = mavlink.MAVLink_param_request_list_message(*ME)


class LogContents:
    """Contents of a log."""

    def __init__(self, parameters: int = 0) -> None:
        value = mavlink.MAVLink_param_value_message
        self.values = {
            f"P{i}": packed(value(f"P{i}".encode(), i, 9, parameters, i), SYSTEM)
            for i in range(parameters)
        }
        here = (470_000_000, 85_000_000)
        home = mavlink.MAVLink_home_position_message(*here, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
        head = (255, 1, 0, 6, 16, 0, 1, 0, 0, 0, 0)
        item = mavlink.MAVLink_mission_item_int_message(*head, *here, 50, MISSION)
        self.kept = {HOME: [packed(home, SYSTEM)]}
        self.missions = {MISSION: [packed(item, SYSTEM)]}

    def has_message(self, message_id: int) -> bool:
        return message_id in (*self.kept, ATTITUDE, 0)

    def frames(self, message_id: int) -> list[bytes]:
        return self.kept.get(message_id, [])

    def mission(self, kind: int) -> Sequence[bytes] | None:
        return self.missions.get(kind)

    def parameters(self) -> dict[str, bytes]:
        return self.values


@pytest.fixture
def asking(clock: ManualClock) -> GroundStation:
    return GroundStation(RecordedVehicle(SYSTEM, LogContents(26)), clock)


def test_recorded_parameters_are_sent_to_the_requesting_client_only(asking: GroundStation) -> None:
    found = asking.send(LIST) + asking.wait(1.0)
    assert [m.param_id for m in found] == [f"P{i}" for i in range(26)]
    assert {frame.client_id for frame in asking.frames} == {asking.client_id}
    assert asking.vehicle.next_due_us() is None


def test_parameter_list_ends_when_its_client_is_removed(asking: GroundStation) -> None:
    asking.send(LIST)
    asking.vehicle.remove_client(asking.client_id)
    assert asking.vehicle.next_due_us() is None
    assert asking.vehicle.poll(1_000_000) == []


def test_parameter_is_read_by_index_or_name(asking: GroundStation) -> None:
    read = mavlink.MAVLink_param_request_read_message
    by_index, by_name, missing = (read(*ME, b"", 4), read(*ME, b"P5", -1), read(*ME, b"", 26))
    expected = ["PARAM_VALUE", "PARAM_VALUE", "PARAM_ERROR"]
    assert [kinds(asking.send(m)) for m in (by_index, by_name, missing)] == [[k] for k in expected]
    assert asking.send(by_name)[0].param_value == 5.0


def test_set_parameter_is_refused_with_its_recorded_value(asking: GroundStation) -> None:
    found = asking.set_parameter("P5", 9.0)
    assert kinds(found) == ["PARAM_ERROR", "PARAM_VALUE", "STATUSTEXT"]
    assert found[1].param_value == 5.0


CHANGES = {
    "arm": (command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1, target=ME), "COMMAND_ACK"),
    "home": (command(mavlink.MAV_CMD_DO_SET_HOME, 1, target=ME), "COMMAND_ACK"),
    "calibration": (command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, 1, target=ME), "COMMAND_ACK"),
    "take-off": (command(mavlink.MAV_CMD_NAV_TAKEOFF, 1, target=ME), "COMMAND_ACK"),
    "mode": (mavlink.MAVLink_set_mode_message(SYSTEM, 1, 0), "COMMAND_ACK"),
    "upload": (mavlink.MAVLink_mission_count_message(*ME, 3, MISSION), "MISSION_ACK"),
    "clear": (mavlink.MAVLink_mission_clear_all_message(*ME, MISSION), "MISSION_ACK"),
    "erase": (mavlink.MAVLink_log_erase_message(*ME), ""),
    "home message": (
        mavlink.MAVLink_set_home_position_message(SYSTEM, *[0] * 6, [1, 0, 0, 0], 0, 0, 0), "",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_request_of_a_change_is_denied_with_a_text(asking: GroundStation, name: str) -> None:
    message, kind = CHANGES[name]
    *acks, text = asking.send(message)
    assert kinds(acks) == ([kind] if kind else [])
    denied = mavlink.MAV_MISSION_DENIED if kind == "MISSION_ACK" else DENIED
    for ack in acks:
        assert (ack.type if kind == "MISSION_ACK" else ack.result) == denied
    assert texts([text]) == ["This is a recording: nothing can be changed in it"]
    assert asking.frames[-1].client_id == asking.client_id


def test_texts_about_denied_requests_are_limited(asking: GroundStation) -> None:
    found = [text for _ in range(50) for text in texts(asking.set_parameter("P5", 9.0))]
    assert len(found) == 3


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (mavlink.MAVLink_log_request_list_message(*ME, 0, 0xFFFF), ["LOG_ENTRY"]),
        (mavlink.MAVLink_log_request_data_message(*ME, 0, 0, 90), ["LOG_DATA"]),
        (mavlink.MAVLink_log_request_end_message(*ME), []),
        (mavlink.MAVLink_param_ext_request_list_message(*ME), ["PARAM_EXT_VALUE"]),
        (mavlink.MAVLink_manual_control_message(SYSTEM, 0, 0, 0, 0, 0), []),
        (mavlink.MAVLink_rc_channels_override_message(*ME, *[1500] * 8), []),
        (mavlink.MAVLink_command_ack_message(400, 0, 0, 0, *ME), []),
    ],
)
def test_request_of_what_does_not_exist_is_answered_without_a_text(
    asking: GroundStation, message: Any, expected: list[str]
) -> None:
    assert kinds(asking.send(message)) == expected


def test_parameter_list_of_a_log_without_parameters_is_an_error(clock: ManualClock) -> None:
    asking = GroundStation(RecordedVehicle(SYSTEM, LogContents()), clock)
    assert kinds(asking.send(LIST)) == ["PARAM_ERROR"]


@pytest.mark.parametrize(
    ("message", "kind", "fields"),
    [
        (mavlink.MAVLink_mission_request_list_message(*ME, MISSION), "MISSION_COUNT", {"count": 1}),
        # One that the log lacks is empty.
        (mavlink.MAVLink_mission_request_list_message(*ME, FENCE), "MISSION_COUNT", {"count": 0}),
        (
            mavlink.MAVLink_mission_request_int_message(*ME, 0, MISSION),
            "MISSION_ITEM_INT",
            {"x": 470_000_000, "target_system": 255},
        ),
        (mavlink.MAVLink_ping_message(1, 2, 0, 0), "PING", {"seq": 2}),
        (mavlink.MAVLink_timesync_message(0, 5), "TIMESYNC", {"ts1": 5}),
    ],
)
def test_request_is_answered_with_the_contents_of_the_log(
    asking: GroundStation, message: Any, kind: str, fields: dict[str, Any]
) -> None:
    answer = asking.send(message)[0]
    assert answer.get_type() == kind
    assert {name: getattr(answer, name) for name in fields} == fields


def test_recorded_home_is_sent_on_request(asking: GroundStation) -> None:
    for found in (asking.request(HOME), asking.command(mavlink.MAV_CMD_GET_HOME_POSITION)):
        ack, home = found
        assert (ack.result, home.latitude) == (ACCEPTED, 470_000_000)


def test_unrecorded_message_is_unsupported(asking: GroundStation) -> None:
    assert results(asking.request(VERSION)) == [UNSUPPORTED]


@pytest.mark.parametrize(
    ("message_id", "interval_us", "result"),
    [
        *((ATTITUDE, 1_000_000, ACCEPTED), (HOME, -1, ACCEPTED), (VERSION, 1e6, UNSUPPORTED)),
        *((0, -1, DENIED), (0, 0, ACCEPTED)),
    ],
)
def test_client_may_reduce_the_rate_of_a_played_message(
    asking: GroundStation, message_id: int, interval_us: float, result: int
) -> None:
    found = asking.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us)
    assert results(found) == [result]
    requested = [(w.message_id, w.interval_us) for w in asking.requested_intervals]
    assert requested == ([(message_id, interval_us)] if result == ACCEPTED else [])


def test_file_of_a_log_without_metadata_is_refused(asking: GroundStation) -> None:
    assert FtpClient(asking).open(b"@PARAM/param.pck").opcode == 129


def test_requests_for_other_systems_and_garbage_are_ignored(asking: GroundStation) -> None:
    assert asking.send(mavlink.MAVLink_param_request_list_message(9, 1)) == []
    assert asking.vehicle.handle(Incoming(7, b"\xfd\x00\x00", trusted=True), 0) == []
