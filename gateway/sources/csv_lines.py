"""Lines of CSV in a stream, with the same column maps that `--columns` reads for files.

The column names are in a line of the stream, repeated after every restart of the sender, or in the
option `names`. Axes and units are those of the map, but accelerometer, gyroscope and compass are
treated as uncalibrated and in sensor axes, as for every source.
"""

import math
import tomllib

import msgspec

from gateway.recordings.formats.csv import DELIMITERS, ColumnMap, CsvReader
from gateway.recordings.rows import TableRow, row_of_cells
from gateway.records import NodeId
from gateway.sources.sampling import SampleClock, imu_raw
from gateway.sources.source import SourceRecord, unusable
from gateway.wire.framing import Fault
from gateway.wire.timesync import WRAP_MASK


def read_column_map(text: str) -> ColumnMap:
    """Read a column map; raises ValueError if it is invalid."""
    try:
        return msgspec.convert(tomllib.loads(text), ColumnMap)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise ValueError(f"map of columns: {error}") from error


class CsvLines:
    """Convert the lines of one sender to records."""

    def __init__(self, column_map: ColumnMap, names: str, node: NodeId) -> None:
        self._map = column_map
        self._header = names
        self._node = node
        self._clock = SampleClock()
        wanted = column_map.columns.values()
        self._wanted = {each if isinstance(each, str) else each.column for each in wanted}

    def line(self, line: str, arrival_us: int) -> list[SourceRecord | Fault]:
        """Process a line with column names or with values."""
        if self._is_header(line):
            self._header = line
            return []
        if not self._header:
            return [unusable("csv", line, "comes before the line of column names")]
        reader = CsvReader(self._map, lenient=True)
        try:
            blocks = [*reader.blocks([self._header, line])]
        except ValueError as error:
            return [unusable("csv", line, str(error))]
        rows = [
            row_of_cells(cells, self._node.vehicle_id) for b in blocks for cells in b.cells.tolist()
        ]
        found = [record for row in rows for record in self._records(row, arrival_us)]
        if not found:
            return [unusable("csv", line, reader.first_fault or "has no value of the map")]
        return [*found]

    def _is_header(self, line: str) -> bool:
        names = (({cell.strip(' "') for cell in line.split(each)}) for each in DELIMITERS)
        return any(self._wanted <= each for each in names)

    def _records(self, row: TableRow, arrival_us: int) -> list[SourceRecord]:
        time_us = self._clock.own(row.time_us, arrival_us)
        common = {"time_us": time_us, "node": self._node, "node_time_us": time_us & WRAP_MASK}
        found: list[SourceRecord | None] = []
        if row.baro is not None:
            found.append(msgspec.structs.replace(row.baro, **common))
        if row.gps is not None:
            found.append(msgspec.structs.replace(row.gps, **common))
        if row.imu is not None:
            x, y, z = (math.degrees(rate) for rate in row.imu.gyro_b_radps)
            values = (row.imu.accel_b_mps2, (x, y, z), row.imu.mag_b_ut, row.imu.temperature_degc)
            found.append(imu_raw(time_us, self._node, *values))
        return [record for record in found if record is not None]
