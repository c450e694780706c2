"""Reference of an estimate to the Earth: usable GPS fixes, their latency, and true north."""

import math
from typing import Annotated, Final, Literal

from gateway.geometry.geodesy import displacement_m
from gateway.geometry.geomagnetism import MagneticField, magnetic_field, year_of
from gateway.records import GpsFix, GpsFixType
from gateway.settings import Settings, setting

USABLE_FIXES: Final = frozenset(
    {GpsFixType.FIX_2D, GpsFixType.FIX_3D, GpsFixType.GNSS_AND_DEAD_RECKONING}
)
FIELD_RENEWAL_M: Final = 20_000.0
"""Distance of a new look-up: the declination changes by well under 0.5 deg over it."""
NO_DECLINATION_RAD: Final = 0.29
"""Standard deviation of an unknown declination: its root mean square within 60 deg of the
equator."""
EarthLocation = tuple[float, float, MagneticField]
"""Latitude and longitude in degrees, and the model's field at this position."""


class ReferenceSettings(Settings, frozen=True):
    """GPS and magnetic reference, shared by all estimators."""

    gps_latency_s: Annotated[
        float,
        setting(
            "Time from the validity of a fix to its arrival at the gateway. If the latency "
            "estimated in manoeuvres differs by more than 0.07 s, eskf uses that.",
            "s",
            ge=0.0,
            le=2.0,
        ),
    ] = 0.15
    gps_max_h_acc_m: Annotated[
        float,
        setting("Maximum reported horizontal accuracy of a usable fix.", "m", ge=1.0, le=1000.0),
    ] = 30.0
    gps_relock_s: Annotated[
        float,
        setting(
            "Time after which rejected fixes that agree with one another are accepted (eskf).",
            "s",
            ge=0.5,
            le=120.0,
        ),
    ] = 8.0
    declination: Annotated[
        Literal["model", "fixed"],
        setting("Magnetic declination: model (World Magnetic Model at the fix) or fixed."),
    ] = "model"
    declination_deg: Annotated[
        float, setting("Fixed declination, positive east.", "deg", ge=-180.0, le=180.0)
    ] = 0.0


def is_usable(fix: GpsFix, settings: ReferenceSettings) -> bool:
    """Return whether a fix may be fused; an unknown accuracy (NaN) is accepted."""
    return (
        fix.fix_ok
        and fix.fix_type in USABLE_FIXES
        and not fix.h_acc_m > settings.gps_max_h_acc_m
        and (fix.lat_dege7, fix.lon_dege7) != (0, 0)
    )


class EarthField:
    """The magnetic reference: looked up once, and again after `FIELD_RENEWAL_M`."""

    def __init__(self, settings: ReferenceSettings) -> None:
        self._settings = settings
        self.reset()

    def reset(self) -> None:
        """Discard the position."""
        self.state: EarthLocation | None = None
        """The position of the last look-up; None before the first fix. May be restored."""

    @property
    def field(self) -> MagneticField | None:
        """The model's field at the last position; None before the first fix."""
        return None if self.state is None else self.state[2]

    @property
    def declination_rad(self) -> float:
        """Declination, positive east; NaN if unknown."""
        if self._settings.declination == "fixed":
            return math.radians(self._settings.declination_deg)
        return math.nan if self.state is None else self.state[2].declination_rad

    def update(self, lat_deg: float, lon_deg: float, alt_m: float, utc_us: int | None) -> None:
        """Look up the field at a position and Unix time, unless the last position is near."""
        if self.state is not None:
            north_m, east_m = displacement_m(*self.state[:2], lat_deg, lon_deg, alt_m)
            if math.hypot(north_m, east_m) < FIELD_RENEWAL_M:
                return
        field = magnetic_field(lat_deg, lon_deg, alt_m, year_of(utc_us))
        self.state = (lat_deg, lon_deg, field)
