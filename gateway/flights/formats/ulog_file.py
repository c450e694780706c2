"""ULog, the log of PX4."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from gateway.edges.disk.recording_streams import read_chunks
from gateway.flightlog.autopilots.px4_log import TOPICS, Px4Log
from gateway.flightlog.autopilots.ulog import UlogReader
from gateway.flightlog.table.row import RowBuilder, TableRow
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, table_of_rows

MS_PER_S: Final = 1000.0
SYSTEM_ID: Final = "MAV_SYS_ID"


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a ULog as a flight; raises FlightError if there is none in it."""
    log = UlogReader(TOPICS)
    for data in read_chunks(path, options.progress):
        log.feed(data)
    log.feed(b"", final=True)
    if log.is_newer:
        raise FlightError(f"{path}: cannot be read: its flags say that it needs a newer program")
    known = log.parameters.get(SYSTEM_ID, math.nan)
    vehicle_id = options.system_id or (int(known) if 1 <= known <= 255 else 1)
    try:
        flight = Px4Log(log.topics(), vehicle_id)
    except ValueError as error:
        raise FlightError("; it ".join([f"{path}: {error}", *_damage(log)])) from error

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        for record in flight.records():
            yield from builder.add(record)
        yield from builder.flush()

    table = table_of_rows(rows(), options, vehicle_id, flight.unix_us_at_zero)
    table.remarks += [f"{path}: {remark}" for remark in _remarks(log, flight)]
    return table


def _damage(log: UlogReader) -> Iterator[str]:
    if log.damaged_bytes:
        yield f"is damaged: {log.damaged_bytes} bytes cannot be understood and were left out"
    if log.cut_bytes:
        yield f"ends within a message: {log.cut_bytes} bytes were left out"


def _remarks(log: UlogReader, flight: Px4Log) -> Iterator[str]:
    yield from _damage(log)
    if log.dropouts_ms:
        lost_s = sum(log.dropouts_ms) / MS_PER_S
        yield f"its logger was too slow {len(log.dropouts_ms)} times, {lost_s:.1f} s are not in it"
    if flight.left_out:
        yield f"lacks fields that PX4 documents for {', '.join(flight.left_out)}; left out"
    if flight.dropped:
        yield f"{flight.dropped} samples without a time that can be were left out"
