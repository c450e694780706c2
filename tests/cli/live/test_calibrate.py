"""`mavgate calibrate`: the guidance on a made-up link."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from gateway.cli.live import calibrate
from gateway.config import load, load_aircraft
from gateway.recordings.table import TableHeader, encode_head
from gateway.records import GpsFix, ImuFlags, ImuRaw, NodeId, Vec3
from gateway.sensing.calibrating import NodeSamples
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.simulator_settings import SimulatorSettings
from tests.batch.flights import line_of
from tests.estimation.samples import fix
from tests.kit.cli import invoke
from tests.kit.records import raw_at
from tools.simulated_flight import fly

pytestmark = pytest.mark.io

NODE = NodeId(3, 0)
G = 9.80665
SIDES = G * np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.0]])
BIAS = np.array([0.2, -0.1, 0.3])


class Link:
    """Each capture lies on the next side; the first lies level."""

    def __init__(self) -> None:
        self.captures = 0
        self.breaks_at = 1000

    def __call__(self, seconds: float, turned: bool) -> NodeSamples:
        rng = np.random.default_rng(self.captures)
        side = SIDES[self.captures % 6]
        self.captures += 1
        if self.captures > self.breaks_at:
            raise KeyboardInterrupt
        n = round(seconds * 100)
        field = rng.normal(size=(n, 3)) if turned else np.tile([0.3, 0.1, 0.9], (n, 1))
        return NodeSamples(
            time_s=np.arange(n) / 100,
            accel=side + BIAS + rng.normal(0, 0.02, (n, 3)),
            gyro=0.05 + rng.normal(0, 0.002, (n, 3)),
            mag_time_s=np.arange(n) / 100,
            mag=45.0 * field / np.linalg.norm(field, axis=1)[:, None] + 10.0,
            moving=np.zeros(n, np.bool_),
        )


@pytest.fixture
def link() -> Link:
    return Link()


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, link: Link) -> Path:
    monkeypatch.setattr(calibrate, "capture_from", lambda serial, vehicle: link)
    path = tmp_path / "gateway.toml"
    path.write_text(f'aircraft_folder = "{tmp_path}"\n')
    return path


def run(config: Path, *words: str, code: int = 0, answers: int = 40) -> str:
    words = ("calibrate", *words, "--config", str(config), "--vehicle", "3")
    return invoke(*words, answers="\n" * answers, code=code).output


def saved(config: Path) -> NodeCalibration:
    return load_aircraft(load(config))[3].calibration


def test_steps_are_guided_and_saved_with_residuals(config: Path) -> None:
    output = run(config, "gyro", "accel", "mag")
    assert [f"{step}: done" in output for step in ("gyro", "accel", "mag")] == [True] * 3
    assert "5 of 6 sides are done. Lay the node on one of these and release it: chips up" in output
    found = saved(config)
    assert found.gyro_bias_radps == pytest.approx((0.05, 0.05, 0.05), abs=1e-3)
    assert found.accel_bias_mps2 == pytest.approx(tuple(BIAS), abs=0.02)
    assert found.mag_hard_iron_ut == pytest.approx((10.0, 10.0, 10.0), abs=0.1)
    assert 0.0 < found.gyro_residual_radps < 0.01
    assert 0.0 < found.accel_residual_mps2 < 0.05


def test_steps_are_in_the_order_in_which_they_build_on_each_other(config: Path) -> None:
    output = run(config, "--dry-run", code=1)
    titles = [line for line in output.splitlines() if line.startswith("Step ")]
    assert [title.rpartition(" ")[2] for title in titles] == ["gyro", "accel", "level", "mag"]


def test_rates_are_shown_in_degrees_per_second(config: Path) -> None:
    (line,) = (each for each in run(config, "gyro").splitlines() if "gyro_bias" in each)
    assert "gyro_bias, °/s" in line
    assert "(2.8" in line, "0.05 rad/s"


def test_missing_port_is_reported_before_the_first_question(tmp_path: Path) -> None:
    result = invoke("calibrate", "gyro", "--port", tmp_path / "none", answers="\n", code=2)
    assert "none: No such file or directory" in result.output
    assert "Lay the aircraft down" not in result.output


def test_dry_run_saves_nothing(config: Path) -> None:
    run(config, "gyro", "--dry-run")
    assert not load_aircraft(load(config))


def test_failed_step_is_reported(config: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def moving(seconds: float, turned: bool) -> NodeSamples:
        noise, times_s = np.random.default_rng(1).normal(0, 5.0, (300, 3)), np.arange(300) / 100
        mag = np.empty(0), np.empty((0, 3))
        return NodeSamples(times_s, noise, noise, *mag, np.zeros(300, np.bool_))

    monkeypatch.setattr(calibrate, "capture_from", lambda serial, vehicle: moving)
    output = run(config, "gyro", code=1)
    assert "the node was not at rest" in output
    assert "nothing changed" in output


def test_interrupt_keeps_the_finished_steps(config: Path, link: Link) -> None:
    link.breaks_at = 4
    output = run(config, "gyro", "accel", "mag", code=1)
    assert "Cancelled (interrupted). Remaining steps: accel, mag." in output
    assert saved(config).gyro_bias_radps == pytest.approx((0.05, 0.05, 0.05), abs=1e-3)
    assert saved(config).accel_bias_mps2 == (0.0, 0.0, 0.0)


def test_end_of_input_keeps_the_finished_steps(config: Path) -> None:
    assert "Remaining steps: mag" in run(config, "gyro", "mag", code=1, answers=1)
    assert saved(config).gyro_residual_radps > 0.0


def gyro_bias_of(config: Path, records: Sequence[ImuRaw | GpsFix]) -> Vec3:
    """Calibrate the gyroscope from a recording."""
    folder = config.parent
    head = encode_head(TableHeader(vehicle_id=3))
    (folder / "flight_01_v3.csv").write_text(head + "".join(map(line_of, records)))
    config.write_text(f'{config.read_text()}[recording]\nfolder = "{folder}"\n')
    assert "gyro: done" in run(config, "gyro", "--log", "flight")
    return saved(config).gyro_bias_radps


def test_gyroscope_is_calibrated_from_a_recorded_flight(config: Path) -> None:
    """A flight with a rest before and steady turns: the bias is that of the rest."""
    flight = fly(SimulatorSettings(imu_rate_hz=50))
    records = [record for record in flight.records() if isinstance(record, ImuRaw | GpsFix)]
    bias_radps = gyro_bias_of(config, records)
    off = np.subtract(bias_radps, flight.errors.gyro_bias_radps)
    assert np.degrees(np.abs(off)).max() < 0.2


def test_steady_turn_is_not_taken_for_rest(config: Path) -> None:
    """In smooth air a long turn is as even as a rest: only the fixes distinguish them."""
    rng = np.random.default_rng(2)
    records: list[ImuRaw | GpsFix] = []
    for time_us in range(0, 80_000_000, 20_000):
        turns = time_us >= 20_000_000
        if time_us % 200_000 == 0:
            records.append(fix(time_us, vel=(15.0 if turns else 0.0, 0.0, 0.0)))
        rates = (np.array([5, -8, 330 if turns else 11]) + rng.normal(0, 1, 3)).round()
        x, y, z = map(int, rates)
        raw = {"accel_raw": (0, 0, 4096), "gyro_raw": (x, y, z), "flags": ImuFlags(0)}
        records.append(raw_at(time_us, node=NODE, **raw))
    expected = np.radians(np.array([5, -8, 11]) / 32.8)
    assert gyro_bias_of(config, records) == pytest.approx(tuple(expected), abs=1e-4)
