"""DataFlash, the log of ArduPilot, in binary (.bin) and as text (.log)."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from statistics import median_low
from typing import Final

from gateway.edges.disk.recording_streams import read_chunks
from gateway.flightlog.autopilots.ardupilot_log import ArdupilotReader, utc_of
from gateway.flightlog.autopilots.dataflash import HEAD, DataflashReader, NamedMessage
from gateway.flightlog.table.row import Imported, RowBuilder, TableRow
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, table_of_rows

SYSTEM_IDS: Final = ("SYSID_THISMAV", "MAV_SYSID")
FIXES: Final = 5
"""Of which the median gives civil time."""
BROKEN: Final = (AttributeError, TypeError, ValueError, OverflowError)
"""What a message of other columns, or with impossible values, makes a reader raise."""


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a DataFlash log as a flight; raises FlightError if there is none in it."""
    known, zero_unix_us = _facts_of(path, replace(options, progress=None))
    vehicle_id = options.system_id or (known if 1 <= known <= 255 else 1)
    reader = ArdupilotReader(vehicle_id)
    remarks: list[str] = []
    damage: list[str] = []

    def rows() -> Iterator[TableRow]:
        builder, log = RowBuilder(), _log_of(path)
        for record in _records(_messages(path, options, log), log, reader):
            yield from builder.add(record)
        yield from builder.flush()
        damage.extend(_remarks(log, reader))
        remarks.extend(f"{path}: {remark}" for remark in damage)

    stream = rows()
    first = next((row for row in stream if row.imu is not None), None)
    if first is None:
        reason = f"{path}: holds no IMU messages, so there is nothing to fuse"
        raise FlightError("; it ".join([reason, *damage]))
    zero_us = None if zero_unix_us is None else zero_unix_us + (reader.zero_us or 0)
    table = table_of_rows(_chained(first, stream), options, vehicle_id, zero_us)
    table.remarks = remarks
    return table


def _chained(first: TableRow, others: Iterator[TableRow]) -> Iterator[TableRow]:
    yield first
    yield from others


def _log_of(path: Path) -> DataflashReader:
    first = next(read_chunks(path), b"")
    names = {*ArdupilotReader(1).names, "PARM"}
    return DataflashReader(names, is_text=not first.startswith(HEAD))


def _messages(path: Path, options: ReadOptions, log: DataflashReader) -> Iterator[NamedMessage]:
    for data in read_chunks(path, options.progress):
        yield from log.feed(data)
    yield from log.feed(b"", final=True)


def _facts_of(path: Path, options: ReadOptions) -> tuple[int, int | None]:
    """Return the system id, and the civil time at the autopilot's zero by its first fixes."""
    system_id, found = 1, list[int]()
    for name, message in _messages(path, options, _log_of(path)):
        try:
            if name == "PARM" and message.Name in SYSTEM_IDS:
                system_id = int(message.Value)
            elif name == "GPS" and (utc_us := utc_of(message)) is not None:
                found.append(utc_us - int(message.TimeUS))
        except BROKEN:
            continue
        if len(found) == FIXES:
            break
    return system_id, median_low(found) if found else None


def _records(
    messages: Iterator[NamedMessage], log: DataflashReader, reader: ArdupilotReader
) -> Iterator[Imported]:
    """Read the whole log; a message that cannot be understood is counted."""
    for name, message in messages:
        try:
            found = reader.feed(name, message)
        except BROKEN:
            log.broken += 1
            continue
        yield from found
    yield from reader.flush()


def _remarks(log: DataflashReader, reader: ArdupilotReader) -> Iterator[str]:
    if log.damaged_bytes:
        yield f"is damaged: {log.damaged_bytes} bytes are no messages and were left out"
    if log.cut_bytes:
        yield f"ends within a message: {log.cut_bytes} bytes were left out"
    if broken := reader.dropped + log.broken:
        yield f"is damaged: {broken} messages cannot be understood and were left out"
    if reader.leaps:
        yield f"its clock leaped {reader.leaps} times"
