import tomllib
from pathlib import Path

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


def test_search_writes_its_best_settings(recording: Path, tmp_path: Path) -> None:
    best = tmp_path / "best.toml"
    arguments = ["--vary", "beta=0:1", "--optimise", "2", "-o", str(best), "--jobs", "1"]
    invoke("sweep", recording, *arguments, code=0)
    # On this short, smooth flight the withheld fixes are nearest at 0.7; 0 and 1 are both worse.
    assert 0.5 < load(best).estimation.paper.beta_velocity < 0.9
