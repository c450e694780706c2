"""Many recordings as a command: where they are, who does the work, progress; and sweeps."""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np
import pandas as pd
import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

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
from gateway.batch.executors import ClusterError, DaskCluster, Executor, LocalProcesses, has_dask
from gateway.batch.statistics import Choice, FloatArray, choose, group_of
from gateway.batch.storage import BatchItem, StorageError, has_fsspec, is_url, items_of
from gateway.batch.tasks import (
    FlightResult,
    FlightTask,
    ResultFolder,
    SweepTask,
    run_season,
    without_secrets,
)
from gateway.cli.support.recording_options import (
    Wanted,
    files_of,
    read_column_map,
    recordings_folder,
    refusing,
)
from gateway.cli.support.settings_options import read_options, read_settings
from gateway.cli.support.sweeping import HEADINGS, SHOWN, SweepOptions, parse_axes
from gateway.cli.support.terminal import console_of, how_to_add, refuse, table_of
from gateway.config import GatewaySettings, render
from gateway.output import check_output, write_new
from gateway.printable import printable
from gateway.recordings.files import SettingsChoice
from gateway.recordings.reading import ReadOptions
from gateway.units import counted

SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler", help="Work on a Dask cluster: tcp://HOST:8786.", show_default=False
    ),
]
JobsOption = Annotated[
    int | None, typer.Option("--jobs", help="Processes here; one a core by default.", min=1)
]
SeasonFiles = Annotated[
    list[str],
    typer.Argument(
        help="Recordings by name or file, folders of them, and URLs: s3://, gs://, sftp://, …",
        show_default=False,
    ),
]

SHOWN_FAILURES: Final = 12
"""Failures that are listed one by one."""


@dataclass(frozen=True, slots=True)
class SeasonWork:
    """Which recordings, and who works on them."""

    names: Sequence[str]
    config: Path | None
    jobs: int | None = None
    scheduler: str | None = None

    def items(self, *, each_file: bool = False) -> list[BatchItem]:
        """Find the recordings; what is not there ends the command."""
        if any(map(is_url, self.names)):
            if not has_fsspec():
                refuse(f"URLs need fsspec, the extra mavgate[batch]:\n{how_to_add('batch')}")
            _quieten_storages()
        wanted: Wanted = "all" if each_file else "tables"
        names: list[str] = []
        with refusing():
            for name in self.names:
                if is_url(name):
                    names.append(name)
                    continue
                folder = recordings_folder(self.config)
                found = [*map(str, files_of([Path(name).expanduser()], folder, wanted))]
                names += found
        try:
            items = items_of(names, each_file=each_file)
        except (StorageError, OSError) as error:
            refuse(str(error))
        if not items:
            refuse(f"{', '.join(self.names)}: no recording is there")
        return items

    @contextmanager
    def executor(self) -> Iterator[Executor]:
        """Open the executor; a cluster that cannot be used ends the command."""
        if self.scheduler is None:
            yield LocalProcesses(self.jobs)
            return
        if not has_dask():
            refuse(f"--scheduler needs Dask, the extra mavgate[batch]:\n{how_to_add('batch')}")
        try:
            cluster = DaskCluster(self.scheduler)
        except ClusterError as error:
            refuse(str(error))
        try:
            yield cluster
        finally:
            cluster.close()

    def run(
        self, task: FlightTask, items: Sequence[BatchItem], output: Path | None
    ) -> list[FlightResult]:
        """Run a task on all, with a progress bar, and list what failed."""
        console = console_of(stderr=True)
        columns = (
            TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(),
            TimeRemainingColumn(),
        )  # fmt: skip
        with refusing():
            folder = None if output is None else ResultFolder(output)
        # No thread of its own: processes are forked while it shows.
        with self.executor() as executor, Progress(
            *columns, console=console, transient=True, auto_refresh=False,
            disable=not console.is_terminal,
        ) as progress, refusing(), folder.held() if folder else nullcontext():  # fmt: skip
            bar = progress.add_task(task.name, total=len(items))

            def report(what: str, done: int, total: int) -> None:
                text = f"{task.name}: {printable(what.rsplit('/', 1)[-1][-40:])}"
                progress.update(bar, description=text, completed=done, total=total, refresh=True)

            try:
                results = run_season(task, items, executor, folder, report)
            except KeyboardInterrupt:
                if folder is not None:
                    console.print("interrupted; what is done is kept: the same command goes on")
                raise
        _print_failures(results)
        return results


def season_options(
    config: Path | None, columns: Path | None, choice: SettingsChoice
) -> ReadOptions:
    """Take what reads a season's flights out of the settings; nothing that must stay secret."""
    with refusing():
        return without_secrets(
            read_options(
                read_settings(config),
                choice=choice,
                columns=read_column_map(columns),
            )
        )


def _quieten_storages() -> None:
    """Leave out what storages log of each connection, unless details are wanted."""
    log = logging.getLogger()
    if log.level == logging.INFO:
        log.setLevel(logging.WARNING)


def failures(results: Sequence[FlightResult]) -> int:
    """Count the recordings that there are no figures of."""
    return sum(result.error is not None for result in results)


def _print_failures(results: Sequence[FlightResult]) -> None:
    console = console_of(stderr=True)
    failed = [result for result in results if result.error is not None]
    for result in failed[:SHOWN_FAILURES]:
        text = result.error or ""
        line = text if text.startswith(result.place) else f"{result.place}: {text}"
        console.print(line, style="red")
    if len(failed) > SHOWN_FAILURES:
        console.print(f"and {len(failed) - SHOWN_FAILURES} more that failed")


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
    fusion = FusionSettings(estimation=settings.estimation)
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
    merged = msgspec.structs.replace(settings, estimation=best.estimation)
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
