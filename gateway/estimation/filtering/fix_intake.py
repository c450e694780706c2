"""A GPS fix as it arrives: whether it is one, where it lies, what it says to the alignment."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.gps_latency import watch_latency
from gateway.estimation.alignment.gps_velocity import FASTEST_MPS, is_zero_refuted
from gateway.estimation.alignment.review import MOVING_MPS
from gateway.estimation.alignment.wahba import align_by_velocity
from gateway.estimation.columns import GPS_DECLINATION, GPS_DIP, GPS_LAT, GPS_LON, GPS_USABLE
from gateway.estimation.filtering.filter_state import FilterGains, FilterState
from gateway.estimation.filtering.receiver_noise import note_receiver_noise
from gateway.estimation.history import recall
from gateway.estimation.kernel_record import FloatArray, as_vec
from gateway.estimation.local_position import NEVER_S, fix_position, fix_velocity, move_origin
from gateway.estimation.sensor_faults import is_sound
from gateway.records import UNKNOWN_VEC3, Vec3

STANDING_MPS: Final = 0.1
"""A receiver that stands tells up to this speed."""
SLOWEST_FIXES_S: Final = 1.1
"""From one fix to the next, of the slowest usual receivers."""


@compiled
def is_fix_told(s: FilterState, row: FloatArray) -> bool:
    """Return whether a row holds a fix that may be fused, and the filter runs."""
    known = math.isfinite(row[GPS_LAT]) and math.isfinite(row[GPS_LON])
    usable = s.started == 1 and row[GPS_USABLE] != 0.0 and known
    return bool(usable and not is_fix_repeated(s, row))


@compiled
def is_fix_repeated(s: FilterState, row: FloatArray) -> bool:
    """Return whether a row tells the last fix again; to be asked of each.

    A log may hold a fix until the next one, and a receiver may be stuck. What moves is nowhere
    twice; what stands may tell the same again and again, and be right.
    """
    lat_deg, lon_deg, vel = row[GPS_LAT], row[GPS_LON], fix_velocity(row)
    last, is_velocity_told = s.fix_told, is_sound(vel, FASTEST_MPS)
    repeated = lat_deg == last[0] and lon_deg == last[1]
    for k in range(3):
        repeated = repeated and (vel[k] == last[2 + k] or not is_velocity_told)
    if not repeated:
        last[0], last[1], s.fix_told_s = lat_deg, lon_deg, s.time_s
        for k in range(3):
            last[2 + k] = vel[k]
        return False
    if is_velocity_told:
        return math.hypot(vel[2], math.hypot(vel[0], vel[1])) > STANDING_MPS
    return s.time_s - s.fix_told_s < SLOWEST_FIXES_S


@compiled
def wanted_time_s(s: FilterState, p: FilterGains, arrival_us: int, row: FloatArray) -> float:
    """Return when a fix was valid, on the filter's own time; its velocity may tell the latency."""
    arrival_s, vel = (arrival_us - s.base_us) * 1e-6, fix_velocity(row)
    if is_sound(vel, FASTEST_MPS):
        watch_latency(s, p.gps_latency_s, arrival_s, vel)
    return arrival_s - s.gps_latency_s


@compiled
def look_back(s: FilterState, time_s: float) -> float:
    """Fill `then` with the integrals of a past time, and return the time that they hold for."""
    return recall(s.ring, s.ring_count, time_s, s.time_s, s.integrals, s.then)


@compiled
def place_fix(s: FilterState, row: FloatArray) -> tuple[Vec3, Vec3]:
    """Return place, metres from the origin, and velocity of a fix; the first sets the origin."""
    move_origin(s, row[GPS_LAT], row[GPS_LON])
    pos, vel = fix_position(s, row), fix_velocity(row)
    return (pos, UNKNOWN_VEC3 if is_zero_refuted(s, s.time_s, pos, vel) else vel)


@compiled
def learn_earth_field(s: FilterState, row: FloatArray) -> float:
    """Note the field at the place; return the turn of a heading that was magnetic so far, rad."""
    s.earth_dip_rad = row[GPS_DIP]
    declination_rad: float = row[GPS_DECLINATION]
    if not math.isfinite(declination_rad):
        return 0.0
    s.declination_rad = declination_rad
    if s.heading_known == 0 or s.heading_true == 1:
        return 0.0
    s.heading_true = 1
    return declination_rad


@compiled
def is_flown_unaided(s: FilterState, vel: Vec3) -> bool:
    """Return whether an attitude that gravity alone has levelled was levelled in flight.

    What was found without GPS took the pull of every turn for gravity.
    """
    return bool(s.by_gps == 0 and math.hypot(vel[0], vel[1]) > MOVING_MPS)


@compiled
def pair_with(s: FilterState, at_s: float, vel: Vec3, noise_mps: float) -> float:
    """Give a velocity to the alignment as of when it was valid; see `align_by_velocity`."""
    at_s = look_back(s, at_s)
    dt = align_by_velocity(s, at_s, vel, as_vec(s.then), noise_mps)
    if dt > 0.0:
        note_receiver_noise(s)
    return dt


@compiled
def accept_fix(s: FilterState) -> None:
    """Note that a fix was used."""
    s.fix_s = s.time_s
    s.silent_s = 0.0
    s.reject_s, s.reject_last[0] = 0.0, NEVER_S
