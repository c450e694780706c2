"""Remove the coordinates, dates and names of the people who flew from recordings.

All coordinates are moved by one offset. Distances are preserved: longitudes are scaled by the ratio
of the cosines of the two latitudes. Dates are moved by whole days. Texts and identifiers are
replaced by numbered ones, the same for the same original. Messages with arbitrary content are left
out.

| found by                                  | fields                                         |
| ----------------------------------------- | ---------------------------------------------- |
| unit degE7 in the dialect                 | latitudes and longitudes                       |
| `OTHER_COORDINATES`                       | coordinates in degrees, or without a unit      |
| the meaning of the command's parameters   | coordinates of commands and items of missions  |
| type char in the dialect, except `PLAIN`  | texts and names                                |
| `IDENTIFIERS`                             | numbers and bytes that identify something      |
| integers whose value is a date since 2000 | times                                          |
| `OPAQUE`                                  | messages of unknown content                    |

Heights and values relative to another one are unchanged. Tests check every field of the dialect
against these lists.
"""

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.files import LAST_CIVIL_US
from gateway.recordings.tlog import DAY_US
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle.plan import GLOBAL_FRAMES
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.frame_editing import FLAGS, edit_frame
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_NAMES, layout_of
from gateway.wire.mavlink_splitter import SIGNED, START_V2, frame_of
from gateway.wire.recorded_frames import Batch, fields_of

BoolArray = NDArray[np.bool_]

OTHER_COORDINATES: Final[dict[str, tuple[tuple[str, str, float], ...]]] = {
    "SIM_STATE": (("lat", "lon", 1.0),),
    "FENCE_POINT": (("lat", "lng", 1.0),),
    "FW_SOARING_DATA": (("xLat", "xLon", 1.0),),
}
"""Latitude, longitude, and their unit in 1/deg, where the unit in the dialect is not degE7."""
LOCATED: Final = {"MISSION_ITEM": 1.0, **dict.fromkeys(
    ("MISSION_ITEM_INT", "COMMAND_INT", "COMMAND_INT_STAMPED", "ORBIT_EXECUTION_STATUS"),
    DEGE7_PER_DEG,
)}  # fmt: skip
"""Messages whose x and y are coordinates in a global frame, and their unit in 1/deg."""
PLAIN: Final = frozenset({
    "param_id", "mode_name", "tune", "tune2", "busname", "mode_str", "band_str",
})  # fmt: skip
"""Names of character fields that do not identify anybody."""
PLAIN_OF: Final = frozenset({"NAMED_VALUE_FLOAT", "NAMED_VALUE_INT", "NAMED_VALUE_STRING",
                             "GIMBAL_DEVICE_INFORMATION.vendor_name",
                             "GIMBAL_DEVICE_INFORMATION.model_name"})  # fmt: skip
"""Fields that contain the name of a quantity or of a product."""
IDENTIFIERS: Final[dict[str, tuple[str, ...]]] = {
    "AUTOPILOT_VERSION": ("uid", "uid2"),
    "FLIGHT_INFORMATION": ("flight_uuid",),
    "GIMBAL_DEVICE_INFORMATION": ("uid",),
    "ADSB_VEHICLE": ("ICAO_address", "squawk"),
    "AIS_VESSEL": ("MMSI",),
    "RESOURCE_REQUEST": ("uri", "storage"),
    "SENS_BATMON": ("serialnumber",),
    "UAVCAN_NODE_INFO": ("hw_unique_id",),
    "UTM_GLOBAL_POSITION": ("uas_id",),
    "UAVIONIX_ADSB_OUT_CFG": ("ICAO",),
    "UAVIONIX_ADSB_OUT_DYNAMIC": ("squawk",),
    "UAVIONIX_ADSB_OUT_CONTROL": ("squawk",),
    "UAVIONIX_ADSB_OUT_STATUS": ("squawk",),
    "OPEN_DRONE_ID_BASIC_ID": ("id_or_mac", "uas_id"),
    "OPEN_DRONE_ID_LOCATION": ("id_or_mac",),
    "OPEN_DRONE_ID_SELF_ID": ("id_or_mac",),
    "OPEN_DRONE_ID_SYSTEM": ("id_or_mac",),
    "OPEN_DRONE_ID_OPERATOR_ID": ("id_or_mac",),
}
OPAQUE: Final = frozenset({
    "FILE_TRANSFER_PROTOCOL", "LOG_DATA", "GPS_INJECT_DATA", "GPS_RTCM_DATA", "SERIAL_CONTROL",
    "ENCAPSULATED_DATA", "DATA16", "DATA32", "DATA64", "DATA96", "REMOTE_LOG_DATA_BLOCK",
    "V2_EXTENSION", "LOGGING_DATA", "LOGGING_DATA_ACKED", "TUNNEL", "CAN_FRAME", "CANFD_FRAME",
    "DEVICE_OP_READ_REPLY", "DEVICE_OP_WRITE", "SECURE_COMMAND", "SECURE_COMMAND_REPLY",
    "OPEN_DRONE_ID_MESSAGE_PACK", "OPEN_DRONE_ID_AUTHENTICATION", "FRSKY_PASSTHROUGH_ARRAY",
    "PARAM_VALUE_ARRAY", "MEMORY_VECT", "DEBUG_VECT", "DEBUG_FLOAT_ARRAY", "SETUP_SIGNING",
    "AUTH_KEY", "AIRLINK_AUTH", "CHANGE_OPERATOR_CONTROL", "MOUNT_CONTROL", "CUBEPILOT_RAW_RC",
    "LED_CONTROL",
})  # fmt: skip
"""Messages left out: files, logs, raw device data, keys, and old messages of ambiguous meaning."""
COMMANDS: Final = frozenset({
    "COMMAND_LONG", "COMMAND_LONG_STAMPED", "COMMAND_INT", "COMMAND_INT_STAMPED",
})  # fmt: skip
"""Messages that contain a command; those with a command of a vendor are left out."""
NAMED_VALUES: Final = {"PARAM_VALUE": "param_id", "PARAM_SET": "param_id",
                       "PARAM_EXT_VALUE": "param_id", "PARAM_EXT_SET": "param_id",
                       "PARAM_EXT_ACK": "param_id", "NAMED_VALUE_FLOAT": "name",
                       "NAMED_VALUE_INT": "name"}  # fmt: skip
"""Messages with a value that is named by another field: that field, by message."""
PRIVATE_NAME: Final = re.compile(
    r"(?<![A-Z])(LAT|LON|LNG|LATITUDE|LONGITUDE)(?![A-Z])|ICAO|SERIAL_?N|SQUAWK|PASS|SSID|UUID",
    re.IGNORECASE,
)
"""Pattern of the names of values that are left out."""
TIME_UNITS: Final = {"s": 1, "ms": 1000, "us": 1_000_000, "ns": 1_000_000_000}
"""Ticks per second of each unit of time."""
UNITLESS_TIMES: Final = frozenset({"utc_time", "vehicle_timestamp", "time_usec", "timestamp"})
GPS_WEEKS: Final = {"GPS_RTK": ("wn", "tow"), "GPS2_RTK": ("wn", "tow"),
                    "GPS_INPUT": ("time_week", "time_week_ms")}  # fmt: skip
WEEK_MS: Final = 7 * 86_400_000
DRONE_ID_TIMES: Final = frozenset({"OPEN_DRONE_ID_SYSTEM", "OPEN_DRONE_ID_SYSTEM_UPDATE"})
"""Messages whose timestamp counts seconds since 2019."""
FIRST_CIVIL_S: Final = 946_684_800
"""The year 2000; earlier times are not civil time."""
MAX_NAMES: Final = 60_000
"""Identifiers that get a number of their own; all later ones share one number."""
MAX_PLACE_DEG: Final = 80.0
"""Greatest latitude to move to: nearer to a pole, a flight would not fit between meridians."""
_COMMAND_FIELDS: Final[dict[int, dict[str, int]]] = {
    number: axes
    for number, entry in mavlink.enums["MAV_CMD"].items()
    if (
        axes := {
            f"param{index}": int("ongitude" in text)
            for index, text in entry.param.items()
            if "atitude" in text or "ongitude" in text
        }
    )
}
"""Parameters that are coordinates, by command; value: 0 for latitude, 1 for longitude."""
_SIZES: Final = np.full(1 << 16, -1, np.int64)
"""Size of each known message's payload, by id."""
_CHANGED: Final = np.zeros(1 << 16, np.bool_)
"""Whether a message can contain fields to change, by id."""
_SPECIAL: Final = {*OPAQUE, *LOCATED, *NAMED_VALUES, *GPS_WEEKS, *DRONE_ID_TIMES,
                   *COMMANDS}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Anonymity:
    """The location and day to which recordings are moved."""

    lat_deg: float = 0.0
    lon_deg: float = 0.0
    day: date = date(2020, 1, 1)
    keep_unknown: bool = False
    """Keep messages that are not in the dialect, or longer than the dialect defines them."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """The fields of a message that may be changed."""

    coordinates: tuple[tuple[str, str, float], ...]
    identifiers: tuple[str, ...]
    times: tuple[tuple[str, int], ...]

    @property
    def is_empty(self) -> bool:
        return not (self.coordinates or self.identifiers or self.times)


def is_plain(message: str, field: str) -> bool:
    """Return whether a character field does not identify anybody."""
    return (
        field in PLAIN
        or f"{message}.{field}" in PLAIN_OF
        or (field == "name" and message in PLAIN_OF)
    )


def longitude_of(latitude: str) -> str:
    """Return the prefix of the name of the longitude that belongs to a latitude."""
    return latitude.replace("latitude", "longitude").replace("Lat", "Lon").replace("lat", "lon")


@cache
def _plan_of(message_id: int) -> _Plan:
    kind = DEFINITIONS[message_id]
    name, units = kind.msgname, kind.fieldunits_by_name
    types = dict(zip(kind.fieldnames, kind.fieldtypes, strict=True))
    scaled = [field for field in kind.fieldnames if units.get(field) == "degE7"]
    pairs = [
        (lat, next(f for f in scaled if f in (lon, lon.replace("lon", "lng"))), DEGE7_PER_DEG)
        for lat in scaled
        if (lon := longitude_of(lat)) != lat
    ]
    texts = [field for field, code in types.items() if code == "char" and not is_plain(name, field)]
    times = [
        (field, TIME_UNITS.get(units.get(field, ""), 1 if field == "utc_time" else 1_000_000))
        for field, code in types.items()
        if code in ("uint32_t", "uint64_t", "int64_t")
        and (units.get(field) in TIME_UNITS or field in UNITLESS_TIMES)
    ]
    return _Plan(
        (*pairs, *OTHER_COORDINATES.get(name, ())),
        (*texts, *IDENTIFIERS.get(name, ())),
        tuple(times),
    )


for _message_id, _name in MESSAGE_NAMES.items():
    _SIZES[_message_id] = layout_of(_message_id).itemsize
    _CHANGED[_message_id] = _name in _SPECIAL or not _plan_of(_message_id).is_empty


class Anonymiser:
    """Anonymise the frames of a recording.

    Parameters
    ----------
    anonymity : Anonymity
        Target location and day.
    reference : tuple of float, optional
        Latitude and longitude that are moved to the target, deg; default: the first ones found.
    """

    def __init__(self, anonymity: Anonymity, reference: tuple[float, float] | None = None) -> None:
        self._anonymity = anonymity
        self.reference = reference
        self.changed: Counter[tuple[str, str]] = Counter()
        """Number of changed fields, by message and field."""
        self._names: dict[bytes, int] = {}
        self._days: int | None = None

    def shift_us(self, batch: Batch) -> int:
        """Return the shift of the recorded times; the first batch determines it."""
        if self._days is None and len(batch):
            first = datetime.fromtimestamp(max(int(batch.time_us[0]), 0) / US_PER_S, UTC)
            self._days = (self._anonymity.day - first.date()).days
        return (self._days or 0) * DAY_US

    def affects(self, batch: Batch) -> BoolArray:
        """Return which frames may change."""
        data = np.frombuffer(batch.data, np.uint8)
        starts = batch.starts + TIME_SIZE
        is_signed = (data[starts] == START_V2) & (data[starts + FLAGS] & SIGNED > 0)
        ids = np.minimum(batch.message_ids, len(_SIZES) - 1)
        found: BoolArray = is_signed | _CHANGED[ids] | (data[starts + 1] > _SIZES[ids])
        return found

    def edit(self, frame: bytes) -> bytes | None:
        """Return the anonymised frame; None if it must be left out."""
        read = frame_of(frame)
        message_id, name = read.message_id, MESSAGE_NAMES.get(read.message_id)
        if name is None or frame[1] > _SIZES[message_id]:
            return frame if self._anonymity.keep_unknown else None
        if name in OPAQUE:
            return None
        fields = fields_of(frame)
        if name in COMMANDS and fields["command"] not in mavlink.enums["MAV_CMD"]:
            return None
        if name in NAMED_VALUES and PRIVATE_NAME.search(text_of(fields[NAMED_VALUES[name]])):
            return None
        plan = _plan_of(message_id)
        changes: dict[str, Any] = {}
        for lat, lon, unit in plan.coordinates:
            changes |= self._moved(fields, lat, lon, unit)
        changes |= self._command(name, fields)
        for field in plan.identifiers:
            changes[field] = self._numbered(message_id, field, fields[field])
        changes |= self._times(name, plan, fields)
        changes = {
            field: value for field, value in changes.items() if np.any(value != fields[field])
        }
        if not changes and not read.signed:
            return frame
        self.changed.update((name, field) for field in changes)
        if read.signed:
            self.changed[name, "signature"] += 1
        edited = edit_frame(read, fields=changes, drop_signature=True)
        return None if edited is None else edited.data

    def _moved(
        self, fields: Mapping[str, Any], lat: str, lon: str, unit: float
    ) -> dict[str, float]:
        """Move a latitude and a longitude; 0, 0 and values out of range mean unknown and stay."""
        lat_deg, lon_deg = fields[lat] / unit, fields[lon] / unit
        moved: dict[str, float] = {}
        if not lat_deg and not lon_deg:
            return moved
        if abs(lat_deg) <= 90.0:
            moved[lat] = self._axis(lat_deg, 0, lat_deg, lon_deg)
        if abs(lon_deg) <= 180.0:
            moved[lon] = self._axis(lon_deg, 1, lat_deg, lon_deg)
        if unit != 1.0:
            moved = {field: round(value * unit) for field, value in moved.items()}
        if not any(moved.values()):
            # One unit (1 cm for degE7) off, because 0, 0 would mean unknown.
            moved = dict.fromkeys(moved, 1 / unit if unit == 1.0 else 1)
        return moved

    def _axis(self, value_deg: float, axis: int, lat_deg: float, lon_deg: float) -> float:
        """Move a latitude (axis 0) or a longitude (axis 1)."""
        if self.reference is None:
            self.reference = lat_deg, lon_deg
        place = self._anonymity
        offset_deg = value_deg - self.reference[axis]
        if axis == 0:
            return max(-90.0, min(90.0, place.lat_deg + offset_deg))
        scale = math.cos(math.radians(self.reference[0])) / math.cos(math.radians(place.lat_deg))
        return _wrapped(place.lon_deg + _wrapped(offset_deg) * scale)

    def _command(self, name: str, fields: Mapping[str, Any]) -> dict[str, float]:
        """Move the coordinates of a command or of a mission item."""
        if name in LOCATED:
            is_global = fields["frame"] in GLOBAL_FRAMES or (
                fields["frame"] == mavlink.MAV_FRAME_MISSION
                and fields.get("command") in _COMMAND_FIELDS
            )
            return self._moved(fields, "x", "y", LOCATED[name]) if is_global else {}
        if name not in ("COMMAND_LONG", "COMMAND_LONG_STAMPED"):
            return {}
        axes = _COMMAND_FIELDS.get(fields["command"], {})
        pairs = sorted(axes, key=lambda field: axes[field])
        return self._moved(fields, pairs[0], pairs[-1], 1.0) if len(pairs) > 1 else {}

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

    def _number(self, original: bytes) -> int:
        """Return the number of an identifier, from 1; 0 for an empty one."""
        if not original:
            return 0
        if len(self._names) >= MAX_NAMES:
            return self._names.get(original, MAX_NAMES)
        return self._names.setdefault(original, len(self._names) + 1)

    def _times(self, name: str, plan: _Plan, fields: Mapping[str, Any]) -> dict[str, int]:
        days = self._days or 0
        moved = {
            field: fields[field] + days * 86_400 * per_s
            for field, per_s in plan.times
            if FIRST_CIVIL_S < fields[field] / per_s < LAST_CIVIL_US / US_PER_S
        }
        if name in DRONE_ID_TIMES and fields["timestamp"]:
            moved["timestamp"] = max(fields["timestamp"] + days * 86_400, 1)
        if name in GPS_WEEKS:
            week, of_week = GPS_WEEKS[name]
            if fields[week]:
                time_ms = fields[week] * WEEK_MS + fields[of_week] + days * 86_400_000
                moved |= {week: max(time_ms, 0) // WEEK_MS, of_week: max(time_ms, 0) % WEEK_MS}
        return moved


def _wrapped(lon_deg: float) -> float:
    """Return a longitude between -180 and 180 degrees."""
    return math.remainder(lon_deg, 360.0)
