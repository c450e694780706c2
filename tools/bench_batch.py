"""Measure work on many recordings: one after the other, in processes, on a Dask cluster.

    python tools/bench_batch.py make                     # simulated recordings; --quick: short ones
    python tools/bench_batch.py fuse --by serial         # or processes, or dask
    python tools/bench_batch.py report --by processes --flights 6
    python tools/bench_batch.py sweep --by processes
    python tools/bench_batch.py growth                   # cost against the number of recordings
    python tools/bench_batch.py hangar                   # a catalogue of 10,000

The recordings lie in --folder and stay there, so each part can be run by itself. Times are wall
clock and CPU of all processes; memory is that of the largest process. What a cluster costs to start
is told apart.
"""

import argparse
import os
import resource
import shutil
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from gateway.aircraft import AircraftSettings
from gateway.analysis.sources import ideal_calibration
from gateway.analysis.tuning.contest import parse_axis
from gateway.flightlog.table.row import TableRow, row_to_line
from gateway.flightlog.table.table import TableHeader, encode_head
from gateway.flights.reading import ReadOptions
from gateway.pipeline import PipelineSettings
from gateway.records import BaroRaw, GpsFix, ImuRaw
from gateway.replay import header_for
from gateway.season.batch.dask_executor import DaskCluster
from gateway.season.batch.flight_tasks import (
    FlightTask,
    FuseTask,
    ReportTask,
    SweepTask,
    warm_up,
)
from gateway.season.batch.result_folder import ResultFolder
from gateway.season.batch.season_run import run_season
from gateway.season.batch.storage import items_of
from gateway.season.executors import Executor, LocalProcesses
from gateway.season.hangar.hangar_file import HANGAR_NAME, find_flights
from gateway.season.hangar.indexing import index_folder
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S
from gateway.units import US_PER_S
from gateway.wire.link import Link

SEEDS = 4
"""Different flights; the others are these under another aircraft and day."""
DAY_0_US = 1_780_000_000 * US_PER_S
DAY_US = 86_400 * US_PER_S
OPTIONS = ReadOptions(PipelineSettings(AircraftSettings()))
QUERIES = ("", "duration > 3 and loss > 0.05", "vehicle = 2 and began >= '2026-09-01'")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("part", choices=("make", "fuse", "report", "sweep", "growth", "hangar"))
    parser.add_argument("--folder", type=Path, default=Path("/tmp/mavgate-season"))
    parser.add_argument("--flights", type=int, default=24)
    parser.add_argument("--files", type=int, default=10_000, help="of the catalogue")
    parser.add_argument("--by", choices=("serial", "processes", "dask"), default="processes")
    parser.add_argument("--quick", action="store_true", help="flights of 60 s, fewer of them")
    chosen = parser.parse_args()
    folder = chosen.folder / ("quick" if chosen.quick else "full")
    match chosen.part:
        case "make":
            make(folder / "flights", chosen.flights, 60.0 if chosen.quick else FLIGHT_S)
        case "hangar":
            hangar(folder, 500 if chosen.quick else chosen.files)
        case "growth":
            growth(folder, chosen.flights)
        case part:
            work(folder, part, chosen.by, chosen.flights)


def make(folder: Path, count: int, duration_s: float) -> None:
    """Write simulated recordings of some aircraft on some days."""
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(min(SEEDS, count)):
        head, rows = simulated_rows(seed + 1, duration_s)
        for number in range(seed, count, SEEDS):
            header = msgspec.structs.replace(
                head,
                vehicle_id=1 + number % 3,
                unix_us_at_zero=DAY_0_US + number // 3 * DAY_US,
            )
            path = folder / f"flight{number:05d}_01_v{header.vehicle_id}.csv"
            path.write_text(encode_head(header) + rows)
    print(f"{count} recordings of {duration_s:.0f} s in {folder}")


def simulated_rows(seed: int, duration_s: float) -> tuple[TableHeader, str]:
    """Fly the simulated tracker, and lay what was received out as the rows of a table."""
    settings = SimulatorSettings(seed=seed)
    calibration = ideal_calibration(SimulatedAircraft(settings).errors)
    columns = {BaroRaw: "baro", GpsFix: "gps", ImuRaw: "raw"}
    link = Link()
    records = (
        record
        for frame in simulate(settings).frames(duration_s)
        for record in link.feed(frame.data, round(frame.time_s * US_PER_S))
    )
    rows = "".join(
        row_to_line(TableRow(record.time_us, **{columns[type(record)]: record}))
        for record in records
        if type(record) in columns
    )
    return header_for(AircraftSettings(calibration=calibration), 1), rows


def task_of(part: str) -> FlightTask:
    """Return the task of a part."""
    if part == "sweep":
        axes = tuple(parse_axis(name, "0.1,0.5,0.9") for name in ("alpha", "beta"))
        return SweepTask(OPTIONS, axes, "held_m", 5, 0.0)
    return FuseTask(OPTIONS) if part == "fuse" else ReportTask(OPTIONS)


@contextmanager
def executor_of(by: str) -> Iterator[Executor]:
    """Have somebody who works; a cluster has two processes of one thread."""
    if by != "dask":
        warm_up()
        yield LocalProcesses(1 if by == "serial" else 2)
        return
    from distributed import LocalCluster

    began = time.perf_counter()
    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        client = DaskCluster(cluster.scheduler_address)
        # What a worker does once in its life: load the machine code.
        dict(client.run(_ready, range(8)))
        print(f"cluster started and ready in {time.perf_counter() - began:.1f} s")
        yield client
        client.close()


def _ready(_: int) -> int:
    warm_up()
    time.sleep(0.2)
    return os.getpid()


def work(folder: Path, part: str, by: str, count: int) -> float:
    """Do a task on recordings, and print what it cost; returns seconds."""
    items = items_of([str(folder / "flights")])[:count]
    out = folder / f"out-{part}-{by}"
    shutil.rmtree(out, ignore_errors=True)
    with executor_of(by) as executor:
        began = time.perf_counter()
        results = run_season(task_of(part), items, executor, ResultFolder(out), _silent)
        wall_s = time.perf_counter() - began
    failed = sum(result.error is not None for result in results)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    own = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = children.ru_utime + children.ru_stime
    print(
        f"{part} by {by}: {len(items)} flights, {failed} failed: {wall_s:.1f} s wall, "
        f"{wall_s / len(items):.2f} s a flight; {cpu_s:.1f} s CPU of the workers; largest worker "
        f"{children.ru_maxrss / 1024:.0f} MB, this process {own.ru_maxrss / 1024:.0f} MB"
    )
    return wall_s


def growth(folder: Path, most: int) -> None:
    """Fuse more and more recordings."""
    for count in (most // 4, most // 2, most):
        work(folder, "fuse", "processes", count)


def hangar(folder: Path, count: int) -> None:
    """Index many short recordings, again with nothing new, again with some new, and ask."""
    place = folder / "hangar"
    if not place.exists() or len(list(place.glob("*.csv"))) != count:
        make(place, count, 10.0)
    (place / HANGAR_NAME).unlink(missing_ok=True)
    size = sum(path.stat().st_size for path in place.glob("*.csv"))
    _timed_index(place, f"first index of {count} recordings of 10 s, {size / 1e9:.2f} GB")
    _timed_index(place, "again, nothing new")
    for path in sorted(place.glob("*.csv"))[: count // 100]:
        path.write_bytes(path.read_bytes() + b'# mark: {"time_us": 1, "text": "new"}\n')
    _timed_index(place, "again, one in a hundred changed")
    print(f"catalogue: {(place / HANGAR_NAME).stat().st_size / 1e6:.1f} MB")
    for query in QUERIES:
        times = []
        for _ in range(9):
            began = time.perf_counter()
            found = find_flights(place, query)
            times.append(time.perf_counter() - began)
        print(f"{query or 'all'}: {len(found)} flights, {1e3 * statistics.median(times):.1f} ms")


def _timed_index(place: Path, what: str) -> None:
    began = time.perf_counter()
    report = index_folder(place, OPTIONS, LocalProcesses())
    print(f"{what}: {time.perf_counter() - began:.1f} s; {report}")


def _silent(what: str, done: int, total: int) -> None:
    pass


if __name__ == "__main__":
    main()
