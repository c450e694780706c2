"""The demo: its line, its settings, and the event loop that it shares with run."""

import asyncio
import gc
import logging
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from itertools import count, islice
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from gateway.cli.live import demo, run
from gateway.cli.live.demo import made_ahead
from gateway.cli.live.run import serve
from gateway.compiled.entry_point import LibraryError
from gateway.config import GatewaySettings, aircraft_folder
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from tests.kit.cli import invoke

pytestmark = pytest.mark.io

Started = Callable[..., list[GatewaySettings]]


@pytest.fixture
def settings_of_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Started:
    """The settings with which the daemon would start, and those that a reload would read."""
    file = tmp_path / "gateway.toml"
    file.write_text(f'aircraft_folder = "{tmp_path}/mine"\n[recording]\nmode = "in_flight"\n')

    def run(*options: str) -> list[GatewaySettings]:
        found: list[GatewaySettings] = []

        async def serve(daemon_of: Callable[[], object], **_: object) -> None:
            daemon_of()

        def make_daemon(started: GatewaySettings, _: Any, read: Any, *__: Any) -> object:
            found.extend([started, read()])
            return object()

        monkeypatch.setattr(demo, "serve", serve)
        monkeypatch.setattr(demo, "Daemon", make_daemon)
        invoke("demo", "--config", file, "--no-panel", *options, code=0)
        return found

    return run


def test_demo_does_not_use_the_aircraft_folder_of_the_user(
    settings_of_demo: Started, tmp_path: Path
) -> None:
    """What a ground station has the demo save must not become a real aircraft's calibration."""
    started, reloaded = settings_of_demo()
    folder = aircraft_folder(started)
    assert folder not in (tmp_path / "mine", Path("~/.config/mavgate/aircraft").expanduser())
    assert aircraft_folder(reloaded) == folder
    assert not folder.exists(), "it goes with the demo"


@pytest.mark.parametrize(("options", "mode"), [((), "manual"), (("--record",), "always")])
def test_demo_is_recorded_only_on_request(
    settings_of_demo: Started, caplog: pytest.LogCaptureFixture,
    options: tuple[str, ...], mode: str,
) -> None:  # fmt: skip
    with caplog.at_level(logging.INFO):
        found = settings_of_demo(*options)
    assert [settings.recording.mode for settings in found] == [mode, mode]
    state = "recording" if options else "not recording without --record"
    assert f"recording.mode is not used here: {state}" in caplog.text


SETTINGS = SimulatorSettings(corrupt_bytes=0.01)


def numbered() -> Iterator[TimedFrame]:
    for k in count():
        yield TimedFrame(float(k), os.getpid().to_bytes(4))


def test_frames_made_ahead_equal_those_of_the_simulator() -> None:
    made = list(islice(made_ahead(simulate(SETTINGS).frames()), 200))
    assert made == list(islice(simulate(SETTINGS).frames(), 200))
    assert any(frame.damaged for frame in made)


def test_frames_are_made_by_a_process_that_ends_with_its_reader() -> None:
    before = set(multiprocessing.active_children())
    line = made_ahead(numbered())
    [child] = set(multiprocessing.active_children()) - before
    made = list(islice(line, 1000))
    assert [frame.time_s for frame in made] == list(range(1000))
    assert {int.from_bytes(frame.data) for frame in made} == {child.pid}
    line.close()
    child.join(60.0)
    assert child.exitcode == 0


def test_end_of_the_simulated_receiver_is_logged(caplog: pytest.LogCaptureFixture) -> None:
    assert len(list(made_ahead(islice(numbered(), 40)))) == 40
    assert "the simulated receiver has ended" in caplog.text


class Daemon:
    """Loads something as it starts, and ends at its first turn."""

    def __init__(self) -> None:
        self.is_collected: bool | None = None

    def start(self) -> None:
        self._loaded = [[] for _ in range(10)]
        asyncio.get_running_loop().call_soon(self._look)

    def _look(self) -> None:
        self.is_collected = any(found is self._loaded for found in gc.get_objects())
        signal.raise_signal(signal.SIGTERM)

    def close(self) -> None:
        """Nothing is open."""


async def test_objects_loaded_at_the_start_are_excluded_from_garbage_collection() -> None:
    daemon: Any = Daemon()
    await serve(lambda: daemon, plain=True)
    assert daemon.is_collected is False


@pytest.mark.parametrize(("port", "starts"), [("none", True), ("auto", False)])
def test_only_a_router_starts_without_the_kernels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, port: str, starts: bool
) -> None:
    file, started = tmp_path / "gateway.toml", list[str]()
    file.write_text(f'[serial]\nport = "{port}"\n')
    missing = LibraryError(Path("kernels.so"), "is missing")
    monkeypatch.setattr(run, "load_entry_points", Mock(side_effect=missing))
    monkeypatch.setattr(run, "serve", lambda *_, **__: None)
    monkeypatch.setattr(run, "run_event_loop", lambda _, event_loop: started.append(event_loop))
    result = invoke("run", "--config", file)
    assert (result.exit_code == 0, bool(started)) == (starts, starts), result.output
