"""Recorded commands to vehicles are left out of a playback."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.play import Track
from gateway.recordings.tlog import TlogScanner, encode_record
from tests.kit.mavlink import packed
from tests.kit.recordings import START_US
from tests.recordings.test_track import make_track, play_all

VEHICLE, COMPANION, STATION, OLD_STATION = (1, 1), (1, 191), (255, 190), (42, 190)
CHANNELS = [1500] * 8

TELEMETRY: list[tuple[tuple[int, int], Any]] = [
    (VEHICLE, mavlink.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)),
    (VEHICLE, mavlink.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0)),
    (VEHICLE, mavlink.MAVLink_odometry_message(
        0, 0, 0, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, [0] * 21, [0] * 21)),
    (COMPANION, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
    (COMPANION, mavlink.MAVLink_statustext_message(6, b"here")),
]  # fmt: skip
ANSWERS: list[tuple[tuple[int, int], Any]] = [
    (VEHICLE, mavlink.MAVLink_param_value_message(b"A", 1.0, 9, 1, 0)),
    (VEHICLE, mavlink.MAVLink_command_ack_message(400, 0)),
    (VEHICLE, mavlink.MAVLink_mission_count_message(255, 190, 3)),
    (VEHICLE, mavlink.MAVLink_mission_request_int_message(42, 190, 3)),
]
"""To a station that asked in flight."""
COMMANDS: list[tuple[tuple[int, int], Any]] = [
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


def tlog_of(said: list[tuple[tuple[int, int], Any]]) -> bytes:
    frames = [packed(message, *who) for who, message in said]
    return b"".join(encode_record(START_US + i, frame) for i, frame in enumerate(frames))


def frames_of(data: bytes) -> list[bytes]:
    return [record.frame for record in TlogScanner().feed(data, final=True).records()]


def played(track: Track) -> list[bytes]:
    return [record.frame for record in play_all(track)]


@pytest.mark.parametrize("command", COMMANDS, ids=lambda said: said[1].get_type())
def test_commands_are_not_played_by_default(command: tuple[tuple[int, int], Any]) -> None:
    # The last heartbeat shows which system was a station all the time.
    data = tlog_of([*TELEMETRY[:2], command, *TELEMETRY[2:], COMMANDS[0]])
    assert played(make_track(data)) == frames_of(tlog_of(TELEMETRY))


@pytest.mark.parametrize("answer", ANSWERS, ids=lambda said: said[1].get_type())
def test_answers_to_commands_are_left_out_without_a_gap_in_the_sequence(
    answer: tuple[tuple[int, int], Any],
) -> None:
    mav, frames = mavlink.MAVLink(None, *VEHICLE), []
    for _, message in [TELEMETRY[0], answer, answer, TELEMETRY[1], answer, TELEMETRY[0]]:
        frames.append(bytes(message.pack(mav)))
        mav.seq += 1
    data = b"".join(encode_record(START_US + i, frame) for i, frame in enumerate(frames))
    found = [mavlink.MAVLink(None).decode(bytearray(frame)) for frame in played(make_track(data))]
    assert [m.get_type() for m in found] == ["HEARTBEAT", "ATTITUDE", "HEARTBEAT"]
    assert [m.get_seq() for m in found] == [0, 1, 2]


def test_commands_are_played_on_request() -> None:
    data = tlog_of([*TELEMETRY, *COMMANDS])
    assert played(make_track(data, with_commands=True)) == frames_of(data)


def test_seek_leaves_out_recorded_commands() -> None:
    data = tlog_of([*TELEMETRY, *COMMANDS, TELEMETRY[0]])
    last_us = START_US + len(TELEMETRY) + len(COMMANDS)
    context = make_track(data).seek(last_us)
    senders = {(frame[5], frame[6]) for frame in context}
    assert senders == {VEHICLE, COMPANION}
    assert len(make_track(data, with_commands=True).seek(last_us)) > len(context)


def test_truncated_heartbeat_is_no_ground_station() -> None:
    (frame,) = frames_of(tlog_of(TELEMETRY[:1]))
    short = bytearray(frame[:10]) + frame[-2:]
    short[1] = 0
    data = encode_record(START_US, bytes(short)) + tlog_of(TELEMETRY[1:])
    assert played(make_track(data))[0] == bytes(short)
