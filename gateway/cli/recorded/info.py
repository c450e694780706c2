"""`mavgate info` and `mavgate recover`: summarise recordings, and recover damaged ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec
import typer
from pymavlink.dialects.v20 import all as mavlink

from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import (
    argument,
    option,
    output_file,
    read_options,
    read_settings,
    recordings_folder,
)
from gateway.cli.support.recordings import progress_of, recorded_files, refuse_unused
from gateway.cli.support.terminal import (
    console_of,
    duration_text,
    print_json,
    progress_bar,
    refuse,
    table_of,
)
from gateway.output import write_new
from gateway.printable import UNKNOWN, figure
from gateway.recordings.file_format import CSV, NO_RECORDING
from gateway.recordings.files import FlightError, Progress, read_blocks
from gateway.recordings.index import Recording, list_recordings
from gateway.recordings.moment import civil_time
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.recordings.recording import RecordedFile, open_recording
from gateway.recordings.summary import FileInfo, VehicleInfo, read_summary
from gateway.recordings.table import TableFault, TableHeader, TableReader, encode_block, encode_head
from gateway.recordings.tlog_index import DAMAGED, DAMAGED_TIME, INCOMPLETE
from gateway.units import US_PER_S, counted

if TYPE_CHECKING:
    from gateway.batch.catalogue import FlightFigures, IndexReport, Row
    from gateway.batch.executors import Executor
    from gateway.recordings.recorded_table import ReadOptions

app = typer.Typer()

WHOLE: Final = ("vehicle", "duration", "gps_outages", "faults")
"""Columns of the catalogue that are shown without decimals."""
SHOWN: Final = 8
"""Gaps and damaged ranges that are listed individually."""

Report = Callable[[str], None]


@app.command()
def info(
    files: list[Path] | None = argument(
        "Recordings, by name or file, or a folder to index; without one, all recordings "
        "are listed.",
        show_default=False,
    ),
    *,
    columns: Path | None = opt.COLUMNS,
    where: str = option(
        "--where", "List flights of a folder by SQL: 'duration > 300 and loss > 0.05'.", ""
    ),
    geojson: bool = option("--geojson", "The tracks of a folder's flights, for maps.", False),
    json: bool = option("--json", "For programs: one line per file.", False),
) -> None:
    """Show duration, vehicles, rates, gaps, distance and damage of recordings; or list all.

    All recordings below a folder are indexed in its file catalogue.sqlite, and its flights listed.
    """
    files = files or []
    folder = next(filter(Path.is_dir, files), None)
    if folder is not None or ((where or geojson) and not files):
        if len(files) > 1:
            refuse(f"{folder}: is a folder; give one folder, or recordings")
        folder = (folder or recordings_folder()).expanduser()
        if not folder.is_dir():
            refuse(f"no recordings in {folder}")
        _list_flights(folder, columns, where, geojson=geojson, json=json)
        return
    refuse_unused("recordings: give their folder", {"--where": where, "--geojson": geojson})
    if not files:
        _list_all(json=json)
        return
    # Files need no settings, which would import all stages.
    files = recorded_files(files, "all")
    with progress_of(files) as advance:

        def options() -> ReadOptions:
            return read_options(read_settings(), columns, progress=advance)

        found = [
            (each, read_summary(open_recording(each), advance, options).info) for each in files
        ]
    for number, (each, info_of_file) in enumerate(found):
        if json:
            print_json(info_of_file)
        else:
            print(end="\n" if number else "")
            _show(each, info_of_file)


def _list_all(*, json: bool) -> None:
    folder = recordings_folder()
    found = list_recordings(folder)
    figures = _figures(found) if found else {}
    if json:
        flights = [figures.get(recording.name, {}) for recording in found]
        listed = [
            {"duration_s": _length_s(flown), "vehicles": sorted(flown)}
            | msgspec.to_builtins(recording, enc_hook=str)
            for recording, flown in zip(found, flights, strict=True)
        ]
        print_json(listed)
    elif found:
        _show_list(found, figures)
    else:
        console_of().print(f"no recordings in {folder}")


@app.command()
def recover(
    file: Path = argument("Damaged recording.", ..., show_default=False),
    *,
    output: Path | None = output_file("Output; by default NAME.recovered.EXT.", (".tlog", ".csv")),
    force: bool = opt.FORCE,
) -> None:
    """Write the intact part of a damaged recording to a new file, and list the damage.

    The checksum of every frame is checked. The damaged file is never changed.
    """
    console = console_of()
    left_out: list[str] = []
    with progress_of([file]) as advance:
        recording = open_recording(file)
        kept, other = (".tlog", ".csv") if recording.is_mavlink else (".csv", ".tlog")
        target = output or file.with_name(f"{file.stem}.recovered{kept}")
        if output is not None and output.suffix == other:
            refuse(f"{output}: {file} is repaired as a {kept}; then `mavgate convert` that")
        sound = _sound_records if recording.is_mavlink else _sound_lines
        pieces = sound(recording, advance, left_out.append)
        size = write_new(target, pieces, overwrite=force, inputs=[file])
        before = file.stat().st_size
    _print_some(left_out, "more place")
    lost = f"{counted(max(before - size, 0), 'byte')} left out"
    verdict = lost if left_out else "nothing was damaged"
    console.print(f"{target}: {size} of {before} bytes; {verdict}")


def _sound_records(recording: RecordedFile, advance: Progress, report: Report) -> Iterator[bytes]:
    found, source = False, recording.mavlink
    for remark in source.remarks:
        console_of().print(f"{source.path}: {remark}")
    for batch in source.batches(advance, strict=True):
        for run in batch.damage:
            report(f"at byte {run.offset}: {counted(run.size, 'byte')} without a record")
        if batch.unfinished:
            report(f"at the end: {counted(batch.unfinished, 'byte')} of an incomplete record")
        if batch.mended:
            console_of().print(DAMAGED_TIME.format(counted(batch.mended, "record")))
        yield batch.encoded()
        found = found or len(batch.starts) > 0
    if not found:
        raise FlightError(f"{source.path}: {NO_RECORDING}")


def _sound_lines(recording: RecordedFile, advance: Progress, report: Report) -> Iterator[bytes]:
    reader = TableReader()
    begun = False
    for block in read_blocks(recording.path, reader, advance):
        faults = [comment for _, comment in block.comments if isinstance(comment, TableFault)]
        if not begun and (len(block) or len(block.comments) > len(faults)):
            begun = True
            if reader.header is None:
                report("the head is lost: the current settings and calibration will be used")
            yield encode_head(reader.header or TableHeader()).encode()
        for fault in faults:
            report(f"line {fault.line}: {counted(fault.size, 'byte')}: {fault.reason}")
        yield encode_block(block)
    if not begun:
        raise FlightError(f"{recording.path}: contains no row that can be read")


def _print_some(lines: Sequence[str], more: str) -> None:
    for line in lines[:SHOWN]:
        console_of().print(line)
    if len(lines) > SHOWN:
        console_of().print(f"and {counted(len(lines) - SHOWN, more)}")


def _show(file: Path, found: FileInfo) -> None:
    console = console_of()
    kind = "another program's CSV" if found.kind == CSV else found.kind
    console.print(f"{file}: {kind}, {found.size / 1e6:.3f} MB")
    console.print(f"{counted(found.records, 'record')} in {_clock(found.duration_s)}{_when(found)}")
    if found.header is not None:
        head = found.header
        session = f"recording {head.session}, " if head.session else ""
        session += f"part {head.part}, " if head.session or head.part > 1 else ""
        console.print(f"{session}by mavgate {head.mavgate_version or UNKNOWN}")
    for vehicle in found.vehicles:
        console.print(f"\n{_heading(vehicle, found.kind)}", *_figures_of(vehicle), sep="\n")
        rows = ((rate.name, str(rate.count), f"{rate.rate_hz:.2f}") for rate in vehicle.rates)
        console.print(table_of("what", "count", "per s", rows=rows))
    begin_us = found.first_us or 0
    gaps = [(gap.duration_s, (gap.time_us - begin_us) / US_PER_S) for gap in found.gaps]
    _print_some([f"gap of {long_s:.1f} s at {_clock(at_s)}" for long_s, at_s in gaps], "more gap")
    for note in found.notes:
        console.print(f"note at {_clock((note.time_us - begin_us) / US_PER_S)}: {note.text}")
    if found.damaged_bytes:
        damage = (counted(found.damaged_bytes, "byte"), counted(found.damaged_runs, "place"))
        console.print(DAMAGED.format(*damage), style="red")
    if found.unfinished_bytes:
        unit = "record" if found.kind == "tlog" else "line"
        console.print(INCOMPLETE.format(unit, counted(found.unfinished_bytes, "byte")))
    for remark in found.remarks:
        console.print(remark)


def _heading(vehicle: VehicleInfo, kind: str) -> str:
    title = f"system {vehicle.system_id}" if kind == "tlog" else f"vehicle {vehicle.system_id}"
    if vehicle.mav_type is not None:
        title += f": {_enum_name('MAV_TYPE', vehicle.mav_type)}"
        title += f", {_enum_name('MAV_AUTOPILOT', vehicle.autopilot or 0)}"
    return title


def _figures_of(vehicle: VehicleInfo) -> list[str]:
    facts = vehicle.facts
    if facts is None:
        return []
    above, distance_m = f"m above {facts.height_above}", facts.distance_m
    parts = (
        distance_m is not None and f"{distance_m / 1000:.3f} km by {vehicle.positions}",
        facts.airborne_s is not None and f"in the air {_clock(facts.airborne_s)}",
        facts.armed_s is not None and f"armed {_clock(facts.armed_s)}",
        facts.highest_m is not None and f"highest {facts.highest_m:.0f} {above}",
        facts.fastest_mps is not None and f"fastest {facts.fastest_mps:.1f} m/s",
    )
    text = ", ".join(part for part in parts if part)
    return [text] if text else []


def _enum_name(enum: str, value: int) -> str:
    entry = mavlink.enums[enum].get(value)
    return entry.name.removeprefix(f"{enum}_").lower() if entry else f"{enum} {value}"


def _clock(seconds: float) -> str:
    minutes, rest = divmod(seconds, 60)
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02d}:{rest:06.3f}" if hours else f"{minutes}:{rest:06.3f}"


def _when(found: FileInfo) -> str:
    begin_us = found.first_us
    if found.header is not None:
        zero_us = found.header.unix_us_at_zero
        begin_us = None if zero_us is None or begin_us is None else zero_us + begin_us
    if begin_us is None or 0 <= begin_us < FIRST_CIVIL_US:
        return ""
    moment = civil_time(begin_us)
    return ", without a valid date" if moment is None else f", from {moment:%Y-%m-%d %H:%M:%S} UTC"


def _figures(recordings: list[Recording]) -> dict[str, dict[int, FlightFigures]]:
    from gateway.batch.catalogue import CatalogueError, figures_of, find_flights
    from gateway.batch.executors import ThisProcess

    folder = recordings[0].files[0].parent
    try:
        _index(folder, None, ThisProcess())
        found = figures_of(find_flights(folder))
    except (CatalogueError, OSError) as error:
        console_of(stderr=True).print(f"no figures of the flights: {error}")
        return {}
    return {
        str(path): {vehicle: one for vehicle, one in flown.items() if vehicle is not None}
        for path, flown in found.items()
    }


def _index(folder: Path, columns: Path | None, executor: Executor) -> IndexReport:
    from gateway.batch.catalogue import index_folder

    with progress_bar() as progress:
        task = progress.add_task("reading new recordings", total=None)

        def show(done: int, total: int) -> None:
            progress.update(task, completed=done, total=total, refresh=True)

        return index_folder(folder, read_options(read_settings(), columns), executor, show)


def _list_flights(
    folder: Path, columns: Path | None, where: str, *, geojson: bool, json: bool
) -> None:
    from gateway.batch.catalogue import CatalogueError, find_flights, geojson_of
    from gateway.batch.executors import LocalProcesses

    console = console_of(stderr=True)
    try:
        done = _index(folder, columns, LocalProcesses(None))
        console.print(
            f"{folder}: {done.unchanged} unchanged, {done.read - done.broken} new, "
            f"{done.gone} removed, {done.broken} unreadable"
        )
    except CatalogueError as error:
        # A catalogue of a folder that cannot be written is read.
        console.print(str(error), style="yellow")
    if geojson or json:
        print_json(geojson_of(folder, where) if geojson else find_flights(folder, where))
    else:
        _show_flights(find_flights(folder, where))


def _show_flights(rows: list[Row]) -> None:
    from gateway.batch.catalogue import figures_of

    grid = table_of(
        "file", "kind", "began (UTC)", "aircraft", "duration, s", "distance, km",
        "highest, m above", "fastest, m/s", "GPS outages", "faults", "loss", left=3,
    )  # fmt: skip
    for row in rows:
        if row["error"] is not None:
            grid.add_row(row["path"], "unreadable", row["error"], *[UNKNOWN] * 8)
            continue
        km = None if row["distance"] is None else row["distance"] / 1000.0
        whole = {key: figure(row[key], ".0f") for key in WHOLE}
        grid.add_row(
            row["path"], row["kind"], row["began"] or UNKNOWN, whole["vehicle"], whole["duration"],
            figure(km, ".2f"), figure(row["highest"], ".0f", row["height_above"] or ""),
            figure(row["fastest"], ".1f"), whole["gps_outages"], whole["faults"],
            figure(row["loss"], ".1%"),
        )  # fmt: skip
    console_of().print(grid)
    lasted_s = [one.duration for flown in figures_of(rows).values() for one in flown.values()]
    files = len({row["path"] for row in rows})
    broken = sum(row["error"] is not None for row in rows)
    console_of().print(
        f"{counted(len(lasted_s), 'flight')}, {sum(lasted_s) / 3600.0:.2f} h, in "
        f"{counted(files, 'file')}; {broken} unreadable"
    )


def _length_s(flown: dict[int, FlightFigures]) -> float | None:
    return max((figures.duration for figures in flown.values()), default=None)


def _show_list(recordings: list[Recording], figures: dict[str, dict[int, FlightFigures]]) -> None:
    grid = table_of(
        "recording", "length", "vehicles", "km", "highest, m above", "loss", "MB",
        "last written (UTC)", "path",
    )  # fmt: skip
    for recording in recordings:
        flown = figures.get(recording.name, {})
        # A shell pattern that matches all files of the recording.
        first, folder = str(recording.files[0]), recording.files[0].parent

        def each(text: Callable[[FlightFigures], str], flown: Any = flown) -> str:
            return " ".join(text(flown[system_id]) for system_id in sorted(flown)) or UNKNOWN

        when, length_s = civil_time(recording.modified_s * US_PER_S), _length_s(flown)
        grid.add_row(
            recording.name,
            UNKNOWN if length_s is None else duration_text(length_s),
            " ".join(map(str, sorted(flown))) or UNKNOWN,
            each(lambda f: figure(f.distance and f.distance / 1000, ".2f")),
            each(lambda f: figure(f.highest, ".0f", f.height_above or "")),
            each(lambda f: figure(f.loss, ".1%")),
            f"{recording.size / 1e6:.2f}",
            UNKNOWN if when is None else f"{when:%Y-%m-%d %H:%M:%S}",
            first if len(recording.files) == 1 else f"{folder / recording.name}_*",
        )
    console_of().print(grid)
