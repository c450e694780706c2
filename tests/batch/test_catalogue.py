import gzip
import json
import os
import re
import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path, PurePath
from shutil import copy
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.batch import catalogue as indexing
from gateway.batch.catalogue import (
    CATALOGUE_NAME,
    COLUMNS,
    Catalogue,
    CataloguedFile,
    CatalogueError,
    FlightFigures,
    IndexReport,
    figures_of,
    find_flights,
    geojson_of,
    index_folder,
    read_file,
    recordings_below,
)
from gateway.batch.executors import LocalProcesses, ThisProcess
from gateway.batch.facts import CataloguedFlight, began_text, simplified
from gateway.pipeline import PipelineSettings
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.recordings.recorded_table import ReadOptions
from gateway.vehicle_state.positions import TrackPoint
from gateway.wire.recorded_frames import RecordedFrame
from tests.batch.flights import DURATION_S, OUTAGE_S, simulated, write_flight
from tests.kit.cli import invoke
from tests.kit.mavlink import packed
from tests.kit.recordings import make_records, make_tlog, write_tlog

pytestmark = pytest.mark.io

OPTIONS = ReadOptions(PipelineSettings(AircraftSettings()))


class InThisProcess(ThisProcess):
    """Remembers on what it works."""

    def __init__(self) -> None:
        self.seen: list[tuple[str, object]] = []

    def run(self, work, items):
        self.seen += items
        yield from super().run(work, items)


def far_flight() -> list[RecordedFrame]:
    """Ten minutes of two vehicles: one flies two sides of a square, the other sends no position."""
    records = []

    def send(time_s: float, system: int, message: mavlink.MAVLink_message) -> None:
        frame = packed(message, system)
        records.append(RecordedFrame(1_780_000_000_000_000 + round(time_s * 1e6), frame))

    for second in range(600):
        for system in (1, 2):
            send(second, system, mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
        send(second, 255, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        north, east = min(second, 300) * 3.5, max(second - 300, 0) * 4.0
        lat, lon = 470_000_000 + round(north / 0.0111319), 80_000_000 + round(east / 0.0075920)
        height = 400_000 + (50_000 if second > 20 else 0)
        at = (lat, lon, height, height - 400_000, *((350, 0) if second < 300 else (0, 400)))
        send(second + 0.1, 1, mavlink.MAVLink_global_position_int_message(0, *at, 0, 0))
        fix = 1 if 100 <= second < 110 else 3
        send(second + 0.2, 1, mavlink.MAVLink_gps_raw_int_message(0, fix, 0, 0, 0, 0, 0, 0, 0, 9))
    send(300.3, 1, mavlink.MAVLink_statustext_message(2, b"it burns"))
    send(300.4, 1, mavlink.MAVLink_statustext_message(6, b"all is well"))
    for number, drop in enumerate((0, 400)):
        status = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 0, 0, 0, drop, 0, 0, 0, 0, 0)
        send(400 + number, 1, status)
    return sorted(records, key=lambda record: record.time_us)


def index(folder: Path) -> IndexReport:
    return index_folder(folder, OPTIONS, ThisProcess())


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all kinds of files, indexed."""
    folder = tmp_path_factory.mktemp("batch")
    write_flight(folder / "one_01_v1.csv", vehicle=1, day=0)
    write_flight(folder / "deeper" / "two_01_v2.csv", vehicle=2, day=3, lost=10)
    write_tlog(folder / "far.tlog", far_flight())
    (folder / "empty.csv").write_text("")
    (folder / "noise.tlog").write_bytes(bytes(np.random.default_rng(1).integers(0, 255, 5000)))
    (folder / "readme.txt").write_text("no recording")
    (folder / ".hidden.csv").write_text("time_us,x\n")
    index(folder)
    return folder


def row_of(folder: Path, path: str) -> dict:
    (found,) = find_flights(folder, f"path = '{path}'")
    return found


def test_time_of_a_clock_that_counts_from_its_start_is_no_begin() -> None:
    assert began_text(FIRST_CIVIL_US - 1) is None
    assert began_text(FIRST_CIVIL_US) == "2000-01-01 00:00:00"


def test_facts_of_a_table_are_those_of_its_flight(folder: Path) -> None:
    row = row_of(folder, "one_01_v1.csv")
    flown = simulated()
    truth = flown.trajectory.truth_at(np.arange(0.0, DURATION_S, 0.2))
    height = truth.alt_amsl_m - truth.alt_amsl_m[0]
    assert (row["name"], row["vehicle"], row["kind"]) == ("one", 1, "table")
    assert row["began"] == "2026-05-28 20:26:40"
    assert row["duration"] == pytest.approx(DURATION_S, abs=0.2)
    assert row["highest"] == pytest.approx(height.max(), abs=6.0)
    speed = np.hypot(*truth.vel_n_mps[:, :2].T)
    assert row["fastest"] == pytest.approx(speed.max(), abs=1.5)
    assert row["distance"] == pytest.approx(speed.sum() * 0.2, rel=0.1)
    assert row["lat_min"] - 1e-4 < truth.lat_deg.min() < truth.lat_deg.max() < row["lat_max"] + 1e-4
    assert row["gps_outages"] == 1
    assert row["gps_lost"] == pytest.approx(OUTAGE_S[1], abs=0.6)
    assert (row["loss"], row["faults"], row["damaged"], row["error"]) == (0.0, 0, 0, None)
    assert len(row["settings"]) == 12
    lossy = row_of(folder, "deeper/two_01_v2.csv")
    assert lossy["loss"] == pytest.approx(0.1, abs=0.005)
    assert (lossy["settings"], lossy["began"]) == (row["settings"], "2026-05-31 20:26:40")


def test_tlog_has_one_row_for_each_vehicle(folder: Path) -> None:
    first, second = find_flights(folder, "path = 'far.tlog'")
    assert (first["vehicle"], second["vehicle"]) == (1, 2)
    assert first["distance"] == pytest.approx(1050.0 + 1196.0, rel=0.01)
    assert (first["highest"], first["fastest"]) == (50.0, 4.0)
    assert (first["gps_outages"], first["gps_lost"]) == (1, 11.0)
    assert (first["faults"], first["loss"]) == (1, 0.02)
    assert first["takeoff_lat"] == pytest.approx(47.0 + 20 * 3.5 / 111_319.0, abs=1e-5)
    assert second["distance"] is None


def test_clock_jump_of_years_is_not_counted_as_duration(tmp_path: Path) -> None:
    records, leap_us = far_flight(), 30 * 31_556_952_000_000
    records[:1000] = [RecordedFrame(r.time_us - leap_us, r.frame) for r in records[:1000]]
    write_tlog(tmp_path / "a.tlog", records)
    found = read_file(tmp_path, OPTIONS, ("a.tlog", ""))
    (facts, _), (other, _) = found.flights
    assert 590 < facts.duration < 600
    assert 590 < other.duration < 600
    assert facts.gps_lost == pytest.approx(11.0, abs=1.5)


def test_file_deleted_during_indexing_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [write_tlog(tmp_path / name, make_records(9)) for name in ("a.tlog", "b.tlog")]
    index(tmp_path)
    files[0].unlink()
    monkeypatch.setattr(indexing, "recordings_below", lambda _: iter(files))
    report = index(tmp_path)
    assert (report.read, report.broken, report.unchanged) == (1, 1, 1)
    (row,) = find_flights(tmp_path, "error is not null")
    assert (row["path"], row["error"]) == ("a.tlog", "No such file or directory")


@pytest.mark.parametrize("name", ["a.tlog.gz", "packed.tlog"])
def test_compressed_file_is_recognised_by_its_first_bytes(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(gzip.compress(make_tlog(far_flight())))
    found = read_file(tmp_path, OPTIONS, (name, ""))
    assert (found.kind, found.error, len(found.flights)) == ("tlog", None, 2)
    log = tmp_path / "log.bin.gz"
    log.write_bytes(gzip.compress(b"\xa3\x95"))
    assert log in [*recordings_below(tmp_path)]


def test_broken_file_has_a_row_with_the_reason(folder: Path) -> None:
    broken = {row["path"]: row["error"] for row in find_flights(folder, "error is not null")}
    assert set(broken) == {"empty.csv", "noise.tlog"}
    assert "unknown file format" in broken["noise.tlog"]


def test_file_with_non_utf8_name_and_extreme_mtime_is_indexed(tmp_path: Path, folder: Path) -> None:
    odd = copy(folder / "one_01_v1.csv", tmp_path / os.fsdecode(b"fl\xfcg_01_v1.csv"))
    os.utime(odd, (13_000_000_000, 13_000_000_000))
    for read in (1, 0):
        assert index(tmp_path).read == read
    # The facts of an unchanged file stay when its time changes.
    os.utime(odd, (1, 1))
    assert index(tmp_path).read == 1
    row = row_of(tmp_path, r"fl\xfcg_01_v1.csv")
    assert (row["name"], row["vehicle"], row["error"]) == (r"fl\xfcg", 1, None)


def test_only_changed_files_are_read_again(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        (tmp_path / f"{name}.csv").write_text(f"time_us,x\n{name},1\n")
    index(tmp_path)
    (tmp_path / "a.csv").write_text("time_us,x\nother,1,2\n")
    (tmp_path / "b.csv").unlink()
    os.utime(tmp_path / "c.csv", ns=(1, 1))
    executor = InThisProcess()
    report = index_folder(tmp_path, OPTIONS, executor)
    assert sorted(name for name, _ in executor.seen) == ["a.csv", "c.csv"]
    assert (report.read, report.unchanged, report.gone) == (2, 0, 1)
    assert [row["path"] for row in find_flights(tmp_path)] == ["a.csv", "c.csv"]
    assert index_folder(tmp_path, OPTIONS, executor).unchanged == 2


def test_interrupted_indexing_keeps_files_already_read(tmp_path: Path) -> None:
    for number in range(5):
        (tmp_path / f"{number}.csv").write_text("x")

    class Interrupted(InThisProcess):
        def run(self, work, items):
            for number, done in super().run(work, items):
                if number == 3:
                    raise KeyboardInterrupt
                yield number, done

    with pytest.raises(KeyboardInterrupt):
        index_folder(tmp_path, OPTIONS, Interrupted())
    assert index(tmp_path).read == 2


def test_truncated_table_is_read_up_to_its_end(tmp_path: Path, folder: Path) -> None:
    whole = (folder / "one_01_v1.csv").read_bytes()
    (tmp_path / "cut.csv").write_bytes(whole[: len(whole) // 2])
    found = read_file(tmp_path, OPTIONS, ("cut.csv", ""))
    ((facts, _),) = found.flights
    assert found.error is None
    assert facts.damaged == 0
    assert 15.0 < facts.duration < 25.0


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("altitude > 3", "no such column: altitude"),
        ("duration >", "syntax error|incomplete"),
        ("1) UNION SELECT 1", "syntax error"),
        ("1; DROP TABLE flights", "syntax error|one statement"),
        ("duration > 0 -- and", ""),
        ("load_extension('x') > 0", "not authorized|no such function"),
    ],
)
def test_query_condition_cannot_write(folder: Path, where: str, message: str) -> None:
    if not message:
        assert len(find_flights(folder, where)) == 4
        return
    with pytest.raises(CatalogueError, match=f"(?s)({message}).*duration > 300"):
        find_flights(folder, where)
    assert len(find_flights(folder)) == 6


def test_file_that_is_no_catalogue_is_reported(tmp_path: Path) -> None:
    with pytest.raises(CatalogueError, match="no catalogue yet"):
        find_flights(tmp_path)
    (tmp_path / CATALOGUE_NAME).write_text("a diary" * 1000)
    with pytest.raises(CatalogueError, match="delete it"):
        Catalogue(tmp_path)


def catalogued(number: int) -> CataloguedFile:
    return CataloguedFile(f"{number}.csv", f"{number}", None, 1, 2, "d" * 500)


def test_catalogue_of_another_version_is_rebuilt(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path)
    catalogue.put([catalogued(1)])
    catalogue.close()
    with closing(sqlite3.connect(tmp_path / CATALOGUE_NAME)) as database:
        database.execute("PRAGMA user_version = 99")
    with pytest.raises(CatalogueError, match="another version"):
        find_flights(tmp_path)
    Catalogue(tmp_path).close()
    assert find_flights(tmp_path) == []


Statement = Callable[[sqlite3.Connection, str], object]


def watch(patched: pytest.MonkeyPatch, before: Statement) -> None:
    """Call a function before each statement of connections that are opened from now on."""

    class Watched(sqlite3.Connection):
        def execute(self, sql: str, *values: Any) -> sqlite3.Cursor:
            before(self, sql)
            return super().execute(sql, *values)

    patched.setattr(sqlite3, "connect", partial(sqlite3.connect, factory=Watched))


@pytest.mark.parametrize(
    ("code", "message"),
    [(sqlite3.SQLITE_FULL, "make room"), (sqlite3.SQLITE_IOERR | 9 << 8, "delete it and index")],
)
def test_unwritable_catalogue_is_reported_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, message: str
) -> None:
    opened = []

    def fail(database: sqlite3.Connection, sql: str) -> None:
        if sql.startswith("CREATE"):
            opened.append(database)
            error = sqlite3.OperationalError("no luck")
            error.sqlite_errorcode = code
            raise error

    watch(monkeypatch, fail)
    with pytest.raises(CatalogueError, match=f"no luck; .*{message}"):
        Catalogue(tmp_path)
    with pytest.raises(sqlite3.ProgrammingError, match="closed"):
        opened[0].total_changes  # noqa: B018
    assert (tmp_path / CATALOGUE_NAME).exists()
    with pytest.raises(CatalogueError, match="no catalogue yet"):
        find_flights(tmp_path)


def test_catalogue_of_concurrent_indexing_is_kept(tmp_path: Path) -> None:
    first: list[Catalogue] = []

    def make_first(_: sqlite3.Connection, sql: str) -> None:
        if sql.startswith("BEGIN") and not first:
            patched.undo()
            first.append(Catalogue(tmp_path))
            first[0].put([catalogued(1)])

    with pytest.MonkeyPatch.context() as patched:
        watch(patched, make_first)
        second = Catalogue(tmp_path)
    second.put([catalogued(2)])
    assert second.known().keys() == first[0].known().keys() == {"1.csv", "2.csv"}
    for catalogue in (*first, second):
        catalogue.close()


def test_damaged_catalogue_is_reported(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path)
    catalogue.put(catalogued(number) for number in range(200))
    catalogue.close()
    data = (tmp_path / CATALOGUE_NAME).read_bytes()
    (tmp_path / CATALOGUE_NAME).write_bytes(data[:4096] + b"\xff" * (len(data) - 4096))
    with pytest.raises(CatalogueError, match="delete it and index again"):
        index_folder(tmp_path, OPTIONS, LocalProcesses(1))


def test_tracks_are_returned_as_geojson(folder: Path) -> None:
    found = geojson_of(folder, "kind = 'tlog'")
    (flight,) = found["features"]
    line = flight["geometry"]["coordinates"]
    assert line[0][:2] == pytest.approx([8.0, 47.0])
    # Two sides of a square need one corner, and the climb at the start one more position.
    assert 3 <= len(line) <= 5
    assert flight["properties"]["vehicle"] == 1


def test_simplified_track_is_within_tolerance(rng: np.random.Generator) -> None:
    turn = np.linspace(0.0, 20.0, 3000)
    positions = [TrackPoint(0, 1e-3 * a * np.cos(a), 1e-3 * a * np.sin(a), 10.0) for a in turn]
    kept = simplified(positions)
    assert kept[0] == positions[0]
    assert kept[-1] == positions[-1]
    assert 20 < len(kept) < 400
    turn_kept = [turn[positions.index(position)] for position in kept]
    lost = np.interp(turn, turn_kept, [p.lat_deg for p in kept])
    assert np.abs(lost - np.array([p.lat_deg for p in positions])).max() * 111_000.0 < 15.0


def row(path: str, name: str, duration: float, **more: Any) -> dict[str, Any]:
    kind = "table" if path.endswith("csv") else "tlog"
    return {
        "path": path, "name": name, "kind": kind, "vehicle": 1, "duration": duration,
        "distance": None, "highest": None, "height_above": None, "loss": None, "error": None,
    } | more  # fmt: skip


def test_figures_add_up_parts_and_keep_folders_apart() -> None:
    rows = [
        row("a_01.tlog", "a", 60.5, distance=900.0, highest=10.0, height_above="home"),
        row("a_01_v1.csv", "a", 60.0, distance=910.0, highest=11.0, loss=0.1),
        row("a_02_v1.csv", "a", 30.0, distance=90.0, highest=5.0, loss=0.3),
        row("b/a_01.tlog", "a", 5.0, distance=7.0),
        row("b/a_02.tlog", "a", 5.0, vehicle=2),
        row("c_01.tlog", "c", 9.0, error="damaged"),
    ]
    assert figures_of(rows) == {
        PurePath("a"): {1: FlightFigures(90.0, 900.0, 10.0, "home", 0.2)},
        PurePath("b/a"): {1: FlightFigures(5.0, 7.0), 2: FlightFigures(5.0)},
    }


def test_commands_index_list_and_show(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "other").mkdir()
    for name in ("one_01_v1.csv", "one_02_v1.csv", "other/one_01_v1.csv"):
        copy(folder / "one_01_v1.csv", tmp_path / name)
    (tmp_path / "bad.csv").write_text("")
    done = invoke("info", tmp_path, code=0)
    assert "0 unchanged, 3 new, 0 removed, 1 unreadable" in done.output
    listed = invoke("info", tmp_path)
    assert "one_01_v1.csv" in listed.output
    assert re.search(r"2 flights, \S+ h, in 4 files; 1 unreadable", listed.output)
    wanted = ("info", tmp_path, "--where")
    found = json.loads(invoke(*wanted, "duration > 30", "--json").stdout)
    assert [row["name"] for row in found] == ["one"] * 3
    geo = json.loads(invoke(*wanted, "name = 'one'", "--geojson").stdout)
    assert geo["type"] == "FeatureCollection"
    assert "no such column" in invoke(*wanted, "nonsense", code=2).output


def test_every_column_is_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "batch.md").read_text()
    assert [name for name in COLUMNS if f"`{name}`" not in text] == []


def test_several_processes_give_results_of_one(folder: Path, tmp_path: Path) -> None:
    for name in ("one_01_v1.csv", "far.tlog"):
        copy(folder / name, tmp_path)
    index_folder(tmp_path, OPTIONS, LocalProcesses(2))
    expected = find_flights(folder, "path in ('one_01_v1.csv', 'far.tlog')")
    for facts, row in zip(find_flights(tmp_path), expected, strict=True):
        assert {k for k in CataloguedFlight.__struct_fields__ if facts[k] != row[k]} == set()
