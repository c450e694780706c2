"""A gap of all samples in flight, as after a stall of the computer."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.estimation.columns import NAV_LAT, NAV_LON, NAV_POS_STD
from tests.estimation.samples import selected
from tools.flights import Flight, north_east_m
from tools.score_estimators import estimator_of

GAP_S = 3.0
LARGEST_STEP_M = 2.0
LARGEST_ERROR_M = 15.0
RECOVERED_M = 4.0


@pytest.mark.slow
@pytest.mark.parametrize("begin_s", [60.0, 90.0, 120.0, 150.0])
def test_position_after_a_gap_moves_to_fixes_without_a_step(flight: Flight, begin_s: float) -> None:
    middle_us, half_us = (begin_s + GAP_S / 2) * 1e6, GAP_S / 2 * 1e6
    log, kept = selected(flight.log, lambda us: np.abs(us - middle_us) > half_us)
    estimator = estimator_of(flight)
    out = estimator.run(log)
    end = int(np.searchsorted(log.imu_time_us, (begin_s + GAP_S) * 1e6))
    found = north_east_m(replace(flight, log=log), out[:, NAV_LAT], out[:, NAV_LON])
    off_m = np.linalg.norm(found - flight.pos_ne_m[kept], axis=1)
    assert off_m[end] < LARGEST_ERROR_M
    assert off_m[end + 400] < RECOVERED_M
    assert np.linalg.norm(np.diff(found[end : end + 500], axis=0), axis=1).max() < LARGEST_STEP_M
    # The standard deviation contains the part of the correction that is not blended in yet.
    std_m = np.linalg.norm(out[end : end + 500, NAV_POS_STD : NAV_POS_STD + 2], axis=1)
    known = np.isfinite(std_m)
    assert (off_m[end : end + 500][known] < 3.0 * std_m[known] + 1.0).all()
    used_s, set_s = estimator.gps_latency_s
    assert used_s == set_s
