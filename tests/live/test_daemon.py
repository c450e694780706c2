"""The composition root: start, recording of clients, saving and reloading of settings."""

import asyncio
import errno
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace
from pymavlink.dialects.v20 import common as mavlink

import gateway.live.daemon
from gateway.aircraft import Outputs
from gateway.clock import unix_time_us
from gateway.config import GatewaySettings
from gateway.hub.settings import HubSettings
from gateway.live.daemon import Daemon
from gateway.live.recording_budget import BURST_S, UNTRUSTED_RATE
from gateway.records import BaroRaw, Incoming, NodeId, Outgoing
from gateway.vehicle.service import Request, SaveSettings
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_signing import EPOCH_2015_US, key_from_passphrase
from gateway.wire.mavlink_splitter import MavFrame
from tests.kit.mavlink import packed

PING = mavlink.MAVLink_ping_message(0, 1, 0, 0)
HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)
STORE = mavlink.MAVLink_command_long_message(
    1, 1, mavlink.MAV_CMD_PREFLIGHT_STORAGE, 0, 1, 0, 0, 0, 0, 0, 0
)


def make_daemon(folder: Path, passphrase: str = "") -> Daemon:
    settings = GatewaySettings(
        aircraft_folder=str(folder),
        hub=HubSettings(endpoints=()),
        vehicle=VehicleSettings(signing_passphrase=passphrase),
    )
    made = Daemon(settings, {}, lambda: settings)
    made._perform(made._pipeline.feed_record(BaroRaw(0, NodeId(1, 0), 0, 1e5, 20.0), 0))
    return made


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Daemon:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    return make_daemon(tmp_path)


@pytest.mark.parametrize("orderly", [True, False])
def test_signed_frame_is_not_accepted_again_after_a_restart(tmp_path: Path, orderly: bool) -> None:
    # First, since it may compile for more than the minute in which a timestamp is new.
    first = make_daemon(tmp_path, "correct horse")
    signing = (key_from_passphrase("correct horse"), 0, (unix_time_us() - EPOCH_2015_US) // 10)
    signed = Incoming(5, packed(PING, 255, 190, signing=signing), True)
    first._on_frame(signed)
    first._timestamps.close(first._pipeline.newest_timestamps() if orderly else {})
    assert first._pipeline.forged == 0
    second = make_daemon(tmp_path, "correct horse")
    second._on_frame(signed)
    assert second._pipeline.forged == 1


@pytest.fixture
def recorded(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    frames: list[bytes] = []
    monkeypatch.setattr(daemon._recorder, "frame", frames.append)
    return frames


def frame(message: mavlink.MAVLink_message, sequence: int = 0) -> bytes:
    return packed(message, 255, 190, sequence=sequence)


def test_untrusted_requests_are_recorded_only_with_an_effect(
    daemon: Daemon, recorded: list[bytes]
) -> None:
    daemon._on_frame(Incoming(5, frame(HEARTBEAT), False))
    assert recorded == []
    daemon._on_frame(Incoming(5, frame(PING), False))
    question, answer = recorded
    assert question == frame(PING)
    assert answer != question
    recorded.clear()
    daemon._on_frame(Incoming(6, frame(HEARTBEAT), True))
    assert recorded == [frame(HEARTBEAT)]


def test_requests_of_a_flooding_untrusted_client_are_recorded_up_to_a_quota(
    daemon: Daemon, recorded: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(daemon, "now_us", lambda: 1_000_000)
    for n in range(2500):
        daemon._on_frame(Incoming(5, frame(PING, n % 256), False))
    assert sum(map(len, recorded)) <= UNTRUSTED_RATE * (BURST_S + 1)
    telemetry = Outgoing(b"telemetry", 30, None)
    daemon._perform(Outputs(frames=[telemetry]))
    assert recorded[-1] == b"telemetry", "all the same"


def test_note_without_an_own_aircraft_is_sent_by_the_hub(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[bytes] = []

    def say(messages: list[mavlink.MAVLink_message]) -> bool:
        said.extend(bytes(message.text.encode()) for message in messages)
        return True

    monkeypatch.setattr(daemon._hub, "say", say)
    daemon._announce(False, "to the aircraft")
    daemon._pipeline.aircraft.clear()
    daemon._announce(False, "Note: " + "x" * 50)
    assert b"".join(said).startswith(b"Note: xxx")
    assert len(said) == 2
    assert daemon._has_vehicle()


@pytest.mark.parametrize("due_us", [0, 999_000_000])
async def test_due_time_is_polled_neither_without_pause_nor_too_late(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, due_us: int
) -> None:
    """Something that stays due must not turn the loop into a busy one."""
    delays: list[float] = []
    monkeypatch.setattr(daemon, "now_us", lambda: 1_000_000)
    monkeypatch.setattr(daemon._pipeline, "next_due_us", lambda: due_us)
    loop = asyncio.get_running_loop()
    call_later = loop.call_later

    def note(delay_s: float, *call: Any) -> asyncio.TimerHandle:
        delays.append(delay_s)
        return call_later(3600.0, *call)

    monkeypatch.setattr(loop, "call_later", note)
    daemon._poll()
    assert 0.001 <= delays[-1] <= 0.1
    assert daemon._timer is not None
    daemon._timer.cancel()


async def test_ready_is_notified_once_the_control_socket_listens(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    ready: list[bool] = []
    control = daemon._control.path
    monkeypatch.setattr(daemon._notifier, "ready", lambda: ready.append(control.is_socket()))
    daemon.start()
    await daemon.control_socket()
    daemon.close()
    assert ready == [True]


async def test_thread_of_look_ups_is_started_before_the_first_one(daemon: Daemon) -> None:
    others = set(threading.enumerate())
    daemon.start()
    begun = {thread for thread in set(threading.enumerate()) - others if "lookups" in thread.name}
    await daemon.control_socket()
    daemon.close()
    assert len(begun) == 1


@pytest.mark.parametrize("estimator", ["eskf", "paper"])
async def test_reload_reports_settings_that_need_a_restart(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, estimator: str
) -> None:
    now = daemon._settings
    changed = replace(now, estimation=replace(now.estimation, estimator=estimator))
    monkeypatch.setattr(daemon, "_read", lambda: changed)
    status = await daemon.reload()
    assert status.startswith("settings of the hub and of signing applied")
    assert ("others need a new start" in status) == (estimator != now.estimation.estimator)


@pytest.mark.parametrize("is_full", [False, True])
async def test_settings_are_reported_as_stored_once_the_file_is_whole(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_full: bool
) -> None:
    file, seen = tmp_path / "1.toml", []
    over = asyncio.get_running_loop().create_future()

    def fail(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def note(sent: MavFrame, *_: object) -> None:
        message = mavlink.MAVLink(None).decode(bytearray(sent.data))
        if message.get_type() == "COMMAND_ACK":
            seen.append((message.result, file.read_text() if file.exists() else ""))
        elif message.get_type() == "STATUSTEXT" and message.text.startswith("Settings"):
            over.set_result(message.text)

    if is_full:
        monkeypatch.setattr("gateway.config.write_new", fail)
    monkeypatch.setattr(daemon._hub, "_pass_on", note)
    bias = mavlink.MAVLink_param_set_message(1, 1, b"CAL_GYRO_BIAS_X", 0.01, 9)
    for message in (bias, STORE):
        daemon._on_frame(Incoming(5, frame(message), True))
    assert seen == [(mavlink.MAV_RESULT_IN_PROGRESS, "")]
    text = await over
    [(result, stored)] = seen[1:]
    if is_full:
        assert (result, stored) == (mavlink.MAV_RESULT_FAILED, "")
        assert text == "Settings not saved: No space left on device"
    else:
        assert (result, text) == (mavlink.MAV_RESULT_ACCEPTED, "Settings saved: 1.toml")
        assert "gyro_bias" in stored


async def test_files_of_settings_are_read_and_written_off_the_loop(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    threads: list[int] = []

    def noting(call: Callable[..., Any]) -> Callable[..., Any]:
        def noted(*arguments: Any) -> Any:
            threads.append(threading.get_ident())
            return call(*arguments)

        return noted

    for name in ("load_aircraft", "save_aircraft"):
        monkeypatch.setattr(
            f"gateway.live.daemon.{name}", noting(getattr(gateway.live.daemon, name))
        )
    monkeypatch.setattr(daemon, "_read", noting(daemon._read))
    outcome = asyncio.get_running_loop().create_future()
    monkeypatch.setattr(daemon, "_on_saved", lambda *_: outcome.set_result(_[-1]))
    daemon._perform(Outputs(orders=[SaveSettings(1, Request(5, 255, 190, STORE, True))]))
    await daemon.reload()
    assert (await outcome).result() == tmp_path / "1.toml"
    assert len(threads) == 3
    assert threading.get_ident() not in threads
