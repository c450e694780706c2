"""`mavgate page`: a flight as one HTML file that needs no network."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.app import RECORDINGS
from gateway.cli.support.options import (
    ConfigOption,
    folder_of,
    load_settings,
    or_refuse,
    read_options,
)
from gateway.cli.support.recording_options import (
    ColumnsOption,
    ForceOption,
    SettingsOption,
    files_of,
    print_remarks,
    progress_of,
    read_column_map,
    refusing,
)
from gateway.cli.support.terminal import how_to_add, refuse
from gateway.output import write_new


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("page", rich_help_panel=RECORDINGS)(page)


def page(
    flight: Annotated[
        Path, typer.Argument(help="A recording by its name, or any flight log.", show_default=False)
    ],
    *,
    output: Annotated[Path, typer.Option("--output", "-o", help="The HTML file.")] = Path(
        "flight.html"
    ),
    compare: Annotated[
        bool,
        typer.Option(
            "--compare/--no-compare",
            help="Also fuse the sensor data with every estimator, and show the differences.",
        ),
    ] = True,
    columns: ColumnsOption = None,
    settings: SettingsOption = "recorded",
    config: ConfigOption = None,
    force: ForceOption = False,
) -> None:
    """Make one HTML file of a flight, which opens offline in any browser.

    It contains the instruments, the flight in 3D and on a plan, a slider, plots and events.
    """
    try:
        # These need an extra, and take a second to import.
        from gateway.panel.flight_page import compare_estimators, read_flight, render_page
    except ModuleNotFoundError as error:
        refuse(f"the page is made by the panel, and {error.name} is missing: {how_to_add('panel')}")
    gateway = or_refuse(lambda: load_settings(config))
    with refusing():
        files = files_of([flight], folder_of(gateway), "tlogs")
        options = read_options(gateway, choice=settings, columns=read_column_map(columns))
        with progress_of(files) as advance:
            made = read_flight(files, replace(options, progress=advance), flight.name)
        if compare:
            tables = files_of([flight], folder_of(gateway), "tables")
            with progress_of(tables) as advance:
                compare_estimators(made, tables, replace(options, progress=advance))
        print_remarks(made.remarks)
        write_new(output, [render_page(made).encode()], overwrite=force, inputs=files)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
