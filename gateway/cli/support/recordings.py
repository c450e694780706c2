"""Recordings of the command line: found by path or name, and read with progress."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from rich.progress import DownloadColumn, TimeElapsedColumn, TimeRemainingColumn

from gateway.cli.support.options import folder_of, recordings_folder
from gateway.cli.support.terminal import console_of, progress_bar, refuse
from gateway.recordings.files import FlightError
from gateway.recordings.index import NEWEST, RecordingError, find_recording, recording_name
from gateway.recordings.moment import Moment, parse_moment
from gateway.recordings.recording import open_recording

if TYPE_CHECKING:
    from gateway.analysis.flight import Flight
    from gateway.config import GatewaySettings
    from gateway.recordings.fuse import FusionSettings
    from gateway.recordings.recorded_table import ReadOptions

Wanted = Literal["tlogs", "tables", "all"]
"""Files of a recording to use; if it has none of these, the others are used."""
OWN: Final = "Recorded by mavgate."
OF_MAVLINK: Final = "Read from an autopilot's MAVLink log; its samples count as calibrated."
OF_OTHERS: Final = "Recorded by another program; its samples count as calibrated."
"""Descriptions of a flight by its recording."""


def read_sensors(texts: Sequence[str] | None) -> tuple[tuple[str, int], ...]:
    """Read --sensor; raises FlightError if one is invalid."""
    from gateway.recordings.formats.dataflash_record import SENSORS

    found = []
    for text in texts or ():
        kind, _, number = text.partition("=")
        if kind.upper() not in SENSORS or number not in ("1", "2", "3"):
            raise FlightError(f"--sensor {text}: write imu, mag, baro or gps, and =1, =2 or =3")
        found.append((kind.upper(), int(number) - 1))
    return tuple(found)


def read_range(begin: str | None, end: str | None) -> tuple[Moment | None, Moment | None]:
    """Read --from and --to; raises FlightError if one is invalid, or the range is empty."""
    try:
        first, last = (None if text is None else parse_moment(text) for text in (begin, end))
    except ValueError as error:
        raise FlightError(str(error)) from error
    for unit in ("offset_s", "time_us"):
        low, high = getattr(first, unit, None), getattr(last, unit, None)
        if low is not None and high is not None and low >= high:
            raise FlightError(f"the range from --from {begin} to --to {end} is empty")
    return first, last


def are_many(names: Sequence[str]) -> bool:
    """Return whether these are several recordings, a folder or a URL."""
    return len(names) > 1 or any("://" in name or Path(name).is_dir() for name in names)


def refuse_unused(kind: str, options: Mapping[str, object]) -> None:
    """End the command if an option is set that has no effect on such an output."""
    if used := [name for name, value in options.items() if value]:
        refuse(f"{', '.join(used)}: not possible for {kind}")


@contextmanager
def progress_of(files: Iterable[Path]) -> Iterator[Callable[[int], None]]:
    """Show the progress of reading, and of the computation after it, on a terminal."""
    total = sum(file.stat().st_size for file in files if file.exists())
    columns = (DownloadColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with progress_bar(*columns, auto_refresh=True) as progress:
        task = progress.add_task("reading", total=total)

        def advance(count: int) -> None:
            progress.advance(task, count)
            if progress.tasks[task].completed >= total:
                progress.update(task, description="computing", total=None)

        yield advance


def print_remarks(remarks: Iterable[str]) -> None:
    """Print remarks on a file to stderr."""
    for remark in remarks:
        console_of(stderr=True).print(remark)


def recorded_files(names: Iterable[Path], wanted: Wanted) -> list[Path]:
    """Replace names of recordings by their files; only for names a gateway is asked."""
    names = list(names)
    is_named = not all(map(_is_path, names))
    return files_of(names, recordings_folder(), wanted) if is_named else names


def files_of(names: Iterable[Path], folder: Path, wanted: Wanted) -> list[Path]:
    """Replace names of recordings by their files; paths stay unchanged."""
    found = list[Path]()
    for name in names:
        if _is_path(name):
            found.append(name)
            continue
        try:
            files = find_recording(folder, str(name)).files
        except RecordingError as error:
            lacking = "recording" if str(name) == NEWEST else "recording of that name"
            raise FlightError(
                f"{name}: no such file, and no {lacking} in {folder}; `mavgate info` lists them"
            ) from error
        ending = {"tlogs": ".tlog", "tables": ".csv", "all": ""}[wanted]
        found += [file for file in files if file.name.endswith(ending)] or files
    return found


def name_of(wanted: Path, files: Sequence[Path]) -> str:
    """Return the name of a file, or of a recording, which may have been given as `last`."""
    return wanted.name if _is_path(wanted) else recording_name(files[0])


def _is_path(name: Path) -> bool:
    return name.exists() or name.name != str(name)


def fusion_of(settings: GatewaySettings) -> FusionSettings:
    """Return the part of the settings that concerns fusion."""
    from gateway.recordings.fuse import FusionSettings

    return FusionSettings(estimation=settings.estimation)


def load_flight(
    path: Path | None,
    settings: GatewaySettings,
    options: ReadOptions,
    reference: Path | None = None,
) -> Flight:
    """Read a recording, or the simulated flight; raises FlightError if a file has no flight."""
    # Imported here: these import all stages, which commands without fusion need not wait for.
    from gateway.analysis.flight import compared_with, flight_of_files
    from gateway.analysis.simulated import simulated_flight

    if path is None:
        return simulated_flight(settings.simulator, fusion_of(settings))
    parts = files_of([path], folder_of(settings), "tables")
    with progress_of([*parts, reference] if reference else parts) as advance:
        options = replace(options, progress=advance)
        recording = open_recording(parts[0])
        of_others = OF_MAVLINK if recording.is_mavlink else OF_OTHERS
        description = OWN if recording.is_own else of_others
        try:
            flight, table, _ = flight_of_files(
                parts, options, name=name_of(path, parts), description=description, checked=True
            )
        except ValueError as error:
            raise FlightError(str(error)) from error
        print_remarks(table.remarks)
        if reference is None:
            return flight
        return compared_with(flight, open_recording(reference).rows(options).blocks, reference.name)
