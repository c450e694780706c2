"""Ten increments of rotation and velocity a second, as nodes send them over a slow link."""

from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.columns import MEANS
from tools.flights import Flight, as_increments, read_flight
from tools.score_estimators import attitude_scores, position_errors_m, rms, run_eskf, share_scores
from tools.spoil_flight import cut

RATE_HZ = 10.0
MOST_WORSE = 1.2
RECORDED = (
    *("arduplane_testlog2", "arducopter_quad106", "px4_swisslog1", "px4_wing_search"),
    *("px4_mocap_log008", "phantom_dot1"),
)


def ratios(flight: Flight) -> dict[str, float]:
    """Return the errors of the reduced flight by those of the whole one."""
    slow = as_increments(flight, RATE_HZ)
    assert len(slow.log.imu) < 0.3 * len(flight.log.imu)
    errors = []
    for each in (flight, slow):
        out = run_eskf(each)
        errors.append({"attitude": attitude_scores(each, out[:, :4])["total"]})
        if np.isfinite(each.pos_ne_m).any():
            errors[-1]["position"] = rms(position_errors_m(each, out)[each.counts])
    whole, reduced = errors
    return {name: reduced[name] / whole[name] for name in whole}


@pytest.mark.slow
def test_simulated_flight_loses_little_by_increments(flight: Flight) -> None:
    assert max(ratios(flight).values()) < MOST_WORSE


@pytest.mark.slow
def test_standard_deviations_contain_the_vibration_of_slow_samples(flight: Flight) -> None:
    slow = cut(flight, np.arange(len(flight.log.imu)) % 10 == 0)
    slow.log.imu[:, MEANS] = 0.0
    shares = share_scores(slow, run_eskf(slow))
    assert min(shares["tilt_2s"], shares["heading_2s"]) > 0.85


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDED)
def test_attitude_of_recorded_flights_loses_little_by_increments(data_dir: Path, name: str) -> None:
    assert ratios(read_flight(data_dir / f"{name}.csv.gz"))["attitude"] < MOST_WORSE
