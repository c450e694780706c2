"""The recorder on a real folder and on a small disk, turned by hand on a manual clock."""

import errno
import itertools
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.live.part import PENDING_LIMIT
from gateway.live.part_files import PartFiles
from gateway.live.recorder import HELD_BYTES
from gateway.live.session import RETRY_US, session_name
from gateway.recordings.index import RecordingError, list_recordings
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableHeader, TableNote
from gateway.records import FusedSample, FusionState
from tests.kit.faults import refusing
from tests.kit.mavlink import Sender
from tests.kit.recorder import (
    FRAMES,
    HEADER,
    NAME,
    UNIX_US,
    ListedRun,
    MakeBench,
    RecorderBench,
    frames_of,
    read_table,
)
from tests.kit.recordings import read_tlog
from tests.recordings.samples import make_baro, make_flight, make_fused

pytestmark = pytest.mark.io

RETRY_S = RETRY_US / 1e6
PIECE = bytes(1 << 20)
POSITION = mavlink.MAVLink_global_position_int_message(
    0, -353_632_621, 1_491_652_374, 0, 0, 0, 0, 0, 0
)


@pytest.fixture
async def bench(make_bench: MakeBench) -> RecorderBench:
    """Return a recorder that records."""
    made = make_bench()
    await made.turn()
    return made


async def test_every_frame_is_in_the_tlog_at_its_time(bench: RecorderBench) -> None:
    begin_us = bench.clock()
    await bench.record(FRAMES)
    records = read_tlog(bench.recorder.folder / f"{NAME}_01.tlog")
    assert [record.frame for record in records] == FRAMES
    for i, record in enumerate(records):
        assert 0 <= UNIX_US + begin_us + 1000 * (i + 1) - record.time_us < 4
    assert bench.announced == [(False, f"Recording {NAME}")]


async def test_armed_mode_records_from_memory_before_arming_to_ten_seconds_after_disarming(
    make_bench: MakeBench,
) -> None:
    bench, sender = make_bench(mode="armed", name="place"), Sender(7)
    recorder = bench.recorder
    for second in range(230):
        # Armed from 100 to 120 and from 170 to 190 s; turned on every second.
        armed = 100 <= second < 120 or 170 <= second < 190
        bench.send([sender.heartbeat(armed=armed), sender.pack(POSITION)])
        recorder.set_in_flight(in_flight=False, operates=False)
        assert recorder.expected == (recorder.status().state == "recording" or armed)
        await bench.turn(0.998)
        assert recorder.status().held_s <= 61.0
        if second == 99:
            assert not list(recorder.folder.rglob("*.tlog"))
            assert recorder.status().held_s >= 30.0
    await bench.turn(20.0)
    files = sorted(recorder.folder.rglob("*.tlog"))
    assert [path.name[15:] for path in files] == ["-v7-35.3633S-149.1652E_01.tlog"] * 2
    for path, (begin_s, end_s) in zip(files, ((100, 130), (170, 200)), strict=True):
        times_s = [(record.time_us - UNIX_US) / 1e6 for record in read_tlog(path)]
        assert begin_s - 61 <= times_s[0] <= begin_s - 29
        assert end_s - 1.5 <= times_s[-1] <= end_s + 2
        assert max(np.diff(times_s)) < 1.1
        assert path.name.startswith(session_name(read_tlog(path)[0].time_us - 500_000)[:11])


async def test_table_that_begins_in_memory_has_the_name_of_its_recording(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    homes = {3: (47.4, 8.5), 2: None}
    bench, sender = make_bench(mode="armed", name="place", vehicles_of=lambda: homes), Sender(2)
    await bench.turn()
    bench.fly(make_fused(rng, 10_000 * k) for k in range(20))
    # An own aircraft without samples, whose armed bit may follow the recording.
    bench.send([sender.heartbeat(armed=True), sender.pack(POSITION)])
    for operates, state in ((False, "idle"), (True, "recording")):
        bench.recorder.set_in_flight(in_flight=False, operates=operates)
        await bench.turn()
        assert bench.recorder.status().state == state
    await bench.turn()
    bench.recorder.close()
    (table,) = bench.recorder.folder.glob("*_v3.csv")
    header, _ = read_table(table)
    assert table.name == f"{header.session}_01_v3.csv"
    assert header.session.endswith("-v2-v3-35.3633S-149.1652E")


async def test_armed_bit_of_own_aircraft_and_its_memory_are_bounded(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    bench = make_bench(mode="armed")
    await bench.turn()
    bench.fly(make_flight(rng, 5))
    bench.send([Sender(3).heartbeat(armed=True)])
    bench.recorder.set_in_flight(in_flight=False, operates=False)
    await bench.turn()
    assert bench.recorder.status().state == "idle"
    for _ in range(40):
        await bench.record(2 * [PIECE])
    bench.recorder.set_in_flight(in_flight=False, operates=True)
    await bench.turn()
    await bench.turn()
    assert bench.recorder.status().state == "recording"
    assert HELD_BYTES < bench.recorder.status().part_bytes < 2 * (HELD_BYTES + 3 * len(PIECE))
    assert not bench.troubles


async def test_table_contains_the_flight_and_its_header(
    bench: RecorderBench, rng: np.random.Generator
) -> None:
    flight = [*make_flight(rng, 50), make_baro(rng, 600_000)]
    bench.fly(flight[:25])
    bench.recorder.note("over the wood")
    bench.fly(flight[25:])
    bench.recorder.close()
    header, events = read_table(bench.recorder.folder / f"{NAME}_01_v3.csv")
    assert header == TableHeader(
        mavgate_version="1.2",
        vehicle_id=3,
        session=NAME,
        part=1,
        cold_start=True,
        unix_us_at_zero=UNIX_US,
        settings=HEADER.settings,
        calibration=HEADER.calibration,
    )
    rows = [event for event in events if isinstance(event, TableRow)]
    flat = [r for row in rows for r in (row.baro, row.gps, row.raw) if r is not None]
    wanted = [r.imu if isinstance(r, FusedSample) else r for r in flight]
    assert repr(flat) == repr(wanted)
    assert [e.text for e in events if isinstance(e, TableNote)] == ["over the wood"]


async def test_changed_settings_write_a_new_header_after_the_samples_before(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    """In a recording that began in flight, so that its fusion had no cold start."""
    bench = make_bench()
    bench.fly([make_fused(rng, 0)])
    await bench.turn()
    bench.fly([make_fused(rng, 1000), make_baro(rng, 1500)])
    bench.recorder.settings_changed(3)
    bench.recorder.settings_changed(4)
    bench.fly([make_fused(rng, 2000)])
    bench.recorder.close()
    header, events = read_table(bench.recorder.folder / f"{NAME}_01_v3.csv")
    assert not header.cold_start
    assert [type(event) for event in events] == [TableRow, TableRow, TableHeader, TableRow]


async def test_part_begins_with_the_state_of_the_fusion(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    seen = 0
    bench = make_bench(rotate_min=1, fusion_of=lambda key: FusionState(key, str(seen), b""))
    await bench.turn()
    bench.fly([make_fused(rng, 1000), make_baro(rng, 1500)])
    seen = 2
    await bench.turn(100)
    seen = 3
    bench.recorder.settings_changed(3)
    bench.fly([make_fused(rng, 2000)])
    bench.recorder.close()
    (_, first), (_, second) = map(read_table, sorted(bench.recorder.folder.glob("*.csv")))
    # What waited for the next sample was fused before the second part began.
    assert [type(event) for event in first] == [TableRow, TableRow]
    assert second[0] == FusionState(3, "2", b"")
    assert [type(event) for event in second[1:]] == [TableHeader, TableRow]
    assert second[2].baro is None


FAULTS = {"disk is full": errno.ENOSPC, "disk is read-only": errno.EROFS, "folder has vanished": 0}


@pytest.mark.parametrize("text", FAULTS)
async def test_failing_disk_stops_recording_until_it_recovers(
    bench: RecorderBench, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    kept = FRAMES[:5] if FAULTS[text] else []
    await bench.record(FRAMES[:5])
    with monkeypatch.context() as patch:
        if FAULTS[text]:
            patch.setattr(os, "write", refusing(FAULTS[text]))
        else:
            shutil.rmtree(bench.recorder.folder)
        await bench.record(FRAMES[5:6])
        assert bench.troubles == [f"Recording stopped: {text}"]
        await bench.record(FRAMES[6:7])
    await bench.turn(RETRY_S)
    await bench.record(FRAMES[7:])
    assert frames_of(bench.recorder.folder) == kept + FRAMES[7:]
    assert bench.announced[-1] == (False, f"Recording {NAME}")


async def test_hanging_disk_stops_recording_and_bounds_the_buffer(bench: RecorderBench) -> None:
    await bench.record(2 * (PENDING_LIMIT // len(PIECE)) * [PIECE])
    assert bench.troubles == ["Recording stopped: disk is too slow"]
    (file,) = bench.recorder.folder.glob("*.tlog")
    assert 0 <= file.stat().st_size - PENDING_LIMIT < len(PIECE)


async def test_each_part_begins_with_the_introduction_of_its_aircraft(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    """And no frame is lost between two parts."""
    bench = make_bench(rotate_min=1, table=False, introduction_of=lambda _: FRAMES[:3])
    await bench.turn()
    for frame, seconds in zip(FRAMES[3:9], (1.0, 100.0, 1.0, 100.0, 1.0, 1.0), strict=True):
        bench.fly([make_fused(rng, bench.clock())])
        await bench.record([frame], seconds)
    bench.recorder.close()
    parts = [read_tlog(path) for path in sorted(bench.recorder.folder.glob("*.tlog"))]
    assert [[record.frame for record in part] for part in parts] == [
        FRAMES[:3] + FRAMES[begin : begin + 2] for begin in (3, 5, 7)
    ]


async def test_gps_time_corrects_the_times_of_a_recording_and_its_name_stays(
    make_bench: MakeBench, rng: np.random.Generator
) -> None:
    bench = make_bench(rotate_min=1)
    bench.unix_at_zero_us = 1_000_000
    await bench.turn()
    await bench.record(FRAMES[:3], 100)
    bench.send(FRAMES[3:5])
    bench.fly([make_fused(rng, 1000)])
    await bench.turn()
    bench.receive_gps_time(UNIX_US)
    await bench.turn()
    bench.send(FRAMES[5:])
    bench.recorder.close()
    name = "19700101-000001"
    tlogs, (table,) = (sorted(bench.recorder.folder.glob(f"*.{end}")) for end in ("tlog", "csv"))
    assert [path.name for path in tlogs] == [f"{name}_0{n}.tlog" for n in (1, 2, 3)]
    assert table.name == f"{name}_02_v3.csv"
    assert read_table(table)[0].unix_us_at_zero == UNIX_US
    records = [record for path in tlogs for record in read_tlog(path)]
    assert [record.frame for record in records] == FRAMES
    times = [record.time_us for record in records]
    assert times == sorted(times)
    assert UNIX_US < times[0] < times[-1] <= UNIX_US + bench.clock()


async def test_differing_times_of_two_aircraft_split_a_session_once_at_most(
    make_bench: MakeBench,
) -> None:
    bench = make_bench(table=False)
    await bench.turn()
    for n in range(60):
        bench.send(FRAMES[:2])
        bench.receive_gps_time(UNIX_US + 5_000_000 * (1 + n % 2), times=20)
        await bench.turn()
    bench.recorder.close()
    assert len(list(bench.recorder.folder.glob("*.tlog"))) <= 2


async def test_save_renames_a_running_recording(make_bench: MakeBench) -> None:
    bench = make_bench(rotate_min=1)
    with pytest.raises(RecordingError, match="nothing was recorded"):
        await bench.recorder.save("x")
    await bench.turn()
    await bench.record(FRAMES[:5])
    with pytest.raises(RecordingError, match="not a name"):
        await bench.recorder.save("../x")
    await bench.recorder.save("first flight")
    await bench.record(FRAMES[5:9], 100)
    await bench.record(FRAMES[9:])
    assert bench.recorder.status().name == "first flight"
    bench.recorder.close()
    (recording,) = list_recordings(bench.recorder.folder)
    names = [path.name for path in recording.files]
    assert names == ["first flight_01.tlog", "first flight_02.tlog"]
    assert frames_of(bench.recorder.folder) == FRAMES


@pytest.mark.parametrize("mode", ["always", "armed"])
async def test_runs_of_the_hub_are_recorded_in_order_with_frames(
    make_bench: MakeBench, mode: str
) -> None:
    bench = make_bench(mode=mode)
    bench.recorder.start()
    assert bench.recorder.takes_frames
    for number in range(0, 40, 8):
        bench.recorder.run(ListedRun(FRAMES[number : number + 7]))
        bench.recorder.frame(FRAMES[number + 7])
    bench.recorder.record()
    await bench.turn()
    await bench.turn()
    bench.recorder.close()
    (path,) = bench.recorder.folder.glob("*.tlog")
    records = list(read_tlog(path))
    assert [each.frame for each in records] == FRAMES
    assert all(b.time_us > a.time_us for a, b in itertools.pairwise(records))


async def test_failed_start_is_reported_and_retried(make_bench: MakeBench) -> None:
    bench = make_bench()
    bench.recorder.folder.write_text("a file where the folder should be")
    bench.recorder.start()
    assert bench.troubles == ["Recording not started: recordings: File exists"]
    bench.recorder.folder.unlink()
    await bench.turn(RETRY_S)
    assert bench.recorder.status().state == "recording"


async def test_recordings_begin_and_frames_are_taken_on_request(make_bench: MakeBench) -> None:
    bench = make_bench(mode="manual")
    recorder = bench.recorder
    recorder.start()
    await recorder.settle()
    assert (recorder.recording, recorder.takes_frames) == (False, False)
    for begin in (0, 20):
        recorder.record()
        await recorder.settle()
        assert recorder.status().state == "recording"
        bench.send(FRAMES[begin : begin + 10])
        recorder.stop()
        await recorder.settle()
        bench.send(FRAMES[begin + 10 : begin + 20])
        bench.clock.advance(1.0)
    assert (bench.takes_frames[0], bench.takes_frames[-1]) == (True, False)
    assert len(list_recordings(recorder.folder)) == 2
    assert frames_of(recorder.folder) == FRAMES[:10] + FRAMES[20:30]


def test_file_without_content_is_removed_and_another_one_is_not_overwritten(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = (PartFiles(tmp_path, "a", 2) for _ in range(2))
    with monkeypatch.context() as patch:
        patch.setattr(os, "write", refusing(errno.ENOSPC))
        with pytest.raises(OSError, match="No space left"):
            first.write({".tlog": b"x"})
    with pytest.raises(FileExistsError):
        second.write({".tlog": b"y"})
    first.close({})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("is_later", [False, True], ids=["together", "one after the other"])
async def test_two_gateways_that_record_in_one_folder_lose_nothing(
    make_bench: MakeBench, is_later: bool
) -> None:
    """Also where the second one begins once the first one has written."""
    benches = [make_bench(), make_bench()]
    for together in [[bench] for bench in benches] if is_later else [benches]:
        for bench in together:
            await bench.turn(0.0)
        for bench in together:
            bench.send(FRAMES)
        for bench in together:
            await bench.turn(0.0)
    assert {bench.recorder.status().name for bench in benches} == {NAME, f"{NAME}-2"}
    for bench in benches:
        bench.send(FRAMES)
        bench.recorder.close()
        assert bench.troubles == []
    for name in (NAME, f"{NAME}-2"):
        records = read_tlog(bench.recorder.folder / f"{name}_01.tlog")
        assert [record.frame for record in records] == 2 * FRAMES


async def test_recording_is_reported_once_the_disk_has_written_something(
    bench: RecorderBench,
) -> None:
    def outcome() -> tuple[bool, str]:
        return bench.recorder.recording, bench.recorder.trouble

    assert outcome() == (False, "")
    bench.recorder.folder.rmdir()
    await bench.record(FRAMES[:5])
    assert outcome() == (False, "folder has vanished")
    bench.recorder.record()
    await bench.turn()
    assert outcome() == (False, "")
    await bench.record(FRAMES[5:])
    assert outcome() == (True, "")


SIZE = 2 << 20


def mount(*arguments: str) -> None:
    done = subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"mounting is not allowed here: {done.stderr.strip()}")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    if os.geteuid() != 0 or shutil.which("mount") is None:
        pytest.skip("mounting a disk needs root")
    folder = tmp_path / "disk"
    folder.mkdir()
    mount("-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", str(folder))
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.fixture
async def small(small_disk: Path, make_bench: MakeBench) -> RecorderBench:
    made = make_bench(small_disk / "recordings")
    await made.turn()
    await made.record(FRAMES[:5])
    assert made.troubles == []
    return made


async def test_full_disk_stops_recording_until_there_is_space(
    small: RecorderBench, small_disk: Path
) -> None:
    ballast = small_disk / "ballast"
    with pytest.raises(OSError, match="No space left"):
        ballast.write_bytes(bytes(2 * SIZE))
    # The page that the file has begun has room for some of these, which are taken back.
    await small.record(FRAMES[5:] * 20)
    assert small.troubles == ["Recording stopped: disk is full"]
    assert small.recorder.status().reason == "disk is full"
    await small.record(FRAMES[5:8], RETRY_S)
    assert not small.recorder.recording
    ballast.unlink()
    await small.turn(RETRY_S)
    await small.record(FRAMES[8:])
    assert small.recorder.recording
    assert frames_of(small.recorder.folder) == FRAMES[:5] + FRAMES[8:]
    assert small.announced[-1] == (False, f"Recording {NAME}")
    assert len(small.troubles) == 1
