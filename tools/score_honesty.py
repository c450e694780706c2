"""How honest the standard deviations are that an estimator tells."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gateway.estimation.columns import (
    NAV_ATTITUDE_STD,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_VEL,
    NAV_VEL_STD,
)
from tools.flights import Flight, north_east_m, simulated_flight
from tools.score_tables import Scores

Run = Callable[[Flight], np.ndarray]


def normalised_errors(flight: Flight, out: np.ndarray) -> dict[str, np.ndarray]:
    """Divide the errors of a simulated flight by the standard deviations told, (n, 3) by kind."""
    true = Rotation.from_quat(flight.q_nb, scalar_first=True)
    found = Rotation.from_quat(out[:, :4], scalar_first=True)
    place = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON])
    down = flight.truth["down"] + out[:, NAV_LAT + 2]
    errors = {
        "attitude": ((true * found.inv()).as_rotvec(), NAV_ATTITUDE_STD),
        "velocity": (flight.truth["vel"] - out[:, NAV_VEL : NAV_VEL + 3], NAV_VEL_STD),
        "position": (np.column_stack([flight.pos_ne_m - place, down]), NAV_POS_STD),
    }
    return {
        kind: (error / out[:, column : column + 3])[flight.counts]
        for kind, (error, column) in errors.items()
    }


def consistency(run: Run, seeds: Sequence[int]) -> dict[str, Scores]:
    """Average the normalised squared error over flights, by kind.

    At each instant the average over M flights of three axes, each divided by its standard
    deviation, is chi-squared of 3 M degrees of freedom if the covariance is right [1]_.

    Returns
    -------
    dict
        By kind: `nees` per axis, expected 1; `low` and `high`, the 95 % band of one instant's
        average; `inside`, the share of instants within it.

    References
    ----------
    .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
       Navigation", 2001, section 5.4.2.
    """
    flights = [simulated_flight(seed, calibrated=seed % 2 == 1) for seed in seeds]
    runs = [normalised_errors(flight, run(flight)) for flight in flights]
    freedom = 3 * len(seeds)
    low, high = chi2.ppf([0.025, 0.975], freedom) / freedom
    found = {}
    for kind in runs[0]:
        nees = np.mean([(errors[kind] ** 2).mean(axis=1) for errors in runs], axis=0)
        inside = np.mean((nees > low) & (nees < high))
        found[kind] = {"nees": nees.mean(), "low": low, "high": high, "inside": inside}
    return found


def judged_by(flight: Flight, out: np.ndarray) -> Flight:
    """Take what an estimator tells of a flight for its reference, no surer than it is told."""
    told = {
        "attitude_std": out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3],
        "place_std": out[:, NAV_POS_STD : NAV_POS_STD + 2],
    }
    return replace(
        flight,
        q_nb=out[:, :4],
        pos_ne_m=north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]),
        free_heading=False,
        truth=flight.truth | told,
    )


def two_sigma(flight: Flight, out: np.ndarray) -> dict[str, np.ndarray]:
    """Tell the share of tilt, heading and place within two sigma at each instant, (n,) by kind.

    What the reference is unsure by counts, too. NaN where there is no reference, nothing is told,
    or it does not count.
    """
    tilt, heading, place = (np.full(len(out), np.nan) for _ in range(3))
    sure = np.zeros((len(out), 3))
    unsure = flight.truth.get("attitude_std", sure)
    use = flight.counts & np.isfinite(flight.q_nb[:, 0]) & np.isfinite(out[:, NAV_ATTITUDE_STD])
    if use.any() and not flight.free_heading:
        true = Rotation.from_quat(flight.q_nb[use], scalar_first=True)
        found = Rotation.from_quat(out[use, :4], scalar_first=True)
        told = np.hypot(out[use, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3], unsure[use])
        within = np.abs((true * found.inv()).as_rotvec()) < 2.0 * told
        tilt[use], heading[use] = within[:, :2].mean(axis=1), within[:, 2]
    off = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
    told = np.hypot(
        out[:, NAV_POS_STD : NAV_POS_STD + 2], flight.truth.get("place_std", sure[:, :2])
    )
    use = flight.counts & np.isfinite(off[:, 0]) & np.isfinite(told[:, 0])
    place[use] = (np.abs(off[use]) < 2.0 * told[use]).mean(axis=1)
    return {"tilt": tilt, "heading": heading, "place": place}


def shares_after(flight: Flight, out: np.ndarray, since_s: float) -> dict[str, float]:
    """Average `two_sigma` from a time on, by kind."""
    late = flight.log.imu_time_us * 1e-6 >= since_s
    return {kind: share(within[late]) for kind, within in two_sigma(flight, out).items()}


def share(within: np.ndarray) -> float:
    """Average what is known; NaN where nothing is."""
    known = within[np.isfinite(within)]
    return float(known.mean()) if len(known) else math.nan
