"""Settings tried out on a flight."""

import math
from functools import partial

import numpy as np
import pytest

from gateway.analysis.flight import fixes_of
from gateway.analysis.processes import forked
from gateway.analysis.sweep import (
    Axis,
    SweepError,
    Values,
    full_key,
    grid,
    make_contest,
    optimise,
    parse_axis,
    run_trial,
    tabulate,
    with_value,
    with_values,
)
from gateway.recordings.fuse import FusionSettings
from tests.analysis.flights import short_case, short_flight

ALPHA, BETA = "estimation.paper.alpha_accel", "estimation.paper.beta_velocity"
LATENCY = "estimation.reference.gps_latency_s"


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("alpha", ALPHA),
        ("beta", BETA),
        ("gps_latency_s", LATENCY),
        ("reference.declination_deg", "estimation.reference.declination_deg"),
    ],
)
def test_setting_is_found_by_short_name_or_end_of_path(name: str, key: str) -> None:
    assert full_key(name) == key
    with pytest.raises(SweepError, match="no setting ends in 'gama'"):
        full_key("gama")


@pytest.mark.parametrize(
    ("name", "text", "values"),
    [
        ("alpha", "0.1:0.9:9", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)),
        ("alpha", "0.5,0.1", (0.5, 0.1)),
        ("alpha", "0:1", (0.0, 1.0)),
        ("alpha", "0.25", (0.25,)),
        ("accel_filter", "butterworth, chebyshev", ("butterworth", "chebyshev")),
    ],
)
def test_axis_is_parsed_from_range_or_list(name: str, text: str, values: Values) -> None:
    assert parse_axis(name, text) == Axis(full_key(name), values)


@pytest.mark.parametrize("text", ["0:2:3", "a:b:c", "-0.1", "chebyshev"])
def test_invalid_axis_values_are_reported(text: str) -> None:
    with pytest.raises(SweepError, match="alpha"):
        parse_axis("alpha", text)


def test_value_changes_only_its_setting() -> None:
    changed = with_value(FusionSettings(), ALPHA, 0.7)
    assert changed.estimation.paper.alpha_accel == 0.7
    assert changed.estimation.paper.beta_velocity == 0.1
    assert changed.estimation.eskf == FusionSettings().estimation.eskf


def test_grid_contains_every_combination_up_to_a_limit() -> None:
    axes = [Axis("a", (1, 2)), Axis("b", (3, 4, 5))]
    assert grid(axes) == [(1, 3), (1, 4), (1, 5), (2, 3), (2, 4), (2, 5)]
    with pytest.raises(SweepError, match="1000000 points"):
        grid([Axis("a", tuple(range(1000))), Axis("b", tuple(range(1000)))])


def test_varied_setting_selects_its_estimator() -> None:
    contest = make_contest(short_flight(), short_case().fusion, [ALPHA, BETA])
    settings = with_values(contest.fusion, contest.keys, (0.3, 0.4)).estimation
    assert (settings.estimator, settings.paper.alpha_accel) == ("paper", 0.3)


def test_settings_of_two_estimators_are_rejected() -> None:
    keys = [ALPHA, "estimation.eskf.x"]
    with pytest.raises(SweepError, match="several estimators"):
        make_contest(short_flight(), short_case().fusion, keys)


@pytest.mark.parametrize(("interval_s", "share"), [(0.0, 0.8), (1.0, 0.2)])
def test_withheld_fixes_are_not_fused(interval_s: float, share: float) -> None:
    flight = short_flight()
    contest = make_contest(flight, short_case().fusion, [ALPHA], hold_out=5, interval_s=interval_s)
    fused, held = fixes_of(contest.split.fused), contest.split.held_fixes
    assert len(fused) + len(held) == len(fixes_of(flight))
    assert not set(fused.arrival_us.tolist()) & set(held.arrival_us.tolist())
    assert len(fused) / len(fixes_of(flight)) == pytest.approx(share, abs=0.03)


def test_several_processes_give_results_of_one() -> None:
    contest = make_contest(short_flight(), short_case().fusion, [ALPHA, BETA])
    points = grid([Axis(ALPHA, (0.1, 0.9)), Axis(BETA, (0.1, 0.9))])
    found = []
    for jobs in (2, 1):
        with forked(partial(run_trial, contest), jobs) as run:
            found.append(dict(run(points)))
    assert found[0] == found[1]
    assert found[0][0]["held_m"] < found[0][3]["held_m"]


def test_withheld_fixes_identify_latency_and_interpolated_do_not() -> None:
    """Interpolated GPS favours no latency compensation, because it copies the late fixes."""
    # With the turns that begin after 40 s.
    flight, fusion = short_flight(60.0), short_case().fusion
    contest = make_contest(flight, fusion, [LATENCY])
    latencies = (0.0, 0.08, 0.16, 0.24, 0.32)
    points: list[Values] = [(latency,) for latency in latencies]
    trials = [(point, run_trial(contest, point)) for point in points]
    table = tabulate([LATENCY], trials, "held")
    assert table.iloc[0][LATENCY] == pytest.approx(0.16, abs=0.09)
    copied = tabulate([LATENCY], trials, "interpolated")
    assert copied.iloc[0][LATENCY] <= table.iloc[0][LATENCY]


def test_trials_are_sorted_without_columns_of_nan() -> None:
    scores = [((k,), {"held_m": m, "reference_m": math.nan}) for k, m in enumerate((3.0, 1.0, 2.0))]
    table = tabulate(["k"], scores, "held")
    assert table["k"].tolist() == [1, 2, 0]
    assert "reference_m" not in table
    with pytest.raises(SweepError, match="no reference of the position"):
        tabulate(["k"], scores, "reference")


def test_optimiser_finds_minimum_of_paraboloid() -> None:
    def bowl(points: list[Values]) -> list[float]:
        return [
            math.nan if p[0] > 0.95 else (float(p[0]) - 0.3) ** 2 + (float(p[1]) - 0.7) ** 2
            for p in points
        ]

    best: list[float] = []
    found = optimise([Axis("a", (0.0, 1.0)), Axis("b", (0.0, 1.0))], bowl, 25, best.append)
    assert found == pytest.approx((0.3, 0.7), abs=0.02)
    assert best == sorted(best, reverse=True)


@pytest.mark.parametrize("values", [(0.5,), ("butterworth", "chebyshev"), (0.5, 0.5)])
def test_optimiser_requires_range(values: Values) -> None:
    with pytest.raises(SweepError, match="needs a range"):
        optimise([Axis("a", values)], lambda points: [0.0] * len(points), 1)


def test_attitude_is_scored_against_reference() -> None:
    contest = make_contest(short_flight(), short_case().fusion, ["estimation.paper.alpha_gyro"])
    close, far = run_trial(contest, (0.995,)), run_trial(contest, (0.1,))
    assert close["attitude_deg"] < far["attitude_deg"]
    assert np.isfinite(close["reference_m"])
