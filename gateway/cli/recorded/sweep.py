"""`mavgate sweep`: try settings on one flight or many, and write the best as a settings file."""

from collections.abc import Sequence
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
from gateway.batch.tasks import FlightResult, SweepTask, without_secrets
from gateway.cli.support import shared_options as opt
from gateway.cli.support.batch_work import exit_if_failed, run_on_all
from gateway.cli.support.options import option, output_file, read_options, read_settings
from gateway.cli.support.recordings import are_many, fusion_of, load_flight, refuse_unused
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.config import render
from gateway.output import check_output, write_new
from gateway.printable import figure
from gateway.recordings.fuse import FusionSettings
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
Found = tuple[FusionSettings, "pd.DataFrame"]
"""The settings with the best values, and a table of the trials or flights."""


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
    current, given = read_settings(), flights or []
    read = read_options(current, columns, choice=fuse_with, system_id=system)
    are_all = are_many(given)
    if are_all:
        refuse_unused("many recordings", {"--reference": reference, "--system": system})
    else:
        refuse_unused("one recording", {"--scheduler": scheduler})
    path = Path(given[0]) if given and not are_all else None
    for out in filter(None, (output, table)):
        check_output(out, [path], overwrite=force)
    if are_all and optimise:
        refuse("--optimise searches on one flight; give a grid for many")
    axes, results = _parse_axes(vary or []), list[FlightResult]()
    if are_all:
        fusion = with_estimator_of(fusion_of(current), [axis.key for axis in axes])
        points, column = grid(axes), COLUMN_OF[metric]
        task = SweepTask(without_secrets(read), axes, column, hold_out, gps_interval)
        results = run_on_all(given, task, None, jobs=jobs, scheduler=scheduler)
        best, rows = _best_of_many(task, points, results, fusion)
    else:
        flight = load_flight(path, current, read, reference)
        best, rows = _best_of_one(
            flight, axes, metric, (hold_out, gps_interval), jobs=jobs, generations=optimise
        )
    keys = [axis.key for axis in axes]
    if best.estimation.estimator != current.estimation.estimator:
        keys.insert(0, ESTIMATOR_KEY)
    merged = render(msgspec.structs.replace(current, estimation=best.estimation), keys)
    write_new(output, [merged.encode()], overwrite=force, inputs=[path])
    print(output)
    if table is not None:
        write_new(table, [rows.to_csv(index=False).encode()], overwrite=force, inputs=[path])
    exit_if_failed(results)


def _best_of_one(
    flight: Flight,
    axes: Sequence[Axis],
    metric: Metric,
    withheld: tuple[int, float],
    *,
    jobs: int | None,
    generations: int,
) -> Found:
    """Try the values on one flight, and show the best."""
    keys = [axis.key for axis in axes]
    contest = sweeping.make_contest(flight, flight.fusion, keys, *withheld)
    fastest = pilot_flight_of_samples(flight).facts.fastest_mps or 0.0
    if fastest < AT_REST_MPS:
        console_of(stderr=True).print(
            f"{flight.name}: at rest throughout, at most {fastest:.1f} m/s by GPS: it contains no "
            "information on settings for flights",
            style="yellow",
        )
    _print_idle(contest, axes)
    with forked(partial(run_trial, contest), jobs) as run:
        trials = (
            _search(axes, run, generations, metric) if generations else _try_all(grid(axes), run)
        )
    results = sweeping.tabulate(contest.keys, trials, metric)
    _show(results, contest, metric)
    best = with_values(contest.fusion, contest.keys, sweeping.best_of(trials, metric))
    return best, results


def _cell(value: object) -> str:
    return figure(value, ".4g") if isinstance(value, float) else str(value)


def _parse_axes(varied: Sequence[str]) -> tuple[Axis, ...]:
    wanted = list[tuple[str, str]]()
    for item in varied:
        name, equals, text = item.partition("=")
        if not equals:
            raise SweepError(f"--vary {item}: write NAME=VALUES")
        wanted.append((name, text))
    if not wanted:
        raise SweepError("nothing to vary: give --vary NAME=VALUES, such as --vary alpha=0.1:0.9:9")
    return tuple(parse_axis(name, text) for name, text in wanted)


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


def _best_of_many(
    task: SweepTask, points: list[Values], results: Sequence[FlightResult], fusion: FusionSettings
) -> Found:
    """Choose the point of a grid that is best on all flights, and show it."""
    import pandas as pd

    from gateway.batch.statistics import choose

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
    _show_choice(task, points, choice, len(swept))
    table = pd.DataFrame(
        {
            "recording": [result.location for result in swept],
            "aircraft": [result.vehicle for result in swept],
            "began": [result.began for result in swept],
            "recorded settings": base,
            "best settings": errors[:, choice.winner],
        }
    )
    best = with_values(fusion, [axis.key for axis in task.axes], points[choice.winner])
    return best, table


def _show_choice(task: SweepTask, points: list[Values], choice: "Choice", flights: int) -> None:
    console = console_of()
    names = (axis.key.rsplit(".", 1)[-1] for axis in task.axes)
    grid_ = table_of(*names, f"mean {HEADINGS[task.metric_column]}", left=0)
    for number in np.argsort(choice.means, kind="stable")[:SHOWN].tolist():
        grid_.add_row(*map(_cell, points[number]), _cell(float(choice.means[number])))
    console.print(grid_)
    console.print(
        f"{counted(len(points), 'point')} on {counted(flights, 'flight')}; "
        f"mean with the recorded settings: {_cell(choice.base_mean)}. The best of many points "
        "leads a little by chance: try it on other flights"
    )
