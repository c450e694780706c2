"""Run a command's task on many recordings: find them, run the task, show progress."""

import logging
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing, nullcontext
from pathlib import Path
from typing import Final

import typer

from gateway.batch.executors import DaskCluster, Executor, LocalProcesses
from gateway.batch.storage import BatchItem, is_url, items_of
from gateway.batch.tasks import FlightResult, FlightTask, ResultFolder, run_batch
from gateway.cli.support.recordings import recorded_files
from gateway.cli.support.terminal import console_of, progress_bar, refuse
from gateway.extras import require
from gateway.printable import printable
from gateway.units import counted

SHOWN_FAILURES: Final = 12
"""Failures that are listed individually."""


def run_on_all(
    names: Sequence[str],
    task: FlightTask,
    output: Path | None,
    *,
    jobs: int | None,
    scheduler: str | None,
) -> list[FlightResult]:
    """Run a task on all recordings, with a progress bar, and list the failures.

    A missing recording or an unusable cluster ends the command.
    """
    items = _items_of(names)
    executor: AbstractContextManager[Executor] = nullcontext(LocalProcesses(jobs))
    if scheduler is not None:
        require("--scheduler", "batch")
        executor = closing(DaskCluster(scheduler))
    folder = None if output is None else ResultFolder(output)
    with (
        executor as opened,
        progress_bar() as progress,
        folder.held() if folder else nullcontext(),
    ):
        bar = progress.add_task(task.name, total=len(items))

        def report(what: str, done: int, total: int) -> None:
            text = f"{task.name}: {printable(what.rsplit('/', 1)[-1][-40:])}"
            progress.update(bar, description=text, completed=done, total=total, refresh=True)

        try:
            results = run_batch(task, items, opened, folder, report)
        except KeyboardInterrupt:
            if folder is not None:
                text = "interrupted; finished results are kept: repeat the command to continue"
                console_of(stderr=True).print(text)
            raise
    _print_failures(results)
    return results


def _items_of(names: Sequence[str]) -> list[BatchItem]:
    if any(map(is_url, names)):
        require("a URL", "batch")
        log = logging.getLogger()
        # Storage libraries log each connection.
        if log.level == logging.INFO:
            log.setLevel(logging.WARNING)
    found = list[str]()
    for name in names:
        path = Path(name).expanduser()
        found += [name] if is_url(name) else [*map(str, recorded_files([path], "tables"))]
    try:
        items = items_of(found)
    except OSError as error:
        refuse(str(error))
    if not items:
        refuse(f"{', '.join(names)}: contains no recording")
    return items


def exit_if_failed(results: Sequence[FlightResult]) -> None:
    """End the command with exit code 1 if there is no result of a recording."""
    if count := sum(result.error is not None for result in results):
        console_of(stderr=True).print(f"{count} of {counted(len(results), 'recording')} failed")
        raise typer.Exit(1)


def _print_failures(results: Sequence[FlightResult]) -> None:
    console = console_of(stderr=True)
    failed = [result for result in results if result.error is not None]
    for result in failed[:SHOWN_FAILURES]:
        text = result.error or ""
        line = text if text.startswith(result.location) else f"{result.location}: {text}"
        console.print(line, style="red")
    if len(failed) > SHOWN_FAILURES:
        console.print(f"and {len(failed) - SHOWN_FAILURES} more that failed")
