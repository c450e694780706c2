"""Every estimator on simulated flights, against exact truth; and on real ones where there are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    GPS_DIP,
    NAV_FLAGS,
    NAV_LAT,
    NAV_VEL,
)
from gateway.estimation.eskf.eskf_settings import EskfSettings
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import NavFlags
from tools.flights import Flight, north_east_m, read_flight, simulated_flight
from tools.score_estimators import (
    OWN,
    attitude_scores,
    outage_score,
    position_errors_m,
    rms,
    run_complementary,
    run_eskf,
    thinned,
)
from tools.score_honesty import consistency, normalised_errors

SEEDS = (21, 22)


@pytest.fixture(scope="module", params=SEEDS)
def flight(request: pytest.FixtureRequest) -> Flight:
    return simulated_flight(request.param, calibrated=request.param % 2 == 1)


def errors(flight: Flight, out: np.ndarray) -> dict[str, np.ndarray]:
    true = Rotation.from_quat(flight.q_nb, scalar_first=True)
    found = Rotation.from_quat(out[:, :4], scalar_first=True)
    place = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LAT + 1])
    down = flight.truth["down"] + out[:, NAV_LAT + 2]
    use = flight.counts
    return {
        "attitude": (true * found.inv()).as_rotvec()[use],
        "velocity": (flight.truth["vel"] - out[:, NAV_VEL : NAV_VEL + 3])[use],
        "position": np.column_stack([flight.pos_ne_m - place, down])[use],
    }


LIMITS = {
    # RMSE: attitude deg about north, east, down; velocity m/s and position m, NED.
    "paper": ((2.5, 2.5, 1.5), (0.5, 1.1, 0.3), (2.5, 5.0, 2.5)),
    "complementary": ((0.8, 0.8, 1.2), (0.4, 0.4, 0.3), (2.5, 2.5, 2.5)),
    "eskf": ((0.8, 0.8, 1.2), (0.3, 0.3, 0.2), (2.2, 2.2, 2.5)),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "run"), list(OWN.items()))
def test_limits_per_axis(flight: Flight, name: str, run) -> None:
    found = errors(flight, run(flight))
    attitude, velocity, position = LIMITS[name]
    assert (np.degrees(np.sqrt((found["attitude"] ** 2).mean(axis=0))) < attitude).all()
    assert (np.sqrt((found["velocity"] ** 2).mean(axis=0)) < velocity).all()
    assert (np.sqrt((found["position"] ** 2).mean(axis=0)) < position).all()


@pytest.mark.slow
def test_standard_deviations_are_honest() -> None:
    for kind, scores in consistency(run_eskf, range(51, 57)).items():
        assert scores["low"] < scores["nees"] < scores["high"], (kind, scores)
        assert scores["inside"] > 0.5, (kind, scores)


@pytest.mark.slow
def test_each_axis_stays_within_three_standard_deviations(flight: Flight) -> None:
    for kind, errors in normalised_errors(flight, run_eskf(flight)).items():
        assert np.mean(np.abs(errors) < 3.0) > 0.93, kind


@pytest.mark.slow
def test_iron_that_the_calibration_left_is_learned_in_flight(flight: Flight) -> None:
    imu = flight.log.imu.copy()
    imu[:, 6:9] += [3.0, -2.0, 4.0]
    no_dip = flight.log.gps.copy()
    no_dip[:, GPS_DIP] = np.nan

    def yaw(gps: np.ndarray, settings: EskfSettings) -> float:
        choice = EstimationSettings(estimator="eskf", reference=flight.reference, eskf=settings)
        out = make_estimator(choice).run(replace(flight.log, imu=imu, gps=gps))
        return attitude_scores(flight, out[:, :4])["yaw"]

    unlearned = yaw(no_dip, EskfSettings(mag_bias_ut=0.01))
    assert yaw(no_dip, EskfSettings()) < 0.9 * unlearned
    assert yaw(flight.log.gps, EskfSettings(mag_bias_ut=0.01)) < 0.9 * unlearned


@pytest.mark.slow
def test_a_gyroscope_off_scale_is_learned_in_the_turns(flight: Flight) -> None:
    """An MPU6050 may be 3 % off, eleven degrees in each circle."""
    imu = flight.log.imu.copy()
    imu[:, 3:6] *= 1.03
    off_scale = replace(flight, log=replace(flight.log, imu=imu))

    def yaw(settings: EskfSettings) -> float:
        choice = EstimationSettings(estimator="eskf", reference=flight.reference, eskf=settings)
        out = make_estimator(choice).run(off_scale.log)
        return attitude_scores(off_scale, out[:, :4])["yaw"]

    assert yaw(EskfSettings()) < 1.2
    assert yaw(EskfSettings()) < 0.6 * yaw(EskfSettings(gyro_scale=0.0))


REAL = {
    # estimator: roll, pitch, yaw; position at 1 Hz; 10 s outages: a little above what is reached.
    "paper": (3.3, 3.4, 6.4, 1.35, 16.0),
    "complementary": (1.2, 1.05, 1.75, 1.07, 6.4),
    # The heading of the reference is known to about 1 deg.
    "eskf": (0.95, 0.75, 1.35, 1.07, 5.0),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "run"), list(OWN.items()))
def test_real_fixed_wing_flight(data_dir: Path, name: str, run) -> None:
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    roll, pitch, yaw, one_hz, outage = REAL[name]
    scores = attitude_scores(flight, run(flight)[:, :4])
    assert scores["roll"] < roll
    assert scores["pitch"] < pitch
    assert scores["yaw"] < yaw
    thin = position_errors_m(flight, run(thinned(flight)))[flight.counts]
    assert rms(thin) < one_hz
    assert outage_score(flight, run, 10.0) < outage


@pytest.mark.slow
def test_a_dive_in_an_outage_is_not_taken_for_a_stop(data_dir: Path) -> None:
    """In the fourth of these outages the aircraft dives: for a moment it has no ground speed."""
    flight = read_flight(data_dir / "arduplane_testlog2.csv.gz")
    assert outage_score(flight, run_complementary, 30.0) < 55.0


@pytest.mark.slow
def test_real_car_in_outages(data_dir: Path) -> None:
    """It drives as quietly as it stands: what is taken for rest would stop it."""
    flight = read_flight(data_dir / "car_rtk_drive0708_first_half.csv.gz")
    assert outage_score(flight, run_complementary, 10.0) < 2.1
    assert outage_score(flight, run_complementary, 30.0) < 7.0
    assert outage_score(flight, run_eskf, 10.0) < 2.1
    assert outage_score(flight, run_eskf, 30.0) < 10.0


@pytest.mark.slow
@pytest.mark.parametrize("run", [run_complementary, run_eskf], ids=["complementary", "eskf"])
def test_real_gps_glitches_do_no_harm(data_dir: Path, run) -> None:
    """The fixes of this log wander off by a hundred metres, then come back."""
    flight = read_flight(data_dir / "px4_f450_glitch.csv.gz")
    out = run(flight)
    assert np.isfinite(out[:, :4]).all()
    assert (out[:, NAV_FLAGS].astype(int) & int(NavFlags.GPS_REJECTED)).any()
    place = north_east_m(flight, out[:, NAV_LAT], out[:, NAV_LAT + 1])
    last_fix = north_east_m(flight, flight.log.gps[-1:, 1], flight.log.gps[-1:, 2])
    known = np.isfinite(place[:, 0])
    assert np.hypot(*place[known].T).max() < 150.0
    assert np.hypot(*(place[-1] - last_fix[0])) < 40.0
