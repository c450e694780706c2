"""The smoother against truth, the filter, and the joint least squares that it stands for."""

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from gateway.estimation import columns as col
from gateway.estimation.eskf.filter import COMPASS_RAD
from gateway.estimation.eskf.state import STATES
from gateway.estimation.reference import NO_DECLINATION_RAD
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.estimation.smoother import AXES_RAD, _backward, smooth
from tools.flights import Flight, read_flight, simulated_flight
from tools.score_estimators import (
    attitude_scores,
    estimator_of,
    outage_score,
    position_errors_m,
    rms,
    run_eskf,
    run_smoothed,
    share_scores,
)
from tools.spoil_flight import no_mag


def test_backward_pass_equals_joint_least_squares() -> None:
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
    begins, _, variances = _backward(P, F, foreseen, d, last)
    walk = np.diff(np.eye(count + 1), axis=0)
    joint = np.eye(count + 1) / r + walk.T @ walk / q
    expected = np.linalg.solve(joint, z / r)
    np.testing.assert_allclose(np.array(means) + begins[:, 0], expected, atol=1e-6)
    np.testing.assert_allclose(variances[:, 0], np.diag(np.linalg.inv(joint)), rtol=1e-6)


@pytest.mark.slow
def test_smoothing_halves_the_error_of_outages(flight: Flight) -> None:
    filtered, smoothed = run_eskf(flight), run_smoothed(flight)
    assert smoothed.shape == (len(flight.log.imu), col.NAV_COLUMNS)
    yaws = [attitude_scores(flight, out[:, :4])["yaw"] for out in (smoothed, filtered)]
    assert yaws[0] < yaws[1]
    assert outage_score(flight, run_smoothed, 10.0) < 2.0
    assert outage_score(flight, run_smoothed, 10.0) < 0.5 * outage_score(flight, run_eskf, 10.0)
    std = slice(col.NAV_ATTITUDE_STD, col.NAV_ATTITUDE_STD + 3)
    use = flight.counts
    expected = np.sqrt(smoothed[use, std] ** 2 - AXES_RAD**2)
    assert (expected <= 1.05 * filtered[use, std]).mean() > 0.95
    np.testing.assert_allclose(np.linalg.norm(smoothed[:, :4], axis=1), 1.0, atol=1e-9)
    same = smoothed[use, col.NAV_FLAGS] == filtered[use, col.NAV_FLAGS]
    assert same.mean() > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(("set_s", "used_s"), [(0.2, 0.2), (0.4, 0.16)])
def test_wrong_latency_is_replaced_for_the_whole_flight(
    flight: Flight, set_s: float, used_s: float
) -> None:
    """The filter finds it on the way; the smoother knows it from the beginning."""
    reference = msgspec.structs.replace(flight.reference, gps_latency_s=set_s)
    set_so = replace(flight, reference=reference)
    found, latency_s = smooth(estimator_of(set_so), flight.log)
    assert latency_s == pytest.approx(used_s, abs=0.0 if set_s == used_s else 0.015)
    right = run_smoothed(flight)
    early = replace(flight, counts=flight.counts & (flight.log.imu_time_us < 80e6))
    off_m, right_off_m = (rms(position_errors_m(early, o)[early.counts]) for o in (found, right))
    assert off_m < right_off_m + 0.3
    off_deg, right_deg = (attitude_scores(early, out[:, :4])["total"] for out in (found, right))
    assert off_deg < right_deg + 0.3


@pytest.mark.slow
def test_smoothing_reduces_the_error_without_gps(flight: Flight) -> None:
    """Over several flights: in a single one the errors of the compass do not average out."""
    flights = [flight, *(simulated_flight(seed, calibrated=seed == 11) for seed in (11, 12))]
    errors: dict[str, list[dict[str, float]]] = {"filtered": [], "smoothed": []}
    for each in flights:
        alone = each.with_gps(np.zeros(len(each.log.gps), bool))
        smoothed = run_smoothed(alone)
        errors["filtered"].append(attitude_scores(alone, run_eskf(alone)[:, :4]))
        errors["smoothed"].append(attitude_scores(alone, smoothed[:, :4]))
        assert share_scores(alone, smoothed)["tilt_2s"] > 0.8
        # Without a fix the declination is not known, and smoothing does not estimate it.
        heading_std = smoothed[each.counts, col.NAV_ATTITUDE_STD + 2]
        assert (heading_std > NO_DECLINATION_RAD).all()
    for part in ("inclination", "heading"):
        before, after = (rms(np.array([s[part] for s in found])) for found in errors.values())
        assert after < before


@pytest.mark.slow
def test_position_restart_keeps_the_attitude_smoothed(flight: Flight) -> None:
    """Fixes are off by a kilometre from the middle on: the filter relocks on them.

    Their velocities are right, and keep it level meanwhile.
    """
    gps, half = flight.log.gps.copy(), len(flight.log.gps) // 2
    gps[half:, col.GPS_LAT] += np.degrees(1000.0 / 6.4e6)
    moved = replace(flight, log=replace(flight.log, gps=gps))
    filtered, smoothed = run_eskf(moved), run_smoothed(moved)
    relock = int(np.nanargmax(np.diff(filtered[:, col.NAV_LAT])))
    assert np.degrees(500.0 / 6.4e6) < np.diff(smoothed[:, col.NAV_LAT])[relock]
    before = slice(relock - 100, relock - 20)
    std = slice(col.NAV_ATTITUDE_STD, col.NAV_ATTITUDE_STD + 3)
    assert (smoothed[before, std] < np.array([1.1, 1.1, 1.0]) * filtered[before, std]).all()
    assert (filtered[before, std][:, :2] < math.radians(0.6)).all()


@pytest.mark.slow
def test_estimator_is_not_changed_by_smoothing(flight: Flight) -> None:
    estimator = make_estimator(EstimationSettings(estimator="eskf", reference=flight.reference))
    before = estimator.snapshot()
    first = smooth(estimator, flight.log)[0]
    assert estimator.snapshot() == before
    np.testing.assert_array_equal(smooth(estimator, flight.log)[0], first)


@pytest.mark.slow
def test_position_without_heading_is_that_of_filter(flight: Flight) -> None:
    """Without a heading, on the ground without a compass, later fixes correct no position."""
    blind = no_mag(flight).flight
    live, smoothed = run_eskf(blind), run_smoothed(blind)
    before = np.isfinite(live[:, col.NAV_LAT]) & (live[:, col.NAV_ATTITUDE_STD + 2] > 1.0)
    assert before.sum() > 500
    position = slice(col.NAV_LAT, col.NAV_LON + 1)
    np.testing.assert_allclose(smoothed[before, position], live[before, position], rtol=1e-8)


@pytest.mark.slow
def test_smoothed_real_fixed_wing_flight_has_small_errors(data_dir) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    assert attitude_scores(flight, run_smoothed(flight)[:, :4])["yaw"] < 1.0
    assert outage_score(flight, run_smoothed, 10.0) < 1.5
    assert outage_score(flight, run_smoothed, 30.0) < 10.0


@pytest.mark.slow
def test_smoothing_reduces_errors_of_real_car(data_dir) -> None:
    """Long parked without a heading; then GPS velocities 0.12 s behind the positions."""
    flight = read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz")
    live, smoothed = (rms(position_errors_m(flight, f(flight))) for f in (run_eskf, run_smoothed))
    assert smoothed < live
    assert outage_score(flight, run_smoothed, 10.0) < outage_score(flight, run_eskf, 10.0)
    fixes_s = flight.log.gps_time_us * 1e-6
    gap = flight.with_gps(np.abs(fixes_s - fixes_s.mean()) > 40.0)
    live, smoothed = run_eskf(gap), run_smoothed(gap)
    flags = [out[:, col.NAV_FLAGS].astype(int) for out in (live, smoothed)]
    valid = [each & col.FLAG.HEADING_VALID != 0 for each in flags]
    assert valid[1].sum() > valid[0].sum()
    sure = smoothed[:, col.NAV_ATTITUDE_STD + 2] < col.HEADING_VALID_RAD
    np.testing.assert_array_equal(valid[1], sure)


@pytest.mark.slow
def test_smoothing_does_not_average_out_lasting_errors_of_the_compass(flight: Flight) -> None:
    std_rad = run_smoothed(flight)[flight.counts, col.NAV_ATTITUDE_STD + 2]
    assert std_rad.min() > COMPASS_RAD
