"""The recorder on a disk that syncs slowly or fails to: it writes all the same."""

import asyncio
from pathlib import Path

import pytest

from gateway.live.session import RETRY_US
from tests.kit.faults import FAR_S, SlowDisk
from tests.kit.process import until
from tests.kit.recorder import FRAMES, NAME, UNIX_US, MakeBench, RecorderBench, frames_of

pytestmark = pytest.mark.io


@pytest.fixture
async def bench(make_bench: MakeBench, disk: SlowDisk) -> RecorderBench:
    made = make_bench(rotate_min=1)
    await made.turn()
    await made.record(FRAMES[:5])
    await disk.await_sync()
    return made


async def record_each(bench: RecorderBench, frames: list[bytes]) -> None:
    """Record the last frames one by one, while a sync may run."""
    for frame in frames:
        await asyncio.wait_for(bench.record([frame]), FAR_S)
    assert frames_of(bench.recorder.folder) == FRAMES


async def begin_end(bench: RecorderBench) -> asyncio.Task[None]:
    """Record the last frames, and begin to end the recording."""
    bench.send(FRAMES[5:])
    bench.recorder.stop()
    turn = asyncio.create_task(bench.turn())
    await until(lambda: bench.recorder.status().state == "idle")
    return turn


async def test_writes_do_not_wait_for_a_sync(bench: RecorderBench, disk: SlowDisk) -> None:
    await record_each(bench, FRAMES[5:])
    assert bench.troubles == []
    assert disk.count == 1
    disk.may_end.set()
    bench.recorder.close()
    assert disk.count == 3, "of the folder, of the file, and at the end"


async def test_next_sync_begins_once_the_last_has_ended(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    await bench.turn()
    disk.may_end.set()
    # The first one syncs the folder, and then the file.
    await disk.await_sync()
    async with asyncio.timeout(FAR_S):
        while not disk.begun.acquire(blocking=False):
            await bench.turn()
    assert disk.most == 1


async def test_failed_sync_stops_recording_until_the_disk_recovers(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    bench.send(FRAMES[5:6])
    disk.failures = 9
    disk.may_end.set()
    async with asyncio.timeout(FAR_S):
        while not bench.troubles:
            await bench.turn(0.0)
    assert bench.troubles == ["Recording stopped: disk fails"]
    disk.failures = 0
    await bench.turn(RETRY_US / 1e6)
    await bench.record(FRAMES[6:])
    # What could be written before is kept.
    assert frames_of(bench.recorder.folder) == FRAMES
    assert bench.announced[-1] == (False, f"Recording {NAME}")


async def test_recording_ends_after_the_running_sync(
    bench: RecorderBench, disk: SlowDisk, caplog: pytest.LogCaptureFixture
) -> None:
    turn = await begin_end(bench)
    assert len(bench.announced) == 1
    disk.may_end.set()
    await turn
    assert caplog.messages == [], "no file was closed during a sync"
    assert disk.most == 1
    assert bench.announced[-1] == (False, f"Recording {NAME} ended")
    assert frames_of(bench.recorder.folder) == FRAMES


@pytest.mark.parametrize("failures", [2, 3], ids=["sync before the last", "last sync"])
@pytest.mark.parametrize("is_stopped", [True, False], ids=["stopped", "closed"])
async def test_failed_last_sync_is_reported(
    bench: RecorderBench,
    disk: SlowDisk,
    caplog: pytest.LogCaptureFixture,
    is_stopped: bool,
    failures: int,
) -> None:
    """Also where only the sync before it fails, which is of the folder and the file."""
    turn = await begin_end(bench) if is_stopped else None
    disk.failures = failures
    disk.may_end.set()
    if turn is not None:
        await turn
    bench.recorder.close()
    assert "disk fails" in caplog.text
    assert frames_of(bench.recorder.folder) == (FRAMES if is_stopped else FRAMES[:5])


async def test_recorder_closed_during_the_end_of_a_part_closes_its_files(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    turn = await begin_end(bench)
    turn.cancel()
    await asyncio.wait([turn])
    disk.may_end.set()
    bench.recorder.close()
    opened = (each.readlink() for each in Path("/proc/self/fd").iterdir() if each.is_symlink())
    assert bench.recorder.folder not in {path.parent for path in opened}
    assert frames_of(bench.recorder.folder) == FRAMES


@pytest.mark.parametrize("is_corrected", [False, True], ids=["rotated", "corrected"])
async def test_next_part_does_not_wait_for_the_sync_of_the_last(
    bench: RecorderBench, disk: SlowDisk, is_corrected: bool
) -> None:
    """Also where the recording gets its true time."""
    bench.send(FRAMES[5:7])
    if is_corrected:
        bench.receive_gps_time(UNIX_US + 5_000_000)
    await asyncio.wait_for(bench.turn(0.5 if is_corrected else 100.0), FAR_S / 2)
    await record_each(bench, FRAMES[7:])
    names = sorted(path.name for path in bench.recorder.folder.glob("*.tlog"))
    assert names == [f"{NAME}_0{number}.tlog" for number in (1, 2)]
    disk.may_end.set()
    bench.recorder.close()
    assert disk.most <= 1 + is_corrected, "a corrected file is synced next to the present one"


async def test_recording_is_renamed_during_a_slow_sync(
    bench: RecorderBench, disk: SlowDisk
) -> None:
    saving = asyncio.create_task(bench.recorder.save("first flight"))
    await record_each(bench, FRAMES[5:])
    assert {path.name for path in bench.recorder.folder.glob("*.tlog")} == {"first flight_01.tlog"}
    assert not saving.done()
    disk.may_end.set()
    await saving
