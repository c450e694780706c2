"""Positions of vehicles: the MAVLink messages with positions, their validity, distances.

All commands, files and pages use this definition: a position is on the earth, is not latitude 0,
longitude 0 (sent before the first fix), and requires a fix if it is a GPS receiver's. A track is
broken where its positions are interrupted, the vehicle restarted, or the position jumped; distance
is not counted there.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import displacement_m, offset_deg, radii_m
from gateway.records import NAN, UNKNOWN_VEC3, Vec3
from gateway.units import DEG_PER_DEGE7, FIX_2D, M_PER_CM, M_PER_MM, US_PER_S
from gateway.wire.mavlink_messages import MESSAGE_IDS

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]

UNKNOWN_U16: Final = 65535
MAX_LAT_DEGE7, MAX_LON_DEGE7 = 900_000_000, 1_800_000_000
GPS_IDS: Final = (MESSAGE_IDS["GPS_RAW_INT"], MESSAGE_IDS["GPS2_RAW"])
"""Messages of the first and of the second GPS receiver."""
GLOBAL_POSITION_INT_ID: Final = MESSAGE_IDS["GLOBAL_POSITION_INT"]
LOCAL_POSITION_NED_ID: Final = MESSAGE_IDS["LOCAL_POSITION_NED"]
ORIGIN_ID: Final = MESSAGE_IDS["GPS_GLOBAL_ORIGIN"]
NO_ORIGIN_M: Final = 1.0
"""Heights above the sea and above home that are equal and less than this are unknown."""
INTERRUPTION_US: Final = 60 * US_PER_S
"""Longer time without a position that breaks a track; narrow links send one every 10 s."""
RESTART_US: Final = 5 * US_PER_S
"""Decrease of the time since boot that means a restart; two links reorder frames by less."""
JUMP_M: Final = 200.0
JUMP_MPS: Final = 400.0
"""A step longer than `JUMP_M` plus this speed times its duration is a jump, not a motion."""
STEP_US: Final = US_PER_S // 2
"""Minimum interval of the positions between which the distance is summed."""
LEAST_STEP_M: Final = 1.0
"""Minimum step that is summed; shorter ones at rest would sum up position noise."""


@dataclass(frozen=True, slots=True)
class PositionSource:
    """A message that contains positions: the names and units of its fields."""

    lat: str = "lat"
    lon: str = "lon"
    alt: str = "alt"
    alt_unit_m: float = M_PER_MM
    fix: str = ""
    """Field with the type of fix; empty if there is none."""
    velocity_unit_mps: float = 0.0
    """Unit of `vx`, `vy` and `vz` in m/s; 0 if the message has no velocity."""
    speed: tuple[str, float, int] = ("", 1.0, 0)
    """Field with the speed over ground, its unit in m/s, and its value for "unknown"."""


_GPS: Final = PositionSource(fix="fix_type", speed=("vel", M_PER_CM, UNKNOWN_U16))
_SOURCES: Final = {
    "GLOBAL_POSITION_INT": PositionSource(velocity_unit_mps=M_PER_CM),
    "GLOBAL_POSITION_INT_COV": PositionSource(velocity_unit_mps=1.0),
    "GPS_RAW_INT": _GPS,
    "GPS2_RAW": _GPS,
    "LOCAL_POSITION_NED": PositionSource(velocity_unit_mps=1.0),
    "HIGH_LATENCY2": PositionSource(
        "latitude", "longitude", "altitude", 1.0, speed=("groundspeed", 0.2, -1)
    ),
    "HIGH_LATENCY": PositionSource(
        "latitude", "longitude", "altitude_amsl", 1.0, "gps_fix_type", 0.0, ("groundspeed", 1.0, -1)
    ),
}  # fmt: skip
POSITION_SOURCES: Final = {MESSAGE_IDS[name]: source for name, source in _SOURCES.items()}
"""Sources by message id, best first: the vehicle's estimates, receivers, narrow links."""
RANKS: Final = {message_id: rank for rank, message_id in enumerate(POSITION_SOURCES)}


@dataclass(frozen=True, slots=True)
class Position:
    """A position of a vehicle; unknown values are NaN."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float = NAN
    alt_home_m: float = NAN
    """Altitude above home."""
    groundspeed_mps: float = NAN
    vel_n_mps: Vec3 = UNKNOWN_VEC3


@dataclass(frozen=True, slots=True)
class TrackPoint:
    """One point of a track."""

    time_us: int
    """µs since 1970, or since the start if civil time is not known."""
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float = NAN
    attitude_deg: tuple[float, float, float] | None = None
    """Roll, pitch and yaw, if they are known."""


@dataclass(frozen=True, slots=True)
class LocalFrame:
    """Local plane: metres north and east of one position."""

    lat_deg: float
    lon_deg: float
    alt_m: float

    def local_m(self, lat_deg: FloatArray, lon_deg: FloatArray) -> FloatArray:
        """Convert positions to metres, shape (N, 2): north, and east in the shorter direction."""
        meridian, parallel = radii_m(self.lat_deg, self.alt_m)
        north_m = np.radians(lat_deg - self.lat_deg) * meridian
        east_m = np.radians(wrap_180(lon_deg - self.lon_deg)) * parallel
        return np.column_stack([north_m, east_m])


def is_located(lat_dege7: Any, lon_dege7: Any) -> Any:
    """Return whether coordinates, scalar or array, are those of a known position."""
    is_somewhere = (lat_dege7 != 0) | (lon_dege7 != 0)
    is_lat = (lat_dege7 >= -MAX_LAT_DEGE7) & (lat_dege7 <= MAX_LAT_DEGE7)
    return is_somewhere & is_lat & (lon_dege7 >= -MAX_LON_DEGE7) & (lon_dege7 <= MAX_LON_DEGE7)


def holds_position(message_id: int, fields: Any) -> Any:
    """Return whether a message contains a valid position; an array if the fields are columns.

    Parameters
    ----------
    message_id : int
        One of `POSITION_SOURCES`.
    fields : mapping or structured ndarray
        The message's fields, as scalars or as columns.
    """
    if message_id == LOCAL_POSITION_NED_ID:
        return np.isfinite(fields["x"]) & np.isfinite(fields["y"])
    source = POSITION_SOURCES[message_id]
    located = is_located(fields[source.lat], fields[source.lon])
    return located & (fields[source.fix] >= FIX_2D) if source.fix else located


def position_of(
    message_id: int, fields: Mapping[str, Any], origin: Position | None = None
) -> Position | None:
    """Return the position in a message of `POSITION_SOURCES`; None if it contains no valid one.

    `origin`, from GPS_GLOBAL_ORIGIN, is the origin of LOCAL_POSITION_NED.
    """
    if not holds_position(message_id, fields):
        return None
    source = POSITION_SOURCES[message_id]
    unit = source.velocity_unit_mps
    velocity = (fields["vx"] * unit, fields["vy"] * unit, fields["vz"] * unit) if unit else None
    name, unit_mps, unknown = source.speed
    speed_mps = NAN if velocity is None else math.hypot(*velocity[:2])
    if name and fields[name] != unknown:
        speed_mps = float(fields[name] * unit_mps)
    alt_home_m = fields["relative_alt"] * M_PER_MM if "relative_alt" in fields else NAN
    if message_id != LOCAL_POSITION_NED_ID:
        lat_deg, lon_deg = (fields[name] * DEG_PER_DEGE7 for name in (source.lat, source.lon))
        alt_m = fields[source.alt] * source.alt_unit_m
        if alt_m == alt_home_m and abs(alt_m) < NO_ORIGIN_M:
            # ArduPilot before its first fix: heights from an origin that is not set.
            alt_m = alt_home_m = NAN
    elif origin is None:
        return None
    else:
        at = (origin.lat_deg, origin.lon_deg, 0.0, fields["x"], fields["y"])
        lat_deg, lon_deg = offset_deg(*at)
        if not abs(lat_deg) <= 90.0:
            return None
        alt_m = origin.alt_amsl_m - fields["z"]
    return Position(lat_deg, lon_deg, alt_m, alt_home_m, speed_mps, velocity or UNKNOWN_VEC3)


def named_position(fields: Mapping[str, Any]) -> Position | None:
    """Return the position in HOME_POSITION or GPS_GLOBAL_ORIGIN; None if invalid."""
    lat, lon = fields["latitude"], fields["longitude"]
    if not is_located(lat, lon):
        return None
    return Position(lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, fields["altitude"] * M_PER_MM)


class Continuity:
    """Detect where a track is broken, position by position."""

    def __init__(self) -> None:
        self._last: tuple[int, float, float] | None = None
        self._boot_us = 0

    def is_broken_at(
        self, time_us: int, lat_deg: float, lon_deg: float, boot_us: int | None = None
    ) -> bool:
        """Return whether a position does not continue the track before it.

        `boot_us` is the vehicle's own time since boot, if it is known.
        """
        last, self._last = self._last, (time_us, lat_deg, lon_deg)
        is_restarted = boot_us is not None and boot_us < self._boot_us - RESTART_US
        self._boot_us = self._boot_us if boot_us is None else boot_us
        if last is None or is_restarted:
            return is_restarted
        step_us = abs(time_us - last[0])
        if step_us > INTERRUPTION_US:
            return True
        if abs(lat_deg - last[1]) < 1e-3 and abs(lon_deg - last[2]) < 1e-3:
            return False
        step_m = math.hypot(*displacement_m(last[1], last[2], lat_deg, lon_deg, 0.0))
        return step_m > JUMP_M + JUMP_MPS * step_us / US_PER_S


class GroundDistance:
    """Distance over ground, as all commands and pages use it.

    Steps of `LEAST_STEP_M` or more between positions at least `STEP_US` apart are summed, except
    where the track is broken. The positions are those of the vehicle's best source; in a table,
    those of the states, or of the fixes if no state has a position.
    """

    def __init__(self) -> None:
        self._sum_m = 0.0
        self._sampled_us: int | None = None
        self._last: tuple[float, float] | None = None
        self._continuity = Continuity()

    @property
    def distance_m(self) -> float | None:
        """Distance over ground in m; None without any position."""
        return None if self._last is None else self._sum_m

    def is_due(self, time_us: int) -> bool:
        """Return whether a position of this time is used."""
        return self._sampled_us is None or not 0 <= time_us - self._sampled_us < STEP_US

    def update(
        self, time_us: int, lat_deg: float, lon_deg: float, boot_us: int | None = None
    ) -> None:
        """Add a position, if it is due; see `Continuity`."""
        if not self.is_due(time_us):
            return
        self._sampled_us = time_us
        is_broken = self._continuity.is_broken_at(time_us, lat_deg, lon_deg, boot_us)
        if self._last is not None and not is_broken:
            step_m = math.hypot(*displacement_m(*self._last, lat_deg, lon_deg, 0.0))
            if step_m < LEAST_STEP_M:
                return
            self._sum_m += step_m
        self._last = (lat_deg, lon_deg)
