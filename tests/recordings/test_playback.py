"""The player keeps time on a clock that the test moves."""

import math

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


def make_player(
    records: list[RecordedFrame] = RECORDS, now_us: int = 0, **options: object
) -> Player:
    return Player([make_track(make_tlog(records))], now_us, **options)


@pytest.fixture
def clip() -> Player:
    """Return a player of a part of the recording."""
    return make_player(begin_us=START_US + 10 * STEP_US, end_us=START_US + 20 * STEP_US)


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


def test_infinite_speed_keeps_the_limit_of_frames_per_poll() -> None:
    player = make_player(speed=math.inf)
    assert player.poll(0, 30) == FRAMES[:30]
    assert [frame for _, frame in play_to_end(player)] == FRAMES[30:]
    assert player.state is PlayState.ENDED


@pytest.mark.parametrize("speed", [0.0, 0.09, 100.1, -1.0, math.nan])
def test_speed_out_of_range_is_refused(speed: float) -> None:
    with pytest.raises(ValueError, match="speed"):
        make_player(speed=speed)


def test_late_poll_returns_all_due_frames() -> None:
    player = make_player()
    assert player.poll(10 * STEP_US, MANY) == FRAMES[:11]
    assert player.next_due_us() == 11 * STEP_US


def test_pause_stops_the_clock() -> None:
    player = make_player()
    player.poll(0, MANY)
    player.pause(STEP_US // 2)
    assert player.next_due_us() is None
    assert player.poll(10 * STEP_US, MANY) == []
    player.resume(10 * STEP_US)
    assert player.next_due_us() == 10 * STEP_US + STEP_US // 2


def test_step_plays_a_number_of_frames_and_pauses() -> None:
    player = make_player()
    assert player.step(0) == FRAMES[:1]
    assert player.step(0, 3) == FRAMES[1:4]
    assert player.state is PlayState.PAUSED
    player.resume(50)
    assert player.next_due_us() == 50 + STEP_US
    assert player.step(60, MANY) == FRAMES[4:]
    assert player.step(60) == []


def test_speed_changes_from_the_present_position() -> None:
    player = make_player()
    player.poll(0, MANY)
    player.set_speed(2.0, STEP_US // 2)
    assert player.next_due_us() == STEP_US // 2 + STEP_US // 4


def test_seek_sends_state_messages_first() -> None:
    player = make_player()
    player.poll(0, MANY)
    player.seek(START_US + 50 * STEP_US, 1000)
    assert player.next_due_us() == 1000
    frames = player.poll(1000, MANY)
    assert frames == [FRAMES[48], FRAMES[49], FRAMES[50]]
    assert player.position_us == START_US + 50 * STEP_US
    assert player.next_due_us() == 1000 + STEP_US


def test_seek_while_paused_sends_the_state_and_stays_paused() -> None:
    player = make_player()
    player.pause(0)
    player.seek(START_US + 50 * STEP_US, 0)
    assert player.next_due_us() == 0
    assert player.poll(0, MANY) == [FRAMES[48], FRAMES[49]]
    assert player.next_due_us() is None


@pytest.mark.parametrize(("to_us", "number"), [(0, 10), (10**18, 20)])
def test_seek_is_clamped_to_the_range(clip: Player, to_us: int, number: int) -> None:
    clip.seek(to_us, 0)
    assert clip.position_us == START_US + number * STEP_US


@pytest.mark.parametrize(("position", "shown"), [(0, {0, 1}), (2, {0, 1}), (50, {48, 49})])
def test_state_is_known_at_every_position(position: int, shown: set[int]) -> None:
    """Before the first message of a kind it is that message."""
    player = make_player()
    player.pause(0)
    player.seek(START_US + position * STEP_US, 0)
    assert set(player.held()) == {FRAMES[i] for i in shown}


def test_state_follows_the_played_frames() -> None:
    player = make_player()
    player.poll(50 * STEP_US, MANY)
    before = set(player.held())
    player.poll(60 * STEP_US, MANY)
    assert set(player.held()) != before
    assert set(player.held()) <= set(FRAMES[50:61])


def test_range_begins_with_its_state_messages(clip: Player) -> None:
    frames = [frame for _, frame in play_to_end(clip)]
    assert sorted(frames[:2]) == sorted([FRAMES[7], FRAMES[9]])
    assert frames[2:] == FRAMES[10:21]


def test_range_is_clamped_to_the_recording() -> None:
    player = make_player(begin_us=START_US - 10**15, end_us=START_US + 10**15)
    assert (player.begin_us, player.end_us) == (START_US, START_US + SPAN_US)
    assert play_to_end(player)[-1] == (SPAN_US, FRAMES[-1])


def test_loop_restarts_at_once() -> None:
    player = make_player(loop=True)
    assert len(player.poll(SPAN_US, MANY)) == 100
    assert player.state is PlayState.PLAYING
    assert player.poll(SPAN_US + STEP_US, MANY)[:2] == FRAMES[:2]


def test_resume_after_the_end_restarts() -> None:
    player = make_player()
    play_to_end(player)
    assert player.state is PlayState.ENDED
    player.resume(10**9)
    assert player.poll(10**9, MANY) == FRAMES[:1]


def test_gaps_are_kept_or_shortened_to_a_maximum() -> None:
    gap_us = 60_000_000
    kept = play_to_end(make_player(with_jump(RECORDS, 50, gap_us)))
    assert kept[-1][0] == SPAN_US + gap_us
    cut = play_to_end(make_player(with_jump(RECORDS, 50, gap_us), max_gap_us=1_000_000))
    assert cut[-1][0] == SPAN_US - STEP_US + 1_000_000
    assert [frame for _, frame in cut] == FRAMES


@pytest.mark.parametrize("jump_us", [50 * 365 * 86_400_000_000, -3_600_000_000])
def test_jump_of_the_recorded_clock_is_skipped(jump_us: int) -> None:
    found = play_to_end(make_player(with_jump(RECORDS, 50, jump_us)))
    assert [frame for _, frame in found] == FRAMES
    assert found[-1][0] <= SPAN_US


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
