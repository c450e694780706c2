"""Open a recording: `open_recording` is the only function that chooses a reader by the format.

| format              | content                                                          |
| ------------------- | ---------------------------------------------------------------- |
| tlog, raw MAVLink   | MAVLink as it was recorded: `is_mavlink`                         |
| table, Parquet      | rows with the settings and states of mavgate: `is_own`           |
| DataFlash, ULog     | the log of an autopilot, with its own estimates: `is_log`        |
| CSV, added formats  | rows of another program                                          |

Any of them can be read as rows. Only the first bytes of the file are read here; the content is
read, and the modules of its format are imported, when it is requested.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gateway.recordings.file_format import CSV, LOGS, PARQUET, TABLE, TLOG, format_of, import_format
from gateway.recordings.files import FlightError
from gateway.recordings.tlog_source import TlogSource, open_tlog

if TYPE_CHECKING:
    from gateway.recordings.autopilot_record import AutopilotLog
    from gateway.recordings.recorded_table import ReadOptions, RecordedTable

Estimates = Literal["own", "fused", "both"]
"""Estimates to use from an autopilot's log: its own, those of mavgate, or both as two vehicles."""


@dataclass(frozen=True)
class RecordedFile:
    """A file with a flight, of any format."""

    path: Path
    kind: str
    """Name of the format."""

    @property
    def is_mavlink(self) -> bool:
        """Whether it contains MAVLink."""
        return self.kind == TLOG

    @property
    def is_own(self) -> bool:
        """Whether it is a table of mavgate, with its own settings and states."""
        return self.kind in (TABLE, PARQUET)

    @property
    def is_log(self) -> bool:
        """Whether it is an autopilot's log, with its own estimates."""
        return self.kind in LOGS

    @cached_property
    def mavlink(self) -> TlogSource:
        """The MAVLink, of which all times have been read once; raises OSError."""
        return open_tlog(self.path)

    def log(self, options: ReadOptions) -> AutopilotLog:
        """Open an autopilot's log for playback; raises FlightError and OSError as `rows`."""
        found = self._log(options, sampled=False)
        if not found.is_shown:
            raise FlightError(f"{self.path}: nothing to play: {found.why_no_samples}")
        return found

    def _log(self, options: ReadOptions, *, sampled: bool) -> AutopilotLog:
        module = import_format(LOGS[self.kind], self.kind)
        log: AutopilotLog = module.open_record(self.path, options, sampled=sampled)
        return log

    def rows(self, options: ReadOptions) -> RecordedTable:
        """Open the file as a table.

        Raises FlightError if it contains no readable flight; OSError if it cannot be read at all.
        """
        # The readers of rows import all stages, which the summary of MAVLink does not need.
        from gateway.recordings.logged_samples import read_samples
        from gateway.recordings.reading import READERS, read_mavlink

        if self.is_mavlink:
            return read_mavlink(self.mavlink, options)
        if self.is_log:
            return read_samples(self.path, self._log(options, sampled=True), options)
        return READERS[self.kind](self.path, options)

    def facts(self) -> dict[str, float]:
        """Return the values `key=value` in the comments of another program's CSV."""
        from gateway.recordings.reading import facts_of_csv

        return facts_of_csv(self.path) if self.kind == CSV else {}

    def end_us(self, options: ReadOptions) -> int | None:
        """Return the civil time of the last row without reading all of them; None if unknown."""
        from gateway.recordings.reading import END_READERS

        return END_READERS[self.kind](self.path, options) if self.kind in END_READERS else None


def open_recording(path: Path) -> RecordedFile:
    """Recognise the format of a file; raises OSError if it cannot be read."""
    return RecordedFile(path, format_of(path))


def open_recordings(paths: Iterable[Path]) -> list[RecordedFile]:
    """Recognise the formats of several files; see `open_recording`."""
    return [*map(open_recording, paths)]


def estimates_of(recordings: Iterable[RecordedFile], *, fuse: bool, both: bool) -> Estimates:
    """Return which estimates are sent; FlightError for `both` unless all are logs of autopilots."""
    if not all(recording.is_log for recording in recordings):
        if both:
            raise FlightError("--beside is for logs of autopilots, DataFlash and ULog")
        return "fused"
    return "both" if both else "fused" if fuse else "own"
