"""The recorder on a real folder, turned by hand on a manual clock."""

import errno
import os
import shutil
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.live.part import PENDING_LIMIT
from gateway.live.part_files import PartFiles
from gateway.live.recorder import HELD_BYTES
from gateway.live.session import RETRY_US, session_name
from gateway.recordings.columns import TableRow
from gateway.recordings.index import RecordingError, list_recordings
from gateway.recordings.table import TableHeader, TableNote, TableReader
from gateway.records import FusedSample, FusionState
from gateway.wire.timesync import ENOUGH
from tests.conftest import ManualClock
from tests.kit.mavlink import Sender
from tests.kit.recorder import FRAMES, HEADER, NAME, UNIX_US, RecorderBench, frames_of
from tests.kit.recordings import read_tlog
from tests.recordings.samples import make_baro, make_flight, make_fused

pytestmark = pytest.mark.io


@pytest.fixture
async def bench(tmp_path: Path, clock: ManualClock) -> AsyncIterator[RecorderBench]:
    made = RecorderBench(tmp_path / "recordings", clock)
    yield made
    made.recorder.close()


async def test_every_frame_is_in_the_tlog_at_its_time(bench: RecorderBench) -> None:
    await bench.turn()
    begin_us = bench.clock()
    await bench.record(FRAMES)
    records = read_tlog(bench.recorder.folder / f"{NAME}_01.tlog")
    assert [record.frame for record in records] == FRAMES
    for i, record in enumerate(records):
        assert 0 <= UNIX_US + begin_us + 1000 * (i + 1) - record.time_us < 4
    assert bench.announced == [(False, f"Recording {NAME}")]


POSITION = mavlink.MAVLink_global_position_int_message(
    0, -353_632_621, 1_491_652_374, 0, 0, 0, 0, 0, 0
)


def heartbeat(sender: Sender, *, armed: bool) -> bytes:
    mode = mavlink.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
    return sender.pack(mavlink.MAVLink_heartbeat_message(2, 3, mode, 0, 4, 3))


async def test_armed_mode_records_from_memory_before_arming_to_ten_seconds_after_disarming(
    tmp_path: Path, clock: ManualClock
) -> None:
    bench, sender = (
        RecorderBench(tmp_path / "recordings", clock, mode="armed", name="place"),
        Sender(7, 1),
    )
    recorder, files = bench.recorder, []
    try:
        for second in range(230):
            # Armed from 100 to 120 and from 170 to 190 s; turned on every second.
            armed = 100 <= second < 120 or 170 <= second < 190
            bench.send([heartbeat(sender, armed=armed), sender.pack(POSITION)])
            recorder.set_in_flight(in_flight=False, operates=False)
            assert recorder.expected == (recorder.status().state == "recording" or armed)
            await bench.turn(0.998)
            assert recorder.status().held_s <= 61.0
            if second == 99:
                assert not list(tmp_path.rglob("*.tlog"))
                assert recorder.status().held_s >= 30.0
        await bench.turn(20.0)
        files = sorted(tmp_path.rglob("*.tlog"))
    finally:
        recorder.close()
    assert [path.name[15:] for path in files] == ["-v7-35.3633S-149.1652E_01.tlog"] * 2
    for path, (begin_s, end_s) in zip(files, ((100, 130), (170, 200)), strict=True):
        times_s = [(record.time_us - UNIX_US) / 1e6 for record in read_tlog(path)]
        assert begin_s - 61 <= times_s[0] <= begin_s - 29
        assert end_s - 1.5 <= times_s[-1] <= end_s + 2
        assert max(np.diff(times_s)) < 1.1
        assert path.name.startswith(session_name(read_tlog(path)[0].time_us - 500_000)[:11])


async def test_table_that_begins_in_memory_has_the_name_of_its_recording(
    tmp_path: Path, clock: ManualClock, rng: np.random.Generator
) -> None:
    homes = {3: (47.4, 8.5), 2: None}
    bench = RecorderBench(tmp_path, clock, mode="armed", name="place", vehicles_of=lambda: homes)
    sender = Sender(2, 1)
    try:
        await bench.turn()
        for k in range(20):
            bench.recorder.flight(make_fused(rng, 10_000 * k))
        # An own aircraft without samples, whose armed bit may follow the recording.
        bench.send([heartbeat(sender, armed=True), sender.pack(POSITION)])
        bench.recorder.set_in_flight(in_flight=False, operates=False)
        await bench.turn()
        assert bench.recorder.status().state == "idle"
        bench.recorder.set_in_flight(in_flight=False, operates=True)
        await bench.turn()
        await bench.turn()
    finally:
        bench.recorder.close()
    (table,) = tmp_path.glob("*_v3.csv")
    reader = TableReader()
    reader.feed(table.read_bytes())
    assert reader.header is not None
    assert table.name == f"{reader.header.session}_01_v3.csv"
    assert reader.header.session.endswith("-v2-v3-35.3633S-149.1652E")


async def test_armed_bit_of_own_aircraft_and_its_memory_are_bounded(
    tmp_path: Path, clock: ManualClock, rng: np.random.Generator
) -> None:
    bench = RecorderBench(tmp_path / "recordings", clock, mode="armed")
    try:
        await bench.turn()
        for record in make_flight(rng, 5):
            bench.recorder.flight(record)
        bench.send([heartbeat(Sender(3, 1), armed=True)])
        bench.recorder.set_in_flight(in_flight=False, operates=False)
        await bench.turn()
        assert bench.recorder.status().state == "idle"
        for _ in range(40):
            bench.send([bytes(280)] * 5000)
            await bench.turn()
        held = [part.size for _, part in bench.recorder._memory]
        assert len(held) == 2
        assert sum(held) <= 2 * (HELD_BYTES + 5000 * 288)
        bench.recorder.set_in_flight(in_flight=False, operates=True)
        await bench.turn()
        assert bench.recorder.status().state == "recording"
        assert not bench.troubles
    finally:
        bench.recorder.close()


async def test_table_contains_the_flight_and_its_header(
    bench: RecorderBench, rng: np.random.Generator
) -> None:
    await bench.turn()
    flight = make_flight(rng, 50)
    for record in flight[:25]:
        bench.recorder.flight(record)
    bench.recorder.note("over the wood")
    for record in flight[25:]:
        bench.recorder.flight(record)
    bench.recorder.close()
    reader = TableReader()
    data = (bench.recorder.folder / f"{NAME}_01_v3.csv").read_bytes()
    events = reader.feed(data, final=True)
    assert reader.header == TableHeader(
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
    bench: RecorderBench, rng: np.random.Generator
) -> None:
    await bench.turn()
    bench.recorder.settings_changed(3)
    for record in (make_fused(rng, 1000), make_baro(rng, 1500)):
        bench.recorder.flight(record)
    bench.recorder.settings_changed(3)
    bench.recorder.flight(make_fused(rng, 2000))
    bench.recorder.close()
    data = (bench.recorder.folder / f"{NAME}_01_v3.csv").read_bytes()
    events = TableReader().feed(data, final=True)
    assert [type(event) for event in events] == [TableRow, TableRow, TableHeader, TableRow]


async def test_header_of_a_recording_begun_in_flight_reports_no_cold_start(
    bench: RecorderBench, rng: np.random.Generator
) -> None:
    flight = make_flight(rng, 10)
    bench.recorder.flight(flight[0])
    await bench.turn()
    bench.recorder.flight(flight[1])
    bench.recorder.close()
    reader = TableReader()
    reader.feed((bench.recorder.folder / f"{NAME}_01_v3.csv").read_bytes())
    assert reader.header is not None
    assert not reader.header.cold_start


async def test_part_begins_with_the_state_of_the_fusion(
    tmp_path: Path, clock: ManualClock, rng: np.random.Generator
) -> None:
    bench = RecorderBench(tmp_path, clock, rotate_min=1)
    seen = 0
    bench.recorder._state_of = lambda vehicle_id: FusionState(vehicle_id, str(seen), b"")
    await bench.turn()
    flight = [make_fused(rng, 1000), make_baro(rng, 1500), make_fused(rng, 2000)]
    for record in flight[:2]:
        bench.recorder.flight(record)
    seen = 2
    await bench.turn(100)
    seen = 3
    bench.recorder.settings_changed(3)
    bench.recorder.flight(flight[2])
    bench.recorder.close()
    first, second = (
        TableReader().feed(path.read_bytes(), final=True) for path in sorted(tmp_path.glob("*.csv"))
    )
    # What waited for the next sample was fused before the second part began.
    assert [type(event) for event in first] == [TableRow, TableRow]
    assert second[0] == FusionState(3, "2", b"")
    assert [type(event) for event in second[1:]] == [TableHeader, TableRow]
    assert isinstance(second[2], TableRow)
    assert second[2].baro is None


async def test_rotation_loses_nothing(tmp_path: Path, clock: ManualClock) -> None:
    bench = RecorderBench(tmp_path, clock, rotate_min=1)
    await bench.turn()
    for frame in FRAMES:
        await bench.record([frame], 10)
    bench.recorder.close()
    assert len(list(tmp_path.glob(f"{NAME}_*.tlog"))) > 3
    assert frames_of(tmp_path) == FRAMES


async def test_stop_and_start_make_two_recordings(bench: RecorderBench) -> None:
    await bench.turn()
    bench.send(FRAMES[:5])
    bench.recorder.stop()
    await bench.turn()
    bench.send(FRAMES[5:10])
    bench.recorder.record()
    await bench.turn()
    await bench.record(FRAMES[10:])
    assert len(list_recordings(bench.recorder.folder)) == 2
    assert sorted(frames_of(bench.recorder.folder)) == sorted(FRAMES[:5] + FRAMES[10:])


@pytest.mark.parametrize(
    ("number", "text"), [(errno.ENOSPC, "disk is full"), (errno.EROFS, "disk is read-only")]
)
async def test_failing_disk_stops_recording_until_it_recovers(
    bench: RecorderBench, monkeypatch: pytest.MonkeyPatch, number: int, text: str
) -> None:
    await bench.turn()
    await bench.record(FRAMES[:5])

    def refuse(*args: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", refuse)
        await bench.record(FRAMES[5:6])
        assert bench.troubles == [f"Recording stopped: {text}"]
        await bench.record(FRAMES[6:7])
    await bench.turn(RETRY_US / 1e6)
    await bench.record(FRAMES[7:])
    assert frames_of(bench.recorder.folder) == FRAMES[:5] + FRAMES[7:]
    assert bench.announced[-1] == (False, f"Recording {NAME}")


async def test_deleted_folder_is_created_again(bench: RecorderBench) -> None:
    await bench.turn()
    await bench.record(FRAMES[:5])
    shutil.rmtree(bench.recorder.folder)
    await bench.record(FRAMES[5:6])
    assert bench.troubles == ["Recording stopped: folder has vanished"]
    await bench.turn(RETRY_US / 1e6)
    await bench.record(FRAMES[6:])
    assert frames_of(bench.recorder.folder) == FRAMES[6:]


async def test_hanging_disk_stops_recording_and_bounds_the_buffer(bench: RecorderBench) -> None:
    await bench.turn()
    part = bench.recorder._part
    assert part is not None
    piece = bytes(1 << 20)
    for _ in range(2 * (PENDING_LIMIT >> 20)):
        part.add(".tlog", piece)
    assert sum(map(len, part.pending.values())) <= PENDING_LIMIT
    await bench.turn()
    assert bench.troubles == ["Recording stopped: disk is too slow"]


async def test_gps_time_corrects_the_times_of_a_recording_and_its_name_stays(
    tmp_path: Path, clock: ManualClock, rng: np.random.Generator
) -> None:
    bench = RecorderBench(tmp_path / "recordings", clock, rotate_min=1)
    bench.unix_at_zero_us = 1_000_000
    await bench.turn()
    await bench.record(FRAMES[:3], 100)
    bench.send(FRAMES[3:5])
    bench.recorder.flight(make_fused(rng, 1000))
    await bench.turn()
    for _ in range(ENOUGH):
        bench.recorder._civil.update_gps(1, UNIX_US + bench.clock(), bench.clock())
    await bench.turn()
    bench.send(FRAMES[5:])
    bench.recorder.close()
    files = sorted(bench.recorder.folder.iterdir())
    table = files.pop(2)
    name = "19700101-000001"
    assert [path.name for path in files] == [f"{name}_0{n}.tlog" for n in (1, 2, 3)]
    assert table.name == f"{name}_02_v3.csv"
    reader = TableReader()
    reader.feed(table.read_bytes())
    assert reader.header is not None
    assert reader.header.unix_us_at_zero == UNIX_US
    records = [record for path in files for record in read_tlog(path)]
    assert [record.frame for record in records] == FRAMES
    times = [record.time_us for record in records]
    assert times == sorted(times)
    assert UNIX_US < times[0] < times[-1] <= UNIX_US + bench.clock()


async def test_differing_times_of_two_aircraft_split_a_session_once_at_most(
    tmp_path: Path, clock: ManualClock
) -> None:
    bench = RecorderBench(tmp_path / "recordings", clock)
    await bench.turn()
    for n in range(60):
        bench.send(FRAMES[:2])
        wrong_us = 5_000_000 * (1 + n % 2)
        for _ in range(20):
            bench.recorder._civil.update_gps(1, UNIX_US + bench.clock() + wrong_us, bench.clock())
        await bench.turn()
    bench.recorder.close()
    assert len(list(bench.recorder.folder.glob("*.tlog"))) <= 2


async def test_save_renames_a_running_recording(tmp_path: Path, clock: ManualClock) -> None:
    bench = RecorderBench(tmp_path, clock, rotate_min=1)
    await bench.turn()
    await bench.record(FRAMES[:5])
    await bench.recorder.save("first flight")
    await bench.record(FRAMES[5:9], 100)
    await bench.record(FRAMES[9:])
    assert bench.recorder.status().name == "first flight"
    bench.recorder.close()
    (recording,) = list_recordings(tmp_path)
    assert [path.name for path in recording.files] == [
        "first flight_01.tlog",
        "first flight_02.tlog",
    ]
    assert frames_of(tmp_path) == FRAMES


async def test_save_needs_a_recording_and_a_good_name(bench: RecorderBench) -> None:
    with pytest.raises(RecordingError, match="nothing was recorded"):
        await bench.recorder.save("x")
    await bench.turn()
    await bench.record(FRAMES)
    with pytest.raises(RecordingError, match="not a name"):
        await bench.recorder.save("../x")


async def test_recording_wanted_at_start_misses_no_frame(bench: RecorderBench) -> None:
    bench.recorder.start()
    assert bench.recorder.status().state == "recording"
    bench.send(FRAMES)
    bench.recorder.close()
    assert frames_of(bench.recorder.folder) == FRAMES


async def test_failed_start_is_reported_and_retried(
    bench: RecorderBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench.recorder.folder.write_text("a file where the folder should be")
    bench.recorder.start()
    assert bench.troubles == [f"Recording not started: {bench.recorder.folder}: File exists"]
    bench.recorder.folder.unlink()
    await bench.turn(RETRY_US / 1e6)
    assert bench.recorder.status().state == "recording"


async def test_recording_begins_on_request(tmp_path: Path, clock: ManualClock) -> None:
    bench = RecorderBench(tmp_path, clock, mode="manual")
    bench.recorder.start()
    await bench.recorder.settle()
    assert not bench.recorder.recording
    bench.recorder.record()
    await bench.recorder.settle()
    assert bench.recorder.status().state == "recording"
    bench.send(FRAMES)
    bench.recorder.close()
    assert frames_of(bench.recorder.folder) == FRAMES


def test_file_without_content_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = PartFiles(tmp_path, "a", 1)

    def refuse(*args: object) -> int:
        raise OSError(errno.ENOSPC, "full")

    with monkeypatch.context() as patch:
        patch.setattr(os, "write", refuse)
        with pytest.raises(OSError, match="full"):
            files.write({".tlog": b"x"})
    files.close({})
    assert list(tmp_path.iterdir()) == []


def test_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    first = PartFiles(tmp_path, "a", 2)
    first.write({".tlog": b"x"})
    second = PartFiles(tmp_path, "a", 2)
    with pytest.raises(FileExistsError):
        second.write({".tlog": b"y"})
    first.close({})


@pytest.mark.parametrize("is_later", [False, True])
async def test_two_gateways_that_record_in_one_folder_lose_nothing(
    tmp_path: Path, clock: ManualClock, is_later: bool
) -> None:
    """Also where the second one begins once the first one has written."""
    benches = [RecorderBench(tmp_path, clock), RecorderBench(tmp_path, clock)]
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
        records = read_tlog(tmp_path / f"{name}_01.tlog")
        assert [record.frame for record in records] == 2 * FRAMES


async def test_recording_is_reported_once_the_disk_has_written_something(
    bench: RecorderBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def outcome() -> tuple[bool, str]:
        status = bench.recorder.status()
        return bench.recorder.recording, status.reason if status.state == "blocked" else ""

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    with monkeypatch.context() as patch:
        patch.setattr(PartFiles, "_open", refuse)
        await bench.turn()
        assert outcome() == (False, "")
        await bench.record(FRAMES[:5])
        assert outcome() == (False, "disk is read-only")
    bench.recorder.record()
    await bench.turn()
    assert outcome() == (False, "")
    await bench.record(FRAMES[5:])
    assert outcome() == (True, "")
