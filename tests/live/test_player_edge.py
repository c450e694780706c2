"""The player on the event loop, with files on the disk."""

import asyncio
import gzip
import math
from collections.abc import Iterable
from pathlib import Path

import pytest

from gateway.clock import GatewayClock
from gateway.live.player_edge import BATCH, PlayerEdge
from gateway.recordings.opening import TlogFile
from gateway.recordings.play import Player, Track
from gateway.wire.recorded_frames import RecordedFrame
from tests.conftest import ManualClock
from tests.kit.recordings import START_US, STEP_US, make_records, make_tlog

pytestmark = pytest.mark.io

COUNT = 24 * BATCH + 7
RECORDS = make_records(COUNT)
FRAMES = [record.frame for record in RECORDS]


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    path = tmp_path / "flight.tlog"
    path.write_bytes(make_tlog(RECORDS))
    return path


class Played:
    """A player edge and its frames."""

    def __init__(self, path: Path, clock: GatewayClock | ManualClock, **options: object) -> None:
        self.file = TlogFile(path)
        self.frames: list[bytes] = []
        self.ended = asyncio.Event()
        player = Player([Track(self.file)], clock(), **options)
        self.edge = PlayerEdge(player, self._emit, clock, files=[path.name], on_end=self.ended.set)

    def _emit(self, frames: Iterable[bytes]) -> None:
        self.frames += frames

    def close(self) -> None:
        self.edge.close()
        self.file.close()


async def test_player_emits_every_frame_and_ends(tlog: Path) -> None:
    played = Played(tlog, GatewayClock(), speed=math.inf)
    played.edge.start()
    await asyncio.wait_for(played.ended.wait(), 60)
    assert played.frames == FRAMES
    status = played.edge.status()
    assert (status.state, status.sent, status.speed) == ("ended", COUNT, None)
    assert status.duration_s == pytest.approx((COUNT - 1) * STEP_US / 1e6)
    assert status.files == ("flight.tlog",)
    played.close()


def test_file_is_indexed_read_at_any_position_and_ends_early_if_it_shrinks(tlog: Path) -> None:
    seen: list[int] = []
    file = TlogFile(tlog, seen.append)
    assert sum(seen) == tlog.stat().st_size
    assert file.index.count == COUNT
    track = Track(file, system_ids={1: 5})
    track.seek(RECORDS[500].time_us)
    assert track.peek_us() == RECORDS[500].time_us
    tlog.write_bytes(make_tlog(RECORDS[:10]))
    track = Track(file)
    track.seek(START_US)
    found = []
    while (time_us := track.peek_us()) is not None:
        found.append(RecordedFrame(time_us, track.take()))
    assert found == RECORDS[:10]
    file.close()
    assert file.read(0, 10) == b""


def test_compressed_tlog_is_played_from_an_unpacked_copy(tlog: Path) -> None:
    plain = TlogFile(tlog)
    packed = tlog.with_name("packed.tlog")
    packed.write_bytes(gzip.compress(tlog.read_bytes()))
    file = TlogFile(packed)
    assert file.index.count == plain.index.count > 0
    assert file.read(100, 500) == plain.read(100, 500)
    for each in (file, plain):
        each.close()
