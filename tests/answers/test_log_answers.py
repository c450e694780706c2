"""Parameters, missions, home and version in a recording, and since when each is known."""

import re
import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as all_messages
from pymavlink.dialects.v20 import common as mavlink

from gateway.answers.log_answers import LogAnswers, VehicleAnswers
from gateway.vehicle.requested_messages import DISTINGUISHED_BY, read_request
from tests.kit.mavlink import frame_with, packed, read_back
from tests.kit.recordings import SECOND_US, START_US, batch_of, index_of, records_of

MISSION = mavlink.MAV_MISSION_TYPE_MISSION
FENCE = mavlink.MAV_MISSION_TYPE_FENCE


class Day:
    """A link of vehicle 3 and station 255 that is being recorded, a message a second."""

    vehicle, gimbal, station = (3, 1), (3, 154), (255, 190)

    def __init__(self) -> None:
        self.frames: list[bytes] = []

    def send(self, origin: tuple[int, int], *messages: Any) -> None:
        self.frames += [packed(message, *origin) for message in messages]

    @property
    def now_us(self) -> int:
        return START_US + len(self.frames) * SECOND_US

    def answers(self, at_us: int | None = None, played_as: int = 3) -> VehicleAnswers:
        batch, found = batch_of(records_of(self.frames, SECOND_US)), LogAnswers()
        found.add(batch, index_of([batch]).senders)
        time_us = self.now_us if at_us is None else at_us
        return VehicleAnswers(found, 3, played_as, lambda: time_us)


@pytest.fixture
def day() -> Day:
    return Day()


def value(name: str, number: float, index: int = 0, count: int = 2) -> Any:
    return mavlink.MAVLink_param_value_message(name.encode(), number, 9, count, index)


def item(sequence: int, kind: int = MISSION, target: int = 255) -> Any:
    return mavlink.MAVLink_mission_item_int_message(
        target, 1, sequence, 6, 16, 0, 1, 0, 0, 0, 0, 470_000_000 + sequence, 85_000_000, 50, kind
    )


def count_of(items: int, kind: int = MISSION, target: int = 255) -> Any:
    return mavlink.MAVLink_mission_count_message(target, 1, items, kind)


def ack(kind: int, result: int = mavlink.MAV_MISSION_ACCEPTED) -> Any:
    return mavlink.MAVLink_mission_ack_message(255, 190, result, kind)


def test_answers_are_those_of_the_vehicle_whatever_its_component(day: Day) -> None:
    autopilot = (3, 7)
    day.send(autopilot, mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
    day.send(autopilot, value("ALPHA", 1.0))
    day.send(day.vehicle, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    day.send(day.vehicle, value("COMPANION", 9.0))
    assert [*day.answers().parameters()] == ["ALPHA"]


def test_parameters_are_complete_and_renumbered(day: Day) -> None:
    day.send(day.vehicle, value("BETA", 2.0, 7, 900), value("ALPHA", 1.0, 3, 900))
    day.send(day.vehicle, value("GAMMA", 5.0, 65535, 900))
    day.send(day.gimbal, value("GIMBAL", 9.0))
    found = [read_back(frame) for frame in day.answers(played_as=8).parameters().values()]
    assert [(m.param_id, m.param_index, m.param_count) for m in found] == [
        ("ALPHA", 0, 3), ("BETA", 1, 3), ("GAMMA", 2, 3),
    ]  # fmt: skip
    assert {m.get_srcSystem() for m in found} == {8}


def test_parameter_has_its_newest_value_or_the_first_before_any(day: Day) -> None:
    day.send(day.vehicle, value("ALPHA", 1.0), value("ALPHA", 1.0), value("ALPHA", 2.0))
    moments = (START_US - 1, START_US + SECOND_US, START_US + 2 * SECOND_US)
    answers = [day.answers(at_us).parameters()["ALPHA"] for at_us in moments]
    assert [read_back(frame).param_value for frame in answers] == [1.0, 1.0, 2.0]


def test_bits_of_a_parameter_value_are_preserved(day: Day) -> None:
    # A signalling NaN as a float: autopilots put the bits of integers there.
    bits = struct.pack("<i", -5_000_000)
    payload = bits + packed(value("COUNT", 1.0))[14:-2]
    day.frames.append(frame_with(mavlink.MAVLINK_MSG_ID_PARAM_VALUE, payload, day.vehicle))
    assert day.answers().parameters()["COUNT"][10:14] == bits


def test_complete_download_is_the_mission(day: Day) -> None:
    day.send(day.vehicle, count_of(2), item(0))
    assert day.answers().mission(MISSION) is None
    day.send(day.vehicle, item(1))
    mission = day.answers().mission(MISSION)
    assert mission is not None
    assert [read_back(frame).x for frame in mission] == [470_000_000, 470_000_001]
    assert day.answers(START_US).mission(MISSION) == mission, "loaded before the recording"


def test_mission_and_parameter_set_in_flight_did_not_exist_before(day: Day) -> None:
    day.send(day.vehicle, value("READ", 1.0))
    set_us = day.now_us
    for name in ("READ", "SET"):
        day.send(day.station, mavlink.MAVLink_param_set_message(3, 1, name.encode(), 2.0, 9))
        day.send(day.vehicle, value(name, 2.0))
    day.send(day.station, count_of(1, target=3), item(0, target=3))
    day.send(day.vehicle, ack(MISSION))
    later, before = day.answers(), day.answers(at_us=set_us)
    assert [sorted(each.parameters()) for each in (later, before)] == [["READ", "SET"], ["READ"]]
    assert read_back(before.parameters()["READ"]).param_value == 1.0
    assert (len(later.mission(MISSION) or ()), before.mission(MISSION)) == (1, None)


UPLOADS = {
    "cleared and uploaded at once": ("clear count ack 0 1 ack", [0, 1]),
    "clear is never acknowledged": ("clear count 0 1 ack", [0, 1]),
    "upload is not finished": ("clear count ack 0", []),
    "clear is refused, upload accepted": ("clear count no 0 1 ack", [0, 1]),
    "upload is refused at the end": ("clear count ack 0 1 no ack", []),
    "item is refused once": ("count 0 no 1 ack", [0, 1]),
    "uploaded, then cleared": ("count 0 1 ack clear ack", []),
    "cleared during an upload": ("count 0 clear ack 1 ack", []),
    "counted again": ("count 0 count 0 1 ack", [0, 1]),
    "another station's upload": ("count 0 other 1 ack", [0, 1]),
    "part written": ("count 0 1 ack part 1 ack", [0, 1]),
    "refused, and nothing before": ("count 0 1 no", None),
    "nothing is acknowledged": ("clear count 0 1", None),
}
"""Messages in their order, and the numbers of the items of the mission after them."""


@pytest.mark.parametrize("name", UPLOADS)
@pytest.mark.parametrize("kind", [MISSION, FENCE])
def test_mission_is_that_of_the_acknowledged_transfer(day: Day, name: str, kind: int) -> None:
    words, expected = UPLOADS[name]
    companion = (7, 191)
    day.send(companion, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    for word in words.split():
        match word:
            case "clear":
                day.send(day.station, mavlink.MAVLink_mission_clear_all_message(3, 1, kind))
            case "count":
                day.send(day.station, count_of(2, kind, target=3))
            case "part":
                part = mavlink.MAVLink_mission_write_partial_list_message(3, 1, 1, 1, kind)
                day.send(day.station, part)
            case "other":
                day.send(companion, count_of(5, kind, target=3))
            case "ack" | "no":
                day.send(day.vehicle, ack(kind, 0 if word == "ack" else 1))
            case number:
                day.send(day.station, item(int(number), kind, target=3))
    mission = day.answers().mission(kind)
    found = None if mission is None else [read_back(frame).seq for frame in mission]
    assert found == expected


def test_parameters_that_a_station_read_from_a_file_are_those_of_the_vehicle(day: Day) -> None:
    day.send(day.vehicle, value("ALPHA", 1.0))
    day.send((3, 190), value("ALPHA", 2.0), value("BETA", 3.0, 1))
    found = day.answers().parameters()
    assert {name: read_back(frame).param_value for name, frame in found.items()} == {
        "ALPHA": 2.0, "BETA": 3.0,
    }  # fmt: skip


def test_every_message_that_is_requested_by_number_is_known() -> None:
    for kind in all_messages.mavlink_map.values():
        text = " ".join((kind.__doc__ or "").split())
        selects = "REQUEST_MESSAGE" in text and re.search(r"param ?[23]", text)
        selects = selects or kind.instance_field or "camera_device_id" in kind.fieldnames
        assert not selects or kind.id in DISTINGUISHED_BY, kind.msgname
    for command in all_messages.enums["MAV_CMD"].values():
        older = re.fullmatch(r"MAV_CMD_(REQUEST|GET)_(.*)", command.name)
        is_other = command.name.endswith(("_MESSAGE", "_INTERVAL", "OPERATOR_CONTROL"))
        assert not older or is_other or read_request(command_number(command), (0.0,) * 7)


def command_number(command: Any) -> int:
    return int(all_messages.__dict__[command.name])


def test_clearing_all_gives_empty_mission_fence_and_rally_points(day: Day) -> None:
    everything = mavlink.MAV_MISSION_TYPE_ALL
    day.send(day.vehicle, count_of(1), item(0))
    loaded_us = day.now_us - 1
    day.send(day.station, mavlink.MAVLink_mission_clear_all_message(3, 1, everything))
    day.send(day.vehicle, ack(everything))
    assert [day.answers().mission(kind) for kind in (0, 1, 2)] == [(), (), ()]
    assert len(day.answers(loaded_us).mission(MISSION) or ()) == 1


def test_home_is_that_at_the_position_of_playback(day: Day) -> None:
    for lat, since_us in ((470_000_000, 1), (470_000_000, 2), (480_000_000, 3)):
        place = (lat, 85_000_000, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
        day.send(day.vehicle, mavlink.MAVLink_home_position_message(*place, since_us))
    frames = [day.answers(START_US + k * SECOND_US).frames(242) for k in range(3)]
    latitudes = [[read_back(frame).latitude for frame in each] for each in frames]
    assert latitudes == [[470_000_000], [470_000_000], [480_000_000]]


def test_values_never_sent_are_unknown(day: Day) -> None:
    day.send(day.station, value("ALPHA", 1.0))
    answers = day.answers()
    assert answers.parameters() == {}
    assert answers.frames(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION) == []
    assert answers.mission(MISSION) is None
    assert not answers.has_message(mavlink.MAVLINK_MSG_ID_PARAM_VALUE)
