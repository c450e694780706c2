"""The recorder on a disk that syncs slowly or fails to: it writes all the same."""

import asyncio
import errno
import logging
import os
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from gateway.live.part_files import PartFiles
from gateway.live.session import RETRY_US, ClosePart, CorrectTimes, OpenPart, SessionAction
from tests.conftest import ManualClock
from tests.kit.recorder import FRAMES, NAME, RecorderBench, frames_of

pytestmark = pytest.mark.io

FAR_S = 60.0
"""After which what waits for a sync makes a test fail."""


class SlowDisk:
    """Syncs of files and folders end when they may."""

    def __init__(self) -> None:
        self.begun = threading.Semaphore(0)
        self.may_end = threading.Event()
        self.fails = False
        self.syncing = self.most = 0

    def sync(self, file: int) -> None:
        self.syncing += 1
        self.most = max(self.most, self.syncing)
        self.begun.release()
        self.may_end.wait(FAR_S)
        os.fstat(file)
        self.syncing -= 1
        if self.fails:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    async def await_sync(self) -> None:
        assert await asyncio.to_thread(self.begun.acquire, timeout=FAR_S)


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> Iterator[SlowDisk]:
    made = SlowDisk()
    monkeypatch.setattr(os, "fsync", made.sync)
    monkeypatch.setattr(os, "fdatasync", made.sync)
    yield made
    made.may_end.set()


@pytest.fixture
async def bench(tmp_path: Path, clock: ManualClock, disk: SlowDisk) -> AsyncIterator[RecorderBench]:
    made = RecorderBench(tmp_path / "recordings", clock)
    await made.turn()
    await made.record(FRAMES[:5])
    await disk.await_sync()
    yield made
    disk.may_end.set()
    made.recorder.close()


async def await_closing(bench: RecorderBench) -> None:
    async with asyncio.timeout(FAR_S):
        while bench.recorder._files is not None:
            await asyncio.sleep(0)


async def record_each(bench: RecorderBench, frames: list[bytes]) -> None:
    """Record the last frames one by one, while a sync may run."""
    for frame in frames:
        await asyncio.wait_for(bench.record([frame]), FAR_S)
    assert frames_of(bench.recorder.folder) == FRAMES


async def test_writes_do_not_wait_for_a_sync(bench: RecorderBench, disk: SlowDisk) -> None:
    syncing = bench.recorder._syncing
    await record_each(bench, FRAMES[5:])
    assert bench.troubles == []
    assert bench.recorder._syncing is syncing


async def test_next_sync_begins_once_the_last_has_ended(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    await bench.turn()
    disk.may_end.set()
    assert bench.recorder._syncing is not None
    await asyncio.wrap_future(bench.recorder._syncing)
    while disk.begun.acquire(blocking=False):
        pass
    await bench.turn()
    await disk.await_sync()
    assert disk.most == 1


async def test_failed_sync_stops_recording_until_the_disk_recovers(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    disk.fails = True
    disk.may_end.set()
    assert bench.recorder._syncing is not None
    await asyncio.wait([asyncio.wrap_future(bench.recorder._syncing)])
    await bench.record(FRAMES[5:6])
    assert bench.troubles == ["Recording stopped: disk fails"]
    disk.fails = False
    await bench.turn(RETRY_US / 1e6)
    await bench.record(FRAMES[6:])
    # What could be written before is kept.
    assert frames_of(bench.recorder.folder) == FRAMES
    assert bench.announced[-1] == (False, f"Recording {NAME}")


async def test_recording_ends_after_the_running_sync(
    bench: RecorderBench, disk: SlowDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed: list[int] = []
    close_all = PartFiles._close_all

    def note(files: PartFiles) -> None:
        closed.append(disk.syncing)
        close_all(files)

    monkeypatch.setattr(PartFiles, "_close_all", note)
    bench.send(FRAMES[5:])
    bench.recorder.stop()
    turn = asyncio.create_task(bench.turn())
    await await_closing(bench)
    assert closed == []
    assert len(bench.announced) == 1
    disk.may_end.set()
    await turn
    assert closed == [0]
    assert disk.most == 1
    assert bench.announced[-1] == (False, f"Recording {NAME} ended")
    assert frames_of(bench.recorder.folder) == FRAMES


@pytest.mark.parametrize("by", ["stop", "end"])
async def test_failed_last_sync_is_reported(
    bench: RecorderBench, disk: SlowDisk, caplog: pytest.LogCaptureFixture, by: str
) -> None:
    disk.fails = True
    disk.may_end.set()
    with caplog.at_level(logging.WARNING):
        if by == "stop":
            await bench.recorder._close_part(bench.recorder._part, is_last=True)
        else:
            bench.recorder.close()
    assert "disk fails" in caplog.text
    assert frames_of(bench.recorder.folder) == FRAMES[:5]


async def test_recorder_closed_during_the_end_of_a_part_closes_its_files(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    files = bench.recorder._files
    assert files is not None
    bench.send(FRAMES[5:])
    bench.recorder.stop()
    turn = asyncio.create_task(bench.turn())
    await await_closing(bench)
    turn.cancel()
    await asyncio.wait([turn])
    disk.may_end.set()
    bench.recorder.close()
    assert files._files == {}
    assert frames_of(bench.recorder.folder) == FRAMES


@pytest.mark.parametrize("between", [[], [CorrectTimes()]])
async def test_next_part_does_not_wait_for_the_sync_of_the_last(
    bench: RecorderBench, disk: SlowDisk, between: list[SessionAction]
) -> None:
    """Also where the recording gets its true time."""
    part = bench.recorder._part
    assert part is not None
    bench.send(FRAMES[5:7])
    actions = [ClosePart(), *between, OpenPart(part.session, part.number + 1)]
    await asyncio.wait_for(bench.recorder._perform(actions), FAR_S / 2)
    await record_each(bench, FRAMES[7:])
    names = sorted(path.name for path in bench.recorder.folder.glob("*.tlog"))
    assert names == [f"{part.session}_0{number}.tlog" for number in (1, 2)]
    disk.may_end.set()
    bench.recorder.close()
    assert disk.most == 1


async def test_recording_is_renamed_during_a_slow_sync(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    saving = asyncio.create_task(bench.recorder.save("first flight"))
    await record_each(bench, FRAMES[5:])
    assert {path.name for path in bench.recorder.folder.glob("*.tlog")} == {"first flight_01.tlog"}
    assert not saving.done()
    disk.may_end.set()
    await saving
