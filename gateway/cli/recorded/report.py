"""`mavgate report`: figures and tables of a flight; `mavgate page`: a flight as one HTML file."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import TimeElapsedColumn

from gateway.cli.support.options import folder_of, output_file, read_options, read_settings
from gateway.cli.support.recording_options import (
    ColumnsOption,
    FlightArgument,
    ForceOption,
    FuseWithOption,
    ReferenceOption,
    SmoothOption,
    SystemOption,
    files_of,
    fusion_of,
    load_flight,
    name_of,
    print_remarks,
    progress_of,
)
from gateway.cli.support.terminal import progress_bar
from gateway.extras import require
from gateway.output import check_folder, write_new
from gateway.recordings.fuse import with_reference
from gateway.recordings.recorded_fusion import smoothed_latency_in_words

app = typer.Typer()

OutputOption = Annotated[
    Path, typer.Option("--output", "-o", help="Folder for the page, its figures and tables.")
]


@app.command()
def report(
    flight: FlightArgument = None,
    *,
    output: OutputOption = Path("report"),
    against: Annotated[
        Path | None, typer.Option("--against", help="Another recording to compare with.")
    ] = None,
    against_config: Annotated[
        Path | None, typer.Option("--against-config", help="Other settings to compare with.")
    ] = None,
    reference: ReferenceOption = None,
    columns: ColumnsOption = None,
    system: SystemOption = None,
    smooth: SmoothOption = False,
    fuse_with: FuseWithOption = "recorded",
    force: ForceOption = False,
) -> None:
    """Make a page of figures and tables of a flight, those of the paper included.

    Without a flight the built-in simulated one is used.
    """
    require("a report", "plot")
    # These require the extra, and take a second to import.
    from gateway.analysis.case import make_case
    from gateway.analysis.reporting.compose import make_report
    from gateway.analysis.reporting.page import count_pictures, write_report

    check_folder(output, overwrite=force)
    gateway = read_settings()
    options = read_options(gateway, columns, choice=fuse_with, system_id=system)
    loaded = load_flight(flight, gateway, options, reference)
    other = loaded if against is None else load_flight(against, gateway, options)
    others = None
    if against_config is not None:
        others = fusion_of(read_settings(against_config))
        if flight is None:
            others = with_reference(others, gps_latency_s=loaded.latency_s)
    with progress_bar(TimeElapsedColumn()) as progress:
        task = progress.add_task("fusing", total=None)
        progress.refresh()
        case = make_case(loaded, smooth=smooth)
        compared = make_case(other, others) if other is not loaded or others else None
        made = make_report(case, compared)
        progress.update(task, description="drawing", total=count_pictures(made.sections))

        def advance() -> None:
            # No thread for the progress bar, since drawing processes are forked from this one.
            progress.advance(task)
            progress.refresh()

        page = write_report(made, output, advance)
    used_s = case.smoothed_latency_s
    if used_s is not None and used_s != loaded.latency_s:
        print_remarks([f"{loaded.name}: {smoothed_latency_in_words(used_s, loaded.latency_s)}"])
    print(page)


@app.command()
def page(
    flight: Annotated[
        Path, typer.Argument(help="A recording by its name, or any flight log.", show_default=False)
    ],
    *,
    output: Annotated[Path, output_file("The HTML file.", (".html",))] = Path("flight.html"),
    compare: Annotated[
        bool,
        typer.Option(
            "--compare/--no-compare",
            help="Also fuse the sensor data with every estimator, and show the differences.",
        ),
    ] = True,
    columns: ColumnsOption = None,
    fuse_with: FuseWithOption = "recorded",
    force: ForceOption = False,
) -> None:
    """Make one HTML file of a flight, which opens offline in any browser.

    It contains the instruments, the flight in 3D and on a plan, a slider, plots and events.
    """
    require("a page", "panel")
    # These take a second to import.
    from gateway.panel.flight_page import add_comparison, begin_comparison, read_flight, render_page

    gateway = read_settings()
    files = files_of([flight], folder_of(gateway), "tlogs")
    options = read_options(gateway, columns, choice=fuse_with)
    comparison = None
    if compare:
        # Runs on another core at the same time.
        tables = files_of([flight], folder_of(gateway), "tables")
        comparison = begin_comparison(tables, options)
    with progress_of(files) as advance:
        made = read_flight(files, replace(options, progress=advance), name_of(flight, files))
        if comparison is not None:
            add_comparison(made, comparison)
    print_remarks(made.remarks)
    write_new(output, [render_page(made).encode()], overwrite=force, inputs=files)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB")
