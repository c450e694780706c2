"""ULog, the log of PX4, read by pyulog."""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from pyulog import ULog
from pyulog.exceptions import ULogException

from gateway.edges.disk.recording_streams import read_chunks
from gateway.flightlog.autopilots.px4_log import TOPICS, Px4Log
from gateway.flightlog.table.row import RowBuilder, TableRow
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, table_of_rows

MS_PER_S: Final = 1000.0
SYSTEM_ID: Final = "MAV_SYS_ID"


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a ULog as a flight; raises FlightError if there is none in it."""
    log = _load(path, options)
    topics = {data.name: data.data for data in reversed(log.data_list)}
    known = log.initial_parameters.get(SYSTEM_ID, 1)
    vehicle_id = options.system_id or (known if 1 <= known <= 255 else 1)
    try:
        flight = Px4Log(topics, vehicle_id)
    except ValueError as error:
        raise FlightError(f"{path}: {error}{_damage(log)}") from error

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        try:
            for record in flight.records():
                yield from builder.add(record)
        except KeyError as error:
            raise FlightError(f"{path}: one of its topics has no field {error}") from error
        yield from builder.flush()

    table = table_of_rows(rows(), options, vehicle_id, flight.unix_us_at_zero)
    table.remarks += [f"{path}: {remark}" for remark in _remarks(log, flight)]
    return table


def _load(path: Path, options: ReadOptions) -> Any:
    content = io.BytesIO(b"".join(read_chunks(path, options.progress)))
    try:
        # Damage that it prints to the terminal is reported by `_remarks`.
        with contextlib.redirect_stdout(io.StringIO()):
            return ULog(content, list(TOPICS))
    except ULogException as error:
        raise FlightError(f"{path}: cannot be read as a ULog: {error}") from error


def _damage(log: Any) -> str:
    return "; it is damaged, so that may be lost" if log.file_corruption else ""


def _remarks(log: Any, flight: Px4Log) -> Iterator[str]:
    if log.file_corruption:
        yield "is damaged; what is sound of it was read"
    if log.dropouts:
        lost_s = sum(dropout.duration for dropout in log.dropouts) / MS_PER_S
        yield f"its logger was too slow {len(log.dropouts)} times, {lost_s:.1f} s are not in it"
    if flight.dropped:
        yield f"{flight.dropped} samples without a time that can be were left out"
