"""One part of a recording: the data buffered for its files until it is written."""

from dataclasses import dataclass, field
from typing import Final

import msgspec

from gateway.hub.forwarding import Forwarding
from gateway.recordings.recorded_clock import STEP_US, Stamper
from gateway.recordings.rows import RowBuilder, TableRow, row_to_line
from gateway.recordings.table import TableHeader, TableNote, encode_head, encode_line
from gateway.recordings.tlog import encode_record
from gateway.records import BaroRaw, FusedSample, FusionState, GpsFix, NodeStatus

PENDING_LIMIT: Final = 16 << 20
"""Maximum bytes that wait for a slow disk: minutes of telemetry. More is dropped."""
TLOG: Final = ".tlog"


@dataclass(slots=True)
class _Table:
    """One aircraft's table, which begins with its first row."""

    header: TableHeader
    state: FusionState | None
    rows: RowBuilder = field(default_factory=RowBuilder)
    begun: bool = False
    has_head: bool = False
    """Whether its head was passed on to be written."""


class Part:
    """Data buffered until it is written to the disk, by the ending of the file name."""

    def __init__(self, session: str, number: int, offset_us: int, begin_us: int) -> None:
        self.session = session
        """Name of the session; may be set until the first bytes are taken."""
        self.number = number
        self.begin_us = begin_us
        """When the buffering began."""
        self.stamper = Stamper(offset_us)
        self.pending: dict[str, bytearray] = {}
        self.size = 0
        """Bytes added, including those dropped beyond the limit."""
        self.tables: dict[int, _Table] = {}
        """The prepared tables, by vehicle id."""
        self.introduced: set[int] = set()
        """Aircraft whose introduction is in the tlog."""

    def add(self, ending: str, data: bytes) -> None:
        """Buffer bytes for one file, unless too many wait already."""
        if self.size < PENDING_LIMIT:
            self.pending.setdefault(ending, bytearray()).extend(data)
        self.size += len(data)

    def take(self) -> dict[str, bytes]:
        """Return the buffered bytes and clear the buffer."""
        heads = {}
        for vehicle_id, table in self.tables.items():
            if table.begun and not table.has_head:
                table.has_head = True
                # The name may have changed since the table was prepared.
                header = msgspec.structs.replace(table.header, session=self.session)
                state = "" if table.state is None else encode_line(table.state)
                heads[table_ending(vehicle_id)] = (encode_head(header) + state).encode()
        pending, self.pending, self.size = self.pending, {}, 0
        endings = dict.fromkeys((*pending, *heads))
        return {each: heads.get(each, b"") + bytes(pending.get(each, b"")) for each in endings}

    def add_frame(self, frame: bytes, now_us: int) -> None:
        """Buffer a MAVLink frame for the tlog."""
        self.add(TLOG, encode_record(self.stamper.stamp(now_us), frame))

    def add_run(self, run: Forwarding, now_us: int) -> None:
        """Buffer frames that the hub has forwarded together for the tlog."""
        first_us = self.stamper.stamp_several(now_us, run.run_length)
        self.add(TLOG, run.records(first_us, STEP_US))

    def prepare_table(self, header: TableHeader, state: FusionState | None = None) -> None:
        """Set the head of an aircraft's table."""
        self.tables[header.vehicle_id] = _Table(header, state)

    def add_flight(
        self, vehicle_id: int, record: BaroRaw | GpsFix | FusedSample | NodeStatus
    ) -> None:
        """Buffer a record of an aircraft, for a table that was prepared."""
        table = self.tables[vehicle_id]
        if not isinstance(record, NodeStatus):
            self._write(table, table.rows.add(record))
        elif table.begun:
            # A status does not begin a table: that begins with a row.
            self.add(table_ending(vehicle_id), encode_line(record).encode())

    def change_settings(self, header: TableHeader) -> None:
        """Note in a prepared table that the following rows are fused with other settings."""
        table = self.tables[header.vehicle_id]
        table.begun = True
        self._write(table, table.rows.flush())
        self.add(table_ending(header.vehicle_id), encode_line(header).encode())

    def add_note(self, note: TableNote) -> None:
        """Add a note to every table that has begun."""
        for vehicle_id, table in self.tables.items():
            if table.begun:
                self.add(table_ending(vehicle_id), encode_line(note).encode())

    def flush_rows(self) -> None:
        """Buffer the records that still wait for the row of an IMU sample."""
        for table in self.tables.values():
            self._write(table, table.rows.flush())

    def _write(self, table: _Table, rows: list[TableRow]) -> None:
        for row in rows:
            table.begun = True
            self.add(table_ending(table.header.vehicle_id), row_to_line(row).encode())


def table_ending(vehicle_id: int) -> str:
    """Return the file name ending of an aircraft's table."""
    return f"_v{vehicle_id}.csv"
