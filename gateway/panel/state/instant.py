"""The state of an aircraft at one moment, as the browser gets it."""

import msgspec

from gateway.vehicle.plan import Location


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
