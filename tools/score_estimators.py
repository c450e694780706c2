"""Score the estimators on real and simulated flights, one set of default settings for all.

    python tools/score_estimators.py --data DIR [--only FLIGHT] [--json FILE] [--no-peers]

Every estimator runs causally but `smoothed`, which knows the whole flight. Attitude is compared
with the reference where it counts (in flight, in motion); position at the native fix rate, with one
fix a second, and in outages of 10 and 30 s that are cut out of the log again and again, there also
with the fixes that were withheld. How often the errors lie within twice the standard deviations
told is counted over the whole flight, in the outages, after disturbances and without any GPS. Other
people's filters (extra `bench`) run beside.
"""

import argparse
import json
import math
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.estimation.columns import (
    GPS_LAT,
    GPS_USABLE,
    NAV_LAT,
    NAV_LON,
)
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.estimation.smoothing.smoother import smooth
from gateway.geometry.angle import wrap_180, wrap_pi
from tools.flights import Flight, north_east_m, read_flight, run_paper, simulated_flight
from tools.peers import PEERS
from tools.score_honesty import consistency, judged_by, share, shares_after, two_sigma
from tools.score_speeds import singly_per_s, vqf_per_s
from tools.score_tables import (
    KINDS,
    SPEEDS,
    Scores,
    show_consistency,
    show_honesty,
    show_scores,
    show_spoilt,
)
from tools.spoil_flight import RECOVERY_S, SPOILS, applies, departure

Run = Callable[[Flight], np.ndarray]

SEEDS = (11, 12, 13)
NEES_SEEDS = range(31, 41)
"""Held out: no setting was chosen on these."""
OUTAGE_EVERY = 2.0
"""An outage begins each so many of its lengths; those too close to another run another time."""
OUTAGE_REST_S = 20.0
THIN_S = 0.95
REPEATS = 3


def estimator_of(name: str, flight: Flight) -> KernelEstimator[Any, Any]:
    """Make a compiled estimator with a flight's references."""
    found = make_estimator(EstimationSettings(estimator=name, reference=flight.reference))
    assert isinstance(found, KernelEstimator)
    return found


def run_complementary(flight: Flight) -> np.ndarray:
    """Run the default estimator."""
    return estimator_of("complementary", flight).run(flight.log)


def run_eskf(flight: Flight) -> np.ndarray:
    """Run the Kalman filter."""
    return estimator_of("eskf", flight).run(flight.log)


def run_smoothed(flight: Flight) -> np.ndarray:
    """Run the Kalman filter from both ends."""
    return smooth(estimator_of("eskf", flight), flight.log)[0]


OWN: dict[str, Run] = {"paper": run_paper, "complementary": run_complementary, "eskf": run_eskf}
SMOOTHED: dict[str, Run] = {"smoothed": run_smoothed}
TELLING = ("complementary", "eskf", "smoothed")
"""These tell how accurate they are."""


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
    angles = wrap_180(np.degrees(found.as_euler("ZYX") - true.as_euler("ZYX")))
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
    return wrap_pi(2.0 * np.arctan2(z, w))


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


def outages(
    flight: Flight, run: Run, length_s: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Run over a flight without the fixes of some of its seconds, again and again.

    Yields
    ------
    out : ndarray, shape (n, NAV_COLUMNS)
        What the estimator tells of the whole flight.
    inside : ndarray of bool, shape (n,)
        The samples within the outages.
    lost : ndarray of bool, shape (m,)
        The fixes that were withheld.
    """
    time_s, gps_s = flight.log.imu_time_us * 1e-6, flight.log.gps_time_us * 1e-6
    for begins in outage_passes(flight, length_s):
        lost, inside = np.zeros(len(gps_s), bool), np.zeros(len(time_s), bool)
        for begin in begins:
            lost |= (gps_s > begin) & (gps_s <= begin + length_s)
            inside |= (time_s > begin) & (time_s <= begin + length_s)
        yield run(flight.with_gps(~lost)), inside, lost


def outage_score(flight: Flight, run: Run, length_s: float) -> float:
    """RMS of the position error over all samples within outages."""
    errors = [
        position_errors_m(flight, out)[inside] for out, inside, _ in outages(flight, run, length_s)
    ]
    return rms(np.concatenate(errors)) if errors else math.nan


def outage_scores(flight: Flight, run: Run, length_s: float) -> Scores:
    """Score the outages of one length: `out10` of 10 s, and how far off the withheld fixes.

    `tilt_out10`, `heading_out10` and `place_out10` are the shares within two sigma.
    """
    name = f"out{length_s:.0f}"
    errors, fixes, within = [], [], []
    for out, inside, lost in outages(flight, run, length_s):
        errors.append(position_errors_m(flight, out)[inside])
        fixes.append(fix_errors_m(flight, out, lost))
        within.append({kind: w[inside] for kind, w in two_sigma(flight, out).items()})
    if not errors:
        return {}
    joined = {kind: np.concatenate([w[kind] for w in within]) for kind in within[0]}
    scores = {name: rms(np.concatenate(errors)), f"fix_{name}": rms(np.concatenate(fixes))}
    return scores | {f"{kind}_{name}": share(values) for kind, values in joined.items()}


def fix_errors_m(flight: Flight, out: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Horizontal distance from some fixes at the times for which they were valid."""
    which = which & (flight.log.gps[:, GPS_USABLE] == 1.0)
    valid_s = flight.log.gps_time_us[which] * 1e-6 - flight.reference.gps_latency_s
    place = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON])
    fixes = north_east_m(flight, *flight.log.gps[which, GPS_LAT : GPS_LAT + 2].T)
    time_s = flight.log.imu_time_us * 1e-6
    return np.hypot(*(np.interp(valid_s, time_s, place[:, k]) - fixes[:, k] for k in range(2)))


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
        **outage_scores(flight, run, 10.0),
        **outage_scores(flight, run, 30.0),
    }


def honesty_scores(flight: Flight, run: Run, out: np.ndarray) -> Scores:
    """Tell how often the errors lie within two sigma: `tilt_2s` with GPS, `tilt_alone` without."""
    scores = {f"{kind}_2s": share(values) for kind, values in two_sigma(flight, out).items()}
    if len(flight.log.gps):
        alone = flight.with_gps(np.zeros(len(flight.log.gps), bool))
        out = run(alone)
        scores |= {f"{kind}_alone": share(v) for kind, v in two_sigma(alone, out).items()}
        found = attitude_scores(alone, out[:, :4])
        scores |= {f"{kind}_off": found[kind] for kind in ("inclination", "heading") if found}
    return scores


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
    if name in TELLING:
        scores |= honesty_scores(flight, run, out)
    scores["finite"] = float(np.isfinite(out[:, :4]).all())
    scores["samples_per_s"] = len(out) / best_s
    if name in OWN:
        scores["singly_per_s"] = singly_per_s(flight, name)
    elif name == "vqf":
        scores["samples_per_s"], scores["singly_per_s"] = vqf_per_s(flight)
    elif name in PEERS:
        scores["singly_per_s"] = scores.pop("samples_per_s")
    return scores


def best_known(flight: Flight) -> Flight:
    """Let the truth judge a simulated flight, and what both ends tell a real one."""
    return flight if flight.truth else judged_by(flight, run_smoothed(flight))


def spoilt_scores(
    known: Flight, name: str, run: Run
) -> tuple[dict[str, tuple[float, float, float, float]], Scores]:
    """Spoil a flight in every way, and compare with the unspoilt run after the recovery.

    Parameters
    ----------
    known : Flight
        From `best_known`.
    name : str
        Of the estimator.
    run : callable
        It.

    Returns
    -------
    off : dict
        By the way of spoiling: tilt, heading that is told as valid, both in deg, and place in m,
        kept for 95 % of the time; and the share of the time in which a heading is told.
    shares : dict
        The lowest share within two sigma since a disturbance, over all ways: `tilt_spoilt`.
    """
    out, found, shares = run(known), {}, []
    for how, spoil in SPOILS.items():
        if applies(how, known):
            spoilt = spoil(known)
            spoilt_out = run(spoilt.flight)
            off = departure(known, out, spoilt.flight, spoilt_out)
            since_s = spoilt.ends_s + RECOVERY_S
            found[how] = (*off.as_told().after(since_s), off.told_share(since_s))
            if name in TELLING:
                shares.append(shares_after(spoilt.flight, spoilt_out, spoilt.ends_s))
    if not shares:
        return found, {}
    return found, {f"{kind}_spoilt": min(each[kind] for each in shares) for kind in KINDS}


def flights_to_score(folder: Path, only: Sequence[str] | None) -> list[Flight]:
    """Read and simulate the flights whose names hold one of some words; all, where none is given.

    Raises
    ------
    SystemExit
        If there is none.
    """
    makers: dict[str, Callable[[], Flight]] = {
        path.name.split(".")[0]: partial(read_flight, path)
        for path in sorted(folder.glob("*.csv*"))
    }
    makers |= {
        f"simulated {seed}": partial(simulated_flight, seed, calibrated=seed % 2 == 1)
        for seed in SEEDS
    }
    names = [name for name in makers if not only or any(word in name for word in only)]
    if not names:
        raise SystemExit(f"no flight is named {' or '.join(only or ())}: {', '.join(makers)}")
    return [makers[name]() for name in names]


def main() -> None:
    """Read, run, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="folder of *.csv.gz flights")
    parser.add_argument("--only", action="append", help="flights whose names hold this; repeatable")
    parser.add_argument("--json", type=Path, help="write all numbers here too")
    parser.add_argument("--no-peers", action="store_true", help="run only our own")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    flights = flights_to_score(arguments.data, arguments.only)
    runs = OWN | SMOOTHED | ({} if arguments.no_peers else PEERS)
    board: dict[str, dict[str, Scores]] = {flight.name: {} for flight in flights}
    spoilt: dict[str, dict[str, dict[str, tuple[float, float, float, float]]]] = {}
    honesty: dict[str, Scores] = {}
    columns = (TextColumn("{task.description:50}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True)) as progress:
        steps = len(flights) * (len(runs) + len(OWN)) + (0 if arguments.only else 1)
        task = progress.add_task("", total=steps)

        def begin(step: str) -> None:
            progress.update(task, description=step)

        for flight in flights:
            for name, run in runs.items():
                begin(f"{flight.name}: {name}")
                board[flight.name][name] = score(flight, name, run)
                progress.advance(task)
            spoilt[flight.name], known = {}, best_known(flight)
            for name, run in OWN.items():
                begin(f"{flight.name} spoilt: {name}")
                spoilt[flight.name][name], shares = spoilt_scores(known, name, run)
                board[flight.name][name] |= shares
                progress.advance(task)
        if not arguments.only:
            begin(f"NEES over {len(NEES_SEEDS)} simulated flights")
            honesty = consistency(run_eskf, NEES_SEEDS)
            progress.advance(task)
    show_scores(board)
    show_honesty(board)
    show_spoilt(spoilt)
    if honesty:
        show_consistency(honesty, len(NEES_SEEDS))
    if arguments.json:
        found = {"flights": board, "consistency": honesty, "spoilt": spoilt}
        arguments.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
