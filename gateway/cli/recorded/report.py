"""`mavgate report`: figures and tables of flights, or one flight as an HTML file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import typer
from rich.progress import TimeElapsedColumn

from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import folder_of, option, read_options, read_settings
from gateway.cli.support.recordings import (
    are_many,
    files_of,
    fusion_of,
    load_flight,
    name_of,
    print_remarks,
    progress_of,
    refuse_unused,
)
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.config import GatewaySettings
from gateway.extras import how_to_add, missing, require
from gateway.output import check_folder, write_new
from gateway.printable import figure
from gateway.recordings.files import FlightError
from gateway.recordings.fuse import with_reference
from gateway.recordings.recorded_fusion import smoothed_latency_in_words
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.table import SettingsChoice

if TYPE_CHECKING:
    from gateway.analysis.case import Case
    from gateway.analysis.pilot import PilotFlight
    from gateway.analysis.reporting.page import Report
    from gateway.batch.statistics import Versus
    from gateway.batch.tasks import FlightResult

app = typer.Typer()
HTML: Final = ".html"
"""Suffix of the output that selects the page of one flight."""
SETTINGS: Final = ".toml"
"""Suffix of settings to compare with."""
FLIGHTS_CSV: Final = "flights.csv"
UNUSED: Final = {
    "an HTML file": ("--against", "--reference", "--system", "--smooth", "--jobs", "--scheduler"),
    "many recordings": ("--reference", "--system", "--smooth"),
    "one recording": ("--jobs", "--scheduler"),
}
"""Options that have no effect, by kind of report."""


@app.command()
def report(
    flights: list[str] | None = opt.FLIGHTS,
    *,
    output: Path = option(
        "--output -o",
        "A folder for figures and tables, or NAME.html for one flight to replay in a browser.",
        Path("report"),
    ),
    against: list[Path] | None = option(
        "--against",
        "Compare with another recording or other settings (.toml); many recordings with "
        "the folder of an earlier report.",
    ),
    reference: Path | None = opt.REFERENCE,
    columns: Path | None = opt.COLUMNS,
    system: int | None = opt.SYSTEM,
    smooth: bool = opt.SMOOTH,
    fuse_with: SettingsChoice = opt.FUSE_WITH,
    quick: bool = option(
        "--quick",
        "Leave out the comparison of estimators in NAME.html, or the pages of many recordings.",
        False,
    ),
    jobs: int | None = opt.JOBS,
    scheduler: str | None = opt.SCHEDULER,
    force: bool = opt.FORCE,
) -> None:
    """Make figures and tables of flights, or one HTML file of a flight.

    The figures and tables include those of the paper; without a recording, the built-in simulated
    flight is used. Those of the paper require IMU samples; without them the page has track, height,
    speed, battery, modes and texts. Of many recordings or a folder, every estimator is scored on
    every flight; finished ones are not repeated, and the exit code is 1 if one failed. The HTML
    file opens offline in any browser: instruments, 3D, plan, plots and events.
    """
    names, others = flights or [], against or []
    kind = "many recordings" if are_many(names) else "one recording"
    kind = "an HTML file" if output.suffix == HTML else kind
    given = {
        "--against": others, "--reference": reference, "--system": system, "--smooth": smooth,
        "--jobs": jobs, "--scheduler": scheduler,
    }  # fmt: skip
    refuse_unused(kind, {name: given[name] for name in UNUSED[kind]})
    gateway = read_settings()
    options = read_options(gateway, columns, choice=fuse_with, system_id=system)
    if kind == "many recordings":
        _report_many(names, output, options, others, quick=quick, jobs=jobs, cluster=scheduler)
        return
    one = Path(names[0]) if names else None
    if kind == "an HTML file":
        if one is None or len(names) > 1:
            refuse(f"{output}: give the one recording that it shows")
        _write_html(one, gateway, output, options, compare=not quick, force=force)
        return
    require("a report", "plot")
    check_folder(output, overwrite=force)
    _report_one(one, gateway, output, options, others, reference, smooth=smooth)


def _report_one(
    path: Path | None,
    gateway: GatewaySettings,
    output: Path,
    options: ReadOptions,
    against: Sequence[Path],
    reference: Path | None,
    *,
    smooth: bool,
) -> None:
    # These require the extra, and take a second to import.
    from gateway.analysis.case import make_case
    from gateway.analysis.reporting.compose import make_report

    settings = [each for each in against if each.suffix == SETTINGS]
    recordings = [each for each in against if each.suffix != SETTINGS]
    if len(settings) > 1 or len(recordings) > 1:
        refuse("--against: give at most one recording and one settings file")
    recorded = None if path is None else _read_recorded(path, gateway, options)
    try:
        loaded = load_flight(path, gateway, options, reference)
    except FlightError as error:
        if recorded is None or reference or against:
            raise
        # The recording can be read, but it has no samples.
        print_remarks([f"its filters are not studied: {error}"])
        print(_drawn(lambda: make_report(recorded), output))
        return
    other = load_flight(recordings[0], gateway, options) if recordings else loaded
    others = None
    if settings:
        others = fusion_of(read_settings(settings[0]))
        if path is None:
            others = with_reference(others, gps_latency_s=loaded.latency_s)
    cases: list[Case] = []

    def made() -> Report:
        cases.append(make_case(loaded, smooth=smooth, recorded=recorded))
        compared = make_case(other, others) if other is not loaded or others else None
        return make_report(cases[0], compared)

    page = _drawn(made, output)
    used_s = cases[0].smoothed_latency_s
    if used_s is not None and used_s != loaded.latency_s:
        print_remarks([f"{loaded.name}: {smoothed_latency_in_words(used_s, loaded.latency_s)}"])
    print(page)


def _drawn(make: Callable[[], Report], output: Path) -> Path:
    from gateway.analysis.reporting.page import write_report

    with progress_bar(TimeElapsedColumn()) as progress:
        task = progress.add_task("fusing", total=None)
        progress.refresh()
        made = make()
        count = sum(len(section.pictures) for section in made.sections)
        progress.update(task, description="drawing", total=count)
        # No thread for the progress bar, since drawing processes are forked from this one.
        return write_report(made, output, lambda: progress.update(task, advance=1, refresh=True))


def _read_recorded(path: Path, settings: GatewaySettings, options: ReadOptions) -> PilotFlight:
    from gateway.analysis.pilot import read_pilot_flight

    files = files_of([path], folder_of(settings), "tlogs")
    with progress_of(files) as advance:
        options = replace(options, progress=advance)
        return read_pilot_flight(files, options, name_of(path, files))


def _write_html(
    path: Path,
    gateway: GatewaySettings,
    output: Path,
    options: ReadOptions,
    *,
    compare: bool,
    force: bool,
) -> None:
    require(f"{output}", "panel")
    # These take a second to import.
    from gateway.panel.flight_page import add_comparison, begin_comparison, read_flight, render_page

    files = files_of([path], folder_of(gateway), "tlogs")
    comparison = None
    if compare:
        # Runs on another core at the same time.
        comparison = begin_comparison(files_of([path], folder_of(gateway), "tables"), options)
    with progress_of(files) as advance:
        made = read_flight(files, replace(options, progress=advance), name_of(path, files))
        if comparison is not None:
            add_comparison(made, comparison)
    print_remarks(made.remarks)
    write_new(output, [render_page(made).encode()], overwrite=force, inputs=files)
    print(f"{output}: {output.stat().st_size / 1e6:.1f} MB")


def _report_many(
    names: Sequence[str],
    output: Path,
    options: ReadOptions,
    against: Sequence[Path],
    *,
    quick: bool,
    jobs: int | None,
    cluster: str | None,
) -> None:
    # Imported here: these import pandas.
    from gateway.batch.statistics import (
        errors_by_group,
        flight_table,
        why_leads,
        write_flights_page,
    )
    from gateway.batch.tasks import EvaluateTask, without_secrets
    from gateway.cli.support.batch_work import exit_if_failed, run_on_all

    if not quick:
        require("a report", "plot")
    if len(against) > 1:
        refuse("--against: give the folder of one earlier report")
    task = EvaluateTask(without_secrets(options), not quick)
    results = run_on_all(names, task, output, jobs=jobs, scheduler=cluster)
    compared = _compare(results, against[0]) if against else None
    grid = table_of(
        "aircraft", "estimator", "flights", "median, m", "9 in 10, m", "worst, m", left=2
    )
    for aircraft, name, flights, *errors_m in errors_by_group(results).itertuples(index=False):
        grid.add_row(
            aircraft, name, str(flights), *(figure(error_m, ".3f") for error_m in errors_m)
        )
    console = console_of()
    console.print(grid)
    if text := why_leads(results):
        console.print(text)
    if compared is not None:
        _show_versus(compared)
    rows = flight_table(results).to_csv(index=False).encode()
    write_new(output / FLIGHTS_CSV, [rows], overwrite=True)
    if not missing("plot"):
        print(write_flights_page(results, output, compared))
    else:
        print(output / FLIGHTS_CSV)
        console.print(how_to_add("a page of the flights", "plot"))
    exit_if_failed(results)


def _compare(results: Sequence[FlightResult], against: Path) -> Versus:
    from gateway.batch.statistics import versus
    from gateway.batch.tasks import read_results

    found = versus(results, read_results(against))
    if not found.compared:
        refuse(f"{against}: contains no result of any of these recordings")
    return found


def _show_versus(compared: Versus) -> None:
    console = console_of()
    for change in compared.medians.itertuples():
        console.print(
            f"{change.estimator}: median error {change.after_m:.3f} m, {change.before_m:.3f} m in "
            "the other results"
        )
    for change in compared.worse.itertuples():
        console.print(
            f"worse: {change.location}, {change.estimator}: {change.before_m:.3f} m before, "
            f"{change.after_m:.3f} m now",
        )
