"""Open a ULog, PX4's log, with pyulog: its damage, and the start of one without a header."""

import contextlib
import io
import os
import struct
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, Final

from pyulog import ULog
from pyulog.exceptions import ULogException

from gateway.recordings.file_format import ULOG_BEGIN, ULOG_HEAD, skip_to
from gateway.recordings.files import FlightError, name_of, read_chunks, temporary_copy
from gateway.recordings.recorded_table import ReadOptions
from gateway.units import counted

MS_PER_S: Final = 1000.0
HEADER: Final = 3
"""Size of a message header: length and type."""
MOST_VALUES: Final = 1 << 16
"""Maximum number of values in a row, from the maximum size of a message."""
BROKEN: Final = (
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError),
    *(struct.error, RecursionError),
)
"""Exceptions that pyulog raises on damaged logs in addition to its own."""
_AXES: Final = tuple(
    f"{name}[{axis}]" for name in ("accelerometer_m_s2", "gyro_rad") for axis in range(3)
)
_GPS_FIELDS: Final = (
    ("lat", "latitude_deg"), ("lon", "longitude_deg"), ("vel_n_m_s",), ("vel_e_m_s",),
    ("vel_d_m_s",),
)  # fmt: skip
NEEDED: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "sensor_combined": tuple(
        (f"{name}[{axis}]",) for name in ("accelerometer_m_s2", "gyro_rad") for axis in range(3)
    ),
    "vehicle_magnetometer": tuple((f"magnetometer_ga[{axis}]",) for axis in range(3)),
    "vehicle_attitude": tuple((f"q[{part}]",) for part in range(4)),
    "vehicle_gps_position": _GPS_FIELDS,
    "sensor_gps": _GPS_FIELDS,
}
"""Required fields by topic: of each tuple one, in addition to the time."""


class _Content(io.BufferedReader):
    """The content of a log, read from its file on demand.

    pyulog seeks back by the size that it requested. At the end of a cut log it received less, so it
    would read the same bytes for ever; `seek` allows for the missing bytes.
    """

    unread = 0
    """Bytes after the last message that pyulog has read completely."""
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


def _lost_head(rest: Iterator[bytes], before: bytes) -> Iterator[bytes]:
    """Yield a header if the log lacks it, and the format that lost its name together with it."""
    first = next(rest, b"")
    if not first.startswith(ULOG_HEAD):
        yield ULOG_HEAD + bytes(9)
        cut, _, fields = before.partition(b";")
        is_whole = b"uint64_t timestamp".endswith(cut.rpartition(b":")[2])
        for topic, needed in NEEDED.items() if is_whole else ():
            names = [{f" {name.partition('[')[0]};".encode() for name in one} for one in needed]
            if all(any(name in b";" + fields for name in one) for one in names):
                text = topic.encode() + b":uint64_t timestamp;" + fields
                yield struct.pack("<Hc", len(text), b"F") + text
    yield first


def load(path: Path, options: ReadOptions, topics: list[str] | None) -> tuple[Any, list[str]]:
    """Read some or all topics of a log; also return remarks for the user on its damage."""
    whole = read_chunks(path, options.progress, options.unpacked_limit)
    rest, before = skip_to(ULOG_BEGIN, whole)
    # Damage that pyulog prints to the terminal is reported as remarks instead.
    with (
        temporary_copy(path, chain(_lost_head(rest, before.text), rest)) as copy,
        contextlib.redirect_stdout(io.StringIO()),
    ):
        try:
            with _Content(name_of(copy)) as head:
                _check_formats(ULog(head, parse_header_only=True).message_formats)
            with _Content(name_of(copy)) as file:
                log = ULog(file, topics)
        except (ULogException, *BROKEN) as error:
            raise FlightError(f"{path}: cannot be read as a ULog: {error}") from error
    return log, [*before.remarks, *_damage_of(log, file.unread)]


def _check_formats(formats: dict[str, Any]) -> None:
    """Raise an exception of `BROKEN` for formats that would fill the memory."""

    @cache
    def values_of(kind: str) -> int:
        fields = formats[kind].fields if kind in formats else ()
        return sum(max(count, 1) * values_of(part) for part, count, _ in fields) if fields else 1

    for name in formats:
        if values_of(name) > MOST_VALUES:
            raise ValueError(f"{name} has more values than a message can hold")


def _damage_of(log: Any, unread: int) -> Iterator[str]:
    if log.file_corruption:
        yield "is damaged; its intact part was read"
    if unread:
        yield f"left out {counted(unread, 'byte')} at its end that cannot be read"
    if log.dropouts:
        lost_s = sum(dropout.duration for dropout in log.dropouts) / MS_PER_S
        slow = counted(len(log.dropouts), "time")
        yield f"its logger was too slow {slow}; {lost_s:.1f} s of data are missing"
