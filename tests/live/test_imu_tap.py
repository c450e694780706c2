"""Calibrating while the gateway runs: its samples out, the result in."""

import asyncio
from pathlib import Path

import msgspec
import numpy as np
import pytest

from gateway.cli.live import calibrate
from gateway.live.control_socket import ControlServer, Verbs, socket_path
from gateway.live.control_verbs import IDLE_US, MAX_SAMPLES, ImuTap, raw_of, values_of
from gateway.records import FusedSample
from gateway.sensing.calibration import NodeCalibration
from tests.kit.cli import invoke
from tests.recordings.samples import make_fused

STEP_US = 10_000


def samples(count: int, begin_us: int = 0) -> list[FusedSample]:
    """Lie still, with a gyroscope that is off by 100 counts about x."""
    rng = np.random.default_rng(1)
    first = make_fused(rng, 0)
    assert first.imu is not None
    still = msgspec.structs.replace(first.imu, accel_raw=(0, 0, 4096), gyro_raw=(100, 0, 0))
    return [
        msgspec.structs.replace(
            first, imu=msgspec.structs.replace(still, time_us=begin_us + k * STEP_US)
        )
        for k in range(count)
    ]


def test_samples_are_collected_only_while_they_are_requested() -> None:
    tap = ImuTap(lambda _: NodeCalibration(), lambda *_: None)
    for sample in samples(10):
        tap.add(sample)
    assert tap._take(3) == []
    for sample in samples(MAX_SAMPLES + 50):
        tap.add(sample)
    found = tap._take(3)
    assert len(found) == MAX_SAMPLES
    assert values_of(raw_of(found[0], 3)) == found[0]
    for sample in samples(3 + IDLE_US // STEP_US):
        tap.add(sample)
    assert tap._take(3) == []


@pytest.mark.io
async def test_calibrate_uses_the_samples_of_the_running_gateway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(calibrate, "POLL_S", 0.0)
    kept = [NodeCalibration(mag_hard_iron_ut=(1.0, 2.0, 3.0))]
    tap = ImuTap(lambda _: kept[-1], lambda _, calibration: kept.append(calibration))
    now = 0

    def taken(vehicle_id: int) -> object:
        nonlocal now
        for sample in samples(100, now):
            tap.add(sample)
        now += 100 * STEP_US
        return tap._take(vehicle_id)

    board = {"sensors_present": 7, "chips": ["MPU6500", "QMC5883L", "BMP280"]}
    status = {"aircraft": [{"vehicle_id": 3, "boards": [board]}]}
    verbs: Verbs = {"imu.samples": taken, "status": lambda: status}
    server = ControlServer(socket_path("run"), tap.verbs(), verbs)
    await server.start()
    try:
        words = ["calibrate", "gyro", "--vehicle", "3"]
        result = await asyncio.to_thread(invoke, *words, answers="\n")
    finally:
        server.close()
    assert result.exit_code == 0, result.output
    assert "used and saved by the gateway" in result.output
    assert "sensors: MPU6500, QMC5883L, BMP280" in result.output
    assert kept[-1].gyro_bias_radps[0] == pytest.approx(np.radians(100 / 65.5), rel=0.01)
    assert kept[-1].mag_hard_iron_ut == (1.0, 2.0, 3.0)
