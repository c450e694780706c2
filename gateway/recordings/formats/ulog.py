"""ULog, PX4's log, read with pyulog by the definitions of its uORB messages.

IMU: `sensor_combined`. Magnetic field: `vehicle_magnetometer`; in old logs, fields of
`sensor_combined`. Barometer: `vehicle_air_data`, `sensor_baro`, or the heights in
`sensor_combined`. GPS: `vehicle_gps_position` or `sensor_gps`, with positions in 1e-7 degrees or,
in newer logs, in degrees. The autopilot's estimates: `vehicle_attitude`,
`vehicle_global_position`, `vehicle_local_position`. All are in body FRD and NED already, times in
µs since the start. Of several topics, or instances of a topic, the first with data is used.
"""

import contextlib
import heapq
import io
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from pathlib import Path
from statistics import median_low
from types import MappingProxyType
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from gateway.geometry.atmosphere import pressure_at_height
from gateway.recordings.columns import LARGEST_WHOLE, Imported, RowBuilder, TableRow
from gateway.recordings.files import (
    ULOG_BEGIN,
    ULOG_HEAD,
    Before,
    FlightError,
    name_of,
    read_chunks,
    skip_to,
    temporary_copy,
)
from gateway.recordings.formats.mavlink import VELOCITY_AGE_US, autopilot_state
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.recordings.recorded_table import ReadOptions, RecordedTable, table_of_rows
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    NavState,
    NodeId,
    Vec3,
)
from gateway.units import DEG_PER_DEGE7, M_PER_MM, PA_PER_HPA, US_PER_S, UT_PER_GAUSS, counted

SOURCES: Final = {
    "IMU": ("sensor_combined",),
    "MAG": ("vehicle_magnetometer", "sensor_combined"),
    "BARO": ("vehicle_air_data", "sensor_baro", "sensor_combined"),
    "GPS": ("vehicle_gps_position", "sensor_gps"),
    "attitude": ("vehicle_attitude",),
    "position": ("vehicle_global_position",),
    "velocity": ("vehicle_local_position", "vehicle_global_position"),
}
"""Topics for each kind of data, the preferred one first."""
TOPICS: Final = tuple(dict.fromkeys(name for names in SOURCES.values() for name in names))
"""All topics that are read."""
LEAST_PA: Final = 2000.0
"""Minimum pressure; smaller values are in hPa, as in `sensor_baro` before PX4 1.14. No aircraft
flies that high."""
AROUND: Final = 5
"""Number of rows around a row whose median time it is compared with."""
FAR_US: Final = US_PER_S
"""Maximum difference from that median; beyond it the time is damaged, as topics are ordered."""
AT_ENDS_US: Final = 60 * US_PER_S
"""The same at the ends of a topic, where a gap of the log causes large differences."""
NOT_THERE: Final = 0x7FFFFFFF
"""Value of a time relative to the sample that means "no new value"."""
FIX_2D, EXTRAPOLATED = 2, 8
ORDER: Final[dict[type, int]] = {NavState: 0, BaroRaw: 1, GpsFix: 2, ImuCalibrated: 3}
"""Order of records of the same time, as in a row."""

_FIX_TYPES: Final = {
    0: GpsFixType.NONE, 1: GpsFixType.NONE, FIX_2D: GpsFixType.FIX_2D,
    EXTRAPOLATED: GpsFixType.DEAD_RECKONING,
}  # fmt: skip

Topic = Mapping[str, NDArray[Any]]
Row = Mapping[str, Any]
Instance = tuple[str, int]
"""Name of a topic, and the number of its instance, from 0."""
_WHOLE: Final = frozenset((
    "time_utc_usec", "fix_type", "satellites_used", "timestamp", "timestamp_time_relative",
    "magnetometer_timestamp_relative", "baro_timestamp_relative",
))  # fmt: skip
"""Integer fields."""
_GPS_FIELDS: Final = (
    ("lat", "latitude_deg"), ("lon", "longitude_deg"), ("vel_n_m_s",), ("vel_e_m_s",),
    ("vel_d_m_s",),
)  # fmt: skip
_BARO_DEGC: Final = ("ambient_temperature", "baro_temp_celcius", "temperature")
_VELOCITY: Final = (("vx", "vel_n"), ("vy", "vel_e"), ("vz", "vel_d"))
MS_PER_S: Final = 1000.0
SYSTEM_ID: Final = "MAV_SYS_ID"
HEADER: Final = 3
"""Size of a message header: length and type."""
MOST_VALUES: Final = 1 << 16
"""Maximum number of values in a row, from the maximum size of a message."""
BROKEN: Final = (
    *(ValueError, TypeError, LookupError, AttributeError, OverflowError),
    *(struct.error, RecursionError),
)
"""Exceptions that pyulog raises on damaged logs in addition to its own."""


def in_order(topic: Topic) -> tuple[Topic, int]:
    """Sort by time, without rows whose time is absent or far from that of adjacent rows."""
    time_us = topic["timestamp"].astype(np.int64)
    sound = (time_us > 0) & (time_us < LARGEST_WHOLE)
    if len(time_us) >= AROUND:
        around = np.median(sliding_window_view(time_us, AROUND), axis=1)
        early_us = np.pad(around, AROUND // 2, mode="edge") - time_us
        far_us = np.full((2, len(time_us)), FAR_US)
        far_us[0, : AROUND // 2] = far_us[1, -(AROUND // 2) :] = AT_ENDS_US
        sound &= (early_us < far_us[0]) & (-early_us < far_us[1])
    order = np.flatnonzero(sound)[np.argsort(time_us[sound], kind="stable")]
    return {name: column[order] for name, column in topic.items()}, int(np.count_nonzero(~sound))


def instances_of(
    kind: str, topics: Mapping[Instance, Topic], wanted: int | None = None
) -> list[Instance]:
    """Return the instances of topics with a kind of data, the preferred one first."""
    return [
        (name, k)
        for name in SOURCES[kind]
        for k in sorted(k for other, k in topics if other == name and wanted in (None, k))
    ]


def first_with_data(
    kind: str, topics: Mapping[Instance, Topic], found: Sequence[Instance]
) -> Instance | None:
    """Return the first instance with data; for IMU and GPS the first one if none has data."""
    default = found[0] if found and kind in ("IMU", "GPS") else None
    return next((one for one in found if _has_data(kind, topics[one])), default)


def unix_us_at_boot(gps: Topic) -> int | None:
    """Return the civil time at zero of the autopilot's clock, from its fixes; None without any."""
    if "time_utc_usec" not in gps:
        return None
    behind = gps.get("timestamp_time_relative", np.zeros(len(gps["timestamp"]), np.int64))
    times = zip(
        gps["time_utc_usec"].tolist(), gps["timestamp"].tolist(), behind.tolist(), strict=True
    )
    found = [
        int(utc_us) - int(time_us) - int(relative_us)
        for utc_us, time_us, relative_us in times
        if FIRST_CIVIL_US < utc_us < LARGEST_WHOLE
    ]
    return median_low(found) if found else None


class Px4Log:
    """The topics of one log, as records."""

    def __init__(
        self,
        topics: Mapping[Instance, Topic],
        vehicle_id: int,
        sensors: Mapping[str, int] = MappingProxyType({}),
    ) -> None:
        self.dropped = 0
        """Number of samples with an invalid time."""
        sound = {instance: _sound_columns(topic) for instance, topic in topics.items()}
        kept = {one: topic for one, topic in sound.items() if not _lacks(one[0], topic)}
        self.left_out = sorted({name for name, _ in sound.keys() - kept.keys()})
        """Topics that are left out because required fields are missing."""
        self.chosen: list[str] = []
        """Remarks for the user on sources that are not the first of their kind."""
        sources = {kind: self._choose(kind, kept, sensors.get(kind)) for kind in SOURCES}
        ordered = {one: self._in_order(kept[one]) for one in {*sources.values()} if one}
        self._topics = {kind: ordered[one] for kind, one in sources.items() if one}
        if not len(self._topics.get("IMU", {}).get("timestamp", ())):
            raise ValueError("contains no sensor_combined, the samples of the IMU")
        self._vehicle_id = vehicle_id
        begins = (t["timestamp"][0] for t in self._topics.values() if len(t["timestamp"]))
        self._zero_us = int(min(begins))

    def _choose(
        self, kind: str, topics: Mapping[Instance, Topic], wanted: int | None
    ) -> Instance | None:
        found = instances_of(kind, topics, wanted)
        chosen = first_with_data(kind, topics, found)
        if chosen is None:
            self.chosen += [] if wanted is None else [f"has no {kind} {wanted + 1}"]
        elif chosen != (found[0][0], 0):
            other = f" of {chosen[0]}" if chosen[0] != found[0][0] else ""
            self.chosen.append(f"uses {kind} {chosen[1] + 1}{other}")
        return chosen

    @property
    def unix_us_at_zero(self) -> int | None:
        """Civil time of the records' time zero, from GPS; None without GPS time."""
        boot_us = unix_us_at_boot(self._topics.get("GPS", {}))
        return None if boot_us is None else self._zero_us + boot_us

    def records(self) -> Iterator[Imported]:
        """Yield all records in the order of time, starting at 0."""
        streams = (self._imu(), self._baros(), self._fixes(), self._states())
        return heapq.merge(*streams, key=lambda record: (record.time_us, ORDER[type(record)]))

    def _in_order(self, topic: Topic) -> Topic:
        ordered, dropped = in_order(topic)
        self.dropped += dropped
        return ordered

    def _rows(self, kind: str) -> Iterator[Row]:
        """Yield the rows of the topic for a kind of data."""
        topic = self._topics.get(kind, {})
        columns = [column.tolist() for column in topic.values()]
        return (dict(zip(topic, row, strict=True)) for row in zip(*columns, strict=True))

    def _time(self, row: Row) -> int:
        return int(row["timestamp"]) - self._zero_us

    def _imu(self) -> Iterator[ImuCalibrated]:
        fields, node = self._fields_at_samples(), NodeId(self._vehicle_id, 0)
        for number, row in enumerate(self._rows("IMU")):
            mag = fields.get(number)
            flags = ImuFlags.MAG_NEW if mag else ImuFlags(0)
            if row.get("accelerometer_clipping", 0):
                flags |= ImuFlags.ACCEL_CLIPPED
            if row.get("gyro_clipping", 0):
                flags |= ImuFlags.GYRO_CLIPPED
            accel, gyro = _vector(row, "accelerometer_m_s2"), _vector(row, "gyro_rad")
            yield ImuCalibrated(self._time(row), node, accel, gyro, mag, NAN, flags)

    def _fields_at_samples(self) -> dict[int, Vec3]:
        """Return the newest magnetic field of IMU samples that have a new one, by their number."""
        imu, mag = self._topics["IMU"], self._topics.get("MAG")
        if mag is None:
            return {}
        if mag is imu:
            relative = imu.get("magnetometer_timestamp_relative", np.zeros(len(imu["timestamp"])))
            at = np.flatnonzero(relative != NOT_THERE).tolist()
            rows = list(self._rows("IMU"))
            return {number: _field(rows[number]) for number in at}
        after = np.searchsorted(imu["timestamp"], mag["timestamp"]).tolist()
        return dict(zip(after, map(_field, self._rows("MAG")), strict=True))

    def _baros(self) -> Iterator[BaroRaw]:
        node = NodeId(self._vehicle_id, 0)
        for row in self._rows("BARO"):
            pressure_pa = row.get("baro_pressure_pa", row.get("pressure", NAN))
            if pressure_pa < LEAST_PA:
                pressure_pa *= PA_PER_HPA
            if math.isnan(pressure_pa):
                if row.get("baro_timestamp_relative", 0) == NOT_THERE:
                    continue
                pressure_pa = pressure_at_height(row.get("baro_alt_meter", NAN))
            if math.isfinite(pressure_pa):
                degc = next((row[name] for name in _BARO_DEGC if name in row), NAN)
                time_us = self._time(row)
                yield BaroRaw(time_us, node, time_us, pressure_pa, degc)

    def _fixes(self) -> Iterator[GpsFix]:
        return (self._fix(row) for row in self._rows("GPS"))

    def _fix(self, row: Row) -> GpsFix:
        time_us = self._time(row)
        fix_type = _FIX_TYPES.get(row.get("fix_type", 0), GpsFixType.FIX_3D)
        utc_us = int(row.get("time_utc_usec", 0))
        has_velocity = fix_type is not GpsFixType.NONE and row.get("vel_ned_valid", 0)
        vel = (row["vel_n_m_s"], row["vel_e_m_s"], row["vel_d_m_s"]) if has_velocity else None
        return GpsFix(
            time_us=time_us,
            node=NodeId(self._vehicle_id, 1),
            node_time_us=time_us,
            itow_ms=0,
            fix_type=fix_type,
            fix_ok=fix_type not in (GpsFixType.NONE, GpsFixType.DEAD_RECKONING),
            satellites=row.get("satellites_used", 0),
            lat_dege7=_dege7(row, "latitude_deg", "lat"),
            lon_dege7=_dege7(row, "longitude_deg", "lon"),
            alt_amsl_m=_metres(row, "altitude_msl_m", "alt"),
            vel_n_mps=vel or UNKNOWN_VEC3,
            alt_ellipsoid_m=_metres(row, "altitude_ellipsoid_m", "alt_ellipsoid"),
            h_acc_m=row.get("eph", NAN) or NAN,
            v_acc_m=row.get("epv", NAN) or NAN,
            speed_acc_mps=row.get("s_variance_m_s", NAN) or NAN,
            course_acc_deg=math.degrees(row.get("c_variance_rad", NAN)) or NAN,
            pdop=math.hypot(row.get("hdop", NAN), row.get("vdop", NAN)) or NAN,
            utc_us=utc_us if FIRST_CIVIL_US < utc_us < LARGEST_WHOLE else None,
        )

    def _states(self) -> Iterator[NavState]:
        """Yield the autopilot's own solution, for comparison."""
        positions, motions = _Newest(self._rows("position")), _Newest(self._rows("velocity"))
        for row in self._rows("attitude"):
            position, motion = positions.at(row["timestamp"]), motions.at(row["timestamp"])
            north, east, down = (motion.get(k, motion.get(old, NAN)) for k, old in _VELOCITY)
            yield autopilot_state(
                self._time(row),
                (row["q[0]"], row["q[1]"], row["q[2]"], row["q[3]"]),
                (position["lat"], position.get("lon", NAN), position.get("alt", NAN))
                if "lat" in position
                else None,
                (north, east, down),
            )


class _Newest:
    """The newest row of a topic at non-decreasing times, unless it is too old."""

    def __init__(self, rows: Iterator[Row]) -> None:
        self._rows = rows
        self._row: Row = {}
        self._next: Row | None = next(rows, None)

    def at(self, time_us: int) -> Row:
        while self._next is not None and self._next["timestamp"] <= time_us:
            self._row, self._next = self._next, next(self._rows, None)
        is_new = self._row and time_us - self._row["timestamp"] <= VELOCITY_AGE_US
        return self._row if is_new else {}


def _axes(name: str, count: int = 3) -> tuple[str, ...]:
    return tuple(f"{name}[{axis}]" for axis in range(count))


_NEEDED: Final[dict[str, tuple[tuple[str, ...], ...]]] = {
    "sensor_combined": tuple(
        (axis,) for axis in (*_axes("accelerometer_m_s2"), *_axes("gyro_rad"))
    ),
    "vehicle_magnetometer": tuple((axis,) for axis in _axes("magnetometer_ga")),
    "vehicle_attitude": tuple((axis,) for axis in _axes("q", 4)),
    "vehicle_gps_position": _GPS_FIELDS,
    "sensor_gps": _GPS_FIELDS,
}
"""Required fields by topic: of each tuple one, in addition to the time."""


def _sound_columns(topic: Topic) -> Topic:
    """Leave out columns that are not numeric, or not integers where these are expected."""
    return {
        name: column
        for name, column in topic.items()
        if column.dtype.kind in ("iub" if name in _WHOLE else "iubf")
    }


def _lacks(name: str, topic: Topic) -> bool:
    needed = (("timestamp",), *_NEEDED.get(name, ()))
    return not all(any(field in topic for field in fields) for fields in needed)


_DATA: Final = {
    "IMU": _axes("accelerometer_m_s2"),
    "MAG": _axes("magnetometer_ga"),
    "BARO": ("baro_pressure_pa", "pressure", "baro_alt_meter"),
}
"""Fields of which not all are zero if a sensor has data."""


def _has_data(kind: str, topic: Topic) -> bool:
    if kind == "GPS" and "fix_type" in topic:
        return bool((topic["fix_type"] >= FIX_2D).any())
    fields = [topic[name] for name in _DATA.get(kind, ("timestamp",)) if name in topic]
    return any(bool((np.isfinite(values) & (values != 0)).any()) for values in fields)


def _vector(row: Row, name: str) -> Vec3:
    return (row[f"{name}[0]"], row[f"{name}[1]"], row[f"{name}[2]"])


def _field(row: Row) -> Vec3:
    x, y, z = _vector(row, "magnetometer_ga")
    return (x * UT_PER_GAUSS, y * UT_PER_GAUSS, z * UT_PER_GAUSS)


def _dege7(row: Row, degrees: str, dege7: str) -> int:
    value = row[degrees] / DEG_PER_DEGE7 if degrees in row else row[dege7]
    return round(value) if math.isfinite(value) else 0


def _metres(row: Row, metres: str, millimetres: str) -> float:
    value: float = row[metres] if metres in row else row.get(millimetres, NAN) * M_PER_MM
    return value


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


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a ULog as a flight; raises FlightError if it contains none."""
    log, unread, before = load(path, options, list(TOPICS))
    topics = {(data.name, data.multi_id): data.data for data in reversed(log.data_list)}
    vehicle_id = options.system_id or system_id_of(log)
    try:
        flight = Px4Log(topics, vehicle_id, dict(options.sensors))
    except ValueError as error:
        if lost := log._missing_message_ids:  # noqa: SLF001
            lost = f", and the formats of {counted(len(lost), 'topic')} are lost"
        why = f"{path}: {error}{lost or ''}"
        raise FlightError("; it ".join([why, *damage_of(log, unread)])) from error

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        for record in flight.records():
            yield from builder.add(record)
        yield from builder.flush()

    table = table_of_rows(rows(), options, vehicle_id, flight.unix_us_at_zero)
    remarks = [*before.remarks, *damage_of(log, unread), *_remarks(flight)]
    table.remarks += [f"{path}: {remark}" for remark in remarks]
    return table


def _lost_head(rest: Iterator[bytes], before: bytes) -> Iterator[bytes]:
    """Yield a header if the log lacks it, and the format that lost its name together with it."""
    first = next(rest, b"")
    if not first.startswith(ULOG_HEAD):
        yield ULOG_HEAD + bytes(9)
        cut, _, fields = before.partition(b";")
        is_whole = b"uint64_t timestamp".endswith(cut.rpartition(b":")[2])
        for topic, needed in _NEEDED.items() if is_whole else ():
            names = [{f" {name.partition('[')[0]};".encode() for name in one} for one in needed]
            if all(any(name in b";" + fields for name in one) for one in names):
                text = topic.encode() + b":uint64_t timestamp;" + fields
                yield struct.pack("<Hc", len(text), b"F") + text
    yield first


def load(path: Path, options: ReadOptions, topics: list[str] | None) -> tuple[Any, int, Before]:
    """Read some or all topics of a log; also return the bytes left out at its end and start."""
    whole = read_chunks(path, options.progress, options.unpacked_limit)
    rest, before = skip_to(ULOG_BEGIN, whole)
    with temporary_copy(path, chain(_lost_head(rest, before.text), rest)) as content:
        return *_load(path, name_of(content), topics), before


def system_id_of(log: Any) -> int:
    """Return the system id in the parameters; 1 if there is no valid one."""
    known = log.initial_parameters.get(SYSTEM_ID, 1)
    return known if isinstance(known, int) and 1 <= known <= 255 else 1


def _load(path: Path, copy: str, topics: list[str] | None) -> tuple[Any, int]:
    """Return the log, and the number of bytes at its end that could not be read."""
    # Damage that pyulog prints to the terminal is reported as remarks instead.
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            with _Content(copy) as head:
                _check_formats(ULog(head, parse_header_only=True).message_formats)
            with _Content(copy) as file:
                log = ULog(file, topics)
        except (ULogException, *BROKEN) as error:
            raise FlightError(f"{path}: cannot be read as a ULog: {error}") from error
    return log, file.unread


def _check_formats(formats: dict[str, Any]) -> None:
    """Raise an exception of `BROKEN` for formats that would fill the memory."""

    @cache
    def values_of(kind: str) -> int:
        fields = formats[kind].fields if kind in formats else ()
        return sum(max(count, 1) * values_of(part) for part, count, _ in fields) if fields else 1

    for name in formats:
        if values_of(name) > MOST_VALUES:
            raise ValueError(f"{name} has more values than a message can hold")


def damage_of(log: Any, unread: int) -> Iterator[str]:
    """Yield remarks for the user on damage and gaps of a log."""
    if log.file_corruption:
        yield "is damaged; its intact part was read"
    if unread:
        yield f"left out {counted(unread, 'byte')} at its end that cannot be read"
    if log.dropouts:
        lost_s = sum(dropout.duration for dropout in log.dropouts) / MS_PER_S
        slow = counted(len(log.dropouts), "time")
        yield f"its logger was too slow {slow}; {lost_s:.1f} s of data are missing"


def _remarks(flight: Px4Log) -> Iterator[str]:
    yield from flight.chosen
    if flight.left_out:
        yield f"lacks fields that PX4 documents for {', '.join(flight.left_out)}; left out"
    if flight.dropped:
        yield f"left out {counted(flight.dropped, 'sample')} with an impossible time"
