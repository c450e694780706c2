"""The state of an aircraft at one moment, as the browser gets it, and its states over time."""

from array import array
from typing import Final

import msgspec

from gateway.vehicle.plan import Location

MAX_TRACK: Final = 20_000
"""Maximum moments of the history: more than an hour at 5 Hz; the oldest are dropped."""
TRACK_INTERVAL_US: Final = 200_000
HISTORY_COLUMNS: Final = {
    "lat_deg": "d", "lon_deg": "d",
    **dict.fromkeys(
        (
            "alt_amsl_m", "alt_home_m", "q_nb.0", "q_nb.1", "q_nb.2", "q_nb.3", "rate_b_radps.0",
            "rate_b_radps.1", "rate_b_radps.2", "vel_n_mps.0", "vel_n_mps.1", "vel_n_mps.2",
            "groundspeed_mps", "airspeed_mps", "climb_mps", "heading_deg", "pos_std_m", "fix_type",
            "satellites", "battery_v", "battery_percent",
        ),
        "f",
    ),
}  # fmt: skip
"""Columns of a history and their types: fields of `Instant`, with `.n` for one of its numbers."""


class Instant(msgspec.Struct, frozen=True, kw_only=True):
    """State of an aircraft at one moment.

    All values are the newest from MAVLink, of any sender; NaN (null in the browser) means unknown.
    """

    system_id: int
    time_us: int
    """When the newest attitude or position was received, on the panel's clock."""
    title: str
    model: str
    """Its 3D model, see `VehicleState.model`."""
    origin: str
    """`live`, `recorded` or `fused again`."""
    generation: int
    silent_s: float
    """Time since the newest heartbeat."""
    q_nb: tuple[float, float, float, float]
    """Attitude, scalar first, body FRD to NED."""
    rate_b_radps: tuple[float, float, float]
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    alt_home_m: float
    vel_n_mps: tuple[float, float, float]
    groundspeed_mps: float
    airspeed_mps: float
    """Unknown if the vehicle has no airspeed sensor and sends its ground speed instead."""
    climb_mps: float
    heading_deg: float
    pos_std_m: float
    """Horizontal standard deviation of the position, root of the sum of both axes."""
    fix_type: int
    """GPS_FIX_TYPE; 0 without a GPS."""
    satellites: float
    """Unknown if the receiver does not report it."""
    fix: Location | None
    """Newest GPS fix of two dimensions or more."""
    home: Location | None
    mark: Location | None
    battery_v: float
    battery_name: str
    """Name of the voltage, that of a battery or of the supply of boards."""
    battery_percent: float
    armed: bool
    attitude_s: float
    """Age of the newest attitude; the ages below are of other data."""
    position_s: float
    hud_s: float
    gps_s: float
    battery_s: float


class FlightHistory:
    """States of one aircraft as columns over time."""

    def __init__(self, limit: int = MAX_TRACK) -> None:
        self._limit = limit
        self.time_us = array("q")
        self.columns = {name: array(kind) for name, kind in HISTORY_COLUMNS.items()}

    def __len__(self) -> int:
        return len(self.time_us)

    @property
    def newest_us(self) -> int:
        """Time of the newest state; far in the past without any."""
        return self.time_us[-1] if self.time_us else -TRACK_INTERVAL_US

    def add(self, time_us: int, now: Instant) -> None:
        """Add the state of one moment."""
        self.time_us.append(time_us)
        for name, column in self.columns.items():
            field, _, index = name.partition(".")
            value = getattr(now, field)
            column.append(value[int(index)] if index else value)
        if len(self.time_us) > self._limit:
            # A quarter at once, so that the rest is seldom moved.
            for column in (self.time_us, *self.columns.values()):
                del column[: self._limit // 4]

    def clear(self) -> None:
        """Delete all states."""
        for column in (self.time_us, *self.columns.values()):
            del column[:]

    def track(self) -> list[tuple[float, float, float, int]]:
        """Return latitude, longitude, height AMSL and time of all moments."""
        names = ("lat_deg", "lon_deg", "alt_amsl_m")
        return list(zip(*(self.columns[name] for name in names), self.time_us, strict=True))
