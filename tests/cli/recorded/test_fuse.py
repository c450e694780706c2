"""`mavgate fuse` on small logs."""

import csv
import gzip
import math
import re
from pathlib import Path

import pytest

from tests.kit.cli import invoke
from tests.kit.cli import run as run_words
from tools.make_golden import GOLDEN

pytestmark = pytest.mark.io

HEAD = "time_s,ax,ay,az,gx,gy,gz,mx,my,mz,gps_time_s,gps_lat,gps_lon,gps_alt_m,gps_vn,gps_ve,gps_vd"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    lines = ["# still gps_latency_s=0.3 declination_deg=10.0", HEAD]
    for k in range(500):
        mag = "20.0,0.0,40.0" if k % 10 == 0 else ",,"
        gps = f"{k / 100:.2f},47.0,8.0,500.0,0,0,0" if k % 20 == 0 else ",,,,,,"
        lines.append(f"{k / 100:.2f},0.0,0.0,-9.8,0.0,0.0,0.0,{mag},{gps}")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def run(log: Path, *arguments: str) -> list[dict[str, str]]:
    out = log.with_name("out.csv")
    invoke("fuse", log, "-o", out, "--force", *arguments, code=0)
    lines = out.read_text().splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def yaw_deg(row: dict[str, str]) -> float:
    return math.degrees(2.0 * math.atan2(float(row["nav_q_z"]), float(row["nav_q_w"])))


@pytest.mark.parametrize("estimator", ["paper", "eskf"])
def test_one_row_per_sample_with_position_and_true_heading(log: Path, estimator: str) -> None:
    rows = run(log, "--estimator", estimator)
    assert len(rows) == 500
    last = rows[-1]
    assert int(last["time_us"]) == 4_990_000
    assert float(last["nav_lat_deg"]) == pytest.approx(47.0, abs=1e-6)
    assert float(last["nav_alt_amsl_m"]) == pytest.approx(500.0, abs=0.5)
    assert yaw_deg(last) == pytest.approx(10.0, abs=0.5)
    assert (last["nav_pos_std_north_m"] == "") == (estimator == "paper")


def test_change_to_settings_of_another_version_is_refused(log: Path) -> None:
    table = log.with_name("table.csv")
    invoke("fuse", log, "-o", table, code=0)
    *before, last = table.read_text().splitlines(keepends=True)
    changed = '# header: {"settings": {"estimation": {"wings": 2}}}\n'
    table.write_text("".join([*before, changed, last]))
    found = invoke("fuse", table, "-o", log.with_name("again.csv"), code=2)
    assert "the recorded settings are of another version" in found.output
    invoke("fuse", table, "-o", log.with_name("again.csv"), "--fuse-with", "current", code=0)


def test_settings_file_overrides_facts_of_the_log(log: Path) -> None:
    config = log.with_name("c.toml")
    config.write_text('[estimation.reference]\ndeclination = "fixed"\ndeclination_deg = -20.0\n')
    last = run(log, "--estimator", "eskf", "--config", str(config))[-1]
    assert yaw_deg(last) == pytest.approx(-20.0, abs=0.5)


@pytest.mark.slow
def test_latency_in_neither_log_nor_settings_is_estimated(tmp_path: Path) -> None:
    log, out = tmp_path / "log.csv", tmp_path / "out.csv"
    flight = gzip.decompress((GOLDEN / "take_off.csv.gz").read_bytes()).decode()
    log.write_text(flight.replace("gps_latency_s=0.16", ""))
    config = tmp_path / "c.toml"
    config.write_text('[estimation]\nestimator = "eskf"\n')
    words = run_words("fuse", log, "-o", out, "--config", config)
    estimate = re.search(r"estimated (0\.\d+) ± 0\.\d+ s \(override: gps_latency_s\)", words)
    assert estimate is not None, words
    assert float(estimate[1]) == pytest.approx(0.16, abs=0.02)
    assert f'"gps_latency_s":{estimate[1][:4]}' in out.read_text().replace(" ", "")


def test_latency_without_manoeuvres_is_assumed(log: Path) -> None:
    log.write_text(log.read_text().replace("gps_latency_s=0.3", ""))
    arguments = ("fuse", log, "-o", log.with_name("out.csv"), "--force")
    assert "assumed 0.15 s, since no manoeuvre shows it" in run_words(*arguments)
    assert "GPS latency not in log" not in run_words(*arguments, "--gps-latency", 0.2)
