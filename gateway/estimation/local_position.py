"""Position in metres near an origin, its recent past, and fixes that were rejected."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.columns import GPS_ALT, GPS_LAT, GPS_LON, GPS_VEL
from gateway.estimation.history import SLOTS
from gateway.estimation.kernel_record import FloatArray, as_vec, write_vec
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.records import Vec3

NEVER_S: Final = -1e9
"""A time long before the start."""
INTEGRALS: Final = 9
"""Values in the ring: force in the inertial frame, acceleration in NED and its integral."""
ORIGIN_RENEWAL_M: Final = 5_000.0
"""Metres are taken on the radii at the origin, which moves along before they stretch."""
BARO_STALE_S: Final = 2.0
AGREE_M: Final = 10.0
"""Rejected fixes within this of their own dead reckoning agree with one another."""


class PlaceState:
    """Position, velocity and the integrals that lead back to a late fix."""

    time_s: float
    """Time since the estimator's start."""
    origin_lat: float
    origin_lon: float
    has_origin: int
    pos_n: Annotated[FloatArray, (3,)]
    """Metres from the origin; the third is minus the height above mean sea level."""
    vel_n: Annotated[FloatArray, (3,)]
    integrals: Annotated[FloatArray, (INTEGRALS,)]
    then: Annotated[FloatArray, (INTEGRALS,)]
    """Scratch: the integrals when a fix was valid."""
    ring: Annotated[FloatArray, (SLOTS, 1 + INTEGRALS)]
    ring_count: int
    reject_s: float
    """How long fixes have been rejected and agreed with one another."""
    reject_last: Annotated[FloatArray, (3,)]
    """Time, north and east of the last rejected fix."""


@compiled
def past_state(s: PlaceState, then: FloatArray, lag: float) -> tuple[Vec3, Vec3]:
    """Go back from the present position and velocity to those `lag` seconds ago.

    Parameters
    ----------
    s : PlaceState
        Present.
    then : ndarray, shape (INTEGRALS,)
        Integrals at that time.
    lag : float
        Seconds, not negative.

    Returns
    -------
    pos_n, vel_n : tuple of 3 floats
        Position in m and velocity in m/s at that time.
    """
    now = s.integrals
    v0 = s.vel_n[0] - (now[3] - then[3])
    v1 = s.vel_n[1] - (now[4] - then[4])
    v2 = s.vel_n[2] - (now[5] - then[5])
    return (
        (
            s.pos_n[0] - v0 * lag - (now[6] - then[6] - then[3] * lag),
            s.pos_n[1] - v1 * lag - (now[7] - then[7] - then[4] * lag),
            s.pos_n[2] - v2 * lag - (now[8] - then[8] - then[5] * lag),
        ),
        (v0, v1, v2),
    )


@compiled
def move_origin(s: PlaceState, lat_deg: float, lon_deg: float) -> None:
    """Set the origin, or shift it below an aircraft that has gone far."""
    if s.has_origin == 0:
        s.origin_lat, s.origin_lon, s.has_origin = lat_deg, lon_deg, 1
    elif math.hypot(s.pos_n[0], s.pos_n[1]) > ORIGIN_RENEWAL_M:
        lat, lon = offset_deg(s.origin_lat, s.origin_lon, 0.0, s.pos_n[0], s.pos_n[1])
        north, east = displacement_m(s.origin_lat, s.origin_lon, lat, lon, 0.0)
        s.pos_n[0] -= north
        s.pos_n[1] -= east
        s.origin_lat, s.origin_lon = lat, lon


@compiled
def fix_position(s: PlaceState, row: FloatArray) -> Vec3:
    """Place a fix in metres from the origin, down positive."""
    north, east = displacement_m(s.origin_lat, s.origin_lon, row[GPS_LAT], row[GPS_LON], 0.0)
    return (north, east, -row[GPS_ALT])


@compiled
def is_relocked(s: PlaceState, relock_s: float, pos: Vec3, vel: Vec3) -> bool:
    """Follow rejected fixes; believe them when they have long agreed with one another.

    Parameters
    ----------
    s : PlaceState
        Changed in place.
    relock_s : float
        How long they must have agreed.
    pos, vel : tuple of 3 floats
        The rejected fix, metres from the origin and m/s.

    Returns
    -------
    bool
        Whether the fix is to be taken as a new start.
    """
    dt = s.time_s - s.reject_last[0]
    north = s.reject_last[1] + vel[0] * dt
    east = s.reject_last[2] + vel[1] * dt
    agrees = dt < 5.0 and math.hypot(pos[0] - north, pos[1] - east) < AGREE_M
    s.reject_s = s.reject_s + dt if agrees else 0.0
    write_vec(s.reject_last, (s.time_s, pos[0], pos[1]))
    return s.reject_s > relock_s


@compiled
def fix_velocity(row: FloatArray) -> Vec3:
    """Read a fix's velocity."""
    return as_vec(row[GPS_VEL : GPS_VEL + 3])
