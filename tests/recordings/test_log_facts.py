"""GPS latency of other programs' logs: the same for every command that fuses them."""

import gzip
from pathlib import Path

import pytest

from gateway.analysis.case import make_case
from gateway.analysis.reporting.estimators import estimators
from gateway.analysis.sweep import with_value
from gateway.batch.tasks import read_batch_flight
from gateway.cli.support.options import read_options
from gateway.cli.support.recordings import load_flight
from gateway.config import GatewaySettings
from gateway.pipeline import PipelineSettings
from gateway.recordings.flown import open_flown
from gateway.recordings.recorded_fusion import RecordedFusion, aircraft_for
from gateway.recordings.recorded_table import ReadOptions, settings_of
from gateway.recordings.recording import open_recording
from tests.kit.cli import run
from tests.recordings.flights import OPTIONS

pytestmark = [pytest.mark.io, pytest.mark.slow]

TODAY = GatewaySettings()

GOLDEN = Path(__file__).parent.parent / "golden" / "take_off.csv.gz"


@pytest.fixture
def without_latency(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(gzip.decompress(GOLDEN.read_bytes()).decode().replace("gps_latency_s=0.16", ""))
    return path


def test_every_command_uses_the_latency_estimated_from_manoeuvres(without_latency: Path) -> None:
    table = open_recording(without_latency).rows(OPTIONS)
    latency_s = aircraft_for(
        open_recording(without_latency), table, OPTIONS
    ).estimation.reference.gps_latency_s
    assert latency_s == pytest.approx(0.16, abs=0.02)
    assert "GPS latency not in log; estimated 0.1" in table.remarks[0]
    assert load_flight(without_latency, TODAY, read_options(TODAY)).latency_s == latency_s
    assert read_batch_flight([without_latency], OPTIONS, "log")[0].latency_s == latency_s
    fusion = RecordedFusion([open_recording(without_latency)], OPTIONS)
    assert fusion.remarks == table.remarks
    assert open_flown([without_latency], OPTIONS).gps_latency_s == latency_s
    settings = settings_of(fusion.table().header)
    assert settings.estimation.reference.gps_latency_s == latency_s


def test_rows_are_read_once_to_estimate_the_latency(without_latency: Path) -> None:
    """The first reader leaves them to the next."""
    table, again = (
        open_recording(without_latency).rows(OPTIONS),
        open_recording(without_latency).rows(OPTIONS),
    )
    aircraft_for(open_recording(without_latency), table, OPTIONS)
    assert sum(map(len, table.blocks)) == sum(map(len, again.blocks)) > 0


@pytest.mark.parametrize("set_s", [0.16, 0.4])
def test_recording_fused_with_another_latency_is_reported(
    without_latency: Path, tmp_path: Path, set_s: float, capsys: pytest.CaptureFixture[str]
) -> None:
    own, config = tmp_path / "own.csv", tmp_path / "c.toml"
    config.write_text(f"[estimation.reference]\ngps_latency_s = {set_s}\n")
    run("fuse", without_latency, "-o", own, "--config", config)
    assert load_flight(own, TODAY, read_options(TODAY)).latency_s == set_s
    words = " ".join(capsys.readouterr().err.split())
    assert ("its manoeuvres show a GPS latency of 0.1" in words) == (set_s == 0.4)


def test_latency_of_user_log_or_settings_is_used(without_latency: Path) -> None:
    def latency_s(path: Path, options: ReadOptions, given_s: float | None = None) -> float:
        table = open_recording(path).rows(options)
        found = aircraft_for(
            open_recording(path), table, options, given_s
        ).estimation.reference.gps_latency_s
        assert table.remarks == []
        return found

    assert latency_s(GOLDEN, OPTIONS) == 0.16
    assert latency_s(GOLDEN, OPTIONS, 0.3) == latency_s(without_latency, OPTIONS, 0.3) == 0.3
    changed = with_value(TODAY.default_aircraft, "estimation.reference.gps_latency_s", 0.2)
    assert latency_s(without_latency, ReadOptions(PipelineSettings(changed))) == 0.2


def test_every_command_smooths_with_the_latency_that_contradicts_the_one_set(
    tmp_path: Path,
) -> None:
    path, out = tmp_path / "log.csv", tmp_path / "smoothed.csv"
    text = gzip.decompress(GOLDEN.read_bytes()).decode()
    path.write_text(text.replace("gps_latency_s=0.16", "gps_latency_s=0.4"))
    remark = "smoothed with a GPS latency of 0.1"
    assert remark in run("fuse", path, "-o", out, "--smooth")
    table = open_recording(out).rows(OPTIONS)
    latency_s = settings_of(table.header).estimation.reference.gps_latency_s
    assert latency_s == pytest.approx(0.16, abs=0.02)
    fusion = RecordedFusion([open_recording(path)], OPTIONS, smooth=True)
    assert remark in fusion.remarks[0]
    settings = settings_of(fusion.table().header)
    assert settings.estimation.reference.gps_latency_s == latency_s
    case = make_case(load_flight(path, TODAY, read_options(TODAY)), smooth=True)
    assert case.smoothed_latency_s == latency_s
    section = estimators(case)
    assert section is not None
    assert f"0.40 s: `smoothed` uses {latency_s:.2f} s" in section.lead
