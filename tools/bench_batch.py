"""Measure work on many recordings: serial, in processes, on a Dask cluster.

    python -m tools.bench_batch evaluate --flights 24  # or report, sweep: serial and in processes
    python -m tools.bench_batch dask --flights 24      # evaluate: a cluster of two, and processes
    python -m tools.bench_batch growth --flights 200   # cost and memory against the number of files
    python -m tools.bench_batch catalogue --files 10000   # index, index again, query

Recordings are simulated once and stay in --folder. Each measurement runs in a new process, so that
memory is that of this work alone. `start` is the cost that occurs once, of loading the estimators
or starting a cluster; `wall` and `CPU` are of the work, CPU of all processes together.
"""

import multiprocessing
import os
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from gateway.aircraft import AircraftSettings
from gateway.analysis.processes import cores
from gateway.analysis.simulated import received
from gateway.analysis.sweep import parse_axis
from gateway.batch.catalogue import CATALOGUE_NAME, find_flights, geojson_of, index_folder
from gateway.batch.executors import DaskCluster, Executor, LocalProcesses
from gateway.batch.storage import items_of
from gateway.batch.tasks import EvaluateTask, FlightTask, ResultFolder, SweepTask, run_batch
from gateway.pipeline import PipelineSettings
from gateway.recordings.recorded_table import ReadOptions, header_for
from gateway.recordings.table import TableHeader, encode_head
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S
from gateway.units import US_PER_S
from tests.batch.flights import line_of
from tools.harness import Figures, arguments, show, write_json

SEEDS = 4
"""Number of different flights; the others are copies with another aircraft and day."""
WORKERS = 2
CATALOGUED_S = 10.0
DAY_0_US = 1_780_000_000 * US_PER_S
DAY_US = 86_400 * US_PER_S
OPTIONS = ReadOptions(PipelineSettings(AircraftSettings()))
QUERIES = (
    "duration > 3 and loss > 0.01",
    "vehicle = 2 and began >= '2030-01-01'",
    "lat_min > -8 and lat_max < -7 and began like '2027%'",
    "gps_outages > 0 or faults > 0",
    "error is not null",
)
TASKS = ("evaluate", "report", "sweep")
PARTS = (*TASKS, "dask", "growth", "catalogue")
BROKEN = 100
"""One in this many files of the catalogue is broken."""
COLUMNS = ("failed", "start_s", "wall_s", "cpu_s", "worker_mb", "here_mb")


def main() -> None:
    """Run one part."""
    parser = arguments(__doc__)
    parser.add_argument("part", choices=PARTS)
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir(), "mavgate-bench-batch")
    )
    parser.add_argument("--flights", type=int, default=24, help="recordings")
    parser.add_argument("--files", type=int, default=10_000, help="files of the catalogue")
    parser.add_argument("--duration", type=float, default=FLIGHT_S, help="of each recording, s")
    options = parser.parse_args()
    folder, part, flights = options.folder, options.part, options.flights
    if part == "catalogue":
        found = fresh_process(catalogue, folder / f"catalogue-{options.files}", options.files)
        title = f"catalogue of {options.files} recordings of {CATALOGUED_S:.0f} s, some broken"
        show(title, ("work", "wall ms", "CPU ms", "flights"), found)
        write_json(options, {"rows": found})
        return
    recordings = folder / f"flights-{options.duration:.0f}"
    make(recordings, flights, options.duration)
    task = part if part in TASKS else "evaluate"
    runs = {
        "growth": [("processes", max(flights // n, 1)) for n in (8, 4, 2, 1)],
        "dask": [("processes", flights), ("dask", flights)],
    }.get(part, [("serial", flights), ("processes", flights)])
    rows = [(*run, fresh_process(measure, recordings, task, *run)) for run in runs]
    base = rows[0][2]["wall_s"] / rows[0][1]
    show(
        f"{task}, {WORKERS} processes",
        ("by", "flights", *COLUMNS, "s/flight, times the first"),
        [
            (by, count, *(cost[key] for key in COLUMNS), cost["wall_s"] / count / base)
            for by, count, cost in rows
        ],
    )
    write_json(options, {"rows": rows})


def measure(recordings: Path, part: str, by: str, count: int) -> Figures:
    """Do a task on recordings, once."""
    items = items_of([str(recordings)])[:count]
    out = recordings.with_name(f"out-{part}-{by}")
    shutil.rmtree(out, ignore_errors=True)
    began_s = time.perf_counter()
    with executor_of(by) as (executor, workers):
        start_s = time.perf_counter() - began_s
        cpu_s, _ = workers()
        began_s = time.perf_counter()
        results = run_batch(task_of(part), items, executor, ResultFolder(out), show_progress)
        wall_s = time.perf_counter() - began_s
        after_s, worker_mb = workers()
    shutil.rmtree(out)
    failed = sum(result.error is not None for result in results)
    here_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    values = (failed, start_s, wall_s, after_s - cpu_s, worker_mb, here_mb)
    return dict(zip(COLUMNS, values, strict=True))


def task_of(part: str) -> FlightTask:
    """Return the task of a part."""
    if part == "sweep":
        axes = tuple(parse_axis(name, "0.1,0.5,0.9") for name in ("alpha", "beta"))
        return SweepTask(OPTIONS, axes, "held_m", 5, 0.0)
    return EvaluateTask(OPTIONS, pages=part == "report")


Used = Callable[[], tuple[float, float]]
"""Returns the CPU time of all processes, s, and the memory of the largest worker, MB."""


@contextmanager
def executor_of(by: str) -> Iterator[tuple[Executor, Used]]:
    """Yield an executor that is ready; a cluster has two processes of one thread."""
    if by != "dask":
        yield LocalProcesses(1 if by == "serial" else WORKERS), _children
        return
    distributed: Any = import_module("distributed")
    with distributed.LocalCluster(
        n_workers=WORKERS, threads_per_worker=1, processes=True, host="127.0.0.1",
        dashboard_address=None,
    ) as cluster:  # fmt: skip
        client = DaskCluster(cluster.scheduler_address)
        # A worker imports the modules only once.
        dict(client.run(_ready, range(4 * WORKERS)))

        def used() -> tuple[float, float]:
            usages = cluster.get_client().run(_own_usage).values()
            return sum(cpu for cpu, _ in usages) + time.process_time(), max(mb for _, mb in usages)

        try:
            yield client, used
        finally:
            client.close()


def _ready(_: int) -> int:
    time.sleep(0.2)
    return os.getpid()


def _own_usage() -> tuple[float, float]:
    return time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _children() -> tuple[float, float]:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime + time.process_time(), used.ru_maxrss / 1024


def make(folder: Path, count: int, duration_s: float) -> None:
    """Write the missing recordings, of some aircraft on some days, in processes."""
    folder.mkdir(parents=True, exist_ok=True)
    there = {path.name for path in folder.iterdir()}
    wanted = [number for number in range(count) if _name(number) not in there]
    if not wanted:
        return
    works = [
        (folder, seed, [number for number in wanted if number % SEEDS == seed], duration_s)
        for seed in range(SEEDS)
    ]
    for done, _ in enumerate(LocalProcesses(cores()).run(_make_some, works), 1):
        show_progress(f"recordings of {duration_s:.0f} s", done, len(works))


def _make_some(work: tuple[Path, int, Sequence[int], float]) -> None:
    folder, seed, numbers, duration_s = work
    if not numbers:
        return
    head, rows = simulated_rows(seed + 1, duration_s)
    for number in numbers:
        header = msgspec.structs.replace(
            head,
            vehicle_id=1 + number % 3,
            unix_us_at_zero=DAY_0_US + number // 3 * DAY_US,
        )
        partial = folder / f".{number}"
        partial.write_text(encode_head(header) + rows)
        partial.rename(folder / _name(number))


def _name(number: int) -> str:
    return f"flight{number:05d}_01_v{1 + number % 3}.csv"


def simulated_rows(seed: int, duration_s: float) -> tuple[TableHeader, str]:
    """Return the header and the rows of a table of the simulated flight."""
    settings = SimulatorSettings(seed=seed)
    calibration = NodeCalibration(**SimulatedAircraft(settings).errors)
    rows = "".join(map(line_of, received(settings, duration_s)))
    return header_for(AircraftSettings(calibration=calibration), 1), rows


def catalogue(place: Path, count: int) -> list[tuple[object, ...]]:
    """Index many short recordings, again without changes, again with some changes, and query."""
    make(place, count, CATALOGUED_S)
    paths = sorted(place.glob("flight*.csv"))
    for number in range(count // BROKEN):
        (place / f"broken{number:05d}.csv").write_text(f"x,y\n1,{number}\n")
    (place / CATALOGUE_NAME).unlink(missing_ok=True)
    rows = [_index(place, "first index"), _index(place, "again, nothing new")]
    for path in paths[::100]:
        path.write_bytes(path.read_bytes() + b'# note: {"time_us": 1, "text": "new"}\n')
    rows.append(_index(place, "again, 1 % changed"))
    asked: dict[str, Callable[[], Any]] = {
        f"{query} (goal 50)": partial(find_flights, place, query) for query in QUERIES
    }
    asked["every flight there is"] = partial(find_flights, place)
    asked["the tracks of all as GeoJSON"] = lambda: geojson_of(place)["features"]
    for what, ask in asked.items():
        times_ms, found = [], 0
        for _ in range(9):
            began_s = time.perf_counter()
            found = len(ask())
            times_ms.append(1e3 * (time.perf_counter() - began_s))
        rows.append((what, median(times_ms), "", found))
    return rows


def _index(place: Path, title: str) -> tuple[object, ...]:
    began_s, before_s = time.perf_counter(), _children()[0]
    report = index_folder(place, OPTIONS, LocalProcesses(WORKERS), partial(show_progress, "index"))
    wall_s, cpu_s = time.perf_counter() - began_s, _children()[0] - before_s
    return title, 1e3 * wall_s, 1e3 * cpu_s, report.read


def fresh_process(function: Callable[..., Any], *arguments: object) -> Any:
    """Call a function in a new process."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()


def show_progress(title: str, done: int, total: int) -> None:
    """Show a count in one line of a terminal."""
    if sys.stderr.isatty():
        end = "\r" if done < total else "\r\x1b[K"
        print(f"{title}: {done} of {total}", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
