"""A sweep as a command: axes from texts, a progress bar, the best as a table and a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import pandas as pd
from rich import box
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from gateway.analysis.flight_arrays import FusionSettings
from gateway.analysis.tuning import contest as sweeping
from gateway.analysis.tuning.axis import ESTIMATOR_KEY, Axis, SweepError, Values, grid, parse_axis
from gateway.analysis.tuning.contest import COLUMN_OF, Contest, Metric, Trial
from gateway.analysis.tuning.workers import Run, pool
from gateway.cli.support.loading import Loading, load_flight
from gateway.cli.support.recording_options import refusing
from gateway.cli.support.terminal import console_of, refuse
from gateway.config import GatewaySettings, render
from gateway.output import check_output, write_new
from gateway.units import counted

SHOWN: Final = 10
HEADINGS: Final = {
    "north_m": "latitude error, m",
    "east_m": "longitude error, m",
    "held_m": "error at withheld fixes, m",
    "interpolated_m": "error against interpolated GPS, m",
    "reference_m": "error against the reference, m",
    "attitude_deg": "attitude error, deg",
}
"""By the columns of a sweep's scores."""


@dataclass(frozen=True, slots=True)
class SweepOptions:
    """Options of the command line."""

    named: Sequence[tuple[str, str]]
    """The paper's own weights, with their values as texts."""
    vary: Sequence[str]
    """Further settings as `NAME=VALUES`."""
    generations: int
    """How long to search; 0 for a grid."""
    metric: Metric
    hold_out: int
    gps_interval_s: float
    jobs: int | None
    output: Path
    table: Path | None
    overwrite: bool


def run_sweep(path: Path | None, loading: Loading, options: SweepOptions) -> None:
    """Try the settings, show the best, and write it as a settings file."""
    with refusing():
        for out in (options.output, options.table):
            if out is not None:
                check_output(out, [path], overwrite=options.overwrite)
    try:
        axes = parse_axes(options)
        flight = load_flight(path, loading)
        contest = sweeping.make_contest(
            flight,
            flight.fusion,
            [axis.key for axis in axes],
            hold_out=options.hold_out,
            interval_s=options.gps_interval_s,
        )
        _print_idle(contest, axes)
        with pool(contest, options.jobs) as run:
            if options.generations:
                trials = _search(axes, run, options.generations, options.metric)
            else:
                trials = _try_all(grid(axes), run)
        results = sweeping.tabulate(contest.keys, trials, options.metric)
    except SweepError as error:
        refuse(str(error))
    _show(results, contest, options.metric)
    best = sweeping.best_of(trials, options.metric)
    with refusing():
        text = render(_merged(loading.settings, contest, best))
        write_new(options.output, [text.encode()], overwrite=options.overwrite, inputs=[path])
        print(options.output)
        if options.table is not None:
            rows = results.to_csv(index=False).encode()
            write_new(options.table, [rows], overwrite=options.overwrite, inputs=[path])


def parse_axes(options: SweepOptions) -> list[Axis]:
    """Read the axes to vary; raises SweepError for invalid ones."""
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
    """Print in advance which settings change nothing."""
    idle = sweeping.idle_axes(contest, axes)
    if not idle:
        return
    estimator = contest.fusion.estimation.estimator
    text = f"{', '.join(idle)}: changes nothing on this flight"
    if not any(axis.key == ESTIMATOR_KEY for axis in axes):
        text += f" with the estimator {estimator}"
    if len(idle) == len(axes):
        raise SweepError(f"{text}; vary another setting, or choose the estimator that uses it")
    console_of(stderr=True).print(text, style="yellow")


def _progress() -> Progress:
    console = console_of(stderr=True)
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, transient=True, disable=not console.is_terminal,
    )  # fmt: skip


def _try_all(points: Sequence[Values], run: Run) -> list[Trial]:
    found: list[Trial] = []
    with _progress() as progress:
        task = progress.add_task("trials", total=len(points))
        for index, scores in run(points):
            found.append((points[index], scores))
            progress.advance(task)
    return found


def _search(axes: Sequence[Axis], run: Run, generations: int, metric: Metric) -> list[Trial]:
    found: list[Trial] = []
    with _progress() as progress:
        task = progress.add_task("generations", total=generations)

        def evaluate(points: list[Values]) -> list[float]:
            scores = dict(run(points))
            found.extend((values, scores[k]) for k, values in enumerate(points))
            return [scores[k][COLUMN_OF[metric]] for k in range(len(points))]

        def show_progress(best: float) -> None:
            progress.update(task, advance=1, description=f"generations, best {best:.3f}")

        sweeping.optimise(axes, evaluate, generations, show_progress)
    return found


def _show(results: pd.DataFrame, contest: Contest, metric: Metric) -> None:
    judged = COLUMN_OF[metric]
    others = [name for name in ("north_m", "east_m", "reference_m") if name in results]
    names = [*contest.keys, judged, *(name for name in others if name != judged)]
    title = (
        f"Best of {counted(len(results), 'trial')}, by the {HEADINGS[judged].rpartition(',')[0]}"
    )
    shown = Table(box=box.SIMPLE_HEAD, title=title)
    for name in names:
        shown.add_column(HEADINGS.get(name, name.rsplit(".", 1)[-1]), justify="right")
    for row in results[names].head(SHOWN).itertuples(index=False):
        shown.add_row(*(f"{v:.4g}" if isinstance(v, float) else str(v) for v in row))
    console_of().print(shown)


def _merged(settings: GatewaySettings, contest: Contest, best: Values) -> GatewaySettings:
    """Put the best values into the whole settings."""
    fusion: FusionSettings = sweeping.settings_at(contest, best)
    return msgspec.structs.replace(settings, estimation=fusion.estimation)
