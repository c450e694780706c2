"""The treatment of each message, field and command when a recording is anonymised.

The table is `private_fields.toml`, whose head explains it. A message is left out unless the table
lists all of its fields, and a command unless the table lists it.
"""

import re
import tomllib
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.gps_time import GPS_EPOCH_UNIX_US
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import DEFINITIONS

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
