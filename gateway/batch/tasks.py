"""Tasks on single recordings, a folder of results, and runs over all recordings."""

import errno
import fcntl
import os
import shutil
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Final, NamedTuple

import msgspec

from gateway import __version__
from gateway.analysis.case import (
    Case,
    make_case,
    outage_error_m,
    recorded_summary,
    summarise,
    withheld_error_m,
)
from gateway.analysis.flight import Flight, flight_of_files
from gateway.analysis.pilot import PilotFlight, read_pilot_flight
from gateway.analysis.sweep import Axis, SweepError, grid, make_contest, run_trial, score_of
from gateway.batch import storage
from gateway.batch.executors import Executor, WorkFailed
from gateway.batch.facts import began_text
from gateway.output import write_new
from gateway.recordings.files import FlightError
from gateway.recordings.fuse import fuse
from gateway.recordings.index import as_text, recording_name
from gateway.recordings.recorded_fusion import fused_lines, header_of_states
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.table import TableHeader

HELD: Final = "held_m"
"""Key of the errors at withheld fixes, by estimator."""
DRIFT: Final = "drift_m"
"""Key of the errors after 10 s without GPS, by estimator."""
Files = Mapping[str, bytes]
RESULTS: Final = "results"
PARTIAL: Final = ".partial"
"""Subfolder in which files are written before they are moved to their final path."""
Report = Callable[[str, int, int], None]
"""Callback with the last finished item, the number of finished items, and the total."""
LOOKING: Final = "looking for changes"
"""First step, which determines the recordings to be processed."""


class FlightResult(msgspec.Struct, frozen=True, kw_only=True):
    """Result of a task on one recording, as it is stored."""

    location: str = msgspec.field(name="place")
    digest: str
    key: str
    """Digest of file, task, settings and version."""
    task: str
    version: str
    vehicle: int | None = None
    began: str | None = None
    error: str | None = None
    figures: dict[str, Any] = {}
    files: tuple[str, ...] = ()


class Worked(NamedTuple):
    """Outcome of a task on one recording, before it is stored."""

    vehicle: int | None
    began: str | None
    figures: dict[str, Any]
    files: Files


@dataclass(frozen=True)
class FlightTask(ABC):
    """A task on one recording; its outcome depends only on its settings and the recording."""

    name: ClassVar[str]
    """Name of the command."""
    options: ReadOptions

    @property
    def fingerprint(self) -> bytes:
        """Return the bytes of everything that affects the result, except recording and version."""
        current = self.options.current
        values = {
            "default": current.default,
            "aircraft": {str(number): own for number, own in sorted(current.aircraft.items())},
            "choice": self.options.choice,
            "columns": self.options.columns,
            "system": self.options.system_id,
            "task": {own.name: getattr(self, own.name) for own in fields(self)[1:]},
        }
        return msgspec.json.encode(values, order="sorted")

    @abstractmethod
    def do(self, files: list[Path], name: str) -> Worked:
        """Do the task; raises FlightError, OSError, ValueError if there is no flight."""


@dataclass(frozen=True)
class EvaluateTask(FlightTask):
    """Score every estimator at withheld fixes, write the states of the settings, and a page."""

    pages: bool
    name: ClassVar[str] = "report"

    def do(self, files: list[Path], name: str) -> Worked:
        """See `FlightTask`."""
        recorded = read_pilot_flight(files, self.options, name)
        try:
            flight, header, began = read_batch_flight(files, self.options, name)
        except (FlightError, ValueError):
            # The recording can be read, but it has no samples.
            made = _page_of(recorded, name) if self.pages else {}
            figures = {"summary": _known(recorded_summary(recorded))}
            return Worked(recorded.vehicle_id, began_text(recorded.begin_us), figures, made)
        case, samples = make_case(flight, recorded=recorded), flight.samples
        states = fuse(samples, samples.estimator_or_cold(case.fusion.estimation)).states
        made = {f"fused/{name}.csv": b"".join(fused_lines(header, flight.time_us, states))}
        if self.pages:
            made |= _page_of(case, name)
        figures = {
            "summary": summarise(case),
            HELD: {name: withheld_error_m(case, name) for name in case.tracks},
            DRIFT: {name: outage_error_m(case, name) for name in case.tracks},
        }
        known = {key: _known(values) for key, values in figures.items()}
        return Worked(header.vehicle_id, began, known, made)


def _known(figures: Mapping[str, float]) -> dict[str, float]:
    """Leave out unknown values, since JSON cannot represent NaN."""
    return {name: value for name, value in figures.items() if value == value}


def _page_of(made: Case | PilotFlight, name: str) -> Files:
    # Imported here: these require the extra `plot`, and take a second to import.
    from gateway.analysis.reporting.compose import make_report
    from gateway.analysis.reporting.page import write_report

    with TemporaryDirectory(prefix="mavgate-") as folder:
        write_report(make_report(made), Path(folder), jobs=1)
        pages = sorted(Path(folder).iterdir())
        return {f"reports/{name}/{page.name}": page.read_bytes() for page in pages}


@dataclass(frozen=True)
class SweepTask(FlightTask):
    """Score every point of a grid of settings."""

    axes: tuple[Axis, ...]
    metric_column: str
    hold_out: int
    interval_s: float
    name: ClassVar[str] = "sweep"

    def do(self, files: list[Path], name: str) -> Worked:
        """See `FlightTask`."""
        flight, header, began = read_batch_flight(files, self.options, name)
        keys, how = [axis.key for axis in self.axes], (self.hold_out, self.interval_s)
        contest = make_contest(flight, flight.fusion, keys, *how)
        scores = [run_trial(contest, values)[self.metric_column] for values in grid(self.axes)]
        base = score_of(contest, flight.fusion)[self.metric_column]
        values = [None if score != score else score for score in (base, *scores)]
        figures = {"base": values[0], "scores": values[1:]}
        return Worked(header.vehicle_id, began, figures, {})


def read_batch_flight(
    files: Sequence[Path], options: ReadOptions, name: str
) -> tuple[Flight, TableHeader, str | None]:
    """Read the parts of a recording as one flight, the head of its states, and its begin.

    Raises as `FlightTask.do`.
    """
    flight, table, aircraft = flight_of_files(
        files, options, name=name, description="One recording of a batch."
    )
    zero_us = table.header.unix_us_at_zero
    began = None if zero_us is None else zero_us + int(flight.time_us[0])
    return flight, header_of_states(table.header, aircraft), began_text(began)


def work_on(
    task: FlightTask, wanted: tuple[storage.BatchItem, str, FlightResult]
) -> tuple[FlightResult, Files]:
    """Do a task on one recording, and complete its result.

    A failure is stored as the `error` of the result.
    """
    item, name, result = wanted
    result = msgspec.structs.replace(result, version=__version__)
    with storage.local_files(item) as files:
        if item.is_fetched:
            result = msgspec.structs.replace(result, digest=storage.digest_of_files(files))
        try:
            worked = task.do(files, name)
        except SweepError:
            # The settings of the sweep are invalid, not the recording.
            raise
        except (FlightError, ValueError) as error:
            text = str(error) or type(error).__name__
            for location, file in zip(item.locations, files, strict=True):
                text = text.replace(str(file), storage.without_user(location))
            return msgspec.structs.replace(result, error=as_text(text)), {}
    known = worked._asdict() | {"files": tuple(worked.files)}
    return msgspec.structs.replace(result, **known), worked.files


def without_secrets(options: ReadOptions) -> ReadOptions:
    """Remove the signing passphrase, which other machines do not need."""
    current = options.current

    def plain(aircraft: Any) -> Any:
        vehicle = msgspec.structs.replace(aircraft.vehicle, signing_passphrase="")
        return msgspec.structs.replace(aircraft, vehicle=vehicle)

    stripped = replace(
        current,
        default=plain(current.default),
        aircraft={number: plain(own) for number, own in current.aircraft.items()},
    )
    return replace(options, current=stripped, progress=None)


def name_of(item: storage.BatchItem) -> str:
    """Return the name of a recording in the folder of results."""
    name = as_text(recording_name(Path(item.location)))
    for ending in (".gz", ".csv", ".tlog"):
        name = name.removesuffix(ending)
    return name


class ResultFolder:
    """Results of many recordings; raises OSError if the folder cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / RESULTS).mkdir(parents=True, exist_ok=True)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Lock out other runs; remove partial files of a killed run, and of this one at its end.

        Raises OSError if another run uses the folder.
        """
        descriptor = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _lock(descriptor, self.folder)
            shutil.rmtree(self.folder / PARTIAL, ignore_errors=True)
            try:
                yield
            finally:
                shutil.rmtree(self.folder / PARTIAL, ignore_errors=True)
        finally:
            # Forked processes have inherited the descriptor, so closing it is not enough.
            with suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)

    def find(self, key: str) -> FlightResult | None:
        """Return a stored result if all its files exist; None if it must be computed."""
        found = _read(self._path(key))
        if found is None or not all((self.folder / name).exists() for name in found.files):
            return None
        return found

    def keep(self, result: FlightResult, files: Files) -> None:
        """Write a result: first its files, all under temporary names, then the result itself."""
        staged = self.folder / PARTIAL / result.key
        for name, content in files.items():
            path = staged / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_new(path, [content])
        # Files of one folder (a page and its figures) are moved into place together.
        for unit in {Path(*Path(name).parts[:2]) for name in files}:
            target = self.folder / unit
            target.parent.mkdir(exist_ok=True)
            if target.is_dir():
                shutil.rmtree(target)
            (staged / unit).replace(target)
        shutil.rmtree(staged, ignore_errors=True)
        write_new(self._path(result.key), [msgspec.json.encode(result)], overwrite=True)

    def _path(self, key: str) -> Path:
        return self.folder / RESULTS / f"{key}.json"


def _lock(descriptor: int, folder: Path) -> None:
    """Lock a folder while the descriptor is open; the lock ends with the process in any case."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        text = "another report writes its results here; wait, or give another folder"
        raise OSError(errno.EBUSY, text, str(folder)) from error
    except OSError:
        # Some network file systems do not support locks.
        return


def read_results(folder: Path) -> Iterator[FlightResult]:
    """Read all results in a folder, newest last; raises OSError if there is none.

    Results of the same modification time are sorted by name.
    """
    paths = list((folder / RESULTS).iterdir())
    for path in sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name)):
        if path.suffix == ".json" and (found := _read(path)) is not None:
            yield found


def _read(path: Path) -> FlightResult | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=FlightResult)
    except (FileNotFoundError, msgspec.DecodeError):
        return None


def run_batch(
    task: FlightTask,
    items: Sequence[storage.BatchItem],
    executor: Executor,
    folder: ResultFolder | None,
    report: Report,
) -> list[FlightResult]:
    """Do a task on every recording for which it is not done yet."""
    found: list[FlightResult | None] = [None] * len(items)
    todo: dict[int, tuple[storage.BatchItem, str, FlightResult]] = {}
    stamps = _stamps(items, executor, report)
    names = _names(items, stamps)
    for number, (item, stamp) in enumerate(zip(items, stamps, strict=True)):
        location = as_text(item.location)
        if isinstance(stamp, WorkFailed):
            found[number] = FlightResult(
                location=location, digest="", key="", task=task.name, version=__version__,
                error=stamp.reason,
            )  # fmt: skip
            continue
        key = _key(task, stamp)
        if folder is not None and (kept := folder.find(key)) is not None:
            found[number] = msgspec.structs.replace(kept, location=location)
            continue
        blank = FlightResult(
            location=location, digest=stamp, key=key, task=task.name, version=__version__
        )
        todo[number] = (item, names[number], blank)
    numbers = list(todo)
    outcomes = executor.run(partial(work_on, task), list(todo.values()))
    for done, (index, outcome) in enumerate(outcomes, len(items) - len(todo) + 1):
        item, _, blank = todo[numbers[index]]
        if isinstance(outcome, WorkFailed):
            result = msgspec.structs.replace(blank, error=outcome.reason)
        elif (version := outcome[0].version) != __version__:
            reason = f"done by mavgate {version}; this is {__version__}"
            result = msgspec.structs.replace(blank, error=reason)
        else:
            result, files = outcome
            if folder is not None:
                folder.keep(result, files)
        found[numbers[index]] = result
        report(item.location, done, len(items))
    return [result for result in found if result is not None]


def _stamps(
    items: Sequence[storage.BatchItem], executor: Executor, report: Report
) -> list[str | WorkFailed]:
    found: list[str | WorkFailed] = [""] * len(items)
    for done, (number, outcome) in enumerate(executor.run(storage.stamp_of_item, items), 1):
        found[number] = outcome
        report(LOOKING, done, len(items))
    return found


def _names(items: Sequence[storage.BatchItem], stamps: Sequence[str | WorkFailed]) -> list[str]:
    """Return names for the results; recordings of equal names get a part of their digests."""
    names = [name_of(item) for item in items]
    often = Counter(names)
    return [
        f"{name}-{stamp[:8]}" if often[name] > 1 and isinstance(stamp, str) else name
        for name, stamp in zip(names, stamps, strict=True)
    ]


def _key(task: FlightTask, stamp: str) -> str:
    values = "\n".join((task.name, stamp, __version__)).encode()
    return sha256(values + b"\n" + task.fingerprint).hexdigest()[:32]
