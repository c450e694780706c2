"""Every estimator on simulated flights, against exact truth; and on real ones where there are."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gateway.estimation.columns import (
    NAV_ATTITUDE_STD,
    NAV_FLAGS,
    NAV_LAT,
    NAV_POS_STD,
    NAV_VEL,
    NAV_VEL_STD,
)
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
    "complementary": ((1.2, 1.2, 1.8), (0.5, 0.5, 0.3), (2.5, 2.5, 2.5)),
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
def test_standard_deviations_are_honest(flight: Flight) -> None:
    out = run_eskf(flight)
    found = errors(flight, out)
    columns = {"attitude": NAV_ATTITUDE_STD, "velocity": NAV_VEL_STD, "position": NAV_POS_STD}
    for name, column in columns.items():
        normalised = found[name] / out[flight.counts, column : column + 3]
        nees = float((normalised**2).mean())
        assert 0.15 < nees < 3.0, f"{name}: {nees}"
    # Each axis within three standard deviations nearly always.
    inside = [
        np.mean(np.abs(found[name] / out[flight.counts, column : column + 3]) < 3.0)
        for name, column in columns.items()
    ]
    assert min(inside) > 0.93


REAL = {
    # estimator: roll, pitch, yaw; position at 1 Hz; 10 s outages: a little above what is reached.
    "paper": (3.3, 3.4, 6.4, 1.35, 16.0),
    "complementary": (1.3, 1.2, 1.9, 1.07, 9.5),
    "eskf": (1.1, 0.8, 1.6, 1.10, 6.4),
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
