import math

import numpy as np
import pytest

from gateway.analysis.flight import LocalFrame, fixes_of, flight_of_blocks, local_frame
from gateway.geometry.geodesy import displacement_m
from gateway.recordings.columns import TableRow
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.table import block_of
from gateway.records import ImuCalibrated, ImuFlags, NodeId
from gateway.sensing.calibration import NodeCalibration
from tests.analysis.flights import DURATION_S, short_flight


def test_the_simulated_flight_is_calibrated_and_has_its_truth() -> None:
    flight = short_flight()
    assert flight.rate_hz == pytest.approx(50.0, rel=0.01)
    assert flight.duration_s == pytest.approx(DURATION_S, abs=0.1)
    rest = flight.imu.accel_b_mps2[: round(5 * flight.rate_hz)].mean(axis=0)
    assert rest == pytest.approx([0.0, 0.0, -9.80665], abs=0.03)
    assert flight.reference is not None
    assert flight.reference.is_exact
    assert len(flight.reference.track.lat_deg) == len(flight.time_us)
    assert np.linalg.norm(flight.imu.gyro_b_radps[:200].mean(axis=0)) < math.radians(0.3)


def test_the_magnetometer_is_there_before_and_after_calibration() -> None:
    flight = short_flight()
    assert flight.mag_uncalibrated_b_ut is not None
    before = np.linalg.norm(flight.mag_uncalibrated_b_ut, axis=1)
    after = np.linalg.norm(flight.imu.mag_b_ut, axis=1)
    assert np.nanstd(after) < 0.2 * np.nanstd(before)


def test_only_usable_fixes_are_laid_out() -> None:
    flight = short_flight()
    fixes = fixes_of(flight)
    assert 0 < len(fixes) < len(flight.fixes)
    assert (fixes.arrival_us - fixes.valid_us == round(flight.latency_s * 1e6)).all()


def test_the_start_up_does_not_count() -> None:
    flight = short_flight()
    first_us = fixes_of(flight).arrival_us[0]
    assert flight.time_us[np.argmax(flight.scored)] == pytest.approx(first_us + 5e6, abs=3e4)


def test_the_local_frame_measures_metres() -> None:
    frame = LocalFrame(-7.0, 179.9999, 100.0)
    place = frame.place(np.array([-6.999]), np.array([-179.9999]))
    expected = displacement_m(-7.0, 179.9999, -6.999, -179.9999, 100.0)
    assert place[0] == pytest.approx(expected)


def test_a_flight_without_fixes_has_no_frame() -> None:
    assert local_frame(short_flight().with_fixes([False] * len(short_flight().fixes))) is None


def test_too_few_samples_are_no_flight() -> None:
    zero = (0.0, 0.0, 0.0)
    row = TableRow(0, imu=ImuCalibrated(0, NodeId(1, 0), zero, zero, None, 20.0, ImuFlags(0)))
    with pytest.raises(ValueError, match="1 IMU samples are no flight"):
        flight_of_blocks([block_of([row])], NodeCalibration(), FusionSettings(), name="x", story="")
