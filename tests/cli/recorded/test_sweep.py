import tomllib
from dataclasses import replace
from pathlib import Path

import msgspec
import pandas as pd
import pytest

from gateway.config import load
from gateway.recordings.table import TableHeader
from tests.analysis.test_flight import rows
from tests.kit.cli import invoke
from tests.kit.recordings import write_table

pytestmark = pytest.mark.io


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Half a minute of a flight, as the recorder writes it."""
    path = tmp_path_factory.mktemp("flight") / "flight.csv"
    return write_table(path, TableHeader(), rows(raw=False))


def test_best_settings_are_written_as_a_settings_file(recording: Path, tmp_path: Path) -> None:
    best, table = tmp_path / "best.toml", tmp_path / "trials.csv"
    arguments = [
        "--vary",
        "alpha=0.1,0.9",
        "--vary",
        "beta=0.1:0.9:3",
        "-o",
        best,
        "--table",
        table,
    ]
    result = invoke("sweep", recording, *arguments, code=0)
    assert "Best of 6 trials, by the error at withheld fixes" in result.output
    trials = pd.read_csv(table)
    assert len(trials) == 6
    assert trials["held_m"].is_monotonic_increasing
    estimation = load(best).estimation
    assert estimation.estimator == "paper"
    assert estimation.paper.alpha_accel == trials["estimation.paper.alpha_accel"][0]
    # Only the varied settings, and those that they require.
    [(section, written)] = tomllib.loads(best.read_text()).items()
    assert (section, written.keys()) == ("estimation", {"estimator", "paper"})
    assert written["paper"].keys() == {"alpha_accel", "beta_velocity"}
    assert "at rest" not in result.output


def test_flight_at_rest_is_reported(tmp_path: Path) -> None:
    resting = [
        replace(row, gps=row.gps and msgspec.structs.replace(row.gps, vel_n_mps=(0.2, 0.1, 0.0)))
        for row in rows(raw=False)
    ]
    path = write_table(tmp_path / "rest.csv", TableHeader(), resting)
    result = invoke("sweep", path, "--vary", "alpha=0.1,0.9", "-o", tmp_path / "best.toml", code=0)
    assert "at rest throughout, at most 0.2 m/s by GPS: it contains no information" in result.output


def test_search_writes_its_best_settings(recording: Path, tmp_path: Path) -> None:
    best = tmp_path / "best.toml"
    arguments = ["--vary", "beta=0:1", "--optimise", "2", "-o", str(best), "--jobs", "1"]
    invoke("sweep", recording, *arguments, code=0)
    # On this short, smooth flight the withheld fixes are nearest at 0.7; 0 and 1 are both worse.
    assert 0.5 < load(best).estimation.paper.beta_velocity < 0.9


def test_texts_and_numbers_are_varied_together(recording: Path, tmp_path: Path) -> None:
    best, table = tmp_path / "best.toml", tmp_path / "trials.csv"
    arguments = ["--vary", "estimator=paper,eskf", "--vary", "gps_latency_s=0.0,0.2"]
    arguments += ["-o", str(best), "--table", str(table), "--jobs", "1"]
    invoke("sweep", recording, *arguments, code=0)
    winner = pd.read_csv(table).iloc[0]
    estimation = load(best).estimation
    assert estimation.estimator == winner["estimation.estimator"]
    assert estimation.reference.gps_latency_s == winner["estimation.reference.gps_latency_s"]


def test_setting_without_effect_is_reported(recording: Path, tmp_path: Path) -> None:
    idle = ["--vary", "dead_reckoning_s=30.0,60.0"]
    base = ["sweep", str(recording), "-o", str(tmp_path / "best.toml"), "--jobs", "1", "--force"]
    result = invoke(*base, "--vary", "baro_noise_m=0.1,5.0", *idle, code=0)
    assert "estimation.eskf.dead_reckoning_s: has no effect" in result.output
    assert "baro_noise_m:" not in result.output
    result = invoke(*base, *idle, code=2)
    assert "vary another setting" in result.output


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "nothing to vary"),
        (["--vary", "alpha=1:2:3"], "alpha_accel = 1.5"),
        (["--vary", "alpha_accel"], "write NAME=VALUES"),
        (["--vary", "gama=1"], "no setting ends in 'gama'"),
        (["--vary", "alpha=0.1,0.2", "--metric", "reference"], "no reference of the position"),
    ],
)
def test_impossible_sweep_is_reported(recording: Path, arguments: list[str], text: str) -> None:
    result = invoke("sweep", recording, *arguments, code=2)
    assert text in result.output
