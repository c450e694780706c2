"""A flight for the analysis: its arrays, its sources, its fused tracks."""

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gateway.aircraft import AircraftSettings
from gateway.analysis.case import ESTIMATORS, make_case
from gateway.analysis.flight import (
    Flight,
    FlightTrack,
    at_times,
    compared_with,
    fixes_of,
    flight_of_blocks,
    fuse_track,
)
from gateway.analysis.metrics import position_error_m, rms
from gateway.analysis.reporting.compose import make_report
from gateway.analysis.sweep import with_value
from gateway.geometry.geodesy import displacement_m
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.fuse import FusionSettings, with_estimator
from gateway.recordings.rows import TableRow
from gateway.recordings.table import block_of
from gateway.records import ImuCalibrated, ImuFlags, ImuRaw, NodeId
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.vehicle_state.positions import LocalFrame
from tests.analysis.flights import DURATION_S, short_case, short_flight, true_track, with_imu
from tests.recordings.flights import record
from tools.simulated_flight import SimulatedFlight, fly


def test_simulated_flight_is_calibrated_and_has_exact_truth() -> None:
    flight = short_flight()
    assert flight.rate_hz == pytest.approx(50.0, rel=0.01)
    assert flight.duration_s == pytest.approx(DURATION_S, abs=0.1)
    rest = flight.imu.accel_b_mps2[: round(5 * flight.rate_hz)].mean(axis=0)
    assert rest == pytest.approx([0.0, 0.0, -9.80665], abs=0.03)
    assert len(true_track(flight).lat_deg) == len(flight.time_us)
    assert np.linalg.norm(flight.imu.gyro_b_radps[:200].mean(axis=0)) < math.radians(0.3)


def test_calibration_reduces_spread_of_field_strength() -> None:
    flight = short_flight()
    assert flight.mag_uncalibrated_b_ut is not None
    before = np.linalg.norm(flight.mag_uncalibrated_b_ut, axis=1)
    after = np.linalg.norm(flight.imu.mag_b_ut, axis=1)
    assert np.nanstd(after) < 0.2 * np.nanstd(before)


def test_fixes_are_usable_ones_with_latency_subtracted() -> None:
    flight = short_flight()
    fixes = fixes_of(flight)
    assert 0 < len(fixes) < len(flight.fixes)
    assert (fixes.arrival_us - fixes.valid_us == round(flight.latency_s * 1e6)).all()


def test_scoring_starts_5_s_after_first_fix() -> None:
    flight = short_flight()
    first_us = fixes_of(flight).arrival_us[0]
    assert flight.time_us[np.argmax(flight.scored)] == pytest.approx(first_us + 5e6, abs=3e4)


def test_local_frame_agrees_with_displacement_across_date_line() -> None:
    frame = LocalFrame(-7.0, 179.9999, 100.0)
    pos_m = frame.local_m(np.array([-6.999]), np.array([-179.9999]))
    expected = displacement_m(-7.0, 179.9999, -6.999, -179.9999, 100.0)
    assert pos_m[0] == pytest.approx(expected)


def test_single_imu_sample_is_rejected() -> None:
    zero = (0.0, 0.0, 0.0)
    row = TableRow(0, imu=ImuCalibrated(0, NodeId(1, 0), zero, zero, None, 20.0, ImuFlags(0)))
    with pytest.raises(ValueError, match="1 IMU samples are not a flight"):
        flight_of_blocks(
            [block_of([row])], NodeCalibration(), FusionSettings(), name="x", description=""
        )


SIMULATED: SimulatedFlight = fly(
    SimulatorSettings(imu_rate_hz=50, gps_outages_s=((40.0, 3.0),)), duration_s=30.0
)


def recorded(*, raw: bool, calibration: NodeCalibration | None = None) -> Flight:
    """Read the rows of the simulated flight as a flight."""
    calibration = calibration or NodeCalibration()
    blocks = [block_of(rows(raw=raw))]
    return flight_of_blocks(
        blocks, calibration, short_case().fusion, name="log.csv", description="A log."
    )


def rows(*, raw: bool) -> list[TableRow]:
    """Rows as the recorder writes them, with states."""
    return list(_rows()) if raw else [replace(row, raw=None) for row in _rows()]


@cache
def _rows() -> tuple[TableRow, ...]:
    estimation = short_case().fusion.estimation
    calibration = NodeCalibration(**SIMULATED.errors)
    settings = AircraftSettings(estimation=estimation, calibration=calibration)
    lines, _ = record(Pipeline(PipelineSettings(settings)), [*SIMULATED.records()])
    return tuple(line for line in lines if isinstance(line, TableRow))


@pytest.mark.parametrize("raw", [True, False])
def test_recorded_rows_give_samples_and_states_of_simulated_flight(raw: bool) -> None:
    flight = recorded(raw=raw, calibration=NodeCalibration(**SIMULATED.errors))
    chain = SensorChain(NodeCalibration(**SIMULATED.errors))
    samples = [chain.imu(record) for record in SIMULATED.records() if isinstance(record, ImuRaw)]
    assert flight.imu.accel_b_mps2.tolist() == [list(s.accel_b_mps2) for s in samples]
    assert np.isfinite(flight.imu.mag_b_ut[:, 0]).tolist() == [
        s.mag_b_ut is not None for s in samples
    ]
    assert len(fixes_of(flight)) > 100
    assert (flight.node_time_us is not None) == raw
    assert flight.recorded is not None
    again = fuse_track(flight, flight.fusion)
    assert flight.recorded.lat_deg[-1] == pytest.approx(again.lat_deg[-1], abs=1e-9)


def test_simulated_flight_has_radio_loss_and_jitter() -> None:
    flight = short_flight()
    assert flight.node_time_us is not None
    lost = np.rint(np.diff(flight.node_time_us) / 20_000) - 1
    assert 0 < lost.sum() < 0.05 * len(lost)
    jitter_us = np.diff(flight.time_us) - np.diff(flight.node_time_us)
    assert 0.0 < jitter_us.std() < 2_000.0


def test_report_without_reference_compares_recorded_states() -> None:
    flight = recorded(raw=False)
    assert flight.reference is None
    report = make_report(make_case(flight))
    titles = [section.title for section in report.sections]
    assert "Estimators compared" in titles
    assert "Timing and loss" not in titles
    compared = report.sections[titles.index("Estimators compared")]
    assert "recorded in flight" in compared.tables[0].frame["estimator"].tolist()


def test_states_of_another_recording_serve_as_reference() -> None:
    plain = replace(short_flight(), reference=None)
    compared = compared_with(plain, [block_of(rows(raw=False))], "ref.csv")
    assert compared.reference is not None
    assert not compared.reference.is_exact
    assert "ref.csv" in compared.reference.description
    known = np.isfinite(compared.reference.track.lat_deg)
    assert 20.0 < known.sum() / 50.0 < 30.0
    with pytest.raises(ValueError, match=r"ref\.csv: contains no states"):
        compared_with(plain, [block_of([TableRow(0)])], "ref.csv")


def test_nearest_row_is_used_within_time_limit() -> None:
    time_us = np.array([0, 100_000, 400_000])
    values = np.array([1.0, 2.0, 3.0])
    track = FlightTrack(
        time_us, np.outer(values, [1, 0, 0, 0]), values, values, values, np.outer(values, [1, 1, 1])
    )
    found = at_times(track, np.array([10_000, 60_000, 200_000, 399_000, 500_000]))
    assert found.lat_deg == pytest.approx([1.0, 2.0, np.nan, 3.0, np.nan], nan_ok=True)
    assert found.vel_n_mps[3].tolist() == [3.0, 3.0, 3.0]


def test_report_without_gps_compass_and_reference_has_four_sections() -> None:
    flight = short_flight()
    bare = replace(flight.with_fixes([False] * len(flight.fixes)), reference=None)
    bare = with_imu(bare, mag_b_ut=np.full_like(flight.imu.mag_b_ut, np.nan))
    assert make_case(bare).frame is None
    titles = [section.title for section in make_report(make_case(bare)).sections]
    assert titles == ["The flight", "Acceleration filters", "Noise", "Timing and loss"]


@pytest.mark.parametrize("name", ESTIMATORS)
def test_fused_track_is_within_4_m_rms_of_truth(name: str) -> None:
    flight = short_flight()
    error = position_error_m(short_case().tracks[name], true_track(flight))[flight.scored]
    assert rms(np.hypot(error[:, 0], error[:, 1])) < 4.0


def test_position_before_first_valid_fix_is_nan() -> None:
    track: FlightTrack = short_case().tracks["paper"]
    unknown = short_flight().time_us < next(f.time_us for f in short_flight().fixes if f.fix_ok)
    assert np.isfinite(track.lat_deg).tolist() == (~unknown).tolist()


def test_changed_cutoff_changes_fused_attitude() -> None:
    flight, fusion = short_flight(), with_estimator(short_case().fusion, "paper")
    changed = fuse_track(flight, with_value(fusion, "estimation.paper.accel_cutoff_hz", 2.0))
    assert not np.array_equal(changed.q_nb, short_case().tracks["paper"].q_nb)
