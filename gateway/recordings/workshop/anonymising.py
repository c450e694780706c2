"""Remove the coordinates, dates and names of the people who flew from recordings.

The table `private_fields.toml`, whose head explains it, states the treatment of each field. A
message is left out unless the table lists all of its fields, and a command unless it is listed.

Locations are moved by one offset, so that distances are preserved: longitudes are scaled by the
ratio of the cosines of the two latitudes. Dates are moved by whole days. A value that anybody could
guess, such as a default location or the date of a clock that was never set, would reveal the
offset. So locations far from all others, and dates more than a year from all others, are moved by
offsets of their own.
"""

import math
import re
import struct
import tomllib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import date
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.gps_time import GPS_EPOCH_UNIX_US
from gateway.recordings.recorded_clock import DAY_US, LAST_CIVIL_US
from gateway.recordings.tlog_source import TlogSource
from gateway.recordings.vehicle_reader import VehicleReader
from gateway.recordings.workshop.editing import FrameEdit
from gateway.recordings.workshop.selection import FrameChoice
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import CRC_SIZE, FLAGS, edit_frame
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import (
    DEFINITIONS,
    MESSAGE_IDS,
    MESSAGE_NAMES,
    base_size,
    layout_of,
)
from gateway.wire.mavlink_splitter import (
    PAYLOAD_V1,
    PAYLOAD_V2,
    SIGNED,
    START_V2,
    MavFrame,
    frame_of,
)
from gateway.wire.recorded_frames import LENGTH_AT, Batch, columns_of, fields_of

BoolArray = NDArray[np.bool_]

SYSTEM_TIME_ID: Final = MESSAGE_IDS["SYSTEM_TIME"]
LOCAL_FRAMES: Final = frozenset({1, 4, 7, 8, 9, 12, 20, 21})
"""Values of MAV_FRAME whose coordinates are in m; all others may be latitudes and longitudes."""
WEEK_MS: Final = 7 * 86_400_000
US_PER_MS: Final = 1000
YEAR_US: Final = 366 * DAY_US
"""Dates further apart are of different clocks."""
MAX_APART_DEG: Final = 4.5
"""Locations further apart, 500 km, are not of one flight: more than ADS-B receives."""
MAX_GROUPS: Final = 1000
"""Maximum number of groups of locations or dates; later ones join the first."""
MAX_NAMES: Final = 60_000
"""Identifiers that get a number of their own; all later ones share one number."""
MAX_PLACE_DEG: Final = 80.0
"""Greatest latitude to move to: nearer to a pole, a flight would not fit between meridians."""
FIRST_DAY, LAST_DAY = date(2000, 1, 1), date(2099, 12, 31)
"""Days to which recordings can be moved: earlier times are taken for times since boot."""
NEAR_DEG: Final = 0.002
"""A named value this close to a coordinate of the flight, 200 m, is taken for it."""
FULL_TURN_DEG: Final = 360.0
PARAMETERS: Final = ("param1", "param2", "param3", "param4", "param5", "param6", "param7")
ITEM_PARAMETERS: Final = (*PARAMETERS[:4], "x", "y", "z")
TABLE: Final = "private_fields.toml"
OUT: Final = "out"
COORDINATES: Final = {"degE7": DEGE7_PER_DEG, "deg": 1.0}
"""Units of coordinates, in 1/deg."""
TICKS: Final = {"s": 1, "ms": 1000, "us": 1_000_000, "ns": 1_000_000_000}
"""Units of dates, per second."""
EPOCHS_S: Final = {"date": 0, "date1980": GPS_EPOCH_UNIX_US // US_PER_S, "date2019": 1_546_300_800}
"""Times from which dates count, s since 1970."""
WORDS: Final = ("text", "id", "label", "week", "command")
"""Treatments other than coordinates, dates and fixed values."""
_HARMLESS: Final = re.compile(
    r"^OSD\d.*|LATENCY|LATERAL|LATCH|PLAT(FORM)?|FLAT|RELAT|TRANSLAT|ISOLAT|ALONG|LONGITUDINAL|"
    r"FS_LONG|COLON|CPLNG|LNGTH|SERIAL_?PASS\d|SLCAN_SERNUM|DECL_(TYPE|A)$|RALLY_INCL|UPDATE|VALIDATE|CANDIDATE|"
    r"GUID(?!$)|MACRO|MACH|RSSI"
)
"""Parts of names that contain a part of a private name by chance."""
_PRIVATE: Final = re.compile(
    # Location, also by the magnetic field and by the time zone.
    r"LAT|LON|LNG|LONG|COORD|ECEF|EASTING|NORTHING|UTM|MGRS|GEOHASH|DECL|(MAG|COMPASS)_?DEC$|INCLIN"
    r"|MAG_?INC|(?<![A-Z])(DIP|INCL)(?![A-Z])|SIH_LOC|TIME_?ZONE|UTC|(?<![A-Z])TZ(?![A-Z])|QNH|COUNTRY|"
    # Date.
    r"DATE|(YY|DD)MM(YY|DD)|EPOCH|UNIX|^STAT_|LND_FLIGHT_T|FLIGHT_?UUID|"
    # Device, network, owner.
    r"MAC_?(ADDR|$|\d)|IP_?ADDR|GW_?ADDR|(?<![A-Z])(IP|GW|DNS)\d*$|(?<![A-Z])HOST|GATEWAY|SSID|WIFI"
    r"|PASSW|PASS_?(PHRASE|KEY)|(?<![A-Z])PASS\d*$|PWD|PSK|(?<!PARAM\d_)(?<![A-Z])KEY|SECRET|TOKEN|"
    r"UUID|GUID$|(?<![A-Z])UID|IMEI|IMSI|ICCID|(?<![A-Z])(APN|MCC|MNC|LAC)(?![A-Z])|CELL_?ID|PHONE|"
    r"EMAIL|SERIAL_?(N(?!T)|$)|(?<![A-Z])SERN|(?<![A-Z])SN\d*$|ICAO|MMSI|CALL_?SIGN|SQUAWK|REGISTR|TAIL_?N|OWNER"
)
"""Parts of the names of parameters and other values that reveal a location, date or identity."""


@dataclass(frozen=True, slots=True)
class Pair:
    """A latitude and a longitude among the fields of a message."""

    lat: str
    lon: str
    per_deg: float
    framed: bool = False
    """Whether the field `frame` decides whether they are coordinates."""


@dataclass(frozen=True, slots=True)
class Treatment:
    """The fields of a message that are changed."""

    pairs: tuple[Pair, ...] = ()
    dates: tuple[tuple[str, int, int], ...] = ()
    """Fields, ticks per second, and zero in s since 1970."""
    weeks: tuple[tuple[str, str], ...] = ()
    """GPS weeks and times of the week in ms."""
    numbered: tuple[str, ...] = ()
    label: str | None = None
    """Field with the name of the value in the message."""
    fixed: tuple[tuple[str, float], ...] = ()
    has_command: bool = False

    @property
    def is_empty(self) -> bool:
        """Whether the message is kept as it is."""
        return self == Treatment()


@cache
def _table() -> dict[str, dict[str, str]]:
    return tomllib.loads(files("gateway.recordings.workshop").joinpath(TABLE).read_text("utf-8"))


def unlisted_fields(message_id: int) -> set[str]:
    """Return the fields of a message that the table lacks; all if it lacks the message."""
    listed = _table()["messages"].get(DEFINITIONS[message_id].msgname, "")
    names = {name for item in listed.split() for name in item.partition(":")[0].split("+")}
    return set() if listed == OUT else set(DEFINITIONS[message_id].fieldnames) - names


@cache
def treatment_of(message_id: int) -> Treatment | None:
    """Return the treatment of a message; None if it is left out."""
    if message_id not in DEFINITIONS or unlisted_fields(message_id):
        return None
    listed = _table()["messages"][DEFINITIONS[message_id].msgname]
    items = [item.partition(":")[::2] for item in listed.split() if ":" in item]
    if listed == OUT:
        return None
    pairs, dates, fixed = [], [], []
    for names, how in items:
        kind, _, unit = how.rpartition("_")
        if unit in COORDINATES:
            lat, lon = names.split("+")
            pairs.append(Pair(lat, lon, COORDINATES[unit], framed=kind == "framed"))
        elif kind in EPOCHS_S:
            dates.append((names, TICKS[unit], EPOCHS_S[kind]))
        elif how not in WORDS:
            fixed.append((names, float(how)))
    of = {word: [names for names, how in items if how == word] for word in WORDS}
    weeks = [tuple(names.split("+")) for names in of["week"]]
    return Treatment(
        tuple(pairs), tuple(dates), tuple((week, ms) for week, ms in weeks),
        (*of["text"], *of["id"]), next(iter(of["label"]), None), tuple(fixed),
        has_command=bool(of["command"]),
    )  # fmt: skip


def parameters_of(command: int, mount_mode: float) -> str | None:
    """Return the treatments of a command's parameters, one letter each; None if it is left out.

    `mount_mode` is parameter 7, which decides the meaning of the others of DO_MOUNT_CONTROL.
    """
    entry = mavlink.enums["MAV_CMD"].get(command)
    name = "" if entry is None else entry.name.removeprefix("MAV_CMD_")
    if name == "DO_MOUNT_CONTROL" and mount_mode == mavlink.MAV_MOUNT_MODE_GPS_POINT:
        name += ".GPS_POINT"
    listed = _table()["commands"].get(name, OUT)
    return None if listed == OUT else listed


def is_private(label: bytes) -> bool:
    """Return whether the value of this name reveals a location, a date or an identity."""
    name = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", text_of(label)).upper()
    return _PRIVATE.search(_HARMLESS.sub(" ", name)) is not None


@dataclass(frozen=True, slots=True)
class Anonymity:
    """The location and day to which recordings are moved."""

    lat_deg: float = 0.0
    lon_deg: float = 0.0
    day: date = date(2020, 1, 1)
    keep_unknown: bool = False
    """Keep messages that are not in the dialect."""


def first_of(
    sources: Iterable[TlogSource], choice: FrameChoice
) -> tuple[tuple[float, float] | None, int | None]:
    """Return the first valid position of a vehicle, deg, and the first date in SYSTEM_TIME, µs."""
    location: tuple[float, float] | None = None
    date_us: int | None = None
    for source in sources:
        reader = VehicleReader(source.senders, with_attitude=False)
        for batch in map(choice.apply, source.batches(strict=True)):
            if location is None:
                found = (m.position for m in reader.feed_batch(batch) if m.position is not None)
                location = next(((at.lat_deg, at.lon_deg) for at in found), None)
            if date_us is None:
                rows = np.flatnonzero(batch.message_ids == SYSTEM_TIME_ID)
                times_us = columns_of(batch, rows, SYSTEM_TIME_ID)["time_unix_usec"]
                dates = times_us[(times_us > GPS_EPOCH_UNIX_US) & (times_us < LAST_CIVIL_US)]
                date_us = int(dates[0]) if len(dates) else None
            if location is not None and date_us is not None:
                return location, date_us
    return location, date_us


class MovedDates:
    """Dates moved by whole days: the first one of each clock to a given day."""

    def __init__(self, day: date) -> None:
        self._day = (day - date(1970, 1, 1)).days
        self._clocks: list[list[int]] = []
        """Newest time of each clock in µs, and its shift in days."""

    def shift_us(self, time_us: int, *, after_us: int = 0, like: "MovedDates | None" = None) -> int:
        """Return the shift of a time, which a new clock moves to `after_us` or later.

        A new clock that agrees with one of another object within a day is moved as that one.
        """
        if (clock := self.nearest(time_us, YEAR_US)) is None:
            same = None if like is None else like.nearest(time_us, DAY_US)
            days = self._day - time_us // DAY_US if same is None else same[1]
            days += max(0, -((time_us + days * DAY_US - after_us) // DAY_US))
            clock = [time_us, days]
            if len(self._clocks) == MAX_GROUPS:
                clock = self._clocks[0]
            else:
                self._clocks.append(clock)
        clock[0] = time_us
        return clock[1] * DAY_US

    def nearest(self, time_us: int, within_us: int) -> list[int] | None:
        """Return the newest time in µs and the shift in days of the clock nearest to a time."""
        near = min(self._clocks, key=lambda clock: abs(clock[0] - time_us), default=None)
        return near if near is not None and abs(near[0] - time_us) <= within_us else None


class MovedLocations:
    """Locations moved to another place, with their distances."""

    def __init__(self, anonymity: Anonymity) -> None:
        self._anonymity = anonymity
        self._groups: list[tuple[float, float]] = []
        """The first location of each group, deg."""
        self._newest: list[tuple[float, float]] = []

    def moved(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        """Return the latitude and longitude to which a location is moved."""
        first_lat, first_lon = self._group_of(lat_deg, lon_deg)
        to = self._anonymity
        lat = max(-90.0, min(90.0, to.lat_deg + lat_deg - first_lat))
        scale = math.cos(math.radians(first_lat)) / math.cos(math.radians(to.lat_deg))
        return lat, _wrapped(to.lon_deg + _wrapped(lon_deg - first_lon) * scale)

    def _group_of(self, lat_deg: float, lon_deg: float) -> tuple[float, float]:
        for known in (self._newest, self._groups):
            for number, at in enumerate(known):
                if _is_near(*at, lat_deg, lon_deg):
                    self._newest[number] = lat_deg, lon_deg
                    return self._groups[number]
        if len(self._groups) == MAX_GROUPS:
            return self._groups[0]
        self._groups.append((lat_deg, lon_deg))
        self._newest.append((lat_deg, lon_deg))
        return lat_deg, lon_deg

    def includes(self, value: float) -> bool:
        """Return whether a number may be a latitude or longitude of a group, in usual units."""
        if not math.isfinite(value) or not value:
            return False
        degrees = (value / DEGE7_PER_DEG, value / 1e6, value, math.degrees(value))
        is_round = abs(value - round(value, 2)) < 1e-6 * abs(value)
        return any(
            abs(known) >= 1.0 and abs(each - known) < NEAR_DEG
            for group in self._groups
            for known in group
            for each in degrees[: 2 if is_round else None]
        )


class Anonymiser(FrameEdit):
    """Anonymise the frames of a recording."""

    def __init__(self, anonymity: Anonymity) -> None:
        super().__init__()
        self._keep_unknown = anonymity.keep_unknown
        self.changed: Counter[tuple[str, str]] = Counter()
        """Number of changed fields, by message and field."""
        self._names: dict[bytes, int] = {}
        self._locations = MovedLocations(anonymity)
        self._records, self._dates = MovedDates(anonymity.day), MovedDates(anonymity.day)
        self._first_date_us: int | None = None
        self._last_us = 0

    def prepare(self, sources: Sequence[TlogSource], choice: FrameChoice) -> None:
        """Find the location and the date that are moved to the target."""
        location, self._first_date_us = first_of(sources, choice)
        if location is not None:
            self._locations.moved(*location)

    def retimed(self, batch: Batch) -> Batch:
        """Return the next batch with moved times of its records."""
        if not len(batch):
            return batch
        times, moved = batch.time_us, batch.time_us.copy()
        steps = np.flatnonzero(np.abs(np.diff(times)) > YEAR_US) + 1
        for begin, end in zip([0, *steps.tolist()], [*steps.tolist(), len(times)], strict=True):
            moved[begin:end] += self._records.shift_us(int(times[begin]), after_us=self._last_us)
            self._records.shift_us(int(times[end - 1]))
            self._last_us = int(moved[end - 1])
        if self._first_date_us is not None:
            self._dates.shift_us(self._first_date_us, like=self._records)
            self._first_date_us = None
        return replace(batch, time_us=moved)

    def affects(self, batch: Batch) -> BoolArray:
        """Return which frames may change."""
        data = np.frombuffer(batch.data, np.uint8)
        starts = batch.starts + TIME_SIZE
        is_signed = (data[starts] == START_V2) & (data[starts + FLAGS] & SIGNED > 0)
        ids, kinds = np.unique(batch.message_ids, return_inverse=True)
        sizes = np.array([_kept_size(message_id) for message_id in ids.tolist()])
        found: BoolArray = is_signed | (data[starts + LENGTH_AT] > sizes[kinds])
        return found

    def edit(self, frame: bytes) -> bytes | None:
        """Return the anonymised frame; None if it must be left out."""
        read = frame_of(frame)
        treatment = None if _is_short(read) else treatment_of(read.message_id)
        if treatment is None:
            return self._unlisted(read)
        name, fields = MESSAGE_NAMES[read.message_id], fields_of(frame)
        if reason := self._private_part(treatment, fields):
            self.left_out[name, reason] += 1
            return None
        changes = self._changes(treatment, fields, read.message_id)
        changes = {k: v for k, v in changes.items() if not _is_equal(v, fields[k])}
        is_longer = frame[LENGTH_AT] > layout_of(read.message_id).itemsize
        if not changes and not read.signed and not is_longer:
            return frame
        self.changed.update((name, field) for field in changes)
        self.changed[name, "signature"] += read.signed
        self.changed[name, "unknown fields"] += is_longer
        known = _known_part(read) if is_longer else read
        edited = edit_frame(known, fields=changes, drop_signature=True)
        return None if edited is None else edited.data

    def _unlisted(self, frame: MavFrame) -> bytes | None:
        """Keep a frame of a message that is in no dialect, if wanted; leave out any other."""
        name = MESSAGE_NAMES.get(frame.message_id)
        # A signature contains the time, and cannot be removed without a checksum.
        if name is None and self._keep_unknown and not frame.signed:
            return frame.data
        self.left_out[name or f"unknown message {frame.message_id}", ""] += 1
        return None

    def _private_part(self, treatment: Treatment, fields: Mapping[str, Any]) -> str:
        """Return why a message must be left out: its command or its label; empty if it is kept."""
        if treatment.has_command and _parameters_of(fields) is None:
            return f"command {fields['command']}"
        if treatment.label is None:
            return ""
        label = fields[treatment.label]
        value = fields.get("param_value", fields.get("value"))
        numbers = [value] if isinstance(value, int | float) else []
        if isinstance(value, float):
            # PX4 sends integers as their bytes.
            numbers += struct.unpack("<i", struct.pack("<f", value))
        return (
            text_of(label)
            if is_private(label)
            or any(self._locations.includes(each) or self._is_date(each) for each in numbers)
            else ""
        )

    def _changes(
        self, treatment: Treatment, fields: Mapping[str, Any], message_id: int
    ) -> dict[str, Any]:
        changes: dict[str, Any] = dict(treatment.fixed)
        if treatment.has_command:
            changes |= self._parameters(fields)
        for pair in treatment.pairs:
            if not (pair.framed and fields["frame"] in LOCAL_FRAMES):
                changes |= self._moved(fields, pair)
        for field in treatment.numbered:
            changes[field] = self._numbered(message_id, field, fields[field])
        if treatment.label is not None:
            changes[treatment.label] = fields[treatment.label].split(b"\0", 1)[0]
        for field, per_s, zero_s in treatment.dates:
            changes[field] = self._moved_date(fields[field], per_s, zero_s, message_id, field)
        for week, ms in treatment.weeks:
            if fields[week]:
                time_us = (fields[week] * WEEK_MS + fields[ms]) * US_PER_MS + GPS_EPOCH_UNIX_US
                moved_us = time_us + self._dates.shift_us(time_us, like=self._records)
                moved_ms = max(moved_us - GPS_EPOCH_UNIX_US, 0) // US_PER_MS
                changes |= {week: moved_ms // WEEK_MS, ms: moved_ms % WEEK_MS}
        return changes

    def _moved(self, fields: Mapping[str, Any], pair: Pair) -> dict[str, float]:
        """Move a latitude and a longitude, if both are known; set a single one to 0."""
        values = fields[pair.lat], fields[pair.lon]
        is_float, per_deg = isinstance(values[0], float), pair.per_deg
        if is_float and (abs(values[0]) > 90.0 or abs(values[1]) > 180.0):
            # Some programs send degE7 as float.
            per_deg = DEGE7_PER_DEG
        lat_deg, lon_deg = values[0] / per_deg, values[1] / per_deg
        is_known = abs(lat_deg) <= 90.0 and abs(lon_deg) <= 180.0
        if not (is_known and all(values)):
            # The largest integers and NaN mean unknown, and so do zeros.
            names = zip((pair.lat, pair.lon), values, strict=True)
            return {name: 0 for name, value in names if not _is_unknown(value)}
        moved = [axis * per_deg for axis in self._locations.moved(lat_deg, lon_deg)]
        if not is_float:
            moved = [round(axis) for axis in moved]
        if not any(moved):
            # 1 cm off, because 0, 0 would mean unknown.
            moved = [1, 1] if not is_float else [per_deg / DEGE7_PER_DEG] * 2
        return dict(zip((pair.lat, pair.lon), moved, strict=True))

    def _parameters(self, fields: Mapping[str, Any]) -> dict[str, float]:
        changes: dict[str, float] = {}
        names, is_local = _names_of(fields), fields.get("frame") in LOCAL_FRAMES
        for number, treatment in enumerate(_parameters_of(fields) or ""):
            name, value = names[number], fields[names[number]]
            if treatment == "A" and not is_local:
                per_deg = DEGE7_PER_DEG if isinstance(value, int) else 1.0
                changes |= self._moved(fields, Pair(name, names[number + 1], per_deg))
            is_cleared = (
                (treatment == "0" and not math.isnan(value))
                or (name not in changes and self._locations.includes(value))
                or (treatment == "a" and abs(value) > FULL_TURN_DEG)
                or (treatment == "T" and abs(value) * US_PER_S > GPS_EPOCH_UNIX_US)
            )
            if is_cleared:
                changes[name] = 0
        return changes

    def _numbered(self, message_id: int, field: str, value: Any) -> Any:
        """Return a numbered identifier in place of the original; an empty one stays empty."""
        kind = layout_of(message_id)[field]
        if isinstance(value, bytes):
            number = self._number(value.rstrip(b"\0"))
            return f"X{number}".encode()[: kind.itemsize] if number else b""
        if isinstance(value, int):
            return self._number(value.to_bytes(8, "little").rstrip(b"\0"))
        original = bytes(value)
        number = self._number(original.rstrip(b"\0"))
        return np.frombuffer(number.to_bytes(len(original), "little"), np.uint8)

    def _is_date(self, value: float) -> bool:
        """Return whether a number, in s since 1970, is within a year of the recording's dates."""
        if not GPS_EPOCH_UNIX_US < value * US_PER_S < LAST_CIVIL_US:
            return False
        clocks = (self._dates, self._records)
        return any(clock.nearest(round(value * US_PER_S), YEAR_US) for clock in clocks)

    def _number(self, original: bytes) -> int:
        """Return the number of an identifier, from 1; 0 for an empty one."""
        if not original:
            return 0
        if len(self._names) >= MAX_NAMES:
            return self._names.get(original, MAX_NAMES)
        return self._names.setdefault(original, len(self._names) + 1)

    def _moved_date(self, value: int, per_s: int, zero_s: int, message_id: int, field: str) -> int:
        """Move a time, if it is a date; 0 if the moved date does not fit the field."""
        if not value:
            return value
        time_us = value * US_PER_S // per_s + zero_s * US_PER_S
        if not GPS_EPOCH_UNIX_US < time_us < LAST_CIVIL_US:
            # Some programs send another unit.
            units = (each for each in TICKS.values() if self._is_date(value / each))
            if (per_s := next(units, 0)) == 0:
                return value
            time_us = value * US_PER_S // per_s
        shift_s = self._dates.shift_us(time_us, like=self._records) // US_PER_S
        moved = value + shift_s * per_s
        limit = np.iinfo(layout_of(message_id)[field]).max
        return moved if 0 <= moved <= limit else 0


def _kept_size(message_id: int) -> int:
    """Return the largest payload of a message that is kept as it is; -1 if none is."""
    treatment = treatment_of(message_id)
    is_kept = treatment is not None and treatment.is_empty
    return layout_of(message_id).itemsize if is_kept else -1


def _known_part(frame: MavFrame) -> MavFrame:
    """Return an unsigned frame without the bytes after the known fields, and without checksum."""
    size = layout_of(frame.message_id).itemsize
    is_v2 = frame.data[0] == START_V2
    cut = bytearray(frame.data[: (PAYLOAD_V2 if is_v2 else PAYLOAD_V1) + size])
    cut[LENGTH_AT] = size
    if is_v2:
        cut[FLAGS] = 0
    return frame_of(bytes(cut) + bytes(CRC_SIZE))


def _is_unknown(value: float) -> bool:
    """Return whether a coordinate has a value that messages define as unknown."""
    return value in (0, (1 << 31) - 1, -(1 << 31)) or not math.isfinite(value)


def _names_of(fields: Mapping[str, Any]) -> tuple[str, ...]:
    return ITEM_PARAMETERS if "x" in fields else PARAMETERS


def _parameters_of(fields: Mapping[str, Any]) -> str | None:
    return parameters_of(fields["command"], fields[_names_of(fields)[-1]])


def _is_short(frame: MavFrame) -> bool:
    """Return whether fields of a MAVLink 1 frame are cut off, which could not be edited."""
    base = base_size(frame.message_id)
    return frame.data[0] != START_V2 and base is not None and frame.data[LENGTH_AT] < base


def _is_equal(new: Any, old: Any) -> bool:
    if isinstance(new, int | float | bytes):
        return bool(new == old or (new != new and old != old))
    return np.array_equal(new, old)


def _is_near(lat_deg: float, lon_deg: float, other_lat_deg: float, other_lon_deg: float) -> bool:
    east_deg = _wrapped(other_lon_deg - lon_deg) * math.cos(math.radians(lat_deg))
    return abs(other_lat_deg - lat_deg) <= MAX_APART_DEG and abs(east_deg) <= MAX_APART_DEG


def _wrapped(lon_deg: float) -> float:
    return math.remainder(lon_deg, 360.0)
