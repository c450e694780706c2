"""A track reads on, seeks, and returns the state before."""

import pytest

from gateway.wire.mavlink_splitter import message_id_of
from tests.kit.recordings import START_US, STEP_US, make_records, make_tlog, make_track, play_all


def test_track_yields_every_record() -> None:
    records = make_records(5000)
    track = make_track(make_tlog(records))
    assert (track.first_us, track.last_us) == (records[0].time_us, records[-1].time_us)
    assert play_all(track) == records
    with pytest.raises(ValueError, match="ended"):
        track.take()


@pytest.mark.parametrize("at", [0, 1, 255, 256, 257, 4999])
def test_seek_goes_to_the_first_record_not_before(at: int) -> None:
    records = make_records(5000)
    track = make_track(make_tlog(records))
    track.seek(records[at].time_us - STEP_US + 1)
    assert play_all(track) == records[at:]


def test_seek_behind_the_end_yields_no_frame_and_to_zero_all() -> None:
    records = make_records(10)
    track = make_track(make_tlog(records))
    track.seek(START_US + 10**9)
    assert track.peek_us() is None
    track.seek(0)
    assert play_all(track) == records


def test_seek_sends_the_newest_state_messages() -> None:
    records = make_records(300)
    track = make_track(make_tlog(records))
    context = track.seek(records[100].time_us)
    assert context == [records[97].frame, records[99].frame]
    assert [message_id_of(frame) for frame in context] == [31, 0]


def test_times_are_shifted_and_senders_replaced() -> None:
    records = make_records(4)
    track = make_track(make_tlog(records), shift_us=1000, system_ids={1: 9})
    assert track.first_us == START_US + 1000
    found = play_all(track)
    assert [record.time_us for record in found] == [r.time_us + 1000 for r in records]
    assert {record.frame[5] for record in found} == {9}
    track.seek(START_US + 1000 + STEP_US)
    assert track.peek_us() == START_US + 1000 + STEP_US


def test_track_of_an_empty_recording_is_empty() -> None:
    track = make_track(b"")
    assert (track.peek_us(), track.first_us, track.last_us) == (None, 0, 0)
    assert track.seek(0) == []
