"""Interpolated GPS and withheld fixes, with which the position filter is compared."""

from typing import Final

import numpy as np

from gateway.analysis.flight_arrays import (
    BoolArray,
    Fixes,
    Flight,
    FlightTrack,
    FloatArray,
    IntArray,
)
from gateway.estimation.reference import is_usable
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m
from gateway.records import GpsFix
from gateway.units import US_PER_S

MAX_GAP_S: Final = 2.0
"""Across a longer gap a straight line is no reference for a curved flight."""


def interpolate(fixes: Fixes, time_us: IntArray) -> FlightTrack:
    """Interpolate linearly between the fixes, at the times at which they were valid.

    Parameters
    ----------
    fixes : Fixes
        In the order of time.
    time_us : ndarray, shape (N,)
        Gateway times to interpolate at.

    Returns
    -------
    FlightTrack
        Positions and velocities; NaN before the first fix, after the last and in long gaps. The
        attitude is NaN.
    """
    size = len(time_us)
    if len(fixes) < 2:
        unknown = np.full(size, np.nan)
        return FlightTrack(
            time_us,
            np.full((size, 4), np.nan),
            unknown,
            unknown,
            unknown,
            np.full((size, 3), np.nan),
        )
    lon_deg = np.unwrap(fixes.lon_deg, period=360.0)
    columns = [fixes.lat_deg, lon_deg, fixes.alt_amsl_m, *fixes.vel_n_mps.T]
    after = np.searchsorted(fixes.valid_us, time_us, side="right").clip(1, len(fixes) - 1)
    gap_s = (fixes.valid_us[after] - fixes.valid_us[after - 1]) / US_PER_S
    known = (time_us >= fixes.valid_us[0]) & (time_us <= fixes.valid_us[-1]) & (gap_s <= MAX_GAP_S)
    lat, lon, alt, *vel = (
        np.where(known, np.interp(time_us, fixes.valid_us, column), np.nan) for column in columns
    )
    lon = wrap_180(lon)
    return FlightTrack(time_us, np.full((size, 4), np.nan), lat, lon, alt, np.column_stack(vel))


def thin(flight: Flight, interval_s: float) -> BoolArray:
    """Choose fixes at least an interval apart; unusable ones are all kept."""
    keep = np.ones(len(flight.fixes), np.bool_)
    last_us: int | None = None
    # Half a fix interval of tolerance: arrival jitters.
    least_us = round(interval_s * US_PER_S * 0.9)
    for k, fix in enumerate(flight.fixes):
        if not is_usable(fix, flight.fusion.estimation.reference):
            continue
        if last_us is not None and 0 <= fix.time_us - last_us < least_us:
            keep[k] = False
        else:
            last_us = fix.time_us
    return keep


def withhold(flight: Flight, every: int) -> BoolArray:
    """Choose all fixes but every n-th usable one."""
    usable = np.array(
        [is_usable(fix, flight.fusion.estimation.reference) for fix in flight.fixes], np.bool_
    )
    return np.asarray(~(usable & (np.cumsum(usable) % every == 0)))


def split(flight: Flight, keep: BoolArray) -> tuple[Flight, Flight]:
    """Split a flight by its fixes: those to fuse, and those to compare with."""
    fused: list[GpsFix] = []
    held: list[GpsFix] = []
    for fix, kept in zip(flight.fixes, keep.tolist(), strict=True):
        (fused if kept else held).append(fix)
    return flight.with_fixes(fused), flight.with_fixes(held)


def error_at_fixes_m(track: FlightTrack, fixes: Fixes) -> FloatArray:
    """Compare a track with fixes, each at the time at which it was valid.

    Returns
    -------
    ndarray, shape (M, 2)
        Metres north and east; NaN where the track has no position.
    """
    if not len(fixes):
        return np.empty((0, 2))
    meridian, parallel = radii_m(float(fixes.lat_deg[0]), float(fixes.alt_amsl_m[0]))
    lat = np.interp(fixes.valid_us, track.time_us, track.lat_deg, left=np.nan, right=np.nan)
    # From the first fix, not from Greenwich: halfway over the date line is not longitude 0.
    lon_deg = fixes.lon_deg[0]
    east_deg = wrap_180(track.lon_deg - lon_deg)
    east = np.interp(fixes.valid_us, track.time_us, east_deg, left=np.nan, right=np.nan)
    away_deg = wrap_180(east - wrap_180(fixes.lon_deg - lon_deg))
    return np.column_stack(
        [np.radians(lat - fixes.lat_deg) * meridian, np.radians(away_deg) * parallel]
    )
