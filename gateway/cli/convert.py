"""`mavgate convert`: recordings into one another, into tables and maps."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from gateway.cli import flights
from gateway.cli.errors import refuse
from gateway.cli.flights import Line, Table, Wishes
from gateway.cli.recording_files import (
    PANEL,
    ColumnsOption,
    Files,
    ForceOption,
    FromOption,
    PositionOption,
    SettingsOption,
    ToOption,
    progress_of,
    read_column_map,
    read_moment,
    refusing,
)
from gateway.cli.run import ConfigOption, read_aircraft, read_settings
from gateway.edges.flight_files import FileKind, kind_of, write_new
from gateway.flightlog.mapshape import TrackPoint, thin_out, to_gpx, to_kml
from gateway.flightlog.moment import Moment, place_in
from gateway.flightlog.row import row_to_line
from gateway.flightlog.table import TableHeader, encode_head, encode_header
from gateway.flightlog.tlog import TlogRecord, encode_record
from gateway.pipeline import PipelineSettings

OUTPUTS: Final = (".tlog", ".csv", ".kml", ".gpx")
LINES: Final = 1000
"""Lines of a table that are written at once."""

Limits = tuple[Moment | None, Moment | None]


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("convert", rich_help_panel=PANEL)(convert)


def convert(
    files: Files,
    *,
    out: Annotated[Path, typer.Option("--out", "-o", help="Output: .tlog, .csv, .kml or .gpx.")],
    begin: FromOption = None,
    end: ToOption = None,
    columns: ColumnsOption = None,
    fuse: Annotated[
        bool, typer.Option("--fuse", help="Fuse a table again in place of its recorded states.")
    ] = False,
    settings: SettingsOption = "recorded",
    position: PositionOption = "causal",
    system: Annotated[
        int | None, typer.Option("--system", min=1, max=255, help="Vehicle of a tlog to take.")
    ] = None,
    config: ConfigOption = None,
    force: ForceOption = False,
) -> None:
    """Convert, trim and join recordings.

    Tlogs and tables become one another, or a track for a map. A tlog of any autopilot that holds
    HIGHRES_IMU, RAW_IMU or SCALED_IMU becomes a table that can be fused; a CSV of another program
    does by its column map.
    """
    if out.suffix not in OUTPUTS:
        refuse(f"{out}: the output must end in {', '.join(OUTPUTS)}")
    with progress_of(files) as advance, refusing():
        wishes = Wishes(
            current=pipeline_settings(config),
            choice=settings,
            position=position,
            columns=read_column_map(columns),
            system_id=system,
            progress=advance,
        )
        limits = (read_moment(begin), read_moment(end))
        if out.suffix != ".csv" and all(kind_of(file) is FileKind.TLOG for file in files):
            pieces = _from_tlogs(files, out, wishes, limits)
        else:
            pieces = _from_tables(files, out, wishes, limits, fuse_again=fuse)
        size = write_new(out, pieces, overwrite=force)
    Console(highlight=False).print(f"{out}: {size / 1e6:.3f} MB")


def pipeline_settings(config: Path | None) -> PipelineSettings:
    """Read the settings of today."""
    settings = read_settings(config)
    return PipelineSettings(settings.default_aircraft, read_aircraft(settings))


def _from_tlogs(files: list[Path], out: Path, wishes: Wishes, limits: Limits) -> Iterator[bytes]:
    records = _within(flights.recorded_frames(files, wishes.progress), limits)
    if out.suffix == ".tlog":
        return (encode_record(record.time_us, record.frame) for record in records)
    return _map_shape(out, flights.points_of_frames(records, wishes.system_id))


def _from_tables(
    files: list[Path], out: Path, wishes: Wishes, limits: Limits, *, fuse_again: bool
) -> Iterator[bytes]:
    table = flights.joined_rows([flights.open_rows(file, wishes) for file in files])
    table = Table(table.header, _rows_within(table, limits))
    recorded = all(kind_of(file) is FileKind.TABLE for file in files)
    if fuse_again or not recorded or out.suffix == ".tlog":
        interpolated = wishes.position == "interpolated"
        fixes = [fix for file in files for fix in flights.fixes_of(file, wishes)]
        replay = flights.fuse(table, wishes, fixes if interpolated else ())
        if out.suffix == ".tlog":
            frames = flights.fused_frames(table, replay)
            return (encode_record(record.time_us, record.frame) for record in frames)
        table = Table(table.header, flights.fused_rows(table, replay))
    if out.suffix == ".csv":
        return _table_text(table)
    return _map_shape(out, flights.points_of_rows(table))


def _map_shape(out: Path, points: Iterable[TrackPoint]) -> Iterator[bytes]:
    shape = to_kml if out.suffix == ".kml" else to_gpx
    return (piece.encode() for piece in shape(out.stem, thin_out(points)))


def _table_text(table: Table) -> Iterator[bytes]:
    yield encode_head(table.header).encode()
    lines: list[str] = []
    for row in table.rows:
        if isinstance(row, TableHeader):
            lines.append(encode_header(row))
        else:
            lines.append(row_to_line(row))
        if len(lines) == LINES:
            yield "".join(lines).encode()
            lines.clear()
    yield "".join(lines).encode()


def _within(records: Iterable[TlogRecord], limits: Limits) -> Iterator[TlogRecord]:
    begin, end = limits
    first_us: int | None = None
    for record in records:
        first_us = record.time_us if first_us is None else first_us
        if end is not None and record.time_us > place_in(end, first_us):
            return
        if begin is None or record.time_us >= place_in(begin, first_us):
            yield record


def _rows_within(table: Table, limits: Limits) -> Iterator[Line]:
    begin, end = limits
    zero_us = table.header.unix_us_at_zero or 0
    first_us: int | None = None
    for row in table.rows:
        if isinstance(row, TableHeader):
            yield row
            continue
        time_us = zero_us + row.time_us
        first_us = time_us if first_us is None else first_us
        if end is not None and time_us > place_in(end, first_us):
            return
        if begin is None or time_us >= place_in(begin, first_us):
            yield row
