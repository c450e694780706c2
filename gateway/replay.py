"""Fuse a recorded flight again: rows of a table through the pipeline, on the recorded clock."""

from collections.abc import Iterator
from typing import Final

from gateway.flightlog.row import TableRow
from gateway.pipeline import Action, Pipeline
from gateway.records import BaroRaw, GpsFix, ImuCalibrated, ImuRaw

LONGEST_SILENCE_US: Final = 1_000_000
"""In a longer one the pipeline's timers are not run through one by one."""


class Replay:
    """Feeds rows to a pipeline as if they arrived now.

    Parameters
    ----------
    pipeline : Pipeline
        Fresh, with the settings to fuse with.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self._now_us: int | None = None

    def take(self, row: TableRow) -> Iterator[tuple[int, Action]]:
        """Take one row.

        Parameters
        ----------
        row : TableRow
            The next of the file.

        Yields
        ------
        tuple of int and Action
            Time on the recorded gateway clock, and what the pipeline decided.
        """
        for record in records_of(row):
            yield from self._wait(record.time_us)
            now_us = self._now_us if self._now_us is not None else record.time_us
            for action in self._pipeline.take(record, now_us):
                yield now_us, action

    def _wait(self, until_us: int) -> Iterator[tuple[int, Action]]:
        """Run what is due by time before the next record; the clock never falls."""
        now_us = until_us if self._now_us is None else max(self._now_us, until_us)
        if self._now_us is None or now_us - self._now_us > LONGEST_SILENCE_US:
            self._now_us = now_us
        while (due_us := max(self._pipeline.next_due_us(), self._now_us)) < now_us:
            self._now_us = due_us
            for action in self._pipeline.poll(due_us):
                yield due_us, action
            if self._pipeline.next_due_us() <= due_us:
                break
        self._now_us = now_us


def records_of(row: TableRow) -> list[BaroRaw | GpsFix | ImuRaw | ImuCalibrated]:
    """List a row's records in the order in which they were taken; counts before SI values."""
    records = (row.baro, row.gps, row.raw or row.imu)
    return [record for record in records if record is not None]
