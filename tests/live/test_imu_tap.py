"""Calibrating while the gateway runs: its samples out, the result in."""

import asyncio
import itertools
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from gateway.cli.live import calibrate
from gateway.live.control_socket import MAX_LINE, ControlServer, Verbs, socket_path
from gateway.live.control_verbs import IDLE_US, MAX_SAMPLES, ImuTap, raw_of
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
    times_us = (begin_us + k * STEP_US for k in range(count))
    raws = [msgspec.structs.replace(still, time_us=time_us) for time_us in times_us]
    return [msgspec.structs.replace(first, imu=raw) for raw in raws]


def test_samples_are_collected_only_while_they_are_requested() -> None:
    tap = ImuTap(lambda _: NodeCalibration(), lambda *_: None)
    take: Any = tap.verbs()["imu.samples"]
    for count, taken in ((10, 0), (MAX_SAMPLES + 50, MAX_SAMPLES), (3 + IDLE_US // STEP_US, 0)):
        for sample in samples(count):
            tap.add(sample)
        found = take(3)
        assert len(found) == taken
        line = msgspec.json.encode(found)
        assert len(line) < MAX_LINE
        assert [*map(raw_of, msgspec.json.decode(line))] == [
            s.imu for s in samples(count)[-taken:] if taken
        ]


@pytest.mark.io
async def test_calibrate_uses_the_samples_of_the_running_gateway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(calibrate, "POLL_S", 0.0)
    kept = [NodeCalibration(mag_hard_iron_ut=(1.0, 2.0, 3.0))]
    tap = ImuTap(lambda _: kept[-1], lambda _, calibration: kept.append(calibration))
    take: Any = tap.verbs()["imu.samples"]
    begins_us = itertools.count(0, 100 * STEP_US)

    def taken(vehicle_id: int) -> object:
        for sample in samples(100, next(begins_us)):
            tap.add(sample)
        return take(vehicle_id)

    board = {"sensors_present": 7, "chips": ["MPU6500", "QMC5883L", "BMP280"]}
    status = {"aircraft": [{"vehicle_id": 3, "boards": [board]}]}
    verbs: Verbs = {"imu.samples": taken, "status": lambda: status}
    server = ControlServer(socket_path("run"), tap.verbs(), verbs)
    await server.start()
    words = ["calibrate", "gyro", "--vehicle", "3"]
    result = await asyncio.to_thread(invoke, *words, answers="\n", code=0)
    server.close()
    assert "used and saved by the gateway" in result.output
    assert "sensors: MPU6500, QMC5883L, BMP280" in result.output
    assert kept[-1].gyro_bias_radps[0] == pytest.approx(np.radians(100 / 65.5), rel=0.01)
    assert kept[-1].mag_hard_iron_ut == (1.0, 2.0, 3.0)
