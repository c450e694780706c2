"""What the report's sections measure, on flights of which it is known."""

import numpy as np
import pytest

from gateway.analysis.reporting.raw_sensors import EXCERPT_S, liveliest, loss_table
from tests.analysis.flights import short_flight, with_imu


def test_lost_and_late_samples_are_measured() -> None:
    flight = short_flight()
    node_time_us = 10_000 * np.arange(len(flight.time_us))
    node_time_us[100:] += 20_000
    late_us = 1000 * (np.arange(len(flight.time_us)) % 2)
    (row,) = loss_table(with_imu(flight, time_us=node_time_us + late_us), node_time_us).to_dict(
        "records"
    )
    assert (row["nominal interval, ms"], row["lost"]) == (10.0, 2)
    assert row["longest gap, ms"] == pytest.approx(30.0, abs=1.01)
    assert row["jitter of gateway time, ms RMS"] == pytest.approx(1.0)


def test_the_excerpt_is_where_the_acceleration_changes() -> None:
    flight = short_flight()
    count = round(EXCERPT_S * flight.rate_hz)
    accel = np.zeros_like(flight.imu.accel_b_mps2)
    accel[2 * count : 3 * count, 1] = np.resize([1.0, -1.0], count)
    assert liveliest(with_imu(flight, accel_b_mps2=accel), 1) == slice(2 * count, 3 * count)
