"""`mavgate convert`: recordings into one another, into tables and maps."""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer

from gateway.cli.live.run import ConfigOption, pipeline_settings, read_settings
from gateway.cli.support.errors import refuse
from gateway.cli.support.recording_options import (
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
from gateway.cli.support.terminal import console_of
from gateway.edges.disk.recording_streams import FileKind, kind_of, write_new
from gateway.flightlog.mapshape import TrackPoint, thin_out, to_gpx, to_kml
from gateway.flightlog.moment import Moment, place_in
from gateway.flightlog.table.row import TableRow, row_to_line
from gateway.flightlog.table.table import (
    TableHeader,
    TableMark,
    encode_head,
    encode_header,
    encode_mark,
    encode_state,
)
from gateway.flightlog.tlog.tlog import TlogRecord, encode_record
from gateway.flights import reading
from gateway.flights.reading import (
    NO_RECORDING,
    FlightError,
    Line,
    ReadOptions,
    RecordedTable,
    open_rows,
)
from gateway.flights.refusion import Refusion
from gateway.records import FusionState

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
    refusion: Refusion | None = None
    with progress_of(files) as advance, refusing():
        options = ReadOptions(
            current=pipeline_settings(read_settings(config)),
            choice=settings,
            position=position,
            columns=read_column_map(columns),
            system_id=system,
            progress=advance,
        )
        limits = (read_moment(begin), read_moment(end))
        kinds = {kind_of(file) for file in files}
        if out.suffix != ".csv" and kinds == {FileKind.TLOG}:
            pieces = _from_tlogs(files, out, options, limits)
        elif kinds == {FileKind.TABLE} and not fuse and out.suffix != ".tlog":
            pieces = _as_recorded(files, out, options, limits)
        else:
            refusion = Refusion(files, options)
            pieces = _fused_again(refusion, out, limits)
        size = write_new(out, pieces, overwrite=force)
    for remark in refusion.remarks if refusion else ():
        console_of(stderr=True).print(remark, markup=False)
    console_of().print(f"{out}: {size / 1e6:.3f} MB", markup=False)


def _from_tlogs(
    files: list[Path], out: Path, options: ReadOptions, limits: Limits
) -> Iterator[bytes]:
    recorded = reading.recorded_frames(files, options.progress)
    first = next(recorded, None)
    if first is None:
        raise FlightError(f"{', '.join(map(str, files))}: {NO_RECORDING}")
    records = _within(chain([first], recorded), limits)
    if out.suffix == ".tlog":
        return _tlog_bytes(records)
    return _map_shape(out, reading.points_of_frames(records, options.system_id))


def _as_recorded(
    files: list[Path], out: Path, options: ReadOptions, limits: Limits
) -> Iterator[bytes]:
    return _from_rows(
        reading.joined_rows([open_rows(file, options) for file in files]), out, limits
    )


def _fused_again(refusion: Refusion, out: Path, limits: Limits) -> Iterator[bytes]:
    """Fuse from the begin, so that what is cut out has settled as it had in flight."""
    if out.suffix == ".tlog":
        return _tlog_bytes(_within(refusion.frames(), limits))
    return _from_rows(refusion.table(), out, limits)


def _from_rows(table: RecordedTable, out: Path, limits: Limits) -> Iterator[bytes]:
    table = _trimmed(table, limits)
    if out.suffix == ".csv":
        return _table_text(table)
    return _map_shape(out, reading.points_of_rows(table))


def _tlog_bytes(records: Iterable[TlogRecord]) -> Iterator[bytes]:
    return (encode_record(record.time_us, record.frame) for record in records)


def _map_shape(out: Path, points: Iterable[TrackPoint]) -> Iterator[bytes]:
    shape = to_kml if out.suffix == ".kml" else to_gpx
    points = iter(points)
    first = next(points, None)
    if first is None:
        raise FlightError(f"{out}: nothing to draw, for the flight tells no position")
    return (piece.encode() for piece in shape(out.stem, thin_out(chain([first], points))))


def _table_text(table: RecordedTable) -> Iterator[bytes]:
    yield encode_head(table.header).encode()
    lines: list[str] = []
    for row in table.rows:
        match row:
            case TableRow():
                lines.append(row_to_line(row))
            case TableHeader():
                lines.append(encode_header(row))
            case TableMark():
                lines.append(encode_mark(row))
            case FusionState():
                lines.append(encode_state(row))
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


def _trimmed(table: RecordedTable, limits: Limits) -> RecordedTable:
    begin, end = limits
    zero_us = table.header.unix_us_at_zero or 0

    def rows() -> Iterator[Line]:
        first_us: int | None = None
        begun = begin is None
        for row in table.rows:
            if isinstance(row, TableRow):
                time_us = zero_us + row.time_us
                first_us = time_us if first_us is None else first_us
                if end is not None and time_us > place_in(end, first_us):
                    return
                begun = begun or (begin is not None and time_us >= place_in(begin, first_us))
            # What was changed before the begin still holds, but a state from there does not.
            if begun or isinstance(row, TableHeader):
                yield row

    cold_start = table.header.cold_start and begin is None
    return RecordedTable(msgspec.structs.replace(table.header, cold_start=cold_start), rows())
