"""Read a tracker's log from a CSV file, plain or gzipped."""

import csv
import io
import math
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.edges.disk.recording_streams import open_unpacked
from gateway.simulator.recorded import RecordedFlight

DEFAULT_LATENCY_S: Final = 0.2
_KEY_VALUE: Final = re.compile(r"(\w+)=(\S+)")


class FlightFileError(Exception):
    """A log that cannot be used as a flight; the text names the file and the error."""


def read_flight(path: Path) -> RecordedFlight:
    """Read a log.

    Parameters
    ----------
    path : Path
        CSV with a header row. Lines that start with `#` may hold `key=value` pairs, of which
        `gps_latency_s` is used. For the columns see `RecordedFlight.from_columns`; others are
        skipped, and an empty cell is "no new sample".

    Returns
    -------
    RecordedFlight

    Raises
    ------
    FlightFileError
        If the file cannot be read, a cell is no number, or columns or rows are missing.
    """
    try:
        metadata: dict[str, str] = {}
        with open_unpacked(path) as (plain, _):
            lines = io.TextIOWrapper(plain, encoding="utf-8")
            columns = _columns(csv.reader(_without_comments(lines, metadata)))
        latency_s = float(metadata.get("gps_latency_s", DEFAULT_LATENCY_S))
        return RecordedFlight.from_columns(columns, latency_s)
    except OSError as error:
        raise FlightFileError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise FlightFileError(f"{path}: is no CSV: it holds bytes that are no text") from error
    except (csv.Error, ValueError) as error:
        raise FlightFileError(f"{path}: {error}") from error


def _without_comments(lines: Iterable[str], metadata: dict[str, str]) -> Iterator[str]:
    for line in lines:
        if line.startswith("#"):
            metadata.update(_KEY_VALUE.findall(line))
        else:
            yield line


def _columns(rows: Iterator[list[str]]) -> dict[str, NDArray[np.float64]]:
    header = [name.strip() for name in next(rows, [])]
    cells: list[list[float]] = [[] for _ in header]
    for number, row in enumerate(rows, start=1):
        if not row:
            continue
        if len(row) != len(header):
            raise ValueError(f"row {number} has {len(row)} cells, the header has {len(header)}")
        for name, column, cell in zip(header, cells, row, strict=True):
            try:
                column.append(float(cell) if cell else math.nan)
            except ValueError:
                raise ValueError(f"row {number}, column {name}: {cell!r} is no number") from None
    return {name: np.array(column) for name, column in zip(header, cells, strict=True)}
