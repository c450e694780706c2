"""A tlog that is made while it is played."""

import asyncio
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.live.player_edge import PlayerEdge
from gateway.recordings import files as recording_streams
from gateway.recordings.files import temporary_copy
from gateway.recordings.opening import PIECE, FusedTlog
from gateway.recordings.play import Player, Track
from gateway.wire.recorded_frames import RecordedFrame
from tests.conftest import ManualClock
from tests.kit.recordings import START_US, STEP_US, make_records, play_all

pytestmark = pytest.mark.io

RECORDS = make_records(1000)
END_US = RECORDS[-1].time_us


class Making:
    """Records that count how many of them were made."""

    def __init__(self) -> None:
        self.made = 0

    def __iter__(self) -> Iterator[RecordedFrame]:
        for record in RECORDS:
            self.made += 1
            yield record


@pytest.fixture
def making() -> Making:
    return Making()


@pytest.fixture
def tlog(making: Making) -> Iterator[FusedTlog]:
    opened = FusedTlog(iter(making), END_US)
    yield opened
    opened.close()


def test_frames_are_made_on_demand(making: Making, tlog: FusedTlog) -> None:
    assert making.made <= 2 * PIECE
    track = Track(tlog)
    assert (track.first_us, track.last_us) == (START_US, END_US)
    assert tlog.index.senders.origins == {0x101}
    for record in RECORDS[:100]:
        assert track.peek_us() == record.time_us
        assert track.take() == record.frame
    assert making.made <= 100 + 2 * PIECE
    assert play_all(track) == RECORDS[100:]


def test_frames_are_played_again_after_seeking_back(tlog: FusedTlog) -> None:
    track = Track(tlog)
    assert play_all(track) == RECORDS
    track.seek(START_US + 300 * STEP_US)
    assert play_all(track) == RECORDS[300:]


def test_preparing_proceeds_in_small_pieces_to_the_end(making: Making, tlog: FusedTlog) -> None:
    made = making.made
    assert not tlog.prepare(START_US + 500 * STEP_US)
    assert making.made <= made + PIECE
    while not tlog.prepare(START_US + 500 * STEP_US):
        pass
    assert 500 <= making.made <= 500 + 2 * PIECE
    while not tlog.prepare(2 * END_US):
        pass
    assert making.made == len(RECORDS)


async def test_playback_continues_until_a_seek_is_ready(
    making: Making, tlog: FusedTlog, clock: ManualClock
) -> None:
    frames: list[bytes] = []
    edge = PlayerEdge(Player([Track(tlog)], clock()), frames.extend, clock)
    edge.start()
    edge.seek("10")
    assert edge.status().state == "seeking"
    assert edge.status().duration_s == pytest.approx((END_US - START_US) / 1e6)
    clock.advance(STEP_US / 1e6)
    edge.seek("+5")
    assert frames == [record.frame for record in RECORDS[:2]]
    for _ in range(2 * len(RECORDS)):
        await asyncio.sleep(0)
    assert edge.status().state == "playing"
    assert edge.status().position_s == pytest.approx(15.0)
    assert frames[-1] == RECORDS[15_000_000 // STEP_US].frame
    assert making.made < len(RECORDS)
    edge.close()


FULL = Path("/dev/full")
needs_full_disk = pytest.mark.skipif(not FULL.exists(), reason="needs a disk that is always full")


@needs_full_disk
def test_full_disk_ends_the_playback_with_a_warning(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: FULL.open("w+b"))
    file = FusedTlog(iter(RECORDS))
    assert file.prepare(RECORDS[-1].time_us)
    assert "The rest cannot be played" in caplog.text
    file.close()


@needs_full_disk
def test_full_disk_of_a_copy_is_reported_with_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.bin"
    monkeypatch.setattr(recording_streams, "TemporaryFile", lambda **_: FULL.open("wb"))
    text = f"No space left on device for a copy of {path}"
    with pytest.raises(OSError, match=text) as caught, temporary_copy(path, [b"1"]):
        pass
    assert caught.value.filename == tempfile.gettempdir()


def test_copy_has_no_name_so_that_nothing_is_left_of_it(tmp_path: Path, temporary: Path) -> None:
    temporary.mkdir()
    with temporary_copy(tmp_path / "a.bin", [b"content"]) as copy:
        assert list(temporary.iterdir()) == []
        assert Path(recording_streams.name_of(copy)).read_bytes() == b"content"
