"""Measure the contribution of each mechanism of the Kalman filter beyond the textbook equations.

    python -m tools.ablate --data DIR

Each mechanism is disabled in turn: one function or constant is replaced, and the kernels are
compiled again, for some 20 s each. The errors are those of `tools.score_estimators`, on recorded
flights and on flights with the disturbances of `tools.spoil_flight`. The ratio is a geometric mean
over the flights; above 1, errors are larger without the mechanism. A flight counts as worse or
better if its own mean differs by more than 1 %. A score that only the full filter has counts as
worse.
"""

import math
import warnings
from collections.abc import Sequence
from importlib import import_module
from inspect import getsourcelines
from pathlib import Path
from statistics import fmean
from typing import Final, NamedTuple
from unittest.mock import patch

from gateway.compiled import compiled
from gateway.estimation.eskf.filter import begin_state, run
from gateway.estimation.eskf.state import INTEGRALS, State
from tools.build_kernels import compiled_again
from tools.flights import Flight
from tools.harness import arguments, show, write_json
from tools.score_estimators import (
    SHARES,
    Scores,
    flights_to_score,
    geometric_means,
    run_eskf,
    score,
    spoilt_scores,
)


@compiled
def at_present(s: State, _: float) -> float:
    """Use a fix as if it were valid now; replaces `look_back`."""
    for k in range(INTEGRALS):
        s.then[k] = s.integrals[k]
    return float(s.time_s)


NOTHING: Final = compiled(lambda *_: None)
FALSE: Final = compiled(lambda *_: False)
ZERO: Final = compiled(lambda *_: 0)
NO_NUMBER: Final = compiled(lambda *_: 0.0)
FULL_WEIGHT: Final = compiled(lambda *_: 1.0)


class Mechanism(NamedTuple):
    """A mechanism, the module of the filter that uses it, and the name to replace there."""

    title: str
    module: str
    name: str
    replacement: object
    parts: tuple[str, ...]
    """Its modules, or functions as `module.function`, whose lines are counted."""


FILTER: Final = "gateway.estimation.eskf"
VALIDITY: Final = ("predict.store_integrals", "predict.look_back", "fix_model.past_state")
SENSORS: Final = ("faults.check_sensor", "faults.check_sensors", "faults.is_hanging")
MECHANISMS: Final = (
    Mechanism(
        "noise by vibration", "predict", "add_vibration", NOTHING, ("predict.add_vibration",),
    ),
    Mechanism(
        "changes of bias and barometer", "predict", "unexpected_density", NO_NUMBER,
        ("predict.unexpected_density", "predict.follow_bias_steps"),
    ),
    Mechanism("rest", "rest", "keeps_means", FALSE, ("rest",)),
    Mechanism(
        "integrity check of the attitude", "integrity", "differs_from_alignment", FALSE,
        ("integrity.differs_from_alignment", "integrity.discard_calibration"),
    ),
    Mechanism(
        "restart of the alignment", "alignment", "contradiction", NO_NUMBER,
        ("alignment.contradiction",),
    ),
    Mechanism(
        "heading from motion", "integrity", "FOUND_HEADING_RAD", 0.0,
        ("alignment.heading_of_pairs", "alignment.moment_along", "alignment.explained_product"),
    ),
    Mechanism(
        "norm and dip of the field", "magnetometer", "field_weight", FULL_WEIGHT,
        ("magnetometer.field_weight", "magnetometer.learn_field"),
    ),
    Mechanism(
        "hard iron by the model's field", "fixes", "raise_hard_iron", NOTHING,
        ("magnetometer.raise_hard_iron",),
    ),
    Mechanism(
        "hard iron by the norm", "magnetometer", "update_hard_iron", NOTHING,
        ("magnetometer.update_hard_iron",),
    ),
    Mechanism("time of validity of a fix", "fixes", "look_back", at_present, VALIDITY),
    Mechanism("GPS latency from motion", "latency", "slew_latency", NOTHING, ("latency",)),
    Mechanism(
        "GPS glitches", "fix_model", "raise_glitch_variance", NOTHING,
        ("fix_model.raise_glitch_variance",),
    ),
    Mechanism("faults of inertial sensors", "faults", "check_sensor", ZERO, SENSORS),
)  # fmt: skip
FULL: Final = "full filter"
FLIGHTS: Final = ("arduplane", "quad106", "phantom", "mocap", "car_", "walk", "px4_", "broad_")
DISTURBED: Final = ("arduplane", "phantom_rtk", "broad_06")
"""Words in the names of the flights that are scored both as recorded and with disturbances."""
EQUAL: Final = 0.01
"""A flight whose errors change by a smaller share counts as equal."""

Board = dict[str, dict[str, Scores]]


def add_scores(recorded: Board, disturbed: Board, name: str, flights: Sequence[Flight]) -> None:
    """Score all flights with the present kernels."""
    for flight in flights:
        recorded.setdefault(flight.name, {})[name] = score(flight, run_eskf)
        if any(word in flight.name for word in DISTURBED):
            for how, scores in spoilt_scores(flight, run_eskf).items():
                disturbed.setdefault(f"{flight.name} {how}", {})[name] = scores


def comparison(board: Board, name: str) -> tuple[str, str, str]:
    """Return the numbers of worse and better flights without a mechanism, and the mean ratio."""
    worse, better, logarithms = 0, 0, []
    for flight, scores in board.items():
        ratios = geometric_means({flight: scores}, FULL)
        if len(ratios[name]) < len(ratios[FULL]):
            worse += 1
        elif ratios[FULL]:
            logarithms.append(fmean(math.log(ratio) for ratio in ratios[name].values()))
            worse += logarithms[-1] > math.log1p(EQUAL)
            better += logarithms[-1] < -math.log1p(EQUAL)
    return str(worse), str(better), f"{math.exp(fmean(logarithms)):.3f}"


def share_within(board: Board, name: str) -> str:
    """Return the mean share of the time that errors are within two standard deviations."""
    shares = [scores[name].get(key, math.nan) for scores in board.values() for key in SHARES]
    return f"{100 * fmean(share for share in shares if math.isfinite(share)):.1f} %"


def lines_of(parts: Sequence[str]) -> int:
    """Return the number of source lines of modules and functions of the filter."""
    total = 0
    for part in parts:
        module, _, function = part.partition(".")
        found = import_module(f"{FILTER}.{module}")
        total += len(getsourcelines(getattr(found, function) if function else found)[0])
    return total


def main() -> None:
    """Score the full filter, then each variant, and print the table."""
    parser = arguments(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder of *.csv.gz flights")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    flights = list(flights_to_score(options.data, FLIGHTS))
    if not flights:
        raise SystemExit(f"{options.data} contains none of the flights {', '.join(FLIGHTS)}")
    boards: tuple[Board, Board] = {}, {}
    add_scores(*boards, FULL, flights)
    heads = ["disabled mechanism", "lines"]
    for board, kind in zip(boards, ("recorded", "disturbed"), strict=True):
        heads += [f"{len(board)} {kind}: worse", "better", "ratio", "within 2 sigma"]
    full = [cell for board in boards for cell in ("", "", "1", share_within(board, FULL))]
    rows: list[list[object]] = [["none", "", *full, ""]]
    for number, (title, module, name, replacement, parts) in enumerate(MECHANISMS, 1):
        target = f"{FILTER}.{module}.{name}"
        with patch(target, replacement), compiled_again([begin_state, run]):
            add_scores(*boards, title, flights)
        cells = [c for b in boards for c in (*comparison(b, title), share_within(b, title))]
        equal = not any(int(cells[k]) for k in (0, 1, 4, 5))
        mark = "no measurable difference" if equal else ""
        rows.append([title, lines_of(parts), *cells, mark])
        print(f"{number} of {len(MECHANISMS)}: without {title}: {'  '.join(cells)}", flush=True)
    show("errors without each mechanism", [*heads, ""], rows)
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
