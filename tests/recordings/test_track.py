"""A track reads on, seeks, and returns the state before."""

import pytest

from gateway.recordings.play import Track
from gateway.recordings.tlog import TlogRecord, TlogScanner
from gateway.recordings.tlog_index import TlogIndex
from gateway.wire.mavlink_splitter import message_id_of
from tests.kit.recordings import START_US, STEP_US, make_records, make_tlog


class Source:
    """A tlog in memory."""

    def __init__(self, data: bytes, index: TlogIndex) -> None:
        self.data, self.index = data, index
        self.last_us = index.last_us or 0

    def read(self, offset: int, size: int) -> bytes:
        return self.data[offset : offset + size]

    def prepare(self, until_us: int) -> bool:
        return True


def make_track(data: bytes, **options: object) -> Track:
    index = TlogIndex()
    index.add(TlogScanner().feed(data, final=True))
    return Track(Source(data, index), **options)


def play_all(track: Track) -> list[TlogRecord]:
    found = []
    while (time_us := track.peek_us()) is not None:
        found.append(TlogRecord(time_us, track.take()))
    return found


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
