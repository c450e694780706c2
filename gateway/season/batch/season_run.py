"""One task over many recordings: what is done already is left, the rest goes to the executor."""

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from hashlib import sha256
from typing import Final

import msgspec

from gateway import __version__
from gateway.recordings.index import as_text
from gateway.season.batch.flight_tasks import FlightResult, FlightTask, name_of, work_on
from gateway.season.batch.result_folder import ResultFolder
from gateway.season.batch.storage import BatchItem, stamp_of_item
from gateway.season.executors import Executor, WorkFailed

Tell = Callable[[str, int, int], None]
"""Called with what was done last, how many are done, and of how many."""
LOOKING: Final = "looking for changes"
"""What is done first: it decides which recordings are to be worked on."""


def run_season(
    task: FlightTask,
    items: Sequence[BatchItem],
    executor: Executor,
    folder: ResultFolder | None,
    tell: Tell,
) -> list[FlightResult]:
    """Do a task on every recording that it is not done on yet."""
    found: list[FlightResult | None] = [None] * len(items)
    todo: list[tuple[BatchItem, str, str, str]] = []
    numbers: list[int] = []
    stamps = _stamps(items, executor, tell)
    names = _names(items, stamps)
    for number, (item, stamp) in enumerate(zip(items, stamps, strict=True)):
        if isinstance(stamp, WorkFailed):
            found[number] = _failed(task, item, "", "", stamp)
            continue
        key = _key(task, stamp)
        kept = folder.find(key) if folder is not None else None
        if kept is not None:
            found[number] = msgspec.structs.replace(kept, place=as_text(item.place))
        else:
            todo.append((item, stamp, key, names[number]))
            numbers.append(number)
    done = len(items) - len(todo)
    for place, outcome in executor.run(partial(work_on, task), todo):
        item, stamp, key, _ = todo[place]
        if isinstance(outcome, WorkFailed):
            result = _failed(task, item, stamp, key, outcome)
        else:
            result, files = outcome
            if result.version != __version__:
                reason = WorkFailed(f"done by mavgate {result.version}; here is {__version__}")
                result = _failed(task, item, stamp, key, reason)
            elif folder is not None:
                folder.keep(result, files)
        found[numbers[place]] = result
        done += 1
        tell(item.place, done, len(items))
    return [result for result in found if result is not None]


def _stamps(items: Sequence[BatchItem], executor: Executor, tell: Tell) -> list[str | WorkFailed]:
    found: list[str | WorkFailed] = [""] * len(items)
    for done, (number, outcome) in enumerate(executor.run(stamp_of_item, items), 1):
        found[number] = outcome
        tell(LOOKING, done, len(items))
    return found


def _names(items: Sequence[BatchItem], stamps: Sequence[str | WorkFailed]) -> list[str]:
    """Name what is written; where two recordings have one name, with a part of their stamps."""
    names = [name_of(item) for item in items]
    often = Counter(names)
    return [
        f"{name}-{stamp[:8]}" if often[name] > 1 and isinstance(stamp, str) else name
        for name, stamp in zip(names, stamps, strict=True)
    ]


def _key(task: FlightTask, stamp: str) -> str:
    told = "\n".join((task.name, stamp, __version__)).encode()
    return sha256(told + b"\n" + task.fingerprint).hexdigest()[:32]


def _failed(
    task: FlightTask, item: BatchItem, stamp: str, key: str, failure: WorkFailed
) -> FlightResult:
    return FlightResult(
        place=as_text(item.place),
        digest=stamp,
        key=key,
        task=task.name,
        version=__version__,
        error=failure.reason,
    )
