from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from gateway.analysis.case import make_case
from gateway.analysis.flight import (
    FlightTrack,
    at_times,
    fixes_of,
    flight_of_blocks,
    fuse_track,
    judged_by,
)
from gateway.analysis.reporting.compose import make_report
from gateway.analysis.simulated import ideal_calibration
from gateway.estimation.select import make_estimator
from gateway.recordings.columns import TableRow
from gateway.recordings.table import block_of
from gateway.records import BaroRaw, GpsFix, ImuCalibrated, ImuRaw
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.simulator.flight import SimulatedFlight, fly
from gateway.simulator.simulator_settings import SimulatorSettings
from tests.analysis.flights import short_case, short_flight, with_imu

SIMULATED: SimulatedFlight = fly(
    SimulatorSettings(imu_rate_hz=50, gps_outages_s=((40.0, 3.0),)), duration_s=30.0
)


def rows(*, raw: bool) -> Iterator[TableRow]:
    """What the recorder would have written, with states."""
    fusion = short_case().fusion
    chain = SensorChain(ideal_calibration(SIMULATED.errors))
    estimator = make_estimator(fusion.estimation)
    for record in SIMULATED.records():
        match record:
            case ImuRaw():
                sample = chain.imu(record)
                state = estimator.update_imu(sample)
                calibrated = ImuCalibrated(
                    sample.time_us, record.node, sample.accel_b_mps2, sample.gyro_b_radps,
                    sample.mag_b_ut, sample.temperature_degc, sample.flags,
                )  # fmt: skip
                yield TableRow(
                    record.time_us, raw=record if raw else None, imu=calibrated, state=state
                )
            case BaroRaw():
                estimator.update_baro(chain.baro(record))
                yield TableRow(record.time_us, baro=record)
            case GpsFix():
                estimator.update_gps(record)
                yield TableRow(record.time_us, gps=record)


@pytest.mark.parametrize("raw", [True, False])
def test_a_recording_becomes_the_same_flight(raw: bool) -> None:
    flight = flight_of_blocks(
        [block_of(rows(raw=raw))],
        ideal_calibration(SIMULATED.errors),
        short_case().fusion,
        name="a",
        story="",
    )
    chain = SensorChain(ideal_calibration(SIMULATED.errors))
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


def test_the_simulated_flight_comes_over_the_radio() -> None:
    flight = short_flight()
    assert flight.node_time_us is not None
    lost = np.rint(np.diff(flight.node_time_us) / 20_000) - 1
    assert 0 < lost.sum() < 0.05 * len(lost)
    jitter_us = np.diff(flight.time_us) - np.diff(flight.node_time_us)
    assert 0.0 < jitter_us.std() < 2_000.0


def test_a_recording_without_reference_still_has_its_report() -> None:
    flight = flight_of_blocks(
        [block_of(rows(raw=False))],
        NodeCalibration(),
        short_case().fusion,
        name="log.csv",
        story="A log.",
    )
    assert flight.reference is None
    report = make_report(make_case(flight))
    titles = [section.title for section in report.sections]
    assert "Estimators compared" in titles
    assert "Timing and loss" not in titles
    compared = report.sections[titles.index("Estimators compared")]
    assert "recorded in flight" in compared.tables[0].frame["estimator"].tolist()


def test_other_states_can_be_the_reference() -> None:
    plain = replace(short_flight(), reference=None)
    judged = judged_by(plain, [block_of(rows(raw=False))], "ref.csv")
    assert judged.reference is not None
    assert not judged.reference.is_exact
    assert "ref.csv" in judged.reference.story
    known = np.isfinite(judged.reference.track.lat_deg)
    assert 20.0 < known.sum() / 50.0 < 30.0


def test_a_reference_without_states_is_refused() -> None:
    with pytest.raises(ValueError, match=r"ref\.csv: holds no states"):
        judged_by(short_flight(), [block_of([TableRow(0)])], "ref.csv")


def test_the_nearest_row_is_taken_if_it_is_near() -> None:
    time_us = np.array([0, 100_000, 400_000])
    values = np.array([1.0, 2.0, 3.0])
    track = FlightTrack(
        time_us, np.outer(values, [1, 0, 0, 0]), values, values, values, np.outer(values, [1, 1, 1])
    )
    found = at_times(track, np.array([10_000, 60_000, 200_000, 399_000, 500_000]))
    assert found.lat_deg == pytest.approx([1.0, 2.0, np.nan, 3.0, np.nan], nan_ok=True)
    assert found.vel_n_mps[3].tolist() == [3.0, 3.0, 3.0]


def test_a_flight_without_gps_compass_and_reference_still_has_its_report() -> None:
    flight = short_flight()
    bare = replace(flight.with_fixes([False] * len(flight.fixes)), reference=None)
    bare = with_imu(bare, mag_b_ut=np.full_like(flight.imu.mag_b_ut, np.nan))
    titles = [section.title for section in make_report(make_case(bare)).sections]
    assert titles == ["Acceleration filters", "Noise", "Timing and loss"]
