"""Position references: interpolated GPS and withheld fixes; and Table I of the paper.

The paper compares its fused track with interpolated GPS, which consists of the same fixes that were
fused. That favours a filter that copies the GPS, so tracks are also compared with withheld fixes
here, and with the reference if there is one.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Final

import numpy as np

from gateway.analysis import metrics
from gateway.analysis.flight import (
    BoolArray,
    Fixes,
    Flight,
    FlightTrack,
    FloatArray,
    IntArray,
    fixes_of,
)
from gateway.geometry.angle import wrap_180
from gateway.geometry.geodesy import radii_m
from gateway.units import US_PER_S

if TYPE_CHECKING:
    import pandas as pd

MAX_GAP_S: Final = 2.0
"""Longest gap to interpolate; over a longer one a straight line is no reference for a curve."""
ENDING: Final = 0.2
"""Last part of a span, as a share of it, in which a fix counts as its end."""
PAPER_ERRORS: Final = (
    (0.1, 0.1, 2.036, 2.652),
    (0.1, 0.5, 4.412, 5.497),
    (0.1, 0.9, 12.866, 19.465),
    (0.5, 0.1, 3.896, 4.729),
    (0.5, 0.5, 7.477, 8.277),
    (0.5, 0.9, 20.816, 24.115),
    (0.9, 0.1, 6.191, 7.179),
    (0.9, 0.5, 11.372, 11.957),
    (0.9, 0.9, 30.411, 31.506),
)
"""Rows of the paper's Table I: alpha, beta, mean error in latitude and in longitude, m."""


def interpolate(fixes: Fixes, time_us: IntArray) -> FlightTrack:
    """Interpolate linearly between the fixes, at their times of validity."""
    size = len(time_us)
    if len(fixes) < 2:
        unknown = (np.full((size, *shape), np.nan) for shape in ((4,), (), (), (), (3,)))
        return FlightTrack(time_us, *unknown)
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
    """Select fixes at least an interval apart; unusable ones are all kept."""
    keep = np.ones(len(flight.fixes), np.bool_)
    last_us: int | None = None
    # A tolerance of a tenth of the interval, for jitter of the arrival.
    least_us = round(interval_s * US_PER_S * 0.9)
    for k in np.flatnonzero(flight.usable).tolist():
        time_us = flight.fixes[k].time_us
        if last_us is not None and 0 <= time_us - last_us < least_us:
            keep[k] = False
        else:
            last_us = time_us
    return keep


def withhold(flight: Flight, every: int) -> BoolArray:
    """Select all fixes except every n-th usable one."""
    usable = flight.usable
    return np.asarray(~(usable & (np.cumsum(usable) % every == 0)))


def withhold_spans(flight: Flight, span_s: float, every_s: float) -> tuple[BoolArray, BoolArray]:
    """Select all fixes except those in the last `span_s` of every `every_s`; and each span's last.

    A span without a fix near its end, as in an outage or at the end of the flight, has no last one.
    """
    usable, times_us = flight.usable, np.array([fix.time_us for fix in flight.fixes], np.int64)
    phase_s = flight.seconds(times_us) % every_s
    keep = ~usable | (phase_s < every_s - span_s)
    ends = usable & (phase_s >= every_s - ENDING * span_s)
    # Of several fixes at the end of a span, only the last one counts.
    ends[:-1] &= ~ends[1:]
    return keep, ends


def error_at_fixes_m(track: FlightTrack, fixes: Fixes) -> FloatArray:
    """Return the horizontal error of a track at fixes, at their times of validity."""
    if not len(fixes):
        return np.empty((0, 2))
    meridian, parallel = radii_m(float(fixes.lat_deg[0]), float(fixes.alt_amsl_m[0]))
    lat = np.interp(fixes.valid_us, track.time_us, track.lat_deg, left=np.nan, right=np.nan)
    # Relative to the first fix, so that interpolation works across the date line.
    lon_deg = fixes.lon_deg[0]
    east_deg = wrap_180(track.lon_deg - lon_deg)
    east = np.interp(fixes.valid_us, track.time_us, east_deg, left=np.nan, right=np.nan)
    away_deg = wrap_180(east - wrap_180(fixes.lon_deg - lon_deg))
    return np.column_stack(
        [np.radians(lat - fixes.lat_deg) * meridian, np.radians(away_deg) * parallel]
    )


def scored_error_m(track: FlightTrack, flight: Flight, fixes: Fixes) -> float:
    """Return the horizontal RMS error of a track at the fixes during scored samples."""
    nearest = np.searchsorted(flight.time_us, fixes.valid_us).clip(0, len(flight.time_us) - 1)
    error_m = error_at_fixes_m(track, fixes)[flight.scored[nearest]]
    return metrics.rms(np.hypot(*error_m.T))


def paper_table() -> "pd.DataFrame":
    """Return the paper's Table I as `sweep.blend_table` returns ours."""
    import pandas as pd

    return pd.DataFrame(PAPER_ERRORS, columns=["alpha", "beta", "north_m", "east_m"])


@dataclass(frozen=True)
class SplitFlight:
    """A flight with the fixes to fuse only, and with those to compare with only."""

    fused: Flight
    held: Flight

    @classmethod
    def by(cls, flight: Flight, keep: BoolArray) -> "SplitFlight":
        """Split a flight by which fixes are fused."""
        return cls(flight.with_fixes(keep), flight.with_fixes(~keep))

    @cached_property
    def interpolated(self) -> FlightTrack:
        """Straight lines between the fused fixes."""
        return interpolate(fixes_of(self.fused), self.fused.time_us)

    @cached_property
    def held_fixes(self) -> Fixes:
        """The withheld fixes; may be empty."""
        return fixes_of(self.held)


def score(track: FlightTrack, split: SplitFlight) -> dict[str, float]:
    """Score one track; NaN if there is nothing to compare with."""
    flight, held = split.fused, split.held_fixes
    to_gps = metrics.position_error_m(track, split.interpolated)[flight.scored]
    found = {
        "north_m": metrics.mean_abs(to_gps[:, 0]),
        "east_m": metrics.mean_abs(to_gps[:, 1]),
        "interpolated_m": metrics.rms(np.hypot(to_gps[:, 0], to_gps[:, 1])),
        "held_m": scored_error_m(track, flight, held),
        "reference_m": float("nan"),
        "attitude_deg": float("nan"),
    }
    if flight.reference is not None:
        truth = flight.reference.track
        error = metrics.position_error_m(track, truth)[flight.scored]
        turned = metrics.total_error_rad(metrics.rotation_error(track.q_nb, truth.q_nb))
        found["reference_m"] = metrics.rms(np.hypot(error[:, 0], error[:, 1]))
        found["attitude_deg"] = metrics.rms(np.degrees(turned[flight.scored]))
    return found


def grows(table: "pd.DataFrame", column: str) -> bool:
    """Return whether an error increases with alpha and with beta, in every row and column."""
    grid = table.pivot_table(index="alpha", columns="beta", values=column).to_numpy()
    return bool(np.all(np.diff(grid, axis=0) > 0.0) and np.all(np.diff(grid, axis=1) > 0.0))
