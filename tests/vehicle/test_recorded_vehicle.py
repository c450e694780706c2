"""A recorded vehicle answers with the contents of its log, and declines the rest."""

from collections.abc import Sequence
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.vehicle.recorded_vehicle import RecordedVehicle

SYSTEM = 3
CLIENT = 7
MISSION, FENCE = mavlink.MAV_MISSION_TYPE_MISSION, mavlink.MAV_MISSION_TYPE_FENCE
HOME = mavlink.MAVLINK_MSG_ID_HOME_POSITION
VERSION = mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION


class LogContents:
    """Contents of a log."""

    def __init__(self, parameters: int = 0) -> None:
        self.mav = mavlink.MAVLink(None, SYSTEM, 1)
        self.values = {
            f"P{i}": self.pack(
                mavlink.MAVLink_param_value_message(f"P{i}".encode(), i, 9, parameters, i)
            )
            for i in range(parameters)
        }
        home = mavlink.MAVLink_home_position_message(
            470_000_000, 85_000_000, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0
        )
        self.kept = {HOME: [self.pack(home)]}
        item = mavlink.MAVLink_mission_item_int_message(
            255, 1, 0, 6, 16, 0, 1, 0, 0, 0, 0, 470_000_000, 85_000_000, 50, MISSION
        )
        self.missions: dict[int, Sequence[bytes]] = {MISSION: [self.pack(item)]}

    def pack(self, message: Any) -> bytes:
        return bytes(message.pack(self.mav))

    def has_message(self, message_id: int) -> bool:
        return message_id in (*self.kept, mavlink.MAVLINK_MSG_ID_ATTITUDE, 0)

    def frames(self, message_id: int) -> list[bytes]:
        return self.kept.get(message_id, [])

    def mission(self, kind: int) -> Sequence[bytes] | None:
        return self.missions.get(kind)

    def parameters(self) -> dict[str, bytes]:
        return self.values


class Asking:
    """A ground station that speaks to a recorded vehicle on a clock of its own."""

    def __init__(self, reported: LogContents) -> None:
        self.vehicle = RecordedVehicle(SYSTEM, reported)
        self.mav = mavlink.MAVLink(None, 255, 190)
        self.now_us = 0
        self.requested_intervals: list[ClientInterval] = []

    def ask(self, message: Any, *, trusted: bool = True) -> list[Any]:
        frame = bytes(message.pack(self.mav))
        found = self._read(self.vehicle.handle(Incoming(CLIENT, frame, trusted), self.now_us))
        while (due_us := self.vehicle.next_due_us()) is not None:
            self.now_us = max(self.now_us, due_us)
            found += self._read(self.vehicle.poll(self.now_us))
        return found

    def command(self, number: int, *params: float) -> list[Any]:
        padded = [*params, *[0.0] * (7 - len(params))]
        return self.ask(mavlink.MAVLink_command_long_message(SYSTEM, 1, number, 0, *padded))

    def _read(self, actions: list[Any]) -> list[Any]:
        self.requested_intervals += [a for a in actions if isinstance(a, ClientInterval)]
        frames = [a for a in actions if isinstance(a, Outgoing)]
        assert {f.client_id for f in frames} <= {CLIENT}
        return [mavlink.MAVLink(None).decode(bytearray(f.frame)) for f in frames]


@pytest.fixture
def asking() -> Asking:
    return Asking(LogContents(26))


def kinds(messages: list[Any]) -> list[str]:
    return [message.get_type() for message in messages]


def test_all_parameters_arrive(asking: Asking) -> None:
    found = asking.ask(mavlink.MAVLink_param_request_list_message(SYSTEM, 1))
    assert [m.param_id for m in found] == [f"P{i}" for i in range(26)]


def test_single_parameters(asking: Asking) -> None:
    by_index = mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"", 4)
    by_name = mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"P5", -1)
    nowhere = mavlink.MAVLink_param_request_read_message(SYSTEM, 1, b"", 26)
    assert [asking.ask(m)[0].get_type() for m in (by_index, by_name, nowhere)] == [
        "PARAM_VALUE", "PARAM_VALUE", "PARAM_ERROR",
    ]  # fmt: skip
    assert asking.ask(by_name)[0].param_value == 5.0


def test_a_parameter_stays_whoever_sets_it(asking: Asking) -> None:
    found = asking.ask(mavlink.MAVLink_param_set_message(SYSTEM, 1, b"P5", 9.0, 9))
    assert kinds(found) == ["PARAM_ERROR", "PARAM_VALUE"]
    assert found[1].param_value == 5.0


def test_without_parameters_the_list_is_declined() -> None:
    found = Asking(LogContents()).ask(mavlink.MAVLink_param_request_list_message(SYSTEM, 1))
    assert kinds(found) == ["PARAM_ERROR"]


def test_the_mission_of_that_day(asking: Asking) -> None:
    (count,) = asking.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, MISSION))
    assert (count.get_type(), count.count) == ("MISSION_COUNT", 1)
    (item,) = asking.ask(mavlink.MAVLink_mission_request_int_message(SYSTEM, 1, 0, MISSION))
    assert (item.x, item.target_system) == (470_000_000, 255)


def test_a_mission_that_the_log_lacks_is_empty(asking: Asking) -> None:
    (count,) = asking.ask(mavlink.MAVLink_mission_request_list_message(SYSTEM, 1, FENCE))
    assert (count.get_type(), count.count) == ("MISSION_COUNT", 0)


def test_an_upload_is_denied(asking: Asking) -> None:
    (ack,) = asking.ask(mavlink.MAVLink_mission_count_message(SYSTEM, 1, 3, MISSION))
    assert (ack.get_type(), ack.type) == ("MISSION_ACK", mavlink.MAV_MISSION_DENIED)


@pytest.mark.parametrize(
    ("number", "params"),
    [
        (mavlink.MAV_CMD_REQUEST_MESSAGE, (HOME,)),
        (mavlink.MAV_CMD_GET_HOME_POSITION, ()),
    ],
)
def test_home_of_that_day(asking: Asking, number: int, params: tuple[float, ...]) -> None:
    ack, home = asking.command(number, *params)
    assert (ack.result, home.latitude) == (mavlink.MAV_RESULT_ACCEPTED, 470_000_000)


def test_a_message_that_the_log_lacks_is_unsupported(asking: Asking) -> None:
    (ack,) = asking.command(mavlink.MAV_CMD_REQUEST_MESSAGE, VERSION)
    assert ack.result == mavlink.MAV_RESULT_UNSUPPORTED


@pytest.mark.parametrize(
    "number",
    [
        mavlink.MAV_CMD_COMPONENT_ARM_DISARM,
        mavlink.MAV_CMD_DO_SET_HOME,
        mavlink.MAV_CMD_PREFLIGHT_CALIBRATION,
        mavlink.MAV_CMD_NAV_TAKEOFF,
    ],
)
def test_recorded_vehicle_denies_commands(asking: Asking, number: int) -> None:
    (ack,) = asking.command(number, 1)
    assert ack.result == mavlink.MAV_RESULT_DENIED


def test_modes_are_denied(asking: Asking) -> None:
    (ack,) = asking.ask(mavlink.MAVLink_set_mode_message(SYSTEM, 1, 0))
    assert ack.result == mavlink.MAV_RESULT_DENIED


def test_client_may_reduce_the_rate_of_a_played_message(asking: Asking) -> None:
    number, attitude = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_ATTITUDE
    results = [
        asking.command(number, message_id, interval)[0].result
        for message_id, interval in ((attitude, 1e6), (HOME, -1), (VERSION, 1e6), (0, -1), (0, 0))
    ]
    accepted, denied = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
    assert results == [accepted, accepted, mavlink.MAV_RESULT_UNSUPPORTED, denied, accepted]
    assert [(w.message_id, w.interval_us) for w in asking.requested_intervals] == [
        (attitude, 1_000_000), (HOME, -1), (0, 0),
    ]  # fmt: skip


def test_files_are_declined_at_once(asking: Asking) -> None:
    path = b"@PARAM/param.pck"
    request = bytes([0, 0, 0, 4, len(path), 0, 0, 0, 0, 0, 0, 0]) + path
    payload = request.ljust(251, b"\0")
    (answer,) = asking.ask(mavlink.MAVLink_file_transfer_protocol_message(0, SYSTEM, 1, payload))
    assert bytes(answer.payload[3:4]) == b"\x81"


def test_ping_and_timesync(asking: Asking) -> None:
    assert kinds(asking.ask(mavlink.MAVLink_ping_message(1, 2, 0, 0))) == ["PING"]
    assert kinds(asking.ask(mavlink.MAVLink_timesync_message(0, 5))) == ["TIMESYNC"]


def test_other_vehicles_and_garbage_are_left_alone(asking: Asking) -> None:
    assert asking.ask(mavlink.MAVLink_param_request_list_message(9, 1)) == []
    assert asking.vehicle.handle(Incoming(CLIENT, b"\xfd\x00\x00", trusted=True), 0) == []


def test_a_list_ends_with_its_client(asking: Asking) -> None:
    request = mavlink.MAVLink_param_request_list_message(SYSTEM, 1)
    frame = bytes(request.pack(asking.mav))
    asking.vehicle.handle(Incoming(CLIENT, frame, trusted=True), 0)
    asking.vehicle.remove_client(CLIENT)
    assert asking.vehicle.poll(0) == []
    assert asking.vehicle.next_due_us() is None
