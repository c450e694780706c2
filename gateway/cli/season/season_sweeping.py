"""A sweep over many flights: one set of settings for all, judged by flights that did not choose."""

from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd

from gateway.analysis.flight_arrays import FusionSettings
from gateway.analysis.tuning.axis import (
    Axis,
    SweepError,
    Values,
    grid,
    with_estimator_of,
    with_values,
)
from gateway.analysis.tuning.contest import COLUMN_OF
from gateway.cli.season.season_work import SeasonWork
from gateway.cli.support.errors import refuse
from gateway.cli.support.recording_options import refusing
from gateway.cli.support.sweeping import HEADINGS, SHOWN, SweepOptions, parse_axes
from gateway.cli.support.terminal import console_of, table_of
from gateway.config import GatewaySettings, render
from gateway.output import check_output, write_new
from gateway.recordings.reading import ReadOptions
from gateway.season.batch.flight_tasks import FlightResult, SweepTask
from gateway.season.statistics.cross_validation import Choice, FloatArray, choose
from gateway.season.statistics.season_errors import group_of
from gateway.units import counted


def run_season_sweep(
    work: SeasonWork,
    read: ReadOptions,
    settings: GatewaySettings,
    options: SweepOptions,
    kept: Path | None = None,
) -> list[FlightResult]:
    """Score every point on every flight, show what is best for all, and write it."""
    with refusing():
        if kept is not None:
            kept.mkdir(parents=True, exist_ok=True)
        for out in (options.output, options.table):
            if out is not None:
                check_output(out, overwrite=options.overwrite)
    if options.generations:
        refuse("--optimise searches on one flight; give a grid for many")
    fusion = FusionSettings(sensing=settings.sensing, estimation=settings.estimation)
    try:
        axes = tuple(parse_axes(options))
        points, keys = grid(axes), [axis.key for axis in axes]
        fusion = with_estimator_of(fusion, keys)
    except SweepError as error:
        refuse(str(error))
    column = COLUMN_OF[options.metric]
    task = SweepTask(read, axes, column, options.hold_out, options.gps_interval_s)
    results = work.run(task, work.items(), kept)
    swept = [result for result in results if result.error is None]
    if not swept:
        refuse("no flight could be swept")
    base, choice = _chosen(swept)
    _show(axes, points, choice, column, len(swept))
    best = with_values(fusion, keys, points[choice.winner])
    merged = msgspec.structs.replace(settings, sensing=best.sensing, estimation=best.estimation)
    with refusing():
        write_new(options.output, [render(merged).encode()], overwrite=options.overwrite)
        print(options.output)
        if options.table is not None:
            rows = _table(swept, base, choice).to_csv(index=False).encode()
            write_new(options.table, [rows], overwrite=options.overwrite)
    return results


def _chosen(swept: Sequence[FlightResult]) -> tuple[FloatArray, Choice]:
    """Return the errors with the settings that the flights came with, and what is best."""
    errors = np.array([_numbers(result.figures["scores"]) for result in swept])
    base = np.array(_numbers([result.figures["base"] for result in swept]))
    groups = [group_of(result.vehicle, result.began, result.digest) for result in swept]
    try:
        return base, choose(errors, base, groups)
    except ValueError as error:
        refuse(f"{error}; choose another --metric")


def _numbers(values: Sequence[float | None]) -> list[float]:
    """Read scores back: what is not known is null in JSON."""
    return [float("nan") if value is None else value for value in values]


def _show(
    axes: Sequence[Axis], points: Sequence[Values], choice: Choice, column: str, flights: int
) -> None:
    console = console_of()
    grid_ = table_of(
        *(axis.key.rsplit(".", 1)[-1] for axis in axes), f"mean {HEADINGS[column]}", left=0
    )
    for number in np.argsort(choice.means, kind="stable")[:SHOWN].tolist():
        cells = [f"{v:.4g}" if isinstance(v, float) else str(v) for v in points[number]]
        grid_.add_row(*cells, f"{choice.means[number]:.4g}")
    console.print(grid_)
    console.print(
        f"{counted(len(points), 'point')} on {counted(flights, 'flight')}, "
        f"in {choice.folds} folds by aircraft and day; "
        f"the same point wins without {choice.stable} of the {choice.folds}"
    )
    if choice.over_base is not None:
        console.print(
            "against the settings that the flights came with, each flight judging only what the "
            f"others chose: {choice.over_base.text}",
        )
    if choice.over_second is not None:
        console.print(
            f"the winner against the second, on the flights that chose both: "
            f"{choice.over_second.text}",
        )


def _table(swept: Sequence[FlightResult], base: FloatArray, choice: Choice) -> pd.DataFrame:
    return pd.DataFrame(
        {
            "recording": [result.place for result in swept],
            "aircraft": [result.vehicle for result in swept],
            "began": [result.began for result in swept],
            "as it came": base,
            "as others chose": choice.judged,
        }
    )
