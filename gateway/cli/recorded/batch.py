"""`mavgate batch`: one work on many recordings, here or on a cluster."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from gateway.batch.tasks import FlightResult, FuseTask, InfoTask, ReportTask, read_results
from gateway.cli.support.batch_work import (
    HoldOutOption,
    IntervalOption,
    SchedulerOption,
    SeasonFiles,
    SeasonWork,
    failures,
    season_options,
)
from gateway.cli.support.options import read_settings
from gateway.cli.support.recording_options import (
    ColumnsOption,
    ForceOption,
    FuseWithOption,
    JobsOption,
)
from gateway.cli.support.terminal import console_of, refuse, table_of
from gateway.extras import how_to_add, missing, require
from gateway.output import write_new
from gateway.printable import figure
from gateway.units import counted

if TYPE_CHECKING:
    from gateway.batch.statistics import Versus

FAILED: Final = 1
"""Exit code of the command if a recording failed."""
FLIGHTS_CSV: Final = "flights.csv"
BEST_TOML: Final = "best.toml"
SWEEP_CSV: Final = "sweep.csv"

Metric = Literal["held", "interpolated", "reference", "attitude"]

app = typer.Typer()
group = typer.Typer(
    help="Fuse, report, sweep or sum up many recordings at once, here or on a cluster.",
    no_args_is_help=True,
)
app.add_typer(group, name="batch")

OutputOption = Annotated[
    Path,
    typer.Option(
        "--output", "-o", help="Folder of the results; what is done there is not done again."
    ),
]
AgainstOption = Annotated[
    Path | None,
    typer.Option("--against", help="Folder of the results of another version, to compare with."),
]


def _add_judging(name: Literal["fuse", "report"], text: str) -> None:
    """Add a command that judges every estimator on every flight; they differ in what they write."""

    @group.command(name, help=text)
    def judge(
        files: SeasonFiles,
        *,
        output: OutputOption,
        against: AgainstOption = None,
        columns: ColumnsOption = None,
        fuse_with: FuseWithOption = "recorded",
        jobs: JobsOption = None,
        scheduler: SchedulerOption = None,
    ) -> None:
        if name == "report":
            require("a report", "plot")
        work = SeasonWork(files, jobs, scheduler)
        task = {"fuse": FuseTask, "report": ReportTask}[name]
        options = season_options(columns, fuse_with)
        _finish(work.run(task(options), work.items(), output), output, against)


_add_judging(
    "fuse",
    "Fuse many recordings with every estimator, judge each by withheld fixes, make one page.",
)
_add_judging("report", "Make the page of each of many recordings, and one of the season.")


@group.command()
def info(
    files: SeasonFiles,
    *,
    output: OutputOption,
    columns: ColumnsOption = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Describe many files, one by one, as `mavgate info` does."""
    from gateway.batch.statistics import flight_table

    work = SeasonWork(files, jobs, scheduler)
    task = InfoTask(season_options(columns, "recorded"))
    results = work.run(task, work.items(each_file=True), output)
    grid = table_of("recording", "aircraft", "began (UTC)", "s", "km", "gaps", "damaged", left=1)
    for result in results:
        figures = result.figures
        if result.error is not None:
            continue
        km = sum(vehicle["distance_m"] or 0.0 for vehicle in figures["vehicles"]) / 1000.0
        grid.add_row(
            result.location.rsplit("/", 1)[-1], str(result.vehicle or "?"), result.began or "",
            figure(figures["duration_s"], ".0f"), figure(km, ".2f"), str(len(figures["gaps"])),
            str(figures["damaged_bytes"]),
        )  # fmt: skip
    console_of().print(grid)
    rows = flight_table(results).to_csv(index=False).encode()
    write_new(output / FLIGHTS_CSV, [rows], overwrite=True)
    _end(results)


@group.command()
def sweep(
    files: SeasonFiles,
    *,
    vary: Annotated[
        list[str],
        typer.Option(help="alpha=0.1:0.9:9, gps_latency_s=0:0.4:9, estimator=eskf,paper, …"),
    ],
    output: OutputOption,
    metric: Annotated[Metric, typer.Option(help="What judges, as for `mavgate sweep`.")] = "held",
    hold_out: HoldOutOption = 5,
    gps_interval: IntervalOption = 0.0,
    columns: ColumnsOption = None,
    fuse_with: FuseWithOption = "recorded",
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    force: ForceOption = False,
) -> None:
    """Find one set of settings for many flights; those of other days judge what was chosen."""
    from gateway.cli.recorded.sweep import SweepOptions, run_season_sweep

    work = SeasonWork(files, jobs, scheduler)
    options = SweepOptions(
        [], vary, 0, metric, hold_out, gps_interval, jobs, output / BEST_TOML, output / SWEEP_CSV,
        force,
    )  # fmt: skip
    read = season_options(columns, fuse_with)
    _end(run_season_sweep(work, read, read_settings(), options, output))


def _finish(results: Sequence[FlightResult], output: Path, against: Path | None) -> None:
    """Show the season as a table, and write its page."""
    from gateway.batch.statistics import errors_by_group, flight_table, why_leads, write_season_page

    compared = None if against is None else _compare(results, against)
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
        print(write_season_page(results, output, compared))
    else:
        print(output / FLIGHTS_CSV)
        console.print(how_to_add("a page of the season", "plot"))
    _end(results)


def _compare(results: Sequence[FlightResult], against: Path) -> "Versus":
    from gateway.batch.statistics import versus

    found = versus(results, read_results(against))
    if not found.compared:
        refuse(f"{against}: contains no result of any of these recordings")
    return found


def _show_versus(compared: "Versus") -> None:
    console = console_of()
    for estimator, lead in compared.leads.items():
        console.print(f"{estimator} against the other results: {lead.text}")
    for change in compared.worse.itertuples():
        console.print(
            f"worse: {change.location}, {change.estimator}: {change.before_m:.3f} m before, "
            f"{change.after_m:.3f} m now",
        )


def _end(results: Sequence[FlightResult]) -> None:
    if count := failures(results):
        console_of(stderr=True).print(f"{count} of {counted(len(results), 'recording')} failed")
        raise typer.Exit(FAILED)
