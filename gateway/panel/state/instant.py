"""The state of an aircraft at one moment, as the browser gets it."""

import msgspec

from gateway.vehicle.plan import Location


class Instant(msgspec.Struct, frozen=True, kw_only=True):
    """State of an aircraft at one moment.

    Everything is the newest from MAVLink, of any sender; NaN (null in the browser) means unknown.
    """

    system_id: int
    time_us: int
    """When the newest attitude or position came, on the panel's clock."""
    title: str
    """Displayed name."""
    model: str
    """Its 3D model, see `VehicleState.model`."""
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
    satellites: float
    """Unknown where the receiver does not count them."""
    fix: Location | None
    """Newest GPS fix of two dimensions or more."""
    home: Location | None
    mark: Location | None
    mark_distance_m: float
    mark_bearing_deg: float
    battery_v: float
    battery_percent: float
    armed: bool
    attitude_s: float
    """Age of the newest attitude, as the others below."""
    position_s: float
    hud_s: float
    gps_s: float
    battery_s: float
