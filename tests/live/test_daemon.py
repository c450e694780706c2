"""The composition root: start, recording of clients, saving and reloading of settings."""

import asyncio
import itertools
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import all as mavlink

from gateway import config
from gateway.clock import unix_time_us
from gateway.config import GatewaySettings
from gateway.hub.settings import HubSettings
from gateway.live import daemon as daemon_module
from gateway.live.control_socket import ControlError, request, socket_path
from gateway.live.daemon import Daemon
from gateway.live.kept_files import TIMESTAMPS_NAME
from gateway.live.operation import Operation
from gateway.live.recorded_traffic import BURST_S, UNTRUSTED_RATE
from gateway.live.serial_port import SerialSettings
from gateway.live.service import ServiceNotifier
from gateway.live.session import RecordingSettings
from gateway.pipeline import Pipeline
from gateway.simulator.flight import START_UNIX_US
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_signing import EPOCH_2015_US, TICK_US, key_from_passphrase
from gateway.wire.payloads import BaroPayload
from gateway.wire.timesync import ENOUGH
from tests.kit.faults import SlowDisk
from tests.kit.ground_station import command, ftp_request
from tests.kit.hub import Station
from tests.kit.mavlink import STATION, Sender, frames_in, packed, read_back
from tests.kit.payloads import Tracker
from tests.kit.process import START_LIMIT_S, until
from tests.kit.recorder import frames_of
from tests.kit.recordings import read_tlog
from tests.ports import free_port

pytestmark = pytest.mark.io

PING = mavlink.MAVLink_ping_message(0, 1, 0, 0)
BIAS = mavlink.MAVLink_param_set_message(1, 1, b"CAL_GYRO_BIAS_X", 0.01, 9)
STORE = command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, 1)
PASSPHRASE = "correct horse"


def board() -> Iterator[TimedFrame]:
    """Send pressures, which make an aircraft appear."""
    tracker = Tracker()
    for k in itertools.count():
        yield TimedFrame(0.02 * k, tracker.frame(20_000 * k, BaroPayload(10_000_000, 250)))


def receiver_of_another_day() -> Iterator[TimedFrame]:
    """Send an aircraft whose GPS time is not that of this machine."""
    return simulate(SimulatorSettings(gps_first_fix_s=0.0), START_UNIX_US).frames()


class Running:
    """A daemon in a folder, by default with an aircraft, and a station that it sends to."""

    def __init__(
        self,
        folder: Path,
        *,
        trusted: str = "yes",
        flies: bool = True,
        passphrase: str = "",
        mode: str = "always",
        line: Callable[[], Iterator[TimedFrame]] = board,
    ) -> None:
        self.station = Station(None, socket.SOCK_DGRAM, (255, STATION))
        self.port = free_port()
        self.recordings, self.flies = folder / "recordings", flies
        self.settings = GatewaySettings(
            aircraft_folder=str(folder / "aircraft"),
            hub=HubSettings(
                endpoints=(
                    f"udp:127.0.0.1:{self.station.port}?trusted={trusted}",
                    f"udp-listen:127.0.0.1:{self.port}",
                )
            ),
            recording=RecordingSettings(folder=str(self.recordings), mode=mode),
            serial=SerialSettings(port="none"),
            vehicle=VehicleSettings(signing_passphrase=passphrase),
        )
        self.read: Callable[[], GatewaySettings] = lambda: self.settings
        receiver = line() if flies else None
        self.daemon = Daemon(self.settings, {}, lambda: self.read(), receiver)

    async def __aenter__(self) -> Self:
        self.daemon.start()
        self.threads = {*threading.enumerate()}
        await self.daemon.control_socket()
        if self.flies:
            await until(lambda: self.daemon.snapshot().aircraft)
            # From then on it has the address of the gateway.
            await self.station.receive()
        return self

    async def __aexit__(self, *_: object) -> None:
        self.daemon.close()
        self.station.socket.close()
        # The event loop ends the readers of what was closed.
        await asyncio.sleep(0)

    async def receive(self, *kinds: str) -> Any:
        """Return the next message of some kinds that the station is sent."""
        async with asyncio.timeout(START_LIMIT_S):
            while True:
                (frame,) = frames_in(await self.station.receive())
                if (message := read_back(frame)).get_type() in kinds:
                    return message

    async def text(self, begin: str) -> str:
        """Return the next text that begins so."""
        async with asyncio.timeout(START_LIMIT_S):
            while not (text := (await self.receive("STATUSTEXT")).text).startswith(begin):
                pass
        return str(text)

    def recorded(self, kind: str) -> list[bytes]:
        """Return the recorded frames of a kind."""
        found = frames_of(self.recordings)
        return [frame for frame in found if read_back(frame).get_type() == kind]

    async def ask(self, verb: str, **params: object) -> Any:
        return await asyncio.to_thread(request, socket_path("run"), verb, params)


@pytest.fixture(autouse=True)
def _own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.parametrize("orderly", [True, False], ids=["orderly end", "killed"])
async def test_signed_frame_is_not_accepted_again_after_a_restart(
    tmp_path: Path, orderly: bool
) -> None:
    timestamp = (unix_time_us() - EPOCH_2015_US) // TICK_US
    key = key_from_passphrase(PASSPHRASE)
    signed, later = (
        packed(PING, 255, STATION, sequence=k, signing=(key, 0, timestamp + k)) for k in (0, 1)
    )
    folders = tmp_path / "first", tmp_path / "second"
    async with Running(folders[0], passphrase=PASSPHRASE) as first:
        first.station.send(signed)
        await first.receive("PING")
        assert first.daemon.snapshot().forged == 0
        if not orderly:
            await until((folders[0] / "aircraft" / TIMESTAMPS_NAME).exists)
            shutil.copytree(*folders)
    if orderly:
        shutil.copytree(*folders)
    async with Running(folders[1], passphrase=PASSPHRASE) as second:
        second.station.send(signed)
        await until(lambda: second.daemon.snapshot().forged == 1)
        if orderly:
            second.station.send(later)
            await second.receive("PING")


@pytest.mark.parametrize("trusted", ["yes", "no"])
async def test_untrusted_requests_are_recorded_only_with_an_effect(
    tmp_path: Path, trusted: str
) -> None:
    async with Running(tmp_path, trusted=trusted) as running:
        sender = running.station.sender
        heartbeat, ping = sender.heartbeat(), sender.pack(PING)
        running.station.send(heartbeat, ping)
        await running.receive("PING")
    assert (heartbeat in running.recorded("HEARTBEAT")) == (trusted == "yes")
    found = running.recorded("PING")
    assert (ping in found, len(found)) == (True, 2), "the request and its answer"


async def test_requests_of_a_flooding_untrusted_client_are_recorded_up_to_a_quota(
    tmp_path: Path,
) -> None:
    message = ftp_request(200, bytes(239 * b"x"))
    async with Running(tmp_path, trusted="no") as running:
        for _ in range(600):
            running.station.send(running.station.sender.pack(message))
            running.station.received()
            await asyncio.sleep(0)
        text = "after it: " * 20
        running.daemon.announce(text)
        for _ in range(len(text) // 50):
            await running.text("after it")
        seconds = running.daemon.now_us() / 1e6
    size = sum(map(len, running.recorded("FILE_TRANSFER_PROTOCOL")))
    assert size <= UNTRUSTED_RATE * (BURST_S + seconds)
    texts = (read_back(each).text for each in running.recorded("STATUSTEXT"))
    assert text in "".join(texts), "telemetry all the same"


async def test_simulated_time_does_not_split_a_recording(tmp_path: Path) -> None:
    """It is late by the start-up of a busy machine, and no better than the machine's."""

    def fixes() -> int:
        return len(running.recorded("GPS_RAW_INT"))

    async with Running(tmp_path, line=receiver_of_another_day) as running:
        await until(lambda: fixes() > ENOUGH)
        found = fixes()
        # The recorder decides after it has written, so before it writes again.
        await until(lambda: fixes() > found)
    (part,) = running.recordings.glob("*.tlog")
    age_us = unix_time_us() - read_tlog(part)[0].time_us
    assert 0 < age_us < 3_600_000_000


async def test_note_without_an_own_aircraft_is_sent_by_the_hub(tmp_path: Path) -> None:
    async with Running(tmp_path, flies=False) as running:
        with pytest.raises(ControlError, match="no vehicle is received"):
            await running.ask("record.note", text="x")
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
            vehicle.sendto(Sender(7).heartbeat(), ("127.0.0.1", running.port))
            assert (await running.receive("HEARTBEAT")).get_srcSystem() == 7
            await running.ask("record.note", text="x" * 50)
            chunks = [await running.receive("STATUSTEXT") for _ in range(2)]
    assert {chunk.get_srcSystem() for chunk in chunks} == {7}
    assert "".join(chunk.text for chunk in chunks) == "Note: " + "x" * 50


async def test_foreign_vehicle_is_recorded_from_arming_on(tmp_path: Path) -> None:
    def state_after(armed: bool) -> str:
        vehicle.sendto(sender.heartbeat(armed=armed), ("127.0.0.1", running.port))
        return running.daemon.snapshot().recorder.state

    sender = Sender(7)
    async with Running(tmp_path, flies=False, mode="armed") as running:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
            await until(lambda: state_after(False) and running.daemon.snapshot().vehicles, 0.01)
            assert state_after(False) == "idle"
            await until(lambda: state_after(True) == "recording", 0.01)


@pytest.mark.parametrize("due_us", [0, 999_000_000], ids=["overdue", "far"])
async def test_due_time_is_polled_neither_without_pause_nor_too_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, due_us: int
) -> None:
    """Something that stays due must not turn the loop into a busy one."""
    delays: list[float] = []
    running, loop = Running(tmp_path), asyncio.get_running_loop()
    call_later = loop.call_later

    def note(delay_s: float, callback: Any, *words: Any) -> asyncio.TimerHandle:
        if isinstance(getattr(callback, "__self__", None), Operation):
            delays.append(delay_s)
        return call_later(delay_s, callback, *words)

    monkeypatch.setattr(Pipeline, "next_due_us", lambda _: due_us)
    monkeypatch.setattr(loop, "call_later", note)
    async with running:
        assert 0.001 <= delays[-1] <= 0.1


async def test_start_notifies_once_the_control_socket_listens_and_begins_a_thread_of_look_ups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready: list[bool] = []
    control, others = socket_path("run"), {*threading.enumerate()}
    monkeypatch.setattr(ServiceNotifier, "ready", lambda _: ready.append(control.is_socket()))
    async with Running(tmp_path) as running:
        assert ready == [True]
        begun = running.threads - others
    assert sum("lookups" in thread.name for thread in begun) == 1


@pytest.mark.parametrize("estimator", ["eskf", "paper"])
async def test_reload_reads_off_the_loop_and_reports_settings_that_need_a_restart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, estimator: str
) -> None:
    threads: list[int] = []

    def noting(call: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *words: (threads.append(threading.get_ident()), call(*words))[1]

    monkeypatch.setattr(daemon_module, "load_aircraft", noting(config.load_aircraft))
    running = Running(tmp_path)
    now = running.settings
    changed = replace(now, estimation=replace(now.estimation, estimator=estimator))
    running.read = noting(lambda: changed)
    async with running:
        status = await running.ask("reload")
    assert status.startswith("settings of the hub and of signing applied")
    assert ("others need a new start" in status) == (estimator != now.estimation.estimator)
    assert len(threads) == 2
    assert threading.get_ident() not in threads


@pytest.mark.parametrize("failures", [0, 9], ids=["good disk", "failing disk"])
async def test_settings_are_reported_as_stored_once_the_file_is_whole(
    tmp_path: Path, disk: SlowDisk, failures: int
) -> None:
    """And they are written off the loop, which answers meanwhile."""
    disk.failures = failures
    async with Running(tmp_path) as running:
        sender = running.station.sender
        running.station.send(*map(sender.pack, (BIAS, STORE)))
        await disk.await_sync()
        running.station.send(sender.pack(PING))
        results = []
        while (message := await running.receive("COMMAND_ACK", "PING")).get_type() != "PING":
            results.append(message.result)
        assert results == [mavlink.MAV_RESULT_IN_PROGRESS]
        disk.may_end.set()
        result = (await running.receive("COMMAND_ACK")).result
        file = tmp_path / "aircraft" / "1.toml"
        text = file.read_text() if file.exists() else ""
        report = await running.text("Settings")
    if failures:
        assert (result, text) == (mavlink.MAV_RESULT_FAILED, "")
        assert report == "Settings not saved: Input/output error"
    else:
        assert (result, report) == (mavlink.MAV_RESULT_ACCEPTED, "Settings saved: 1.toml")
        assert "gyro_bias" in text
