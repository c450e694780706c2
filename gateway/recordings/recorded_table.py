"""A recorded flight as rows with a head, and the settings for its fusion."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any

import msgspec

from gateway import __version__
from gateway.aircraft import AircraftSettings
from gateway.pipeline import PipelineSettings
from gateway.recordings.files import MAX_UNPACKED, FlightError, Progress
from gateway.recordings.formats.csv import ColumnMap
from gateway.recordings.rows import TableRow
from gateway.recordings.table import (
    BLOCK_ROWS,
    HEAD_LINES,
    Position,
    SettingsChoice,
    TableBlock,
    TableFault,
    TableHeader,
    TableNote,
    TableReader,
    block_of,
)
from gateway.records import FusionState, NodeStatus
from gateway.sensing.calibration import NodeCalibration

Line = TableRow | TableHeader | TableNote | FusionState | NodeStatus


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options for reading and fusing flights."""

    current: PipelineSettings
    """The current settings."""
    choice: SettingsChoice = "recorded"
    """Settings to fuse a table with; a table without settings is fused with the current ones."""
    position: Position = "causal"
    columns: ColumnMap | None = None
    """Column map for another program's CSV; default: that of a tracker log."""
    system_id: int | None = None
    """System id of the vehicle to use from a tlog."""
    progress: Progress | None = None
    sensors: tuple[tuple[str, int], ...] = ()
    """Sensors to use where there are several of a kind: ("GPS", 1) is the second GPS."""
    unpacked_limit: int = MAX_UNPACKED
    """Maximum unpacked size of a packed file that is read as a whole, bytes."""


@dataclass(slots=True)
class RecordedTable:
    """Rows with their head."""

    header: TableHeader
    blocks: Iterator[TableBlock]
    """A header among the rows is a change of settings in flight, a state is that of the fusion at
    this row, and a note is a remark of the operator."""
    remarks: list[str] = field(default_factory=list)
    """Remarks about the file for the user; complete once the rows are read."""

    @property
    def rows(self) -> Iterator[Line]:
        """The rows and comments one by one, without faults."""
        events = (e for block in self.blocks for e in block.events(self.header.vehicle_id))
        return (event for event in events if isinstance(event, Line))

    @property
    def plain_rows(self) -> Iterator[TableRow]:
        """The rows only."""
        return (row for row in self.rows if isinstance(row, TableRow))


def header_for(aircraft: AircraftSettings, vehicle_id: int) -> TableHeader:
    """Return the header that a table needs to be fused again."""
    sections: dict[str, Any] = msgspec.to_builtins(aircraft)
    sections["vehicle"].pop("signing_passphrase")
    calibration = sections.pop("calibration")
    return TableHeader(
        mavgate_version=__version__,
        vehicle_id=vehicle_id,
        settings=sections,
        calibration=calibration,
    )


def settings_of(header: TableHeader) -> AircraftSettings:
    """Return the settings that were used to record a table; FlightError if they are invalid."""
    sections = {**header.settings, "calibration": header.calibration}
    try:
        return msgspec.convert(sections, AircraftSettings)
    except msgspec.ValidationError as error:
        raise FlightError(
            f"the recorded settings are of another version ({error}); "
            "`fuse`, `play` and `report` use the current ones with --fuse-with current"
        ) from error


def aircraft_of(table: RecordedTable, options: ReadOptions) -> AircraftSettings:
    """Choose the settings for a table: its own, or the current ones."""
    if options.choice == "current" or not table.header.settings:
        return options.current.aircraft.get(table.header.vehicle_id, options.current.default)
    return settings_of(table.header)


def table_of_blocks(path: Path, reader: TableReader, blocks: Iterator[TableBlock]) -> RecordedTable:
    """Begin to read a table; raises FlightError if its head is damaged, or it has no row."""
    head: list[TableBlock] = []
    for block in blocks:
        head.append(block)
        for _, comment in block.comments:
            if isinstance(comment, TableFault) and comment.line <= HEAD_LINES:
                raise FlightError(
                    f"{path}: line {comment.line}: {comment.reason}; `mavgate recover` writes the "
                    "intact rows"
                )
        if len(block):
            return RecordedTable(reader.header or TableHeader(), chain(head, blocks))
    raise FlightError(f"{path}: contains no row")


def table_of_rows(
    rows: Iterator[TableRow],
    options: ReadOptions,
    vehicle_id: int = 1,
    unix_us_at_zero: int | None = None,
) -> RecordedTable:
    """Combine rows from another program with the head of a table of the current settings."""
    header = header_of_today(options, vehicle_id, unix_us_at_zero)
    blocks = (block_of(some) for some in iter(lambda: [*islice(rows, BLOCK_ROWS)], []))
    return RecordedTable(header, blocks)


def header_of_today(
    options: ReadOptions, vehicle_id: int, unix_us_at_zero: int | None
) -> TableHeader:
    """Return the head of a table of calibrated values, with the current settings."""
    current = options.current.aircraft.get(vehicle_id, options.current.default)
    # The values are calibrated already, so no calibration is applied to them.
    calibrated = msgspec.structs.replace(current, calibration=NodeCalibration())
    known = header_for(calibrated, vehicle_id)
    return msgspec.structs.replace(known, unix_us_at_zero=unix_us_at_zero)
