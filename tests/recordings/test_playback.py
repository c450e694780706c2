"""The player keeps time on a clock that the test moves."""

import math
from typing import Any

import pytest

from gateway.recordings.play import Player, PlayState
from gateway.recordings.tlog import STRIDE
from gateway.wire.mavlink_splitter import origin_of
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.recordings import (
    START_US,
    STEP_US,
    make_records,
    make_tlog,
    make_track,
    play_all,
    with_jump,
)

MANY = 10_000
RECORDS = make_records(100)
FRAMES = [record.frame for record in RECORDS]
SPAN_US = 99 * STEP_US
ALL = range(100)


def make_player(
    records: list[RecordedFrame] = RECORDS, now_us: int = 0, **options: object
) -> Player:
    return Player([make_track(make_tlog(records))], now_us, **options)


def play_to_end(player: Player, now_us: int = 0) -> list[tuple[int, bytes]]:
    """Poll exactly when the player asks for it."""
    found = []
    while (due_us := player.next_due_us()) is not None:
        now_us = max(now_us, due_us)
        found += [(now_us, frame) for frame in player.poll(now_us, MANY)]
    return found


@pytest.mark.parametrize("speed", [0.1, 0.5, 1.0, 3.0, 100.0])
def test_every_frame_is_played_at_its_time(speed: float) -> None:
    found = play_to_end(make_player(speed=speed, now_us=777), 777)
    assert found == [
        (777 + math.ceil(i * STEP_US / speed), frame) for i, frame in enumerate(FRAMES)
    ]


PART: dict[str, Any] = {"begin_us": START_US + 10 * STEP_US, "end_us": START_US + 20 * STEP_US}
Script = list[tuple[str, Any, Any]]
"""A verb, its time or position in intervals of the recording, and the numbers of the frames that
come, the next due time, or the position."""
SCRIPTS: dict[str, tuple[dict[str, Any], Script]] = {
    "an infinite speed keeps the limit of frames per poll": (
        {"speed": math.inf}, [("thirty", 0, range(30)), ("end", 0, range(30, 100))],
    ),
    "a late poll returns all due frames": ({}, [("poll", 10, range(11)), ("due", 0, 11)]),
    "a pause stops the clock": ({}, [
        ("poll", 0, [0]), ("pause", 0.5, ()), ("due", 0, None), ("poll", 10, ()),
        ("resume", 10, ()), ("due", 0, 10.5),
    ]),
    "a step plays a number of frames and pauses": ({}, [
        ("step", 1, [0]), ("step", 3, [1, 2, 3]), ("due", 0, None), ("resume", 2, ()),
        ("due", 0, 3), ("step", MANY, range(4, 100)), ("step", 1, ()),
    ]),
    "the speed changes from the present position": ({}, [
        ("poll", 0, [0]), ("double", 0.5, ()), ("due", 0, 0.75),
    ]),
    "a seek sends state messages first": ({}, [
        ("poll", 0, [0]), ("seek", 50, ()), ("due", 0, 0), ("poll", 0, [48, 49, 50]),
        ("position", 0, 50), ("due", 0, 1),
    ]),
    "a seek while paused sends the state and stays paused": ({}, [
        ("pause", 0, ()), ("seek", 50, ()), ("due", 0, 0), ("poll", 0, [48, 49]),
        ("due", 0, None),
    ]),
    "a seek before the range is clamped": (PART, [("seek", -1e9, ()), ("position", 0, 10)]),
    "a seek behind the range is clamped": (PART, [("seek", 1e9, ()), ("position", 0, 20)]),
    # Before the first message of a kind it is that message.
    "the state is known at every position": ({}, [
        ("pause", 0, ()), ("seek", 0, ()), ("held", 0, {0, 1}), ("seek", 2, ()),
        ("held", 0, {0, 1}), ("seek", 50, ()), ("held", 0, {48, 49}),
    ]),
    "the state follows the played frames": ({}, [
        ("poll", 50, range(51)), ("held", 0, {48, 49}), ("poll", 60, range(51, 61)),
        ("held", 0, {60, 58}),
    ]),
    "a range begins with its state messages": (PART, [("end", 0, [7, 9, *range(10, 21)])]),
    "a range is clamped to the recording": (
        {"begin_us": START_US - 10**15, "end_us": START_US + 10**15}, [("end", 0, ALL)],
    ),
    "a loop restarts at once": ({"loop": True}, [("poll", 99, ALL), ("poll", 100, [0, 1])]),
    "a resumed recording restarts after its end": ({}, [
        ("end", 0, ALL), ("resume", 1000, ()), ("poll", 1000, [0]),
    ]),
}  # fmt: skip


def perform(player: Player, verb: str, at: float) -> Any:
    """Let the player act; return frames, or what it is asked for."""
    at_us = round(at * STEP_US)
    due_us = player.next_due_us()
    verbs: dict[str, Any] = {
        "poll": lambda: player.poll(at_us, MANY), "thirty": lambda: player.poll(at_us, 30),
        "end": lambda: [frame for _, frame in play_to_end(player)],
        "pause": lambda: player.pause(at_us), "resume": lambda: player.resume(at_us),
        "step": lambda: player.step(0, int(at)), "double": lambda: player.set_speed(2.0, at_us),
        "seek": lambda: player.seek(START_US + at_us, 0), "held": player.held,
        "due": lambda: due_us if due_us is None else due_us / STEP_US,
        "position": lambda: (player.position_us - START_US) / STEP_US,
    }  # fmt: skip
    return verbs[verb]()


@pytest.mark.parametrize("name", SCRIPTS)
def test_player_follows_the_script(name: str) -> None:
    options, script = SCRIPTS[name]
    player = make_player(**options)
    for number, (verb, at, expected) in enumerate(script):
        found = perform(player, verb, at)
        if verb in ("due", "position"):
            assert found == expected, (number, verb)
        elif verb == "held":
            assert {*found} == {FRAMES[k] for k in expected}, (number, verb)
        else:
            assert [*(found or ())] == [FRAMES[k] for k in expected], (number, verb)
    assert (player.state is PlayState.ENDED) == (script[-1][0] == "end")


@pytest.mark.parametrize("speed", [0.0, 0.09, 100.1, -1.0, math.nan])
def test_speed_out_of_range_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed"):
        make_player(speed=speed)


GAP_US = 60_000_000


@pytest.mark.parametrize(
    ("jump_us", "options", "end_us"),
    [
        (GAP_US, {}, SPAN_US + GAP_US),
        (GAP_US, {"max_gap_us": 1_000_000}, SPAN_US - STEP_US + 1_000_000),
        (50 * 365 * 86_400_000_000, {}, SPAN_US - STEP_US),
        (-3_600_000_000, {}, SPAN_US - STEP_US),
    ],
    ids=["kept", "shortened", "jump of the clock", "clock set back"],
)
def test_gap_is_kept_or_shortened_and_a_jump_of_the_clock_skipped(
    jump_us: int, options: dict[str, int], end_us: int
) -> None:
    found = play_to_end(make_player(with_jump(RECORDS, 50, jump_us), **options))
    assert [frame for _, frame in found] == FRAMES
    assert found[-1][0] == end_us


def test_several_recordings_interleave_by_time() -> None:
    first = make_track(make_tlog(RECORDS))
    second = make_track(make_tlog(RECORDS), shift_us=STEP_US // 2, system_ids={1: 2})
    player = Player([first, second], 0)
    found = play_to_end(player)
    assert [origin_of(frame)[0] for _, frame in found] == [1, 2] * 100
    assert [time_us for time_us, _ in found] == [i * STEP_US // 2 for i in range(200)]


@pytest.mark.parametrize("at", [0, 1, STRIDE - 1, STRIDE, STRIDE + 1, 999])
def test_seek_goes_to_the_first_record_not_before(at: int) -> None:
    records = make_records(1000)
    track = make_track(make_tlog(records))
    track.seek(records[at].time_us - STEP_US + 1)
    assert play_all(track) == records[at:]


def test_empty_recording_ends_at_once() -> None:
    player = make_player([])
    assert play_to_end(player) == []
    assert player.state is PlayState.ENDED
