"""Score the estimators on recorded and simulated flights, one set of default settings for all.

    python -m tools.score_estimators --data DIR [--only FLIGHT] [--json FILE] [--estimator NAME]

There is one row for each flight and estimator. Attitude is compared with the reference in flight or
motion, in degrees RMS; `turns` is the heading without a reference: changes of the GPS velocity
within 20 s against the specific force in NED. Position is in metres RMS at the native fix rate,
with one fix a second, and in repeated artificial outages of 10 and 30 s. The height is compared
with the barometer plus its slow offset from GPS, its RMS and largest error and the RMS of the
climb. The other columns are the share of the time within two standard deviations, millions of
samples processed in a second, and the largest error 20 s after each disturbance of
`tools.spoil_flight` (--spoilt).
"""

import math
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    ACCEL,
    GPS_LAT,
    GPS_LON,
    GPS_VEL,
    NAV_ALT,
    NAV_ATTITUDE_STD,
    NAV_LAT,
    NAV_LON,
    NAV_POS_STD,
    NAV_VEL,
)
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.estimation.smoother import smooth
from gateway.geometry.angle import wrap_180, wrap_pi
from tools.flights import Flight, north_east_m, read_flight, run_paper, simulated_flight
from tools.harness import arguments, show, write_json
from tools.peers import PEERS
from tools.spoil_flight import RECOVERY_S, SPOILS, applies

Run = Callable[[Flight], np.ndarray]
Scores = dict[str, float]

SEEDS = (11, 12, 21)
OUTAGE_REST_S = 20.0
THIN_S = 0.95
CLIMB_S = 1.0
"""Time over which climbs are averaged."""
TURN_S = 20.0
"""Time in which changes of velocity give one heading."""
PAIR_S = 0.9
"""Least interval of the fixes of such a change."""
LEAST_PAIRS = 8
TURN_STD_RAD = math.radians(2.0)
"""Least number of pairs, and largest standard deviation, of such a heading."""
ATTITUDE = ("roll", "pitch", "yaw", "total", "inclination", "heading", "turns")
POSITION = ("pos", "pos_1hz", "out10", "out30", "alt", "alt_max", "climb")
SHARES = ("tilt_2s", "heading_2s", "pos_2s", "alt_2s")
SPEED = "million_per_s"
COLUMNS = (*ATTITUDE, *POSITION, *SHARES, SPEED)


def estimator_of(flight: Flight) -> KernelEstimator:
    """Return the Kalman filter with a flight's references."""
    found = make_estimator(EstimationSettings(reference=flight.reference))
    assert isinstance(found, KernelEstimator)
    return found


def run_eskf(flight: Flight) -> np.ndarray:
    """Run the Kalman filter."""
    return estimator_of(flight).run(flight.log)


def run_smoothed(flight: Flight) -> np.ndarray:
    """Run the smoother."""
    return smooth(estimator_of(flight), flight.log)[0]


OWN: dict[str, Run] = {"eskf": run_eskf, "smoothed": run_smoothed, "paper": run_paper}


def rms(values: np.ndarray) -> float:
    """Return the root of the mean square of the known values; NaN if there are none."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan


def heading_rad(off: Rotation) -> np.ndarray:
    """Return the rotation about down of rotations in NED."""
    w, z = off.as_quat(scalar_first=True)[:, [0, 3]].T
    return wrap_pi(2.0 * np.arctan2(z, w))


def attitude_scores(flight: Flight, q_nb: np.ndarray, since_s: float = -math.inf) -> Scores:
    """Compare attitudes with the reference, in degrees: Euler angles, inclination and heading."""
    use = flight.counts & (flight.log.imu_time_us * 1e-6 >= since_s)
    use &= np.isfinite(flight.q_nb[:, 0]) & np.isfinite(q_nb[:, 0])
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
        "inclination": rms(np.degrees(2.0 * np.arccos(np.hypot(w, z).clip(max=1.0)))),
        "heading": rms(np.degrees(heading_rad(off))),
    }


def position_errors_m(flight: Flight, out: np.ndarray) -> np.ndarray:
    """Return the horizontal distance from the reference; NaN where there is none."""
    if not len(flight.log.gps):
        return np.full(len(out), np.nan)
    off = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
    return np.hypot(off[:, 0], off[:, 1])


def outage_passes(flight: Flight, length_s: float) -> list[list[float]]:
    """Distribute the begins of outages over as many runs as they need."""
    time_s = flight.log.imu_time_us * 1e-6
    known = time_s[flight.counts & np.isfinite(flight.pos_ne_m[:, 0])]
    first = max(known[0], flight.log.gps_time_us[0] * 1e-6) + 10.0
    passes: list[list[float]] = []
    for begin in np.arange(first, known[-1] - length_s, 2.0 * length_s):
        for line in passes:
            if begin - line[-1] >= length_s + OUTAGE_REST_S:
                line.append(begin)
                break
        else:
            passes.append([begin])
    return passes


def outages(flight: Flight, run: Run, length_s: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the output and the samples inside the outages of each run."""
    time_s, gps_s = flight.log.imu_time_us * 1e-6, flight.log.gps_time_us * 1e-6
    for begins in outage_passes(flight, length_s):
        lost, inside = np.zeros(len(gps_s), bool), np.zeros(len(time_s), bool)
        for begin in begins:
            lost |= (gps_s > begin) & (gps_s <= begin + length_s)
            inside |= (time_s > begin) & (time_s <= begin + length_s)
        yield run(flight.with_gps(~lost)), inside


def outage_score(flight: Flight, run: Run, length_s: float) -> float:
    """Return the RMS position error within outages."""
    errors = [
        position_errors_m(flight, out)[inside] for out, inside in outages(flight, run, length_s)
    ]
    return rms(np.concatenate(errors)) if errors else math.nan


def thinned(flight: Flight) -> Flight:
    """Keep one fix a second."""
    keep, last = np.zeros(len(flight.log.gps), bool), -math.inf
    for i, gps_s in enumerate(flight.log.gps_time_us * 1e-6):
        if gps_s - last >= THIN_S:
            keep[i], last = True, gps_s
    return flight.with_gps(keep)


def position_scores(flight: Flight, run: Run, out: np.ndarray) -> Scores:
    """Score the position at every fix rate and in outages, in metres."""
    if not np.isfinite(position_errors_m(flight, out)).any():
        return {}
    return {
        "pos": rms(position_errors_m(flight, out)[flight.counts]),
        "pos_1hz": rms(position_errors_m(flight, run(thinned(flight)))[flight.counts]),
        "out10": outage_score(flight, run, 10.0),
        "out30": outage_score(flight, run, 30.0),
    }


def height_scores(flight: Flight, out: np.ndarray) -> Scores:
    """Compare the height in metres, and its change over `CLIMB_S` in m/s."""
    use = flight.counts & np.isfinite(flight.alt_m)
    off_m = np.where(use, out[:, NAV_ALT] - flight.alt_m, math.nan)
    if not np.isfinite(off_m).any():
        return {}
    time_s = flight.log.imu_time_us * 1e-6
    before, after = time_s - 0.5 * CLIMB_S, time_s + 0.5 * CLIMB_S
    climbed_m = np.cumsum(np.nan_to_num(-out[:, NAV_VEL + 2]) * np.gradient(time_s))
    found, true = (
        (np.interp(after, time_s, line) - np.interp(before, time_s, line)) / CLIMB_S
        for line in (climbed_m, flight.alt_m)
    )
    climb_off = np.where(use & np.isfinite(out[:, NAV_VEL + 2]), found - true, math.nan)
    worst_m = float(np.nanmax(np.abs(off_m)))
    return {"alt": rms(off_m), "alt_max": worst_m, "climb": rms(climb_off)}


def turned_rad(time_s: np.ndarray, true: np.ndarray, found: np.ndarray) -> float:
    """Return the rotation of horizontal changes of velocity (north + i east), NaN if unknown.

    Their means and ramps, which errors of the level cause, are removed.
    """
    count = len(time_s)
    if count < LEAST_PAIRS:
        return math.nan
    basis = np.column_stack([np.ones(count), time_s - time_s[0]])
    true, found = (
        line - basis @ np.linalg.lstsq(basis, line, rcond=None)[0] for line in (true, found)
    )
    product = np.vdot(true, found)
    residual = found - product / abs(product) * true
    # Pairs overlap, so that only one in `PAIR_S` is independent.
    independent = min(count, TURN_S / PAIR_S)
    variance = np.vdot(residual, residual).real / (2.0 * abs(product) * independent)
    return float(np.angle(product)) if variance < TURN_STD_RAD**2 else math.nan


def turn_score(flight: Flight, q_nb: np.ndarray) -> Scores:
    """Compare the heading with that of changes of the GPS velocity, in degrees RMS."""
    log, time_s = flight.log, flight.log.imu_time_us * 1e-6
    use = np.isfinite(q_nb[:, 0]) & np.isfinite(log.imu[:, ACCEL])
    fix_s = log.gps_time_us * 1e-6 - flight.reference.gps_latency_s
    if not use.any() or not len(fix_s):
        return {}
    force = Rotation.from_quat(q_nb[use], scalar_first=True).apply(log.imu[use, ACCEL : ACCEL + 3])
    gained = np.cumsum(force[:, :2] * np.gradient(time_s[use])[:, None], axis=0) @ (1.0, 1.0j)
    counted = np.interp(fix_s, time_s, flight.counts) > 0.5
    kept = counted & np.isfinite(log.gps[:, GPS_VEL : GPS_VEL + 2]).all(axis=1)
    kept &= np.diff(log.gps[:, GPS_LAT : GPS_LON + 1], axis=0, prepend=0.0).any(axis=1)
    fix_s, velocity = fix_s[kept], log.gps[kept, GPS_VEL : GPS_VEL + 2] @ (1.0, 1.0j)
    after = np.searchsorted(fix_s, fix_s + PAIR_S)
    pairs = np.flatnonzero(after < len(fix_s))
    pairs = pairs[fix_s[after[pairs]] - fix_s[pairs] < 2.0 * PAIR_S]
    ends = after[pairs]
    change = velocity[ends] - velocity[pairs]
    begins_s, ends_s = fix_s[pairs], fix_s[ends]
    found = np.interp(ends_s, time_s[use], gained) - np.interp(begins_s, time_s[use], gained)
    slots = begins_s // TURN_S
    windows = [slots == slot for slot in np.unique(slots)]
    headings = [turned_rad(begins_s[each], change[each], found[each]) for each in windows]
    return {"turns": rms(np.degrees(np.array(headings)))}


def share_scores(flight: Flight, out: np.ndarray, since_s: float = -math.inf) -> Scores:
    """Return the shares of tilt, heading, position and height within two standard deviations."""
    late = flight.counts & (flight.log.imu_time_us * 1e-6 >= since_s)
    scores = dict.fromkeys(SHARES, math.nan)
    use = late & np.isfinite(flight.q_nb[:, 0]) & np.isfinite(out[:, NAV_ATTITUDE_STD])
    if use.any() and not flight.free_heading:
        true = Rotation.from_quat(flight.q_nb[use], scalar_first=True)
        found = Rotation.from_quat(out[use, :4], scalar_first=True)
        std = out[use, NAV_ATTITUDE_STD : NAV_ATTITUDE_STD + 3]
        within = np.abs((true * found.inv()).as_rotvec()) < 2.0 * std
        scores["tilt_2s"], scores["heading_2s"] = within[:, :2].mean(), within[:, 2].mean()
    if len(flight.log.gps):
        off = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LON]) - flight.pos_ne_m
        std = out[:, NAV_POS_STD : NAV_POS_STD + 2]
        use = late & np.isfinite(off[:, 0]) & np.isfinite(std[:, 0])
        if use.any():
            scores["pos_2s"] = (np.abs(off[use]) < 2.0 * std[use]).mean()
    off_m, std_m = np.abs(out[:, NAV_ALT] - flight.alt_m), out[:, NAV_POS_STD + 2]
    use = late & np.isfinite(off_m) & np.isfinite(std_m)
    if use.any():
        scores["alt_2s"] = (off_m[use] < 2.0 * std_m[use]).mean()
    return scores


def spoilt_scores(flight: Flight, run: Run) -> dict[str, Scores]:
    """Return the errors 20 s after each disturbance and later, and the shares since its end."""
    found = {}
    for how, spoil in SPOILS.items():
        if not applies(how, flight):
            continue
        spoilt = spoil(flight)
        out, since_s = run(spoilt.flight), spoilt.ends_s + RECOVERY_S
        late = replace(
            spoilt.flight,
            counts=spoilt.flight.counts & (spoilt.flight.log.imu_time_us * 1e-6 >= since_s),
        )
        attitude = attitude_scores(late, out[:, :4])
        found[how] = {
            "inclination": attitude.get("inclination", math.nan),
            "heading": attitude.get("heading", math.nan),
            "pos": rms(position_errors_m(late, out)[late.counts]),
        } | share_scores(spoilt.flight, out, spoilt.ends_s)
    return found


def score(flight: Flight, run: Run, *, whole: bool = True) -> Scores:
    """Run one estimator over one flight and score it; `whole` adds outages and shares."""
    begin = time.perf_counter()
    out = run(flight)
    elapsed_s = time.perf_counter() - begin
    scores = attitude_scores(flight, out[:, :4]) | {SPEED: 1e-6 * len(out) / elapsed_s}
    scores |= turn_score(flight, out[:, :4])
    if out.shape[1] > NAV_VEL:
        scores |= height_scores(flight, out)
    if out.shape[1] > NAV_LON:
        if whole:
            scores |= position_scores(flight, run, out)
        else:
            scores["pos"] = rms(position_errors_m(flight, out)[flight.counts])
    if out.shape[1] > NAV_POS_STD and np.isfinite(out[:, NAV_ATTITUDE_STD]).any():
        scores |= share_scores(flight, out)
    return scores


def flights_to_score(folder: Path, only: Sequence[str] | None) -> Iterator[Flight]:
    """Read and simulate the flights whose names contain one of the words, or all flights."""
    makers: dict[str, Callable[[], Flight]] = {
        path.name.split(".")[0]: partial(read_flight, path)
        for path in sorted(folder.glob("*.csv*"))
    }
    makers |= {
        f"simulated {seed}": partial(simulated_flight, seed, calibrated=seed % 2 == 1)
        for seed in SEEDS
    }
    for name, make in makers.items():
        if not only or any(word in name for word in only):
            yield make()


def geometric_means(board: dict[str, dict[str, Scores]], base: str) -> dict[str, Scores]:
    """Return each estimator's errors relative to one estimator's, as geometric means."""
    means: dict[str, Scores] = {}
    for name in {name for scores in board.values() for name in scores}:
        means[name] = {}
        for key in (*ATTITUDE[3:], *POSITION):
            ratios = [
                math.log(scores[name][key] / scores[base][key])
                for scores in board.values()
                if name in scores
                and scores[name].get(key, math.nan) > 0.0
                and scores[base].get(key, math.nan) > 0.0
            ]
            if ratios:
                means[name][key] = math.exp(sum(ratios) / len(ratios))
    return means


def rows_of(board: dict[str, dict[str, Scores]], base: str) -> Iterator[tuple[object, ...]]:
    """Yield the rows of a table, shares in percent, the geometric means last."""
    means = {f"geometric mean, {base} = 1": geometric_means(board, base)}
    for flight, by_name in (board | means).items():
        for name, scores in by_name.items():
            values = [(100 if key in SHARES else 1) * scores.get(key, math.nan) for key in COLUMNS]
            yield flight, name, *values


def main() -> None:
    """Read, run, print."""
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of *.csv.gz flights")
    parser.add_argument("--only", action="append", help="flights whose names contain this")
    parser.add_argument("--estimator", action="append", choices=OWN | PEERS, help="run only these")
    parser.add_argument("--spoilt", action="store_true", help="score the disturbed flights too")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    known = OWN | PEERS
    runs = {name: known[name] for name in known if name in (options.estimator or known)}
    board: dict[str, dict[str, Scores]] = {}
    spoilt: dict[str, dict[str, Scores]] = {}
    flights = list(flights_to_score(options.data, options.only))
    if not flights:
        raise SystemExit("no flight has such a name")
    for flight in track(flights, "scoring", console=Console(stderr=True)):
        board[flight.name] = {
            name: score(flight, run, whole=name in OWN) for name, run in runs.items()
        }
        if options.spoilt:
            spoilt[flight.name] = spoilt_scores(flight, run_eskf)
    heads = ("flight", "estimator", *COLUMNS)
    show("scores", heads, rows_of(board, next(iter(runs))))
    for name, ways in spoilt.items():
        by_way: dict[str, dict[str, Scores]] = {how: {"eskf": each} for how, each in ways.items()}
        show(f"disturbances of {name}", heads, rows_of(by_way, "eskf"))
    write_json(options, {"flights": board, "spoilt": spoilt})


if __name__ == "__main__":
    main()
