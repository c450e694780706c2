"""`mavgate sweep`: try settings on one flight or many, and write the best as a settings file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import numpy as np
import typer

from gateway.analysis import sweep as sweeping
from gateway.analysis.flight import Flight, max_speed_mps
from gateway.analysis.sweep import (
    COLUMN_OF,
    ESTIMATOR_KEY,
    Axis,
    Contest,
    Metric,
    Run,
    SweepError,
    Trial,
    Values,
    grid,
    parse_axis,
    pool,
    with_estimator_of,
    with_values,
)
from gateway.batch.storage import is_url
from gateway.batch.tasks import FlightResult, SweepTask
from gateway.cli.support.batch_work import HoldOutOption, IntervalOption, SeasonWork, season_options
from gateway.cli.support.options import output_file, read_options, read_settings
from gateway.cli.support.recording_options import (
    ColumnsOption,
    ForceOption,
    FuseWithOption,
    JobsOption,
    ReferenceOption,
    SystemOption,
    fusion_of,
    load_flight,
)
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.config import GatewaySettings, render
from gateway.output import check_output, write_new
from gateway.printable import figure
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import counted

if TYPE_CHECKING:
    import pandas as pd

    from gateway.batch.statistics import Choice, FloatArray

app = typer.Typer()
SHOWN: Final = 10
AT_REST_MPS: Final = 1.0
"""Greatest GPS speed of a flight at rest; a receiver at rest reports up to 0.3 m/s."""
HEADINGS: Final = {
    "north_m": "latitude error, m",
    "east_m": "longitude error, m",
    "held_m": "error at withheld fixes, m",
    "interpolated_m": "error against interpolated GPS, m",
    "reference_m": "error against the reference, m",
    "attitude_deg": "attitude error, deg",
}
"""Headings of the columns with a sweep's scores."""


@app.command()
def sweep(
    flights: Annotated[
        list[str] | None,
        typer.Argument(
            help="Recordings by name, flight logs, or a folder; by default the built-in "
            "simulated flight.",
            show_default=False,
        ),
    ] = None,
    *,
    alpha: Annotated[
        str | None, typer.Option(help="Weight of the acceleration: 0.1:0.9:9 or 0.1,0.5.")
    ] = None,
    beta: Annotated[str | None, typer.Option(help="Weight of the velocity, likewise.")] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="Any other setting: gps_latency_s=0:0.4:9, accel_filter=chebyshev,…"),
    ] = None,
    optimise: Annotated[
        int, typer.Option(help="Search the ranges for this many generations, instead of a grid.")
    ] = 0,
    metric: Annotated[
        Metric,
        typer.Option(
            help="Minimise the error at withheld fixes, against interpolated GPS, as in the paper, "
            "or against the reference's position or attitude."
        ),
    ] = "held",
    hold_out: HoldOutOption = 5,
    gps_interval: IntervalOption = 0.0,
    jobs: JobsOption = None,
    output: Annotated[Path, output_file("Settings file for the best.", (".toml",))] = Path(
        "best.toml"
    ),
    table: Annotated[
        Path | None, output_file("CSV file for every trial.", (".csv",), "--table")
    ] = None,
    reference: ReferenceOption = None,
    columns: ColumnsOption = None,
    system: SystemOption = None,
    fuse_with: FuseWithOption = "recorded",
    force: ForceOption = False,
) -> None:
    """Try settings on one flight or many, and write the best as a settings file.

    Without a flight the built-in simulated one is used. The filter runs causally and is scored by
    fixes that are withheld from it. With many flights, the choice is scored by flights of other
    aircraft and days.
    """
    current = read_settings()
    named = [(name, text) for name, text in (("alpha", alpha), ("beta", beta)) if text]
    options = SweepOptions(
        named, vary or [], optimise, metric, hold_out, gps_interval, jobs, output, table, force
    )
    given = flights or []
    if len(given) > 1 or any(Path(name).is_dir() or is_url(name) for name in given):
        if reference is not None or system is not None:
            refuse("--reference and --system belong to one flight")
        read = season_options(columns, fuse_with)
        run_season_sweep(SeasonWork(given, jobs), read, current, options)
        return
    path = Path(given[0]) if given else None
    read = read_options(current, columns, choice=fuse_with, system_id=system)
    run_sweep(path, current, options, lambda: load_flight(path, current, read, reference))


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """Options of the command line for a sweep."""

    named: Sequence[tuple[str, str]]
    """The paper's own weights, with their values as text."""
    vary: Sequence[str]
    """Further settings as `NAME=VALUES`."""
    generations: int
    """Number of generations to search; 0 for a grid."""
    metric: Metric
    hold_out: int
    gps_interval_s: float
    jobs: int | None
    output: Path
    table: Path | None
    overwrite: bool


def run_sweep(
    path: Path | None,
    settings: GatewaySettings,
    options: SweepOptions,
    load: Callable[[], Flight],
) -> None:
    """Try the settings, show the best, and write it as a settings file."""
    _check_outputs(options, path)
    axes = _parse_axes(options)
    flight = load()
    contest = sweeping.make_contest(
        flight,
        flight.fusion,
        [axis.key for axis in axes],
        hold_out=options.hold_out,
        interval_s=options.gps_interval_s,
    )
    if (fastest := max_speed_mps(flight)) < AT_REST_MPS:
        console_of(stderr=True).print(
            f"{flight.name}: at rest throughout, at most {fastest:.1f} m/s by GPS: it contains no "
            "information on settings for flights",
            style="yellow",
        )
    _print_idle(contest, axes)
    with pool(contest, options.jobs) as run:
        if options.generations:
            trials = _search(axes, run, options.generations, options.metric)
        else:
            trials = _try_all(grid(axes), run)
    results = sweeping.tabulate(contest.keys, trials, options.metric)
    _show(results, contest, options.metric)
    best = with_values(contest.fusion, contest.keys, sweeping.best_of(trials, options.metric))
    _write(options, settings, best, contest.keys, results, path)


def _check_outputs(options: SweepOptions, path: Path | None = None) -> None:
    """Raise OSError if an output cannot be written, or is the input itself."""
    for out in (options.output, options.table):
        if out is not None:
            check_output(out, [path], overwrite=options.overwrite)


def _write(
    options: SweepOptions,
    settings: GatewaySettings,
    best: FusionSettings,
    keys: Sequence[str],
    table: "pd.DataFrame",
    path: Path | None = None,
) -> None:
    """Write a settings file with the best of the varied values, and the table if requested."""
    if best.estimation.estimator != settings.estimation.estimator:
        keys = [ESTIMATOR_KEY, *keys]
    merged = render(msgspec.structs.replace(settings, estimation=best.estimation), keys)
    write_new(options.output, [merged.encode()], overwrite=options.overwrite, inputs=[path])
    print(options.output)
    if options.table is not None:
        rows = table.to_csv(index=False).encode()
        write_new(options.table, [rows], overwrite=options.overwrite, inputs=[path])


def _cell(value: object) -> str:
    return figure(value, ".4g") if isinstance(value, float) else str(value)


def _parse_axes(options: SweepOptions) -> list[Axis]:
    """Parse the axes to vary; raises SweepError for invalid ones."""
    wanted = list(options.named)
    for item in options.vary:
        name, equals, text = item.partition("=")
        if not equals:
            raise SweepError(f"--vary {item}: write NAME=VALUES")
        wanted.append((name, text))
    if not wanted:
        raise SweepError("nothing to vary: give --alpha, --beta or --vary NAME=VALUES")
    return [parse_axis(name, text) for name, text in wanted]


def _print_idle(contest: Contest, axes: Sequence[Axis]) -> None:
    """Print in advance the settings that have no effect."""
    idle = sweeping.idle_axes(contest, axes)
    if not idle:
        return
    estimator = contest.fusion.estimation.estimator
    text = f"{', '.join(idle)}: has no effect on this flight"
    if not any(axis.key == ESTIMATOR_KEY for axis in axes):
        text += f" with the estimator {estimator}"
    if len(idle) == len(axes):
        raise SweepError(f"{text}; vary another setting, or choose the estimator that uses it")
    console_of(stderr=True).print(text, style="yellow")


def _try_all(points: Sequence[Values], run: Run) -> list[Trial]:
    found: list[Trial] = []
    with progress_bar() as progress:
        task = progress.add_task("trials", total=len(points))
        for index, scores in run(points):
            found.append((points[index], scores))
            progress.update(task, advance=1, refresh=True)
    return found


def _search(axes: Sequence[Axis], run: Run, generations: int, metric: Metric) -> list[Trial]:
    found: list[Trial] = []
    with progress_bar() as progress:
        task = progress.add_task("generations", total=generations)

        def evaluate(points: list[Values]) -> list[float]:
            scores = dict(run(points))
            found.extend((values, scores[k]) for k, values in enumerate(points))
            return [scores[k][COLUMN_OF[metric]] for k in range(len(points))]

        def show_progress(best: float) -> None:
            text = f"generations, best {best:.3f}"
            progress.update(task, advance=1, description=text, refresh=True)

        sweeping.optimise(axes, evaluate, generations, show_progress)
    return found


def _show(results: "pd.DataFrame", contest: Contest, metric: Metric) -> None:
    judged = COLUMN_OF[metric]
    others = [name for name in ("north_m", "east_m", "reference_m") if name in results]
    names = [*contest.keys, judged, *(name for name in others if name != judged)]
    title = (
        f"Best of {counted(len(results), 'trial')}, by the {HEADINGS[judged].rpartition(',')[0]}"
    )
    shown = table_of(*(HEADINGS.get(name, name.rsplit(".", 1)[-1]) for name in names), left=0)
    for row in results[names].head(SHOWN).itertuples(index=False):
        shown.add_row(*map(_cell, row))
    console_of().print(title, shown, sep="\n")


def run_season_sweep(
    work: SeasonWork,
    read: ReadOptions,
    settings: GatewaySettings,
    options: SweepOptions,
    kept: Path | None = None,
) -> list[FlightResult]:
    """Score every point on every flight, show the point that is best overall, and write it."""
    import pandas as pd

    if kept is not None:
        kept.mkdir(parents=True, exist_ok=True)
    _check_outputs(options)
    if options.generations:
        refuse("--optimise searches on one flight; give a grid for many")
    fusion = fusion_of(settings)
    axes = tuple(_parse_axes(options))
    points, keys = grid(axes), [axis.key for axis in axes]
    fusion = with_estimator_of(fusion, keys)
    column = COLUMN_OF[options.metric]
    task = SweepTask(read, axes, column, options.hold_out, options.gps_interval_s)
    results = work.run(task, work.items(), kept)
    swept = [result for result in results if result.error is None]
    if not swept:
        refuse("the sweep failed on all flights")
    base, choice = _chosen(swept)
    _show_choice(axes, points, choice, column, len(swept))
    best = with_values(fusion, keys, points[choice.winner])
    table = pd.DataFrame(
        {
            "recording": [result.location for result in swept],
            "aircraft": [result.vehicle for result in swept],
            "began": [result.began for result in swept],
            "recorded settings": base,
            "chosen by others": choice.judged,
        }
    )
    _write(options, settings, best, keys, table)
    return results


def _chosen(swept: Sequence[FlightResult]) -> "tuple[FloatArray, Choice]":
    """Return the errors with the recorded settings, and the choice of the best point."""
    from gateway.batch.statistics import choose, group_of

    # JSON represents an unknown score as null.
    errors = np.array([result.figures["scores"] for result in swept], float)
    base = np.array([result.figures["base"] for result in swept], float)
    groups = [group_of(result) for result in swept]
    try:
        return base, choose(errors, base, groups)
    except ValueError as error:
        refuse(f"{error}; choose another --metric")


def _show_choice(
    axes: Sequence[Axis], points: Sequence[Values], choice: "Choice", column: str, flights: int
) -> None:
    console = console_of()
    grid_ = table_of(
        *(axis.key.rsplit(".", 1)[-1] for axis in axes), f"mean {HEADINGS[column]}", left=0
    )
    for number in np.argsort(choice.means, kind="stable")[:SHOWN].tolist():
        grid_.add_row(*map(_cell, points[number]), _cell(float(choice.means[number])))
    console.print(grid_)
    console.print(
        f"{counted(len(points), 'point')} on {counted(flights, 'flight')}, "
        f"in {choice.folds} folds by aircraft and day; "
        f"the same point wins without {choice.stable} of the {choice.folds}"
    )
    if choice.over_base is not None:
        console.print(
            "against the recorded settings, each flight scored only with settings that the "
            f"others chose: {choice.over_base.text}",
        )
    if choice.over_second is not None:
        console.print(
            f"the winner against the second, on the flights that chose both: "
            f"{choice.over_second.text}",
        )
