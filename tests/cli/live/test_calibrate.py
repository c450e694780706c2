"""`mavgate calibrate`: the guidance on a made-up link."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gateway.cli.app import app
from gateway.cli.live import calibrate
from gateway.config import load, load_aircraft
from gateway.sensing.solvers import NodeSamples

G = 9.80665
SIDES = G * np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.0]])
BIAS = np.array([0.2, -0.1, 0.3])


class Link:
    """Each capture lies on the next side; the first lies level."""

    def __init__(self) -> None:
        self.captures = 0

    def __call__(self, seconds: float) -> NodeSamples:
        rng = np.random.default_rng(self.captures)
        side = SIDES[self.captures % 6]
        self.captures += 1
        n = round(seconds * 100)
        field = rng.normal(size=(n, 3))
        return NodeSamples(
            time_s=np.arange(n) / 100,
            accel=side + BIAS + rng.normal(0, 0.02, (n, 3)),
            gyro=0.05 + rng.normal(0, 0.002, (n, 3)),
            mag=45.0 * field / np.linalg.norm(field, axis=1)[:, None] + 10.0,
        )


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    link = Link()
    monkeypatch.setattr(calibrate, "_capture_from", lambda serial, vehicle: link)
    path = tmp_path / "gateway.toml"
    path.write_text(f'aircraft_folder = "{tmp_path}"\n')
    return path


def run(config: Path, *arguments: str) -> str:
    command = ["calibrate", *arguments, "--config", str(config), "--vehicle", "3"]
    result = CliRunner().invoke(app, command, input="\n" * 40)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.mark.io
def test_guides_through_the_steps_and_saves_with_residuals(config: Path) -> None:
    output = run(config, "gyro", "accel", "mag")
    assert output.count("done") == 3
    saved = load_aircraft(load(config))[3].calibration
    assert saved.gyro_bias_radps == pytest.approx((0.05, 0.05, 0.05), abs=1e-3)
    assert saved.accel_bias_mps2 == pytest.approx(tuple(BIAS), abs=0.02)
    assert saved.mag_hard_iron_ut == pytest.approx((10.0, 10.0, 10.0), abs=0.1)
    assert 0.0 < saved.gyro_residual_radps < 0.01
    assert 0.0 < saved.accel_residual_mps2 < 0.05


@pytest.mark.io
def test_dry_run_saves_nothing(config: Path) -> None:
    run(config, "gyro", "--dry-run")
    assert not load_aircraft(load(config))


@pytest.mark.io
def test_a_step_that_fails_is_said(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def moving(seconds: float) -> NodeSamples:
        noise = np.random.default_rng(1).normal(0, 5.0, (300, 3))
        return NodeSamples(np.arange(300) / 100, noise, noise, np.empty((0, 3)))

    monkeypatch.setattr(calibrate, "_capture_from", lambda serial, vehicle: moving)
    output = run(config, "gyro")
    assert "still" in output
    assert "nothing changed" in output
