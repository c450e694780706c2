"""`mavgate sweep`: try settings on one flight or many, and write the best as a settings file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import numpy as np
import typer

from gateway.analysis import sweep as sweeping
from gateway.analysis.flight import Flight
from gateway.analysis.pilot import pilot_flight_of_samples
from gateway.analysis.processes import forked
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
    run_trial,
    with_estimator_of,
    with_values,
)
from gateway.batch.tasks import SweepTask, without_secrets
from gateway.cli.support import shared_options as opt
from gateway.cli.support.batch_work import exit_if_failed, run_on_all
from gateway.cli.support.options import option, output_file, read_options, read_settings
from gateway.cli.support.recordings import are_many, fusion_of, load_flight, refuse_unused
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.config import GatewaySettings, render
from gateway.output import check_output, write_new
from gateway.printable import figure
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.table import SettingsChoice
from gateway.units import counted

if TYPE_CHECKING:
    import pandas as pd

    from gateway.batch.statistics import Choice

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
    flights: list[str] | None = opt.FLIGHTS,
    *,
    vary: list[str] | None = option(
        "--vary",
        "NAME=FROM:TO:COUNT or NAME=VALUE,VALUE: alpha=0.1:0.9:9, estimator=eskf,paper; "
        "may be repeated.",
    ),
    optimise: int = option(
        "--optimise", "Search the ranges for this many generations, instead of a grid.", 0
    ),
    metric: Metric = option(
        "--metric",
        "Minimise the error at withheld fixes, against interpolated GPS, as in the paper, "
        "or against the reference's position or attitude.",
        "held",
    ),
    hold_out: int = option("--hold-out", "Withhold every n-th fix; 0 for none.", 5, min=0),
    gps_interval: float = option(
        "--gps-interval",
        "Fuse one fix in this many seconds, and withhold all others; 0 for all.",
        0.0,
        min=0.0,
    ),
    jobs: int | None = opt.JOBS,
    scheduler: str | None = opt.SCHEDULER,
    output: Path = output_file(
        "Settings file for the best.", (".toml",), default=Path("best.toml")
    ),
    table: Path | None = output_file("CSV file for every trial.", (".csv",), "--table"),
    reference: Path | None = opt.REFERENCE,
    columns: Path | None = opt.COLUMNS,
    system: int | None = opt.SYSTEM,
    fuse_with: SettingsChoice = opt.FUSE_WITH,
    force: bool = opt.FORCE,
) -> None:
    """Try settings on one flight or many, and write the best as a settings file.

    Without a flight the built-in simulated one is used. The filter runs causally and is scored by
    fixes that are withheld from it. Of many flights each has the same weight.
    """
    current = read_settings()
    options = SweepOptions(
        vary or [], optimise, metric, hold_out, gps_interval, jobs, output, table, force
    )
    given = flights or []
    read = read_options(current, columns, choice=fuse_with, system_id=system)
    if are_many(given):
        refuse_unused("many recordings", {"--reference": reference, "--system": system})
        run_sweep_of_many(given, scheduler, without_secrets(read), current, options)
        return
    refuse_unused("one recording", {"--scheduler": scheduler})
    path = Path(given[0]) if given else None
    run_sweep(path, current, options, lambda: load_flight(path, current, read, reference))


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """Options of the command line for a sweep."""

    vary: Sequence[str]
    """Settings as `NAME=VALUES`."""
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
    fastest = pilot_flight_of_samples(flight).facts.fastest_mps or 0.0
    if fastest < AT_REST_MPS:
        console_of(stderr=True).print(
            f"{flight.name}: at rest throughout, at most {fastest:.1f} m/s by GPS: it contains no "
            "information on settings for flights",
            style="yellow",
        )
    _print_idle(contest, axes)
    with forked(partial(run_trial, contest), options.jobs) as run:
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
    wanted = list[tuple[str, str]]()
    for item in options.vary:
        name, equals, text = item.partition("=")
        if not equals:
            raise SweepError(f"--vary {item}: write NAME=VALUES")
        wanted.append((name, text))
    if not wanted:
        raise SweepError("nothing to vary: give --vary NAME=VALUES, such as --vary alpha=0.1:0.9:9")
    return [parse_axis(name, text) for name, text in wanted]


def _print_idle(contest: Contest, axes: Sequence[Axis]) -> None:
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
    column = COLUMN_OF[metric]
    others = [name for name in ("north_m", "east_m", "reference_m") if name in results]
    names = [*contest.keys, column, *(name for name in others if name != column)]
    title = (
        f"Best of {counted(len(results), 'trial')}, by the {HEADINGS[column].rpartition(',')[0]}"
    )
    shown = table_of(*(HEADINGS.get(name, name.rsplit(".", 1)[-1]) for name in names), left=0)
    for row in results[names].head(SHOWN).itertuples(index=False):
        shown.add_row(*map(_cell, row))
    console_of().print(title, shown, sep="\n")


def run_sweep_of_many(
    names: Sequence[str],
    scheduler: str | None,
    read: ReadOptions,
    settings: GatewaySettings,
    options: SweepOptions,
) -> None:
    """Score every point on every flight, show the point that is best overall, and write it."""
    import pandas as pd

    from gateway.batch.statistics import choose

    _check_outputs(options)
    if options.generations:
        refuse("--optimise searches on one flight; give a grid for many")
    axes = tuple(_parse_axes(options))
    points, keys = grid(axes), [axis.key for axis in axes]
    fusion = with_estimator_of(fusion_of(settings), keys)
    column = COLUMN_OF[options.metric]
    task = SweepTask(read, axes, column, options.hold_out, options.gps_interval_s)
    results = run_on_all(names, task, None, jobs=options.jobs, scheduler=scheduler)
    swept = [result for result in results if result.error is None]
    if not swept:
        refuse("the sweep failed on all flights")
    # JSON represents an unknown score as null.
    errors = np.array([result.figures["scores"] for result in swept], float)
    base = np.array([result.figures["base"] for result in swept], float)
    try:
        choice = choose(errors, base)
    except ValueError as error:
        refuse(f"{error}; choose another --metric")
    _show_choice(axes, points, choice, column, len(swept))
    best = with_values(fusion, keys, points[choice.winner])
    table = pd.DataFrame(
        {
            "recording": [result.location for result in swept],
            "aircraft": [result.vehicle for result in swept],
            "began": [result.began for result in swept],
            "recorded settings": base,
            "best settings": errors[:, choice.winner],
        }
    )
    _write(options, settings, best, keys, table)
    exit_if_failed(results)


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
        f"{counted(len(points), 'point')} on {counted(flights, 'flight')}; "
        f"mean with the recorded settings: {_cell(choice.base_mean)}. The best of many points "
        "leads a little by chance: try it on other flights"
    )
