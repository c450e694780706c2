"""DataFlash, the log of ArduPilot, in binary (.bin) and as text (.log), read by pymavlink."""

import contextlib
import io
import re
from collections.abc import Callable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import Any, Final

from pymavlink.DFReader import DFReader_binary, DFReader_text

from gateway.edges.disk.recording_streams import ERASED, read_chunks, temporary_copy
from gateway.flightlog.autopilots.ardupilot_log import (
    FIX_2D,
    KINDS,
    SENSORS,
    ArdupilotReader,
    in_era,
    sensor_of,
)
from gateway.flightlog.table.row import Imported, RowBuilder, TableRow
from gateway.flights.flight_terms import FlightError
from gateway.flights.reading import ReadOptions, RecordedTable, table_of_rows
from gateway.units import US_PER_S, counted

MAGIC: Final = b"\xa3\x95"
MAX_LOOKED_AT: Final = 20_000
"""Messages of a kind that are read to find the first sensor with data: an hour of GPS."""
SYSTEM_IDS: Final = ("SYSID_THISMAV", "MAV_SYSID")
_AS_TEXT: Final = bytes(range(128)) + b"?" * 128
_SKIPPED: Final = re.compile(r"Skipped (\d+) bad bytes")


class _Complaints(io.TextIOBase):
    """Count the damage that pymavlink prints to the terminal."""

    def __init__(self) -> None:
        self.bytes = self.messages = 0
        self.spoken = False

    def write(self, text: str) -> int:
        self.spoken = True
        self.bytes += sum(map(int, _SKIPPED.findall(text)))
        return len(text)

    def quietly(self, call: Callable[[], Any]) -> Any:
        """Call while counting what is printed."""
        with contextlib.redirect_stdout(self), contextlib.redirect_stderr(self):
            return call()


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a DataFlash log as a flight; raises FlightError if there is none in it."""
    heard = _Complaints()
    log = _open(path, options, heard)
    named = (log.params.get(name) for name in SYSTEM_IDS)
    known = next((int(value) for value in named if value is not None), 1)
    vehicle_id = options.system_id or (known if 1 <= known <= 255 else 1)
    sensors = _sensors_of(log, heard) | dict(options.sensors)
    reader = ArdupilotReader(vehicle_id, sensors)
    remarks = [f"{path}: uses {kind} {number + 1}" for kind, number in sensors.items() if number]

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        with contextlib.closing(log):
            for record in _records(log, heard, reader):
                yield from builder.add(record)
            yield from builder.flush()
            remarks.extend(f"{path}: {remark}" for remark in _remarks(log, heard, reader))

    stream = rows()
    first = next((row for row in stream if row.imu is not None), None)
    if first is None:
        raise FlightError(f"{path}: holds no IMU messages, so there is nothing to fuse")
    # By the first week and time of GPS; 0 without one.
    unix_us = in_era(round(log.clock.timebase * US_PER_S)) if log.clock.timebase else None
    zero_us = None if unix_us is None else unix_us + (reader.zero_us or 0)
    table = table_of_rows(chain([first], stream), options, vehicle_id, zero_us)
    table.remarks = remarks
    return table


def _sensors_of(log: Any, heard: _Complaints) -> dict[str, int]:
    """Find the first sensor of each kind that has data; a GPS that has a fix."""
    found: dict[str, int] = {}
    for kind in SENSORS:
        names = {name for name, of in KINDS.items() if of == kind}
        seen: set[int] = set()
        for message in islice(_each(log, heard, names), MAX_LOOKED_AT):
            if kind != "GPS" or getattr(message, "Status", 0) >= FIX_2D:
                seen.add(sensor_of(message.get_type(), message))
            if 0 in seen:
                break
        found[kind] = min(seen, default=0)
    return found


def _each(log: Any, heard: _Complaints, names: set[str]) -> Iterator[Any]:
    """Yield the messages of these names up to the first damage, and go back to the begin."""
    log.type_list = None
    try:
        while message := heard.quietly(lambda: log.recv_match(type=names, strict=True)):
            yield message
    except Exception:  # noqa: BLE001 - as for `_open`
        return
    finally:
        log._rewind(keep_messages=True)  # noqa: SLF001 - the public one clears the parameters


def _open(path: Path, options: ReadOptions, heard: _Complaints) -> Any:
    """Open a temporary copy of a log, unpacked.

    pymavlink maps a log into the memory, where one that shrinks would end the process.
    """
    content = read_chunks(path, options.progress, options.unpacked_limit)
    first = next(content, b"")
    while first and not first.strip(ERASED):
        first = next(content, b"")
    first = first.lstrip(ERASED) if first[:2] == ERASED * 2 else first
    is_binary = first.startswith(MAGIC)
    kind = DFReader_binary if is_binary else DFReader_text
    # A byte that is not text must not stop the reading.
    all_of_it = chain([first], content)
    sound = all_of_it if is_binary else (data.translate(_AS_TEXT) for data in all_of_it)
    with temporary_copy(path, sound) as plain:
        log = kind.__new__(kind)
        # The fast indexer prints to the terminal directly, not through Python.
        log.init_arrays_fast = log.init_arrays
        try:
            heard.quietly(lambda: kind.__init__(log, plain.name))
        except Exception as error:
            # Damage makes pymavlink raise anything, bare exceptions included.
            log.close()
            raise FlightError(f"{path}: its list of formats is damaged: {error}") from error
        return log


def _records(log: Any, heard: _Complaints, reader: ArdupilotReader) -> Iterator[Imported]:
    """Read the whole log; a message that cannot be decoded is counted.

    Of an intact log only the needed messages are decoded. The index of a damaged one ends at the
    damage, so it is read message by message.
    """

    def wanted() -> Any:
        return log.recv_match(type=reader.names, strict=True)

    take = log.recv_msg if heard.spoken else wanted
    lines, end = 0, -1
    while True:
        begin = log.offset
        try:
            message = heard.quietly(take)
            # For a line that is no message it gives the next one, and that again in its turn.
            is_again, end = log.offset == end, log.offset
            found = [] if message is None or is_again else reader.feed(message.get_type(), message)
        except Exception:  # noqa: BLE001 - as above
            heard.messages += 1
            log.offset = max(log.offset, begin + 1)
            continue
        if message is None:
            yield from reader.flush()
            break
        lines += not is_again
        yield from found
    if isinstance(log, DFReader_text):
        heard.messages = _lines_of(log, reader.names) - lines


def _lines_of(log: Any, names: set[str]) -> int:
    """Count the lines of a text log that should be such messages, or are of no known format."""
    odd = {name for name in log.counts if name.strip() and name not in log.formats}
    return sum(log.counts.get(name, 0) for name in names | odd)


def _remarks(log: Any, heard: _Complaints, reader: ArdupilotReader) -> Iterator[str]:
    if heard.bytes:
        yield f"is damaged: left out {counted(heard.bytes, 'byte')} without a message"
    if log.offset < log.data_len:
        yield f"ends within a message: left out {counted(log.data_len - log.offset, 'byte')}"
    if broken := reader.dropped + heard.messages:
        yield f"is damaged: left out {counted(broken, 'message')} that cannot be understood"
    if reader.leaps:
        yield f"its clock jumped forward {counted(reader.leaps, 'time')}"
    if reader.restarts:
        yield f"the autopilot restarted {counted(reader.restarts, 'time')}; its times run on"
    if reader.is_rolled_over:
        yield "its GPS receiver counts 1024 weeks too few; its dates are corrected"
