"""Table I of the paper: how alpha and beta change the error of the position.

The paper measures its fused track against interpolated GPS, the same fixes that it was fused from.
That favours a filter that copies the GPS; so here it is also measured against withheld fixes, and
the reference if there is one.
"""

import itertools
from dataclasses import dataclass
from typing import Final

import msgspec
import numpy as np
import pandas as pd

from gateway.analysis.flight_arrays import (
    BoolArray,
    Fixes,
    Flight,
    FlightTrack,
    FloatArray,
    FusionSettings,
    fixes_of,
)
from gateway.analysis.fusion import fuse
from gateway.analysis.interpolation import error_at_fixes_m, interpolate, split, thin
from gateway.analysis.metrics import mean_abs, position_error_m, rms

WEIGHTS: Final = (0.1, 0.5, 0.9)

PAPER_TABLE: Final = pd.DataFrame(
    [
        (0.1, 0.1, 2.036, 2.652),
        (0.1, 0.5, 4.412, 5.497),
        (0.1, 0.9, 12.866, 19.465),
        (0.5, 0.1, 3.896, 4.729),
        (0.5, 0.5, 7.477, 8.277),
        (0.5, 0.9, 20.816, 24.115),
        (0.9, 0.1, 6.191, 7.179),
        (0.9, 0.5, 11.372, 11.957),
        (0.9, 0.9, 30.411, 31.506),
    ],
    columns=["alpha", "beta", "north_m", "east_m"],
)
"""The paper's Table I: mean error in latitude and longitude, in metres."""


@dataclass(frozen=True, slots=True)
class Judge:
    """The data against which the tracks of one flight are scored."""

    fused: Flight
    """The flight with only the fixes that are fused."""
    interpolated: FlightTrack
    """Straight lines between those."""
    held_flight: Flight
    """The flight with only the fixes that are not fused."""
    held: Fixes
    """The same as arrays; may be empty."""


def make_judge(flight: Flight, keep: BoolArray) -> Judge:
    """Split the fixes of a flight."""
    return judge_of(*split(flight, keep))


def judge_of(fused: Flight, held: Flight) -> Judge:
    """Build a judge from a flight with the fused fixes, and one with the withheld ones."""
    return Judge(fused, interpolate(fixes_of(fused), fused.time_us), held, fixes_of(held))


def score(track: FlightTrack, judge: Judge) -> dict[str, float]:
    """Score one track."""
    flight = judge.fused
    scored = flight.scored
    to_gps = position_error_m(track, judge.interpolated)[scored]
    found = {
        "north_m": mean_abs(to_gps[:, 0]),
        "east_m": mean_abs(to_gps[:, 1]),
        "interpolated_m": rms(np.hypot(to_gps[:, 0], to_gps[:, 1])),
        "held_m": rms(np.hypot(*_scored_fix_errors(track, judge).T)),
        "reference_m": float("nan"),
    }
    if flight.reference is not None:
        error = position_error_m(track, flight.reference.track)[scored]
        found["reference_m"] = rms(np.hypot(error[:, 0], error[:, 1]))
    return found


def blend_table(
    flight: Flight,
    fusion: FusionSettings,
    interval_s: float,
) -> pd.DataFrame:
    """Fuse a flight with every pair of weights, as in Table I."""
    judge = make_judge(flight, thin(flight, interval_s))
    rows = []
    for alpha, beta in itertools.product(WEIGHTS, repeat=2):
        track = fuse(judge.fused, with_weights(fusion, alpha, beta))
        rows.append({"alpha": alpha, "beta": beta, **score(track, judge)})
    return pd.DataFrame(rows)


def with_weights(fusion: FusionSettings, alpha: float, beta: float) -> FusionSettings:
    """Choose the paper's estimator with these weights."""
    estimation = fusion.estimation
    paper = msgspec.structs.replace(estimation.paper, alpha_accel=alpha, beta_velocity=beta)
    estimation = msgspec.structs.replace(estimation, estimator="paper", paper=paper)
    return msgspec.structs.replace(fusion, estimation=estimation)


def grows(table: pd.DataFrame, column: str) -> bool:
    """Return whether an error grows with alpha and with beta, row by row and column by column."""
    grid = table.pivot_table(index="alpha", columns="beta", values=column).to_numpy()
    return bool(np.all(np.diff(grid, axis=0) > 0.0) and np.all(np.diff(grid, axis=1) > 0.0))


def _scored_fix_errors(track: FlightTrack, judge: Judge) -> FloatArray:
    """Errors at the held fixes that fall among the scored samples."""
    errors = error_at_fixes_m(track, judge.held)
    times = judge.fused.time_us
    index = np.searchsorted(times, judge.held.valid_us).clip(0, len(times) - 1)
    return np.asarray(errors[judge.fused.scored[index]])
