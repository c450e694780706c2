"""A recorded vehicle answers with the contents of its log, and declines the rest."""

from collections.abc import Sequence
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import Incoming
from gateway.vehicle.recorded_vehicle import RecordedVehicle
from tests.conftest import ManualClock
from tests.kit.conversation import converse
from tests.kit.ground_station import FtpClient, GroundStation, command, kinds, texts, to_vehicle
from tests.kit.mavlink import packed

SYSTEM = 3
ME = (SYSTEM, 1)
MISSION, FENCE = mavlink.MAV_MISSION_TYPE_MISSION, mavlink.MAV_MISSION_TYPE_FENCE
HOME = mavlink.MAVLINK_MSG_ID_HOME_POSITION
VERSION = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION
ATTITUDE = mavlink.MAVLINK_MSG_ID_ATTITUDE
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
    asking.send(LIST)
    asking.vehicle.remove_client(asking.client_id)
    assert asking.vehicle.next_due_us() is None
    assert asking.vehicle.poll(1_000_000) == []


def me(name: str, *fields: Any) -> Any:
    return to_vehicle(name, *fields, target=ME)


def interval(message_id: int, interval_us: float) -> Any:
    return command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, interval_us, target=ME)


NOTHING_CHANGES = {"texts": ["This is a recording: nothing can be changed in it"]}
ACCEPTED, DENIED, UNSUPPORTED = ({"COMMAND_ACK": {"result": n}} for n in (0, 2, 3))
NOT_STORED = {"MISSION_ACK": {"type": mavlink.MAV_MISSION_DENIED}}
HOME_ANSWER = ACCEPTED | {"HOME_POSITION": {"latitude": 470_000_000}}
SET_HOME_POSITION = mavlink.MAVLink_set_home_position_message(3, *[0] * 6, [1, 0, 0, 0], 0, 0, 0)
READ_P5 = me("PARAM_REQUEST_READ", b"P5", -1)
REQUESTS: dict[str, tuple[Any, dict[str, Any]]] = {
    # Parameters by index or name, and unchanged.
    "parameter by index": (me("PARAM_REQUEST_READ", b"", 4), {"PARAM_VALUE": {"param_value": 4}}),
    "parameter by name": (READ_P5, {"PARAM_VALUE": {"param_value": 5}}),
    "missing parameter": (me("PARAM_REQUEST_READ", b"", 26), {"kinds": ["PARAM_ERROR"]}),
    "set a parameter": (
        me("PARAM_SET", b"P5", 9.0, 9),
        {"kinds": ["PARAM_ERROR", "PARAM_VALUE", "STATUSTEXT"], "PARAM_VALUE": {"param_value": 5}},
    ),
    # Every change is denied with a text.
    **{
        name: (command(number, 1, target=ME), DENIED | NOTHING_CHANGES)
        for name, number in {
            "arm": mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
            "home": mavlink.MAV_CMD_DO_SET_HOME,
            "calibration": mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
            "take-off": mavlink.MAV_CMD_NAV_TAKEOFF,
        }.items()
    },
    "mode": (mavlink.MAVLink_set_mode_message(SYSTEM, 1, 0), DENIED | NOTHING_CHANGES),
    "upload": (me("MISSION_COUNT", 3, MISSION), NOT_STORED | NOTHING_CHANGES),
    "clear": (me("MISSION_CLEAR_ALL", MISSION), NOT_STORED | NOTHING_CHANGES),
    "erase": (me("LOG_ERASE"), NOTHING_CHANGES | {"kinds": ["STATUSTEXT"]}),
    "home message": (SET_HOME_POSITION, NOTHING_CHANGES | {"kinds": ["STATUSTEXT"]}),
    # What does not exist is answered without a text.
    "logs": (me("LOG_REQUEST_LIST", 0, 0xFFFF), {"kinds": ["LOG_ENTRY"]}),
    "log data": (me("LOG_REQUEST_DATA", 0, 0, 90), {"kinds": ["LOG_DATA"]}),
    "end of logs": (me("LOG_REQUEST_END"), {}),
    "extended parameters": (me("PARAM_EXT_REQUEST_LIST"), {"kinds": ["PARAM_EXT_VALUE"]}),
    "joystick": (mavlink.MAVLink_manual_control_message(SYSTEM, 0, 0, 0, 0, 0), {}),
    "remote control": (me("RC_CHANNELS_OVERRIDE", *[1500] * 8), {}),
    "answer": (mavlink.MAVLink_command_ack_message(400, 0, 0, 0, *ME), {}),
    # The contents of the log; a plan that it lacks is empty.
    "mission": (me("MISSION_REQUEST_LIST", MISSION), {"MISSION_COUNT": {"count": 1}}),
    "fence": (me("MISSION_REQUEST_LIST", FENCE), {"MISSION_COUNT": {"count": 0}}),
    "item": (
        me("MISSION_REQUEST_INT", 0, MISSION),
        {"MISSION_ITEM_INT": {"x": 470_000_000, "target_system": 255}},
    ),
    "ping": (mavlink.MAVLink_ping_message(1, 2, 0, 0), {"PING": {"seq": 2}}),
    "timesync": (mavlink.MAVLink_timesync_message(0, 5), {"TIMESYNC": {"ts1": 5}}),
    "recorded home": (command(512, HOME, target=ME), HOME_ANSWER),
    "recorded home by its command": (command(410, target=ME), HOME_ANSWER),
    "unrecorded message": (command(512, VERSION, target=ME), UNSUPPORTED),
    # A client may reduce the rate of a played message.
    "slower message": (interval(ATTITUDE, 1_000_000), ACCEPTED),
    "message off": (interval(HOME, -1), ACCEPTED),
    "rate of an unrecorded message": (interval(VERSION, 1e6), UNSUPPORTED),
    "heartbeats off": (interval(0, -1), DENIED),
    "usual heartbeats": (interval(0, 0), ACCEPTED),
    "other system": (mavlink.MAVLink_param_request_list_message(9, 1), {}),
}  # fmt: skip


@pytest.mark.parametrize("name", REQUESTS)
def test_recorded_vehicle_answers_from_its_log(clock: ManualClock, name: str) -> None:
    message, expected = REQUESTS[name]
    vehicle = RecordedVehicle(SYSTEM, LogContents(26))
    stations = converse(vehicle, clock, [("A", message, expected)])
    assert {frame.client_id for frame in stations["A"].frames} <= {7}
    is_interval = getattr(message, "command", 0) == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
    requested = [(w.message_id, w.interval_us) for w in stations["A"].requested_intervals]
    granted = is_interval and expected is ACCEPTED
    assert requested == ([(message.param1, message.param2)] if granted else [])


def test_texts_about_denied_requests_are_limited(asking: GroundStation) -> None:
    found = [text for _ in range(50) for text in texts(asking.set_parameter("P5", 9.0))]
    assert len(found) == 3


def test_log_without_parameters_or_metadata_has_neither(clock: ManualClock) -> None:
    asking = GroundStation(RecordedVehicle(SYSTEM, LogContents()), clock)
    assert kinds(asking.send(LIST)) == ["PARAM_ERROR"]
    assert FtpClient(asking).open(b"@PARAM/param.pck").opcode == 129
    assert asking.vehicle.handle(Incoming(7, b"\xfd\x00\x00", trusted=True), 0) == []
