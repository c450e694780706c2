"""Recorded commands to vehicles are left out of a playback."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import Sender, packed, read_back
from tests.kit.recordings import Sent, make_tlog, make_track, play_all, records_of, records_sent

VEHICLE, COMPANION, STATION, OLD_STATION = (1, 1), (1, 191), (255, 190), (42, 190)
CHANNELS = [1500] * 8

TELEMETRY = [
    (VEHICLE, mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)),
    (VEHICLE, mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)),
    (VEHICLE, mavlink.MAVLink_odometry_message(
        0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0] * 21, [0] * 21)),
    (COMPANION, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
    (COMPANION, mavlink.MAVLink_statustext_message(6, b"here")),
]  # fmt: skip
ANSWERS = [
    (VEHICLE, mavlink.MAVLink_param_value_message(b"A", 1.0, 9, 1, 0)),
    (VEHICLE, mavlink.MAVLink_command_ack_message(400, 0)),
    (VEHICLE, mavlink.MAVLink_mission_count_message(255, 190, 3)),
    (VEHICLE, mavlink.MAVLink_mission_request_int_message(42, 190, 3)),
]
"""To a station that asked in flight."""
COMMANDS = [
    (OLD_STATION, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)),
    (OLD_STATION, mavlink.MAVLink_statustext_message(6, b"hello")),
    (STATION, mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)),
    (STATION, mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)),
    (STATION, mavlink.MAVLink_rc_channels_override_message(1, 1, *CHANNELS)),
    (STATION, mavlink.MAVLink_param_set_message(1, 1, b"A", 2.0, 9)),
    (STATION, mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0)),
    (COMPANION, mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)),
    (COMPANION, mavlink.MAVLink_command_long_message(0, 0, 400, 0, 1, 0, 0, 0, 0, 0, 0)),
    (COMPANION, mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, 0, 1, 2, 3, 0, 0, 0, 0, 0, 0, 0, 0)),
    (COMPANION, mavlink.MAVLink_vision_position_estimate_message(0, 1, 2, 3, 0, 0, 0)),
    (VEHICLE, mavlink.MAVLink_set_mode_message(2, 1, 0)),
]  # fmt: skip


def frames_of(sent: Sent) -> list[bytes]:
    return [packed(message, *origin) for origin, message in sent]


def played(records: list[RecordedFrame], **options: bool) -> list[bytes]:
    return [record.frame for record in play_all(make_track(make_tlog(records), **options))]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda said: said[1].get_type())
def test_commands_are_not_played_by_default(command: tuple[tuple[int, int], Any]) -> None:
    # The last heartbeat shows which system was a station all the time.
    sent = [*TELEMETRY[:2], command, *TELEMETRY[2:], COMMANDS[0]]
    assert played(records_sent(sent)) == frames_of(TELEMETRY)


@pytest.mark.parametrize("answer", ANSWERS, ids=lambda said: said[1].get_type())
def test_answers_to_commands_are_left_out_without_a_gap_in_the_sequence(
    answer: tuple[tuple[int, int], Any],
) -> None:
    vehicle = Sender(*VEHICLE)
    sent = [TELEMETRY[0], answer, answer, TELEMETRY[1], answer, TELEMETRY[0]]
    records = records_of(vehicle.pack(message) for _, message in sent)
    found = [read_back(frame) for frame in played(records)]
    assert [m.get_type() for m in found] == ["HEARTBEAT", "ATTITUDE", "HEARTBEAT"]
    assert [m.get_seq() for m in found] == [0, 1, 2]


def test_commands_are_played_on_request() -> None:
    sent = [*TELEMETRY, *COMMANDS]
    assert played(records_sent(sent), with_commands=True) == frames_of(sent)


def test_seek_leaves_out_recorded_commands() -> None:
    records = records_sent([*TELEMETRY, *COMMANDS, TELEMETRY[0]])
    data, last_us = make_tlog(records), records[-1].time_us
    context = make_track(data).seek(last_us)
    assert {(frame[5], frame[6]) for frame in context} == {VEHICLE, COMPANION}
    assert len(make_track(data, with_commands=True).seek(last_us)) > len(context)


def test_truncated_heartbeat_is_no_ground_station() -> None:
    first, *others = frames_of(TELEMETRY)
    short = bytes((first[0], 0)) + first[2:10] + first[-2:]
    assert played(records_of([short, *others]))[0] == short
