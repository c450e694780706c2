"""State of one aircraft at one moment, in SI units, for the browser to draw."""

import msgspec

from gateway.records import NAN


class Spot(msgspec.Struct, frozen=True):
    """A position; its height is NaN if unknown."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float = NAN


class Instant(msgspec.Struct, frozen=True, kw_only=True):
    """State of an aircraft at one moment.

    Everything is the newest from MAVLink, of any sender; NaN (null in the browser) means unknown.
    """

    system_id: int
    time_us: int
    """When the newest attitude or position came, on the panel's clock."""
    model: str
    """`plane`, `copter`, `heli`, `rover`, `boat` or `none`; see `VehiclePicture`."""
    origin: str
    """`live`, `recorded` or `fused again`."""
    generation: int
    """How often its path was restarted."""
    silent_s: float
    """Since the newest heartbeat."""
    q_nb: tuple[float, float, float, float]
    """Attitude, scalar first, body FRD to NED."""
    rate_b_radps: tuple[float, float, float]
    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    alt_home_m: float
    """Above home."""
    vel_n_mps: tuple[float, float, float]
    groundspeed_mps: float
    airspeed_mps: float
    """Unknown where the vehicle sends its ground speed for want of a sensor."""
    climb_mps: float
    heading_deg: float
    pos_std_m: float
    """Horizontal standard deviation of the position, root of the sum of both axes."""
    fix_type: int
    """GPS_FIX_TYPE; 0 without a GPS."""
    satellites: int
    fix: Spot | None
    """Newest GPS fix of two dimensions or more."""
    home: Spot | None
    mark: Spot | None
    mark_distance_m: float
    mark_bearing_deg: float
