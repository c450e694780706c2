"""Trials of a sweep on all cores, in processes that share the flight."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from gateway.analysis.processes import copies, cores
from gateway.analysis.tuning.axis import Values
from gateway.analysis.tuning.contest import Contest, run_trial

Scores = dict[str, float]
Run = Callable[[Sequence[Values]], Iterator[tuple[int, Scores]]]

_contest: Contest | None = None
"""Of this process of the pool; it has no other place for it."""


@contextmanager
def pool(contest: Contest, jobs: int | None = None) -> Iterator[Run]:
    """Open a pool of processes."""
    count = jobs or cores()
    if count == 1:
        yield lambda points: ((k, run_trial(contest, values)) for k, values in enumerate(points))
        return
    with copies(count, _begin, contest) as processes:

        def run(points: Sequence[Values]) -> Iterator[tuple[int, Scores]]:
            return processes.imap_unordered(_run, enumerate(points), _chunk(points, count))

        yield run


def _chunk(points: Sequence[Values], jobs: int) -> int:
    """Return how many points a process is given at once: few messages, and an even load."""
    return max(1, min(8, len(points) // (4 * jobs)))


def _begin(contest: Contest) -> None:
    global _contest
    _contest = contest


def _run(numbered: tuple[int, Values]) -> tuple[int, Scores]:
    assert _contest is not None
    index, values = numbered
    return index, run_trial(_contest, values)
