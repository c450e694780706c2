"""A gap of all samples in flight, as after a stall of the computer."""

from dataclasses import replace

import numpy as np
import pytest

from gateway.estimation.columns import NAV_LAT, NAV_LON, NAV_POS_STD
from gateway.estimation.kernel import SampleLog
from tools.flights import Flight, north_east_m, simulated_flight
from tools.score_estimators import estimator_of

GAP_S = 3.0
LARGEST_STEP_M = 2.0
LARGEST_ERROR_M = 15.0
RECOVERED_M = 4.0


@pytest.fixture(scope="module")
def flight() -> Flight:
    return simulated_flight(21, calibrated=True)


def without(log: SampleLog, begin_s: float) -> tuple[SampleLog, np.ndarray]:
    """Leave out `GAP_S` of all sensors; also return which IMU samples are left."""
    imu, baro, gps = (
        np.abs(times_us * 1e-6 - begin_s - GAP_S / 2) > GAP_S / 2
        for times_us in (log.imu_time_us, log.baro_time_us, log.gps_time_us)
    )
    return SampleLog(
        log.imu_time_us[imu], log.imu[imu],
        log.baro_time_us[baro], log.baro_alt_m[baro],
        log.gps_time_us[gps], log.gps[gps],
    ), imu  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("begin_s", [60.0, 90.0, 120.0, 150.0])
def test_position_after_a_gap_moves_to_the_fixes_without_a_step(
    flight: Flight, begin_s: float
) -> None:
    log, kept = without(flight.log, begin_s)
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
