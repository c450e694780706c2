"""The verbs do what docs/control.md says."""

import asyncio
import itertools
import math
import os
import sys
import threading
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from gateway.cli.live import calibrate
from gateway.hub.hub import Hub
from gateway.hub.transports import url_files
from gateway.live import control_verbs
from gateway.live.control_socket import MAX_LINE, ControlError, ControlServer, Verbs, socket_path
from gateway.live.control_verbs import (
    IDLE_US,
    MAX_SAMPLES,
    ImuTap,
    client_verbs,
    mark_verbs,
    raw_of,
    recorder_verbs,
)
from gateway.outputs import extend
from gateway.recordings.index import Recording, list_recordings
from gateway.records import FusedSample
from gateway.sensing.calibration import NodeCalibration
from gateway.vehicle.plan import Location
from tests.conftest import ManualClock
from tests.kit.cli import invoke
from tests.kit.recorder import RecorderBench
from tests.kit.recordings import START_US, make_frames, make_records, make_tlog
from tests.live.test_player_edge import Played
from tests.recordings.samples import make_fused

pytestmark = pytest.mark.io


async def ask(server: ControlServer, verb: str, **params: object) -> dict[str, Any]:
    line = msgspec.json.encode({"verb": verb, "params": params})
    answer: dict[str, Any] = msgspec.json.decode(await server.answer(line))
    return answer


@pytest.fixture
async def bench(tmp_path: Path, clock: ManualClock) -> AsyncIterator[RecorderBench]:
    made = RecorderBench(tmp_path / "recordings", clock, mode="manual")
    made.recorder.start()
    yield made
    made.recorder.close()


async def test_recording_is_started_renamed_stopped_listed_and_deleted(
    bench: RecorderBench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    threads: set[threading.Thread] = set()

    def looked(folder: Path) -> list[Recording]:
        threads.add(threading.current_thread())
        return list_recordings(folder)

    monkeypatch.setattr(control_verbs, "list_recordings", looked)
    server = ControlServer(tmp_path / "s", recorder_verbs(bench.recorder))
    started = (await ask(server, "record.start"))["result"]
    assert (started["state"], started["part"]) == ("recording", 1)
    bench.send(make_frames(9))
    assert (await ask(server, "record.note", text="here"))["ok"]
    await bench.recorder.settle()
    saved = await ask(server, "record.rename", name="first")
    assert saved["result"]["name"] == "first"
    assert not (await ask(server, "record.rename", name="../x"))["ok"]
    refused = await ask(server, "record.delete", name="last")
    assert refused["error"] == "first is being recorded; stop it first"
    stopped = (await ask(server, "record.stop"))["result"]
    assert stopped["state"] == "idle"
    (listed,) = (await ask(server, "record.list"))["result"]
    assert listed["name"] == "first"
    deleted = await ask(server, "record.delete", name="first")
    assert [Path(file).name for file in deleted["result"]["files"]] == ["first_01.tlog"]
    assert (await ask(server, "record.list"))["result"] == []
    assert not (await ask(server, "record.delete", name="first"))["ok"]
    assert bench.announced[1] == (False, "Note: here")
    assert threading.main_thread() not in threads, "the event loop does not wait for the disk"
    server = ControlServer(tmp_path / "s", recorder_verbs(bench.recorder, lambda: False))
    refused = await ask(server, "record.note", text="here")
    assert "no vehicle is received" in refused["error"]


async def test_location_is_marked_for_one_aircraft_or_all(tmp_path: Path) -> None:
    marked: list[tuple[Location | None, int | None]] = []

    def mark(location: Location | None, vehicle_id: int | None) -> None:
        if vehicle_id == 9:
            raise ValueError("no such aircraft; no aircraft 7; received: 1")
        marked.append((location, vehicle_id))

    server = ControlServer(tmp_path / "s", mark_verbs(mark))
    assert (await ask(server, "mark", lat_deg=-7.5, lon_deg=110.0, alt_amsl_m=90.0))["ok"]
    assert (await ask(server, "mark", lat_deg=1.0, lon_deg=2.0, vehicle_id=3))["ok"]
    assert (await ask(server, "mark"))["result"] == "mark cleared"
    assert not (await ask(server, "mark", lat_deg=1.0))["ok"]
    refused = await ask(server, "mark", lat_deg=1.0, lon_deg=2.0, vehicle_id=9)
    assert refused["error"] == "no such aircraft; no aircraft 7; received: 1"
    assert marked[0] == (Location(-7.5, 110.0, 90.0), None)
    assert marked[1][0] is not None
    assert math.isnan(marked[1][0].alt_amsl_m)
    assert marked[1][1] == 3
    assert marked[2] == (None, None)


async def test_endpoint_without_its_extra_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    server = ControlServer(tmp_path / "s", client_verbs(Mock(spec=Hub)))
    refused = await ask(server, "clients.add", url="zenoh:tcp/127.0.0.1:7447?site=a")
    assert "an endpoint zenoh: needs the extra fleet; to install it: " in refused["error"]


async def test_player_follows_its_verbs(clock: ManualClock, tmp_path: Path) -> None:
    path, records = tmp_path / "flight.tlog", make_records(500)
    path.write_bytes(make_tlog(records))
    frames = [record.frame for record in records]
    played = Played(path, clock)
    played.edge.start()
    assert played.frames == frames[:1]
    server = ControlServer(tmp_path / "s", played.edge.verbs())

    async def state(verb: str, **params: object) -> dict[str, Any]:
        answer = await ask(server, verb, **params)
        assert answer["ok"], answer
        result: dict[str, Any] = answer["result"]
        return result

    assert (await state("play.pause"))["state"] == "paused"
    assert (await state("play.step", count=2))["sent"] == 3
    assert played.frames == frames[:3]
    assert (await state("seek", to="0:05"))["position_s"] == pytest.approx(5.0)
    assert (await state("seek", to="-2"))["position_s"] == pytest.approx(3.0)
    assert (await state("seek", to="2025-10-09T08:53:20.14Z"))["time_us"] == START_US + 140_000
    played.frames.clear()
    assert (await state("play.resume"))["state"] == "playing"
    assert played.frames == frames[7:8]
    assert (await state("play.speed", speed=20))["speed"] == 20.0
    assert (await state("play.speed", speed=None))["speed"] is None
    assert (await state("play.loop", on=True))["loop"] is True
    assert math.isclose((await state("play.status"))["duration_s"], 499 * 0.02)
    assert not (await ask(server, "seek", to="soon"))["ok"]
    refused = await ask(server, "play.speed", speed=1000)
    assert "speed" in refused["error"]
    await state("play.pause")
    for to, position_s, limit in (("1:00:00", 499 * 0.02, "end"), ("-1:00:00", 0.0, "begin")):
        limited = await state("seek", to=to)
        assert limited["position_s"] == pytest.approx(position_s, abs=0.03)
        assert limited["remark"] == f"{to} is beyond the recording: moved to its {limit}"
    assert (await state("seek", to="0:05"))["remark"] == ""
    assert (await state("play.stop"))["state"] == "paused"
    assert played.ended.is_set()
    played.close()


Add = Callable[[str], Awaitable[None]]


@pytest.fixture
def add(tmp_path: Path) -> Add:
    """Add a client, whose files must be in the folder `own`."""
    extend()
    hub: Any = SimpleNamespace(add=lambda _: None, remove=None, clients=None, endpoints=tuple)
    return client_verbs(hub, tmp_path / "own")["clients.add"]


async def test_only_listed_serial_ports_are_added_as_clients(
    add: Add, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    port = SimpleNamespace(device="/dev/ttyUSB9")
    monkeypatch.setattr(control_verbs, "list_serial_ports", lambda: [port])
    (link := tmp_path / "by-id").symlink_to("/dev/ttyUSB9")
    for device in ("/dev/pts/0", "/dev/watchdog", "/dev/zero", tmp_path):
        for url in (f"serial:{device}:57600", f"rotator:serial:{device}:9600"):
            with pytest.raises(ControlError, match="is not a serial port here"):
                await add(url)
    for url in ("serial:/dev/ttyUSB9:57600", f"serial:{link}:57600", "udp:127.0.0.1:14550"):
        await add(url)


async def test_added_endpoint_names_only_files_of_the_settings_folder(
    add: Add, tmp_path: Path
) -> None:
    (own := tmp_path / "own").mkdir()
    (own / "login").write_text("user:password")
    (tmp_path / "other").write_text("secret:key")
    (own / "link").symlink_to(tmp_path / "other")
    os.mkfifo(own / "pipe")
    (own / "large").write_bytes(bytes(url_files.MAX_BYTES + 1))
    for option in ("mqtt:tcp:127.0.0.1:1883?login", "cot:tls:127.0.0.1:8089?authority"):
        await add(f"{option}={own / 'login'}")
        for name, why in {
            "other": "not in",
            "own/link": "not in",
            "own/pipe": "not a regular file",
            "own/large": "not a regular file",
            "own/absent": "No such file",
        }.items():
            with pytest.raises(ControlError, match=why):
                await add(f"{option}={tmp_path / name}")


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
