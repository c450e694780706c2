"""The sensor samples of an autopilot's log as rows of a table, in the resolution of the log."""

import math
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any, Final

from gateway.recordings.autopilot_record import AutopilotLog, LogRow, NewestRows
from gateway.recordings.columns import (
    BARO_CODEC,
    GPS_CODEC,
    LARGEST_WHOLE,
    NAV_CODEC,
    SI_CODEC,
    WHOLE_COLUMNS,
    Codec,
)
from gateway.recordings.files import FlightError
from gateway.recordings.message_table import MessageRow, bind_columns, first_known
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.recordings.recorded_table import ReadOptions, RecordedTable, table_of_rows
from gateway.recordings.rows import Imported, RowBuilder, TableRow
from gateway.records import NAN, UNKNOWN_VEC3, GpsFixType, ImuFlags, NavFlags, NodeId, Vec3
from gateway.units import US_PER_S

STATE_AGE_US: Final = US_PER_S // 2
"""Maximum age of a position or velocity in a state of the autopilot."""
IMU_NODE, GPS_NODE = 0, 1
_CODECS: Final[dict[str, Codec[Any]]] = {
    "mag": SI_CODEC, "imu": SI_CODEC, "baro": BARO_CODEC, "gps": GPS_CODEC, "nav": NAV_CODEC,
}  # fmt: skip
_FIX_TYPES: Final = {
    0: GpsFixType.NONE, 1: GpsFixType.NONE, 2: GpsFixType.FIX_2D, 8: GpsFixType.DEAD_RECKONING,
}  # fmt: skip
"""Type of a fix by that of MAVLink and of the logs; all others are 3D."""
_FLAGS: Final = {
    "nav_q_w": NavFlags.ATTITUDE_VALID | NavFlags.HEADING_VALID,
    "nav_lat_deg": NavFlags.POSITION_VALID | NavFlags.ALTITUDE_VALID,
    "nav_vel_down_mps": NavFlags.VELOCITY_VALID,
}
"""What a known column of a state shows to be valid."""
_MAG: Final = tuple(f"mag_{axis}_b_ut" for axis in "xyz")


class _Sample:
    """One kind of sample, bound to a log."""

    def __init__(self, row: MessageRow, log: AutopilotLog) -> None:
        self.kind, self.codec = row.name, _CODECS[row.name]
        columns = (*self.codec.columns, "imu_flags")
        self._empty = {name: 0 if name in WHOLE_COLUMNS else NAN for name in columns}
        self._times = (f"{row.name}_time_us", f"{row.name}_node_time_us")
        self._reads = [
            (name, name in WHOLE_COLUMNS, reads)
            for name, reads in bind_columns(row, columns, log).items()
        ]

    def values(self, newest: NewestRows, time_us: int) -> dict[str, float]:
        """Return the values by column; an unknown one is NaN, or 0 if it is an integer."""
        found: dict[str, float] = self._empty | dict.fromkeys(self._times, time_us)
        for name, is_whole, reads in self._reads:
            if math.isfinite(value := first_known(reads, newest.value)):
                found[name] = round(value) if is_whole else value
        return found


class _Samples:
    """Convert the rows of a log to records, in their order; times begin at zero."""

    def __init__(self, log: AutopilotLog) -> None:
        self.zero_us: int | None = None
        self._log = log
        self._newest = NewestRows(log, STATE_AGE_US)
        self._node = NodeId(log.vehicle_id, IMU_NODE)
        self._mag: Vec3 | None = None
        self._by_topic: dict[str, list[_Sample]] = {}
        for row in log.table.samples:
            topic = next((topic for topic in row.of if topic in log.present), None)
            if topic is not None:
                self._by_topic.setdefault(topic, []).append(_Sample(row, log))

    def records(self) -> Iterator[Imported]:
        newest = self._newest
        for row in self._log.entries:
            if not isinstance(row, LogRow):
                continue
            newest.add(row)
            samples = self._by_topic.get(row.topic)
            if samples is None or row.instance != newest.primary(row.topic):
                continue
            if self.zero_us is None:
                self.zero_us = row.time_us
            time_us = row.time_us - self.zero_us
            for sample in samples:
                record = self._record(sample, sample.values(newest, time_us), time_us)
                if record is not None:
                    yield record

    def _record(self, sample: _Sample, values: dict[str, float], time_us: int) -> Imported | None:
        if sample.kind == "mag":
            x, y, z = (values[name] for name in _MAG)
            self._mag = (x, y, z) if math.isfinite(x + y + z) else self._mag
            return None
        if sample.kind == "imu":
            flags = ImuFlags(int(values["imu_flags"])) | (ImuFlags.MAG_NEW if self._mag else 0)
            values |= zip(_MAG, self._mag or UNKNOWN_VEC3, strict=True)
            self._mag = None
            cells = [values[name] for name in SI_CODEC.columns]
            return SI_CODEC.read(cells, time_us=time_us, node=self._node, flags=flags)
        if sample.kind == "baro":
            if not math.isfinite(values["baro_pressure_pa"]):
                return None
        elif sample.kind == "gps":
            _complete_fix(values)
        else:
            known = (flag for name, flag in _FLAGS.items() if math.isfinite(values[name]))
            values["nav_flags"] = sum(known)
        cells = [values[name] for name in sample.codec.columns]
        record: Imported = sample.codec.read(cells, self._log.vehicle_id)
        return record


def _complete_fix(values: dict[str, float]) -> None:
    fix_type = _FIX_TYPES.get(round(values["gps_fix_type"]), GpsFixType.FIX_3D)
    values["gps_fix_type"] = fix_type
    values["gps_fix_ok"] = fix_type not in (GpsFixType.NONE, GpsFixType.DEAD_RECKONING)
    values["gps_node_id"], values["gps_pdop"] = GPS_NODE, values["gps_pdop"] or NAN
    if fix_type is GpsFixType.NONE:
        values |= dict.fromkeys([name for name in values if name.startswith("gps_vel_")], NAN)
    if not FIRST_CIVIL_US < values["gps_utc_us"] < LARGEST_WHOLE:
        values["gps_utc_us"] = NAN


def read_samples(path: Path, log: AutopilotLog, options: ReadOptions) -> RecordedTable:
    """Return the samples of a log as a flight; raises FlightError if it has none of the IMU."""
    samples = _Samples(log)

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        for record in samples.records():
            yield from builder.add(record)
        yield from builder.flush()

    stream, head = rows(), list[TableRow]()
    while not head or head[-1].imu is None:
        row = next(stream, None)
        if row is None:
            raise FlightError(f"{path}: {log.why_no_samples}")
        head.append(row)
    civil_us = log.unix_us_at_zero
    zero_us = None if civil_us is None else civil_us + (samples.zero_us or 0)
    table = table_of_rows(chain(head, stream), options, log.vehicle_id, zero_us)
    table.remarks = log.remarks
    return table
