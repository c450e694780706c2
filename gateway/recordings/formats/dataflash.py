"""DataFlash, ArduPilot's log, as binary (.bin) or text (.log), read with pymavlink.

Messages read: IMU, MAG (milligauss, offsets subtracted), BARO, GPS with the accuracies in GPA, and
the autopilot's estimates: ATT, POS and the velocities of its Kalman filter (XKF1, formerly NKF1).
All are in body FRD and NED, in µs since the start. Of several sensors of a kind one is used.
Firmware before 3.3 counts milliseconds (TimeMS; T in GPS) and names the second sensor IMU2, GPS2
and so on.
"""

import contextlib
import io
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from functools import cache
from importlib.resources import files
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Generic, Protocol, TypeVar

from msgspec.structs import replace
from pymavlink.DFReader import DFReader_binary, DFReader_text

from gateway.geometry.quaternion import from_euler
from gateway.gps_time import GPS_EPOCH_UNIX_US, LEAPS_KNOWN_UNTIL_US, WEEK_US, unix_us_of_gps
from gateway.recordings.columns import Imported, RowBuilder, TableRow
from gateway.recordings.files import (
    DATAFLASH_BEGIN,
    Before,
    FlightError,
    name_of,
    read_chunks,
    skip_to,
    temporary_copy,
)
from gateway.recordings.formats.mavlink import MILLI, VELOCITY_AGE_US, autopilot_state
from gateway.recordings.message_table import MessageTable, read_table
from gateway.recordings.recorded_table import ReadOptions, RecordedTable, table_of_rows
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuCalibrated,
    ImuFlags,
    NodeId,
    Vec3,
)
from gateway.units import DEG_PER_DEGE7, US_PER_S, UT_PER_GAUSS, counted

LATE_US: Final = US_PER_S
"""Messages of one loop are not quite in order; one that is older than this has a damaged time."""
AHEAD_US: Final = 3_600 * US_PER_S
"""Maximum step forward; a message further ahead has a damaged time as well."""
AGREEING: Final = 50
"""Consecutive messages with consistent deviating times that prove a jump of the clock."""
LEAST_AGREEING: Final = 3
"""The same at the end of the log, where no more messages follow."""
FIX_2D: Final = 2
TIME_COLUMNS: Final = ("TimeUS", "TimeMS")
INSTANCES: Final = ("I", "C", "Instance", "Inst", "IMU")
"""Columns with the number of a sensor, filter or battery."""
SENSORS: Final = {
    "IMU": ("AccX", "AccY", "AccZ"),
    "MAG": ("MagX", "MagY", "MagZ"),
    "BARO": ("Press",),
    "GPS": ("Status",),
}
"""Kinds of sensor with several instances; value: columns that are not all zero if it has data."""
ROLLOVER_US: Final = 1024 * WEEK_US
FIRST_LOG_US: Final = 1_262_304_000 * US_PER_S - GPS_EPOCH_UNIX_US
"""The year 2010, as GPS time: the format is not older, so a receiver with an earlier date has a
wrong week number, which restarts every 1024 weeks."""

Message = Any
"""A message with its columns as attributes, in the units of the format."""
Item = TypeVar("Item")
MAGIC: Final = b"\xa3\x95"
MAX_LOOKED_AT: Final = 20_000
"""Messages of a kind that are searched for the first sensor with data: an hour of GPS."""
SYSTEM_IDS: Final = ("SYSID_THISMAV", "MAV_SYSID")
_AS_TEXT: Final = bytes(range(128)) + b"?" * 128
_SKIPPED: Final = re.compile(r"Skipped (\d+) bad bytes")


@cache
def table() -> MessageTable:
    """Return the table of DataFlash."""
    return read_table((files("gateway.recordings.formats") / "dataflash.toml").read_bytes())


def kind_of(name: str) -> str:
    """Return the kind of a message; that of a second sensor was formerly another one."""
    return table().aliases.get(name, (name, 0))[0]


def instance_of(name: str, message: Message) -> int:
    """Return the number of the sensor, filter or battery in a message, from 0."""
    columns = {message.fmt.instance_field, *INSTANCES} & {*message.fmt.columns}
    found = (getattr(message, column) for column in columns)
    number = next((value for value in found if isinstance(value, int)), 0)
    return number or table().aliases.get(name, ("", 0))[1]


def in_era(gps_us: int) -> int:
    """Add the multiple of 1024 weeks that a GPS receiver lacks."""
    lost = -(-(FIRST_LOG_US - gps_us) // ROLLOVER_US) if gps_us < FIRST_LOG_US else 0
    return gps_us + lost * ROLLOVER_US


def own_us_of(name: str, message: Message) -> int:
    """Return a message's time on the autopilot's clock."""
    time_us = getattr(message, "TimeUS", None)
    if time_us is not None:
        return int(time_us)
    return 1000 * int(message.T if kind_of(name) == "GPS" else message.TimeMS)


class LogClock(Generic[Item]):
    """Map autopilot times to times from 0: damaged times are discarded, clock jumps followed."""

    def __init__(self) -> None:
        self.dropped = 0
        """Messages with an impossible time."""
        self.leaps = 0
        """Number of jumps of the autopilot's clock forward by more than `AHEAD_US`."""
        self.restarts = 0
        """Number of restarts of the autopilot's clock."""
        self.is_rolled_over = False
        """Whether a receiver's week number has rolled over."""
        self.is_beyond_leaps = False
        """Whether a date is later than the time up to which leap seconds are known."""
        self.zero_us: int | None = None
        """Autopilot time at zero of the records' clock."""
        self._newest_us = 0
        self._held: list[tuple[int, Item]] = []
        """Items with consistent times that deviate from the times before them."""

    def feed(self, own_us: int | None, item: Item) -> list[tuple[int, Item]]:
        """Process an item with its time on the autopilot's clock; return the items that are timed.

        An item without a time gets that of the one before.
        """
        if own_us is None:
            return [(self._newest_us, item)]
        if self.zero_us is None:
            self.zero_us = own_us
        if -LATE_US <= own_us - self.zero_us - self._newest_us <= AHEAD_US:
            self._drop_held()
            return [self._timed(own_us, item)]
        if self._held and abs(own_us - self._held[-1][0]) > LATE_US:
            self._drop_held()
        self._held.append((own_us, item))
        return self._follow() if len(self._held) == AGREEING else []

    def flush(self) -> list[tuple[int, Item]]:
        """Return the items that are still held at the end of the log."""
        held = self._follow() if len(self._held) >= LEAST_AGREEING else []
        self._drop_held()
        return held

    def utc_us(self, message: Message) -> int | None:
        """Return the civil time of a fix, µs since 1970; None if it has no week number."""
        week = getattr(message, "GWk", 0) or getattr(message, "Week", 0)
        if not week or message.Status < FIX_2D:
            return None
        counted_us = week * WEEK_US + week_ms_of(message) * 1000
        utc_us = unix_us_of_gps(in_era(counted_us))
        self.is_rolled_over |= counted_us < FIRST_LOG_US
        self.is_beyond_leaps |= utc_us > LEAPS_KNOWN_UNTIL_US
        return utc_us

    def _timed(self, own_us: int, item: Item) -> tuple[int, Item]:
        """Return an item with its time on the records' clock, which never decreases."""
        self._newest_us = max(self._newest_us, own_us - (self.zero_us or 0))
        return self._newest_us, item

    def _drop_held(self) -> None:
        self.dropped += len(self._held)
        self._held.clear()

    def _follow(self) -> list[tuple[int, Item]]:
        """Follow the clock to the times of the held items."""
        held, self._held = self._held, []
        step_us = held[0][0] - (self.zero_us or 0) - self._newest_us
        self.leaps += step_us > 0
        self.restarts += step_us < 0
        # After a restart, times continue from the last one.
        self.zero_us = (self.zero_us or 0) + min(step_us, 0)
        return [self._timed(*one) for one in held]


def week_ms_of(message: Message) -> int:
    """Return the time of week of a fix, ms; firmware before 3.3 sends it as TimeMS."""
    week_ms = getattr(message, "GMS", None)
    return int(message.TimeMS if week_ms is None else week_ms)


class ArdupilotReader:
    """Convert the messages of one log to records."""

    def __init__(self, vehicle_id: int, sensors: Mapping[str, int] = MappingProxyType({})) -> None:
        self.clock: LogClock[tuple[str, Message]] = LogClock()
        self._vehicle_id = vehicle_id
        self._sensors = {**sensors, "GPA": sensors.get("GPS", 0)}
        self._mag: Vec3 | None = None
        self._fix: GpsFix | None = None
        """The newest fix, waiting for its accuracies."""
        self._fused_position: tuple[int, Vec3 | None] = (0, None)
        """Time of the estimate; latitude and longitude in degrees, height in m."""
        self._motion: tuple[int, Vec3 | None] = (0, None)
        self._handlers: dict[str, Callable[[Message, int], list[Imported]]] = {
            "IMU": self._imu, "MAG": self._magnetometer, "BARO": self._baro,
            "GPS": self._gps, "GPA": self._accuracies,
            "ATT": self._attitude, "POS": self._position, "XKF1": self._kalman,
            "NKF1": self._kalman,
        }  # fmt: skip

    @property
    def names(self) -> set[str]:
        """Names of the messages that are read."""
        former = (name for name, (kind, _) in table().aliases.items() if kind in self._handlers)
        return {*self._handlers, *former}

    def feed(self, name: str, message: Message) -> list[Imported]:
        """Process the next message."""
        kind = kind_of(name)
        if kind not in self._handlers or instance_of(name, message) != self._sensors.get(kind, 0):
            return []
        return self._handle(self.clock.feed(own_us_of(name, message), (kind, message)))

    def flush(self) -> list[Imported]:
        """Return the records that are still held at the end of the log."""
        return [*self._handle(self.clock.flush()), *self._flush_fix()]

    def _handle(self, timed: Iterable[tuple[int, tuple[str, Message]]]) -> list[Imported]:
        """Handle messages at their times."""
        found: list[Imported] = []
        for time_us, (kind, message) in timed:
            found += [] if kind == "GPA" else self._flush_fix()
            found += self._handlers[kind](message, time_us)
        return found

    def _flush_fix(self) -> list[Imported]:
        """Return the fix that is waiting for its accuracies, if any."""
        fix, self._fix = self._fix, None
        return [] if fix is None else [fix]

    def _imu(self, m: Message, time_us: int) -> list[Imported]:
        mag, self._mag = self._mag, None
        return [
            ImuCalibrated(
                time_us=time_us,
                node=NodeId(self._vehicle_id, 0),
                accel_b_mps2=(m.AccX, m.AccY, m.AccZ),
                gyro_b_radps=(m.GyrX, m.GyrY, m.GyrZ),
                mag_b_ut=mag,
                temperature_degc=getattr(m, "T", getattr(m, "Temp", NAN)),
                flags=ImuFlags.MAG_NEW if mag else ImuFlags(0),
            )
        ]

    def _magnetometer(self, m: Message, _time_us: int) -> list[Imported]:
        ut = MILLI * UT_PER_GAUSS
        self._mag = (m.MagX * ut, m.MagY * ut, m.MagZ * ut)
        return []

    def _baro(self, m: Message, time_us: int) -> list[Imported]:
        node = NodeId(self._vehicle_id, 0)
        return [BaroRaw(time_us, node, time_us, m.Press, getattr(m, "Temp", NAN))]

    def _gps(self, m: Message, time_us: int) -> list[Imported]:
        fix_type = GpsFixType(min(m.Status, 3)) if m.Status >= FIX_2D else GpsFixType.NONE
        has_fix = fix_type is not GpsFixType.NONE
        course_rad = math.radians(m.GCrs)
        level = (m.Spd * math.cos(course_rad), m.Spd * math.sin(course_rad))
        self._fix = GpsFix(
            time_us=time_us,
            node=NodeId(self._vehicle_id, 1),
            node_time_us=time_us,
            itow_ms=week_ms_of(m),
            fix_type=fix_type,
            fix_ok=has_fix,
            satellites=m.NSats,
            lat_dege7=round(m.Lat / DEG_PER_DEGE7),
            lon_dege7=round(m.Lng / DEG_PER_DEGE7),
            alt_amsl_m=m.Alt,
            vel_n_mps=(*level, getattr(m, "VZ", NAN)) if has_fix else UNKNOWN_VEC3,
            alt_ellipsoid_m=NAN,
            h_acc_m=NAN,
            v_acc_m=NAN,
            speed_acc_mps=NAN,
            course_acc_deg=NAN,
            pdop=NAN,
            utc_us=self.clock.utc_us(m),
        )
        return []

    def _accuracies(self, m: Message, time_us: int) -> list[Imported]:
        """Add the receiver's accuracies, which follow a fix, to the fix."""
        fix = self._fix
        if fix is None or fix.time_us != time_us:
            return self._flush_fix()
        north, east, down = fix.vel_n_mps
        self._fix = replace(
            fix,
            vel_n_mps=(north, east, down if getattr(m, "VV", 1) else NAN),
            h_acc_m=m.HAcc or NAN,
            v_acc_m=m.VAcc or NAN,
            speed_acc_mps=m.SAcc or NAN,
        )
        return self._flush_fix()

    def _position(self, m: Message, time_us: int) -> list[Imported]:
        self._fused_position = (time_us, (m.Lat, m.Lng, m.Alt))
        return []

    def _kalman(self, m: Message, time_us: int) -> list[Imported]:
        self._motion = (time_us, (m.VN, m.VE, m.VD))
        return []

    def _attitude(self, m: Message, time_us: int) -> list[Imported]:
        """Return the autopilot's own solution, for comparison."""
        position, vel_n_mps = (
            value if time_us - newest_us <= VELOCITY_AGE_US else None
            for newest_us, value in (self._fused_position, self._motion)
        )
        angles_rad = (math.radians(degrees) for degrees in (m.Roll, m.Pitch, m.Yaw))
        return [
            autopilot_state(time_us, from_euler(*angles_rad), position, vel_n_mps or UNKNOWN_VEC3)
        ]


class PrintedDamage(io.TextIOBase):
    """Count the damage that pymavlink reports on the terminal."""

    def __init__(self) -> None:
        self.before = Before()
        self.bytes = self.messages = 0
        self.was_printed = False

    def write(self, text: str) -> int:
        """Add the number of bytes that are reported as skipped."""
        self.was_printed = True
        self.bytes += sum(map(int, _SKIPPED.findall(text)))
        return len(text)

    def counting(self, call: Callable[[], Any]) -> Any:
        """Make a call, and count the damage that it prints."""
        with contextlib.redirect_stdout(self), contextlib.redirect_stderr(self):
            return call()


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a DataFlash log as a flight; raises FlightError if it contains none."""
    damage = PrintedDamage()
    log = open_log(path, options, damage)
    vehicle_id = options.system_id or system_id_of(log.params)
    sensors = sensors_of(log, damage) | dict(options.sensors)
    reader = ArdupilotReader(vehicle_id, sensors)
    remarks = [f"{path}: uses {kind} {number + 1}" for kind, number in sensors.items() if number]

    def rows() -> Iterator[TableRow]:
        builder = RowBuilder()
        with contextlib.closing(log):
            for record in items_of(log, damage, reader):
                yield from builder.add(record)
            yield from builder.flush()
            remarks.extend(f"{path}: {remark}" for remark in remarks_of(log, damage, reader.clock))

    stream = rows()
    first = next((row for row in stream if row.imu is not None), None)
    if first is None:
        raise FlightError(f"{path}: {_why_empty(log, damage, reader)}")
    zero_us = unix_us_at(log, reader.clock.zero_us or 0)
    table = table_of_rows(chain([first], stream), options, vehicle_id, zero_us)
    table.remarks = remarks
    return table


def system_id_of(parameters: Mapping[str, float]) -> int:
    """Return the system id in the parameters; 1 if there is no valid one."""
    named = (parameters.get(name) for name in SYSTEM_IDS)
    known = next((int(value) for value in named if value is not None), 1)
    return known if 1 <= known <= 255 else 1


def unix_us_at(log: Any, own_us: int) -> int | None:
    """Return the civil time at a time of the autopilot's clock; None without GPS time.

    It is derived from the first GPS week and time, to which pymavlink applies the present number
    of leap seconds.
    """
    clock = log.clock
    if not clock.timebase:
        return None
    zero_us = round((clock.timebase - clock._gpsTimeToTime(0, 0)) * US_PER_S)  # noqa: SLF001
    return unix_us_of_gps(in_era(zero_us + own_us))


def _why_empty(log: Any, damage: PrintedDamage, reader: ArdupilotReader) -> str:
    """Return the reason why a log contains no IMU samples."""
    formats = {known.name: {*known.columns} for known in log.formats.values()}
    if not formats.keys() - {"FMT"}:
        return "it has no list of formats (FMT), without which its messages cannot be decoded"
    needed = {*SENSORS["IMU"], "GyrX", "GyrY", "GyrZ"}
    for name, columns in formats.items():
        lacking = needed - columns | ({"TimeUS"} if columns.isdisjoint(TIME_COLUMNS) else set())
        if kind_of(name) == "IMU" and lacking:
            return (
                f"its {name} messages cannot be decoded: they have no {', '.join(sorted(lacking))}"
                ", as in a log of sdlog2, PX4's logger before ULog, which is not supported"
            )
    if damage.messages or reader.clock.dropped:
        return "none of its IMU messages can be decoded"
    return "contains no IMU messages, so there is nothing to fuse"


def sensors_of(log: Any, damage: PrintedDamage) -> dict[str, int]:
    """Find the first sensor of each kind that has data; for GPS, a fix."""
    found: dict[str, int] = {}
    for kind, columns in SENSORS.items():
        names = {kind, *(name for name, (of, _) in table().aliases.items() if of == kind)}
        least = FIX_2D if kind == "GPS" else 0.0
        seen: set[int] = set()
        for message in islice(each_of(log, damage, names), MAX_LOOKED_AT):
            values = (getattr(message, column, 0) for column in columns)
            if any(isinstance(v, int | float) and abs(v) >= least and v != 0 for v in values):
                seen.add(instance_of(message.get_type(), message))
            if 0 in seen:
                break
        found[kind] = min(seen, default=0)
    return found


def each_of(log: Any, damage: PrintedDamage, names: set[str]) -> Iterator[Any]:
    """Yield the messages of these names up to the first damage, and rewind the log."""
    log.type_list = None
    try:
        while message := damage.counting(lambda: log.recv_match(type=names, strict=True)):
            yield message
    except Exception:  # noqa: BLE001 - as for `open_log`
        return
    finally:
        log._rewind(keep_messages=True)  # noqa: SLF001 - the public one clears the parameters


def open_log(path: Path, options: ReadOptions, damage: PrintedDamage) -> Any:
    """Open a temporary copy of a log, unpacked.

    pymavlink memory-maps a log; if the file shrank, the process would be killed.
    """
    whole = read_chunks(path, options.progress, options.unpacked_limit)
    content, damage.before = skip_to(DATAFLASH_BEGIN, whole)
    first = next(content, b"")
    is_binary = first.startswith(MAGIC)
    kind = DFReader_binary if is_binary else DFReader_text
    # Replace bytes that are not ASCII, so that reading continues.
    all_of_it = chain([first], content)
    sound = all_of_it if is_binary else (data.translate(_AS_TEXT) for data in all_of_it)
    with temporary_copy(path, sound) as plain:
        log = kind.__new__(kind)
        # The fast indexer prints to the terminal directly, not through Python's stdout.
        log.init_arrays_fast = log.init_arrays
        try:
            damage.counting(lambda: kind.__init__(log, name_of(plain)))
        except Exception as error:
            # On damaged logs pymavlink raises any exception, including bare ones.
            log.close()
            raise FlightError(f"{path}: its list of formats is damaged: {error}") from error
        return log


class MessageReader(Protocol[Item]):
    """Process the messages of a log one by one."""

    @property
    def names(self) -> set[str]:
        """Names of the messages that are read."""
        ...

    def feed(self, name: str, message: Message) -> list[Item]:
        """Process the next message."""
        ...

    def flush(self) -> list[Item]:
        """Return the items that are still held at the end of the log."""
        ...


def items_of(log: Any, damage: PrintedDamage, reader: MessageReader[Item]) -> Iterator[Item]:
    """Read the whole log; a message that cannot be decoded is counted.

    If the log is intact, only the needed messages are decoded. The index of a damaged one ends at
    the damage, so it is read message by message.
    """

    def wanted() -> Any:
        return log.recv_match(type=reader.names, strict=True)

    take = log.recv_msg if damage.was_printed else wanted
    lines, end = 0, -1
    while True:
        begin = log.offset
        try:
            message = damage.counting(take)
            # Instead of an invalid line pymavlink returns the next message, and again later.
            is_again, end = log.offset == end, log.offset
            found = [] if message is None or is_again else reader.feed(message.get_type(), message)
        except Exception:  # noqa: BLE001 - as above
            damage.messages += 1
            log.offset = max(log.offset, begin + 1)
            continue
        if message is None:
            yield from reader.flush()
            break
        lines += not is_again
        yield from found
    if isinstance(log, DFReader_text):
        damage.messages = _lines_of(log, reader.names) - lines


def _lines_of(log: Any, names: set[str]) -> int:
    """Count the lines of a text log that should be these messages, or have an unknown format."""
    odd = {name for name in log.counts if name.strip() and name not in log.formats}
    return sum(log.counts.get(name, 0) for name in names | odd)


def remarks_of(log: Any, damage: PrintedDamage, clock: LogClock[Any]) -> Iterator[str]:
    """Yield remarks for the user on a log that was read."""
    yield from damage.before.remarks
    if damage.bytes:
        yield f"is damaged: left out {counted(damage.bytes, 'byte')} that belong to no message"
    if log.offset < log.data_len:
        yield f"ends within a message: left out {counted(log.data_len - log.offset, 'byte')}"
    if broken := clock.dropped + damage.messages:
        yield f"is damaged: left out {counted(broken, 'message')} that cannot be decoded"
    if clock.leaps:
        yield f"its clock jumped forward {counted(clock.leaps, 'time')}"
    if clock.restarts:
        yield f"the autopilot restarted {counted(clock.restarts, 'time')}; its times continue"
    if clock.is_rolled_over:
        yield "its GPS receiver counts 1024 weeks too few; its dates are corrected"
    if clock.is_beyond_leaps:
        known = datetime.fromtimestamp(LEAPS_KNOWN_UNTIL_US / US_PER_S, UTC)
        yield f"its dates assume no leap second since {known:%d %B %Y}"
