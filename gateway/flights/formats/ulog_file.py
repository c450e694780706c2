"""ULog, the log of PX4, read by pyulog."""

import contextlib
import io
import os
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

from pyulog import ULog
from pyulog.exceptions import ULogException

from gateway.edges.disk.recording_streams import read_chunks, temporary_copy
from gateway.flightlog.autopilots.px4_log import TOPICS, Px4Log
from gateway.flightlog.table.row import RowBuilder, TableRow
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, table_of_rows
from gateway.units import counted

MS_PER_S: Final = 1000.0
SYSTEM_ID: Final = "MAV_SYS_ID"
HEADER: Final = 3
"""Bytes before the content of a message."""
MOST_VALUES: Final = 1 << 16
"""In a row: a message has no more bytes."""
BROKEN: Final = (
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError),
    *(struct.error, RecursionError),
)
"""What damage makes pyulog raise, beside its own error."""


class _Content(io.BufferedReader):
    """The bytes of a log, read from a file as they are needed.

    pyulog steps back by as much as it has asked for. Where the log is cut that is more than it has
    got, and it would read the same bytes for ever.
    """

    unread = 0
    """Bytes behind the last message that pyulog has read whole."""
    _missing = _header_at = 0

    def __init__(self, name: str) -> None:
        super().__init__(io.FileIO(name))

    def read(self, size: int | None = -1, /) -> bytes:
        if size == HEADER:
            self._header_at = self.tell()
        data = super().read(size)
        self._missing = max((size or 0) - len(data), 0)
        return data

    def seek(self, offset: int, whence: int = io.SEEK_SET, /) -> int:
        return super().seek(offset + self._missing * (whence == io.SEEK_CUR), whence)

    def close(self) -> None:
        if not self.closed:
            end = self._header_at if self._missing else self.tell()
            self.unread = os.fstat(self.fileno()).st_size - end
        super().close()


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a ULog as a flight; raises FlightError if there is none in it."""
    with temporary_copy(
        path, read_chunks(path, options.progress, options.unpacked_limit)
    ) as content:
        log, unread = _load(path, content.name)
    topics = {data.name: data.data for data in reversed(log.data_list)}
    known = log.initial_parameters.get(SYSTEM_ID, 1)
    is_id = isinstance(known, int) and 1 <= known <= 255
    vehicle_id = options.system_id or (known if is_id else 1)
    try:
        flight = Px4Log(topics, vehicle_id)
    except ValueError as error:
        raise FlightError("; it ".join([f"{path}: {error}", *_damage(log, unread)])) from error

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        for record in flight.records():
            yield from builder.add(record)
        yield from builder.flush()

    table = table_of_rows(rows(), options, vehicle_id, flight.unix_us_at_zero)
    remarks = [*_damage(log, unread), *_remarks(log, flight)]
    table.remarks += [f"{path}: {remark}" for remark in remarks]
    return table


def _load(path: Path, copy: str) -> tuple[Any, int]:
    """Return the log, and how many bytes at its end could not be read."""
    # Damage that it prints to the terminal is reported as remarks.
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            _check_formats(ULog(_Content(copy), parse_header_only=True).message_formats)
            file = _Content(copy)
            return ULog(file, list(TOPICS)), file.unread
        except (ULogException, *BROKEN) as error:
            raise FlightError(f"{path}: cannot be read as a ULog: {error}") from error


def _check_formats(formats: dict[str, Any]) -> None:
    """Raise an error of `BROKEN` for formats that would fill the memory."""

    @cache
    def values_of(kind: str) -> int:
        fields = formats[kind].fields if kind in formats else ()
        return sum(max(count, 1) * values_of(part) for part, count, _ in fields) if fields else 1

    for name in formats:
        if values_of(name) > MOST_VALUES:
            raise ValueError(f"{name} has more values than a message can hold")


def _damage(log: Any, unread: int) -> Iterator[str]:
    if log.file_corruption:
        yield "is damaged; what is sound of it was read"
    if unread:
        yield f"left out {counted(unread, 'byte')} at its end that cannot be read"


def _remarks(log: Any, flight: Px4Log) -> Iterator[str]:
    if log.dropouts:
        lost_s = sum(dropout.duration for dropout in log.dropouts) / MS_PER_S
        slow = counted(len(log.dropouts), "time")
        yield f"its logger was too slow {slow}, {lost_s:.1f} s are not in it"
    if flight.left_out:
        yield f"lacks fields that PX4 documents for {', '.join(flight.left_out)}; left out"
    if flight.dropped:
        yield f"left out {counted(flight.dropped, 'sample')} without a time that can be"
