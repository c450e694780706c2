"""`mavgate batch`: one task on many recordings, on this machine or on a cluster."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import typer

from gateway.batch.tasks import FlightResult, JudgeTask, read_results
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
"""Exit code if a recording failed."""
FLIGHTS_CSV: Final = "flights.csv"
BEST_TOML: Final = "best.toml"
SWEEP_CSV: Final = "sweep.csv"

Metric = Literal["held", "interpolated", "reference", "attitude"]

app = typer.Typer()
group = typer.Typer(
    help="Score every estimator, or try settings, on many recordings at once, here or on a "
    "cluster.",
    no_args_is_help=True,
)
app.add_typer(group, name="batch")

OutputOption = Annotated[
    Path,
    typer.Option(
        "--output", "-o", help="Folder of the results; finished tasks in it are not repeated."
    ),
]
AgainstOption = Annotated[
    Path | None,
    typer.Option("--against", help="Folder of the results of another version, to compare with."),
]


@group.command()
def report(
    files: SeasonFiles,
    *,
    output: OutputOption,
    pages: Annotated[
        bool,
        typer.Option("--pages/--no-pages", help="Make a page of each flight, which takes longer."),
    ] = True,
    against: AgainstOption = None,
    columns: ColumnsOption = None,
    fuse_with: FuseWithOption = "recorded",
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
) -> None:
    """Score every estimator on every flight at withheld fixes; make a page of each, and of all."""
    if pages:
        require("a report", "plot")
    work = SeasonWork(files, jobs, scheduler)
    task = JudgeTask(season_options(columns, fuse_with), pages)
    _finish(work.run(task, work.items(), output), output, against)


@group.command()
def sweep(
    files: SeasonFiles,
    *,
    vary: Annotated[
        list[str],
        typer.Option(help="alpha=0.1:0.9:9, gps_latency_s=0:0.4:9, estimator=eskf,paper, …"),
    ],
    output: OutputOption,
    metric: Annotated[
        Metric, typer.Option(help="Error to minimise, as in `mavgate sweep`.")
    ] = "held",
    hold_out: HoldOutOption = 5,
    gps_interval: IntervalOption = 0.0,
    columns: ColumnsOption = None,
    fuse_with: FuseWithOption = "recorded",
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    force: ForceOption = False,
) -> None:
    """Find one set of settings for many flights, validated by those of other days."""
    from gateway.cli.recorded.sweep import SweepOptions, run_season_sweep

    work = SeasonWork(files, jobs, scheduler)
    options = SweepOptions(
        [], vary, 0, metric, hold_out, gps_interval, jobs, output / BEST_TOML, output / SWEEP_CSV,
        force,
    )  # fmt: skip
    read = season_options(columns, fuse_with)
    _end(run_season_sweep(work, read, read_settings(), options, output))


def _finish(results: Sequence[FlightResult], output: Path, against: Path | None) -> None:
    """Show the results of the season as a table, and write its page."""
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
