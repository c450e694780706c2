"""`mavgate convert`: recordings into one another, into tables and maps."""

from pathlib import Path
from typing import Annotated, Final

import typer

from gateway.cli.app import RECORDINGS
from gateway.cli.support.options import (
    ConfigOption,
    read_options,
    read_settings,
)
from gateway.cli.support.recording_options import (
    ColumnsOption,
    Files,
    ForceOption,
    FromOption,
    PositionOption,
    SensorOption,
    SettingsOption,
    SmoothOption,
    ToOption,
    Wanted,
    files_of,
    print_remarks,
    progress_of,
    read_column_map,
    read_range,
    read_sensors,
    recordings_folder,
    refusing,
)
from gateway.cli.support.terminal import console_of, refuse
from gateway.output import write_new
from gateway.recordings.convert import LACKS, WRITERS, FlightToWrite

ONE_KIND: Final = ".parquet"
FROM_TLOGS: Final = (".tlog", ".kml", ".gpx", ".geojson", ".mcap")
"""Formats made from a recording's tlogs, which hold all its vehicles and messages."""


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("convert", rich_help_panel=RECORDINGS)(convert)


def convert(
    files: Files,
    *,
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Output; its ending selects the format.")
    ],
    begin: FromOption = None,
    end: ToOption = None,
    columns: ColumnsOption = None,
    sensor: SensorOption = None,
    fuse: Annotated[
        bool,
        typer.Option("--fuse", help="Fuse a table again instead of using its recorded states."),
    ] = False,
    smooth: SmoothOption = False,
    settings: SettingsOption = "recorded",
    position: PositionOption = "causal",
    system: Annotated[
        int | None, typer.Option("--system", min=1, max=255, help="Vehicle of a tlog to use.")
    ] = None,
    message: Annotated[
        str | None,
        typer.Option("--message", help="For Parquet: this MAVLink message instead of the table."),
    ] = None,
    config: ConfigOption = None,
    force: ForceOption = False,
) -> None:
    """Convert, trim and join recordings.

    Convert between tlogs and tables, or to a track for a map, MCAP for Foxglove, or Parquet. Logs
    of other autopilots (tlog, ULog, DataFlash) become tables that can be fused, and so does a CSV
    of another program, by its column map.
    """
    write = WRITERS.get(out.suffix)
    if write is None:
        refuse(f"{out}: the output must end in {', '.join(WRITERS)}")
    with refusing():
        if smooth and not fuse:
            refuse("--smooth smooths what --fuse fuses: give both")
        if message and out.suffix != ONE_KIND:
            refuse(f"--message is for {ONE_KIND}, which holds one kind of message a file")
        of_tlogs = not fuse and (out.suffix in FROM_TLOGS or message)
        wanted: Wanted = "tlogs" if of_tlogs else "tables"
        files = files_of(files, recordings_folder(config), wanted)
    with progress_of(files) as advance, refusing():
        options = read_options(
            read_settings(config),
            choice=settings,
            position=position,
            columns=read_column_map(columns),
            system_id=system,
            sensors=read_sensors(sensor),
            progress=advance,
        )
        limits = read_range(begin, end)
        flight = FlightToWrite(
            files,
            options,
            limits=limits,
            title=out.stem,
            fuse=fuse,
            smooth=smooth,
            message=message,
        )
        inputs = [*files, columns, config]
        size = write_new(out, write(flight), overwrite=force, inputs=inputs)
    print_remarks(flight.remarks)
    lacks = LACKS[out.suffix].of_tlogs if flight.is_mavlink else LACKS[out.suffix].of_tables
    if lacks and message is None:
        print_remarks([f"{out} does not hold {lacks}"])
    console_of().print(f"{out}: {size / 1e6:.3f} MB")
