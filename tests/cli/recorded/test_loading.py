"""Flights loaded for the analysis commands."""

from pathlib import Path

import pytest

from gateway.aircraft import AircraftSettings
from gateway.cli.support.options import read_options
from gateway.cli.support.recordings import DESCRIPTIONS, load_flight
from gateway.config import GatewaySettings
from gateway.estimation.kernel import FoundLatency
from gateway.estimation.select import EstimationSettings
from gateway.recordings import recorded_fusion as log_facts
from gateway.recordings.columns import TableRow
from gateway.recordings.file_format import TABLE
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_table import header_for
from gateway.records import ImuCalibrated, ImuFlags
from tests.kit.recordings import write_table
from tests.kit.records import IMU_NODE

pytestmark = pytest.mark.io

RECORDED = AircraftSettings(estimation=EstimationSettings(estimator="paper"))
TODAY = GatewaySettings()


def recording(path: Path, samples: int) -> Path:
    rest = ((0.0, 0.0, -9.81), (0.0, 0.0, 0.0), None, 20.0, ImuFlags(0))
    times_us = range(10_000, 10_000 * (samples + 1), 10_000)
    rows = (TableRow(t, imu=ImuCalibrated(t, IMU_NODE, *rest)) for t in times_us)
    return write_table(path, header_for(RECORDED, 1), rows)


def test_recording_is_loaded_with_its_recorded_settings(tmp_path: Path) -> None:
    flight = load_flight(recording(tmp_path / "flight.csv", 20), TODAY, read_options(TODAY))
    assert flight.fusion.estimation == RECORDED.estimation
    assert flight.description == DESCRIPTIONS[TABLE]
    today = load_flight(tmp_path / "flight.csv", TODAY, read_options(TODAY, choice="current"))
    assert today.fusion.estimation == TODAY.default_aircraft.estimation


def test_latency_contradicted_by_the_motion_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(log_facts, "estimate_latency", lambda log: FoundLatency(0.9, 0.01))
    load_flight(recording(tmp_path / "flight.csv", 20), TODAY, read_options(TODAY))
    remark = "flight.csv: its manoeuvres show a GPS latency of 0.900 ± 0.010 s"
    assert remark in capsys.readouterr().err


def test_recording_of_one_sample_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match=r"flight\.csv: 1 IMU samples are not a flight"):
        load_flight(recording(tmp_path / "flight.csv", 1), TODAY, read_options(TODAY))
