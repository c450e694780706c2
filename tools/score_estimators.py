"""Score the estimators on real and simulated flights, one set of default settings for all.

    python tools/score_estimators.py --data DIR [--json FILE] [--no-peers]

Every estimator runs causally. Attitude is compared with the reference where it counts (in flight,
in motion); position at the native fix rate, with one fix a second, and in outages of 10 and 30 s
that are cut out of the log again and again. Other people's filters (extra `bench`) run beside.
"""

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.estimation.columns import (
    NAV_ATTITUDE_STD,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_VEL,
    NAV_VEL_STD,
)
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.estimation.smoothing.smoother import smooth
from tools.flights import Flight, north_east_m, read_flight, run_paper, simulated_flight
from tools.peers import PEERS
from tools.spoil_flight import RECOVERY_S, SPOILS, applies, departure

Run = Callable[[Flight], np.ndarray]
Scores = dict[str, float]

SEEDS = (11, 12, 13)
NEES_SEEDS = range(31, 41)
"""Held out: no setting was chosen on these."""
OUTAGE_EVERY = 2.0
"""An outage begins each so many of its lengths; those too close to another run another time."""
OUTAGE_REST_S = 20.0
THIN_S = 0.95
SPEEDS = {"paper": 5e5, "complementary": 1e6, "eskf": 2e5, "smoothed": 1e5}
"""Samples a second that each is to reach."""
SPOILT_LIMITS = (3.0, 3.0, 10.0)
"""Tilt and heading in deg and place in m, off the unspoilt run, at which a spoilt one is back."""
REPEATS = 3

TARGETS: dict[tuple[str, str], Scores] = {
    ("arduplane_testlog2", "complementary"): {
        "roll": 1.9, "pitch": 1.7, "yaw": 2.8, "pos_1hz": 1.07, "out10": 12.0,
    },
    ("arduplane_testlog2", "eskf"): {
        "roll": 0.9, "pitch": 0.7, "yaw": 1.1, "pos_1hz": 1.07, "out10": 6.4,
    },
    ("car_rtk_drive0708_first_half", "eskf"): {"out10": 2.1},
    ("arduplane_testlog2", "smoothed"): {"yaw": 1.0, "out10": 1.5, "out30": 10.0},
    ("px4_mocap_log008", "complementary"): {"total": 2.2},
    ("px4_mocap_log008", "eskf"): {"total": 2.2},
}  # fmt: skip
"""What is to be reached; on the other flights, not to be worse than VQF."""


def run_complementary(flight: Flight) -> np.ndarray:
    """Run the default estimator."""
    settings = EstimationSettings(estimator="complementary", reference=flight.reference)
    return make_estimator(settings).run(flight.log)


def run_eskf(flight: Flight) -> np.ndarray:
    """Run the Kalman filter."""
    settings = EstimationSettings(estimator="eskf", reference=flight.reference)
    return make_estimator(settings).run(flight.log)


def run_smoothed(flight: Flight) -> np.ndarray:
    """Run the Kalman filter from both ends."""
    settings = EstimationSettings(estimator="eskf", reference=flight.reference)
    return smooth(make_estimator(settings), flight.log)


OWN: dict[str, Run] = {"paper": run_paper, "complementary": run_complementary, "eskf": run_eskf}
SMOOTHED: dict[str, Run] = {"smoothed": run_smoothed}


def rms(values: np.ndarray) -> float:
    """Root of the mean square of what is known."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def attitude_scores(flight: Flight, q_nb: np.ndarray) -> Scores:
    """Compare attitudes in degrees: by Euler angles, and as heading and inclination."""
    use = flight.counts & np.isfinite(flight.q_nb[:, 0]) & np.isfinite(q_nb[:, 0])
    if not use.any():
        return {}
    true = Rotation.from_quat(flight.q_nb[use], scalar_first=True)
    found = Rotation.from_quat(q_nb[use], scalar_first=True)
    if flight.free_heading:
        mean = np.angle(np.exp(1j * heading_rad(found * true.inv())).mean())
        found = Rotation.from_euler("z", -mean) * found
    off = found * true.inv()
    w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
    angles = np.degrees(found.as_euler("ZYX") - true.as_euler("ZYX"))
    angles = (angles + 180.0) % 360.0 - 180.0
    return {
        "roll": rms(angles[:, 2]),
        "pitch": rms(angles[:, 1]),
        "yaw": rms(angles[:, 0]),
        "total": rms(np.degrees(off.magnitude())),
        "heading": rms(np.degrees(heading_rad(off))),
        "inclination": rms(np.degrees(2.0 * np.arccos(np.hypot(w, z).clip(max=1.0)))),
    }


def heading_rad(off: Rotation) -> np.ndarray:
    """Split the turn about down from small rotations in NED."""
    w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
    return (2.0 * np.arctan2(z, w) + np.pi) % (2.0 * np.pi) - np.pi


def position_errors_m(flight: Flight, out: np.ndarray) -> np.ndarray:
    """Horizontal distance from the reference, NaN where there is none."""
    off = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
    return np.hypot(off[:, 0], off[:, 1])


def outage_passes(flight: Flight, length_s: float) -> list[list[float]]:
    """Lay out the beginnings of outages over as many passes as they need."""
    time_s = flight.log.imu_time_us * 1e-6
    known = time_s[flight.counts & np.isfinite(flight.pos_ne_m[:, 0])]
    first = max(known[0], flight.log.gps_time_us[0] * 1e-6) + 10.0
    passes: list[list[float]] = []
    for begin in np.arange(first, known[-1] - length_s, OUTAGE_EVERY * length_s):
        for line in passes:
            if begin - line[-1] >= length_s + OUTAGE_REST_S:
                line.append(begin)
                break
        else:
            passes.append([begin])
    return passes


def outage_score(flight: Flight, run: Run, length_s: float) -> float:
    """RMS of the position error over all samples within outages."""
    time_s, gps_s = flight.log.imu_time_us * 1e-6, flight.log.gps_time_us * 1e-6
    errors = []
    for begins in outage_passes(flight, length_s):
        lost, inside = np.zeros(len(gps_s), bool), np.zeros(len(time_s), bool)
        for begin in begins:
            lost |= (gps_s > begin) & (gps_s <= begin + length_s)
            inside |= (time_s > begin) & (time_s <= begin + length_s)
        cut = flight.with_gps(~lost)
        errors.append(position_errors_m(flight, run(cut))[inside])
    return rms(np.concatenate(errors)) if errors else math.nan


def thinned(flight: Flight) -> Flight:
    """Keep one fix a second."""
    keep, last = np.zeros(len(flight.log.gps), bool), -math.inf
    for i, gps_s in enumerate(flight.log.gps_time_us * 1e-6):
        if gps_s - last >= THIN_S:
            keep[i], last = True, gps_s
    return flight.with_gps(keep)


def position_scores(flight: Flight, run: Run, out: np.ndarray) -> Scores:
    """Score the position in metres at every fix rate and in outages."""
    if not np.isfinite(flight.pos_ne_m).any() or len(flight.log.gps) == 0:
        return {}
    errors = position_errors_m(flight, out)[flight.counts]
    return {
        "pos": rms(errors),
        "pos_max": float(np.nanmax(errors)),
        "pos_1hz": rms(position_errors_m(flight, run(thinned(flight)))[flight.counts]),
        "out10": outage_score(flight, run, 10.0),
        "out30": outage_score(flight, run, 30.0),
    }


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


def score(flight: Flight, name: str, run: Run) -> Scores:
    """Run one estimator over one flight and score it."""
    out = run(flight)
    best_s = math.inf
    for _ in range(REPEATS if name in SPEEDS else 1):
        begin = time.perf_counter()
        out = run(flight)
        best_s = min(best_s, time.perf_counter() - begin)
    scores = attitude_scores(flight, out[:, :4])
    if out.shape[1] > 4:
        scores |= position_scores(flight, run, out)
    if name in ("eskf", "smoothed"):
        scores |= honesty_shares(flight, out)
    scores["finite"] = float(np.isfinite(out[:, :4]).all())
    scores["samples_per_s"] = len(out) / best_s
    return scores


def targets_for(flight: str, name: str, board: dict[str, Scores]) -> Scores:
    """Return what a row is to reach."""
    found = dict(TARGETS.get((flight, name), {}))
    if flight.startswith("broad") and name in ("complementary", "eskf") and "vqf" in board:
        found |= {key: board["vqf"][key] for key in ("total",)}
    found |= {"samples_per_s": SPEEDS[name]} if name in SPEEDS else {}
    return found


def show(board: dict[str, dict[str, Scores]]) -> None:
    """Print one table; green reaches its target, red does not."""
    columns = ["roll", "pitch", "yaw", "total", "heading", "inclination", "pos", "pos_max"]
    columns += ["pos_1hz", "out10", "out30", "tilt_2s", "heading_2s", "place_2s"]
    table = Table(box=box.SIMPLE_HEAD, title="RMSE in deg and m")
    for column in ("flight", "estimator", *columns, "samples/s"):
        table.add_column(column, justify="left" if column in ("flight", "estimator") else "right")
    for flight, rows in board.items():
        for name, scores in rows.items():
            wanted = targets_for(flight, name, rows)
            cells = [cell(scores, column, wanted) for column in columns]
            table.add_row(flight, name, *cells, cell(scores, "samples_per_s", wanted))
        table.add_section()
    Console(width=240).print(table)


def show_consistency(found: dict[str, Scores]) -> None:
    """Print how honest the standard deviations of the Kalman filter are."""
    title = f"NEES of eskf per axis over {len(NEES_SEEDS)} simulated flights, expected 1"
    table = Table(box=box.SIMPLE_HEAD, title=title)
    for column in ("", "NEES", "95 % band", "instants in it"):
        table.add_column(column, justify="left" if not column else "right")
    for kind, scores in found.items():
        good = scores["low"] < scores["nees"] < scores["high"]
        nees = f"[{'green' if good else 'red'}]{scores['nees']:.2f}[/]"
        band = f"{scores['low']:.2f} to {scores['high']:.2f}"
        table.add_row(kind, nees, band, f"{100.0 * scores['inside']:.0f} %")
    Console(width=240).print(table)


def cell(scores: Scores, column: str, wanted: Scores) -> str:
    """Write one number, coloured by its target."""
    value = scores.get(column, math.nan)
    if not math.isfinite(value):
        return ""
    text = f"{value:,.0f}" if column == "samples_per_s" else f"{value:.2f}"
    if column not in wanted:
        return text
    good = value >= wanted[column] if column == "samples_per_s" else value <= wanted[column]
    limit = "" if column == "samples_per_s" else f" ({wanted[column]:.2f})"
    return f"[{'green' if good else 'red'}]{text}[/]{limit}"


def spoilt_scores(flight: Flight, run: Run) -> dict[str, tuple[float, float, float]]:
    """Spoil a flight in every way, and compare with the unspoilt run after the recovery.

    Returns
    -------
    dict
        By the way of spoiling: tilt and heading in deg and place in m, kept for 95 % of the time.
    """
    out, found = run(flight), {}
    for how, spoil in SPOILS.items():
        if applies(how, flight):
            spoilt = spoil(flight)
            off = departure(flight, out, spoilt.flight, run(spoilt.flight))
            found[how] = off.after(spoilt.ends_s + RECOVERY_S)
    return found


def show_spoilt(board: dict[str, dict[str, dict[str, tuple[float, float, float]]]]) -> None:
    """Print what is left of each disturbance 20 s after its end."""
    title = f"{RECOVERY_S:.0f} s after a disturbance, off the unspoilt run: tilt/heading deg, m"
    table = Table(box=box.SIMPLE_HEAD, title=title)
    for column in ("flight", "estimator", *SPOILS):
        table.add_column(column)
    for flight, rows in board.items():
        for name, found in rows.items():
            cells = [spoilt_cell(found[how]) if how in found else "" for how in SPOILS]
            table.add_row(flight, name, *cells)
    Console(width=240).print(table)


def spoilt_cell(off: tuple[float, float, float]) -> str:
    """Write one disturbance's remains, coloured by the limits."""
    good = all(a < b for a, b in zip(off, SPOILT_LIMITS, strict=True))
    return f"[{'green' if good else 'red'}]{off[0]:.1f}/{off[1]:.1f} {off[2]:.1f}[/]"


def honesty_shares(flight: Flight, out: np.ndarray) -> Scores:
    """Tell the share of instants at which tilt, heading and place lie within two sigma."""
    use = flight.counts & np.isfinite(flight.q_nb[:, 0]) & np.isfinite(out[:, 0])
    shares: Scores = {}
    std = out[:, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
    if use.any() and not flight.free_heading:
        true = Rotation.from_quat(flight.q_nb[use], scalar_first=True)
        found = Rotation.from_quat(out[use, :4], scalar_first=True)
        off = np.abs((true * found.inv()).as_rotvec()) < 2.0 * std[use]
        shares = {"tilt_2s": float(off[:, :2].mean()), "heading_2s": float(off[:, 2].mean())}
    place = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
    told = flight.counts & np.isfinite(place[:, 0]) & np.isfinite(out[:, NAV_POS_STD])
    if told.any():
        within = np.abs(place[told]) < 2.0 * out[told, NAV_POS_STD : NAV_POS_STD + 2]
        shares["place_2s"] = float(within.mean())
    return shares


def main() -> None:
    """Read, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of *.csv.gz flights")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    parser.add_argument("--no-peers", action="store_true", help="run only our own")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    flights = [read_flight(path) for path in sorted(arguments.data.glob("*.csv*"))]
    flights += [simulated_flight(seed, calibrated=seed % 2 == 1) for seed in SEEDS]
    runs = OWN | SMOOTHED | ({} if arguments.no_peers else PEERS)
    board: dict[str, dict[str, Scores]] = {}
    spoilt: dict[str, dict[str, dict[str, tuple[float, float, float]]]] = {}
    for flight in flights:
        board[flight.name] = {name: score(flight, name, run) for name, run in runs.items()}
        spoilt[flight.name] = {
            name: spoilt_scores(flight, run) for name, run in OWN.items() if name != "paper"
        }
        print(f"{flight.name}: done", file=sys.stderr)
    show(board)
    show_spoilt(spoilt)
    honesty = consistency(run_eskf, NEES_SEEDS)
    show_consistency(honesty)
    if arguments.json:
        arguments.json.write_text(
            json.dumps(board | {"consistency": honesty, "spoilt": spoilt}, indent=1)
        )


if __name__ == "__main__":
    main()
