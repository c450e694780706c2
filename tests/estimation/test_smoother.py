"""The smoother against truth, the filter, and the joint least squares that it stands for."""

import numpy as np
import pytest

from gateway.estimation.columns import (
    NAV_ATTITUDE_STD,
    NAV_COLUMNS,
    NAV_FLAGS,
    NAV_LAT,
    NAV_POS_STD,
)
from gateway.estimation.eskf.eskf_state import STATES
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.estimation.smoothing.smoother import _backward, smooth
from tools.flights import Flight, read_flight, simulated_flight
from tools.score_estimators import (
    attitude_scores,
    outage_score,
    position_errors_m,
    rms,
    run_eskf,
    run_smoothed,
)
from tools.spoil_flight import no_mag


def test_backward_is_the_joint_estimate() -> None:
    """One coordinate that walks, measured at each node: the normal equations are solved."""
    rng = np.random.default_rng(5)
    count, q, r = 12, 0.3, 0.5
    z = np.cumsum(rng.normal(0.0, np.sqrt(q), count + 1)) + rng.normal(0.0, np.sqrt(r), count + 1)
    x, var = z[0], r
    means, P = [x], np.zeros((count, STATES, STATES))
    F, foreseen = np.tile(np.eye(STATES), (count, 1, 1)), np.zeros((count, STATES, STATES))
    d = np.zeros((count, STATES))
    for k in range(count):
        P[k, 0, 0], foreseen[k, 0, 0] = var, var + q
        gain = (var + q) / (var + q + r)
        d[k, 0] = gain * (z[k + 1] - x)
        x, var = x + d[k, 0], (1.0 - gain) * (var + q)
        means.append(x)
    last = np.zeros((STATES, STATES))
    last[0, 0] = var
    begins, _ = _backward(P, F, foreseen, d, np.ones(count, np.int64), last)
    walk = np.diff(np.eye(count + 1), axis=0)
    joint = np.eye(count + 1) / r + walk.T @ walk / q
    expected = np.linalg.solve(joint, z / r)
    np.testing.assert_allclose(np.array(means[:-1]) + begins[:, 0], expected[:-1], atol=1e-6)
    np.testing.assert_allclose(P[:, 0, 0], np.diag(np.linalg.inv(joint))[:-1], rtol=1e-6)


@pytest.fixture(scope="module")
def flight() -> Flight:
    return simulated_flight(21, calibrated=True)


@pytest.mark.slow
def test_it_beats_the_filter_most_of_all_in_outages(flight: Flight) -> None:
    filtered, smoothed = run_eskf(flight), run_smoothed(flight)
    assert smoothed.shape == (len(flight.log.imu), NAV_COLUMNS)
    assert (
        attitude_scores(flight, smoothed[:, :4])["yaw"]
        < attitude_scores(flight, filtered[:, :4])["yaw"]
    )
    assert outage_score(flight, run_smoothed, 10.0) < 2.0
    assert outage_score(flight, run_smoothed, 10.0) < 0.5 * outage_score(flight, run_eskf, 10.0)
    std = slice(NAV_ATTITUDE_STD, NAV_ATTITUDE_STD + 3)
    use = flight.counts
    assert (smoothed[use, std] <= 1.05 * filtered[use, std]).mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(smoothed[:, :4], axis=1), 1.0, atol=1e-9)
    same = smoothed[use, NAV_FLAGS] == filtered[use, NAV_FLAGS]
    assert same.mean() > 0.95


@pytest.mark.slow
def test_the_estimator_is_left_as_it_was(flight: Flight) -> None:
    estimator = make_estimator(EstimationSettings(estimator="eskf", reference=flight.reference))
    before = estimator.snapshot()
    first = smooth(estimator, flight.log)
    assert estimator.snapshot() == before
    np.testing.assert_array_equal(smooth(estimator, flight.log), first)


@pytest.mark.slow
def test_a_place_that_follows_the_fixes_is_left_to_them(flight: Flight) -> None:
    """On the ground without a compass no heading is known: what comes later moves nothing there."""
    blind = no_mag(flight).flight
    live, smoothed = run_eskf(blind), run_smoothed(blind)
    before = np.isfinite(live[:, NAV_LAT]) & np.isnan(live[:, NAV_POS_STD])
    assert before.sum() > 500
    place = slice(NAV_LAT, NAV_LAT + 3)
    np.testing.assert_allclose(smoothed[before, place], live[before, place], rtol=1e-8)


@pytest.mark.slow
def test_real_fixed_wing(data_dir) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    assert attitude_scores(flight, run_smoothed(flight)[:, :4])["yaw"] < 1.0
    assert outage_score(flight, run_smoothed, 10.0) < 1.7
    assert outage_score(flight, run_smoothed, 30.0) < 10.0


@pytest.mark.slow
def test_real_car(data_dir) -> None:
    """Long parked without a heading; the smoother is not worse than the filter there."""
    flight = read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz")
    live, smoothed = (
        rms(position_errors_m(flight, run(flight))) for run in (run_eskf, run_smoothed)
    )
    assert smoothed < live + 0.1
    assert outage_score(flight, run_smoothed, 10.0) < outage_score(flight, run_eskf, 10.0)
