"""`mavgate record …` with a gateway that runs."""

import asyncio
import re
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest

from gateway.batch.catalogue import CATALOGUE_NAME
from gateway.live.control_socket import ControlServer, socket_path
from gateway.live.control_verbs import recorder_verbs
from tests.conftest import ManualClock
from tests.kit.cli import invoke
from tests.kit.recorder import RecorderBench
from tests.kit.recordings import make_frames

pytestmark = pytest.mark.io

Run = Callable[..., Awaitable[str]]


@pytest.fixture
async def gateway(
    tmp_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> AsyncIterator[RecorderBench]:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    bench = RecorderBench(tmp_path / "elsewhere", clock, mode="manual")
    bench.recorder.start()
    server = ControlServer(socket_path("run"), recorder_verbs(bench.recorder))
    await server.start()
    yield bench
    server.close()
    bench.recorder.close()


async def run(*args: str, code: int = 0) -> str:
    words = args if args[0] == "info" else ("record", *args)
    return (await asyncio.to_thread(invoke, *words, code=code)).output


async def test_recording_is_started_renamed_stopped_listed_and_deleted(
    gateway: RecorderBench,
) -> None:
    assert "recording" in await run("start")
    gateway.send(make_frames(9))
    assert "recording" in await run("note", "over the wood")
    assert "the note is empty" in await run("note", " ", code=2)
    # Also before anything of it is on the disk.
    assert "first" in await run("rename", "first")
    await gateway.recorder.settle()
    assert "stop it first" in await run("delete", "first", "--yes", code=2)
    assert re.match(r"Stopped: first, 0:\d\d, \d\.\d MB, in /.* GB free", await run("stop"))
    assert "Stopped: first, " in await run("status")
    assert "in no file: nothing is recorded" in await run("note", "over the lake", code=2)
    # The folder is the one of the gateway that runs, whatever the user's settings say.
    [listed] = [line for line in (await run("info")).splitlines() if "first" in line]
    assert re.search(r" 20\d\d-\d\d-\d\d \d\d:\d\d:\d\d ", listed), listed
    assert '"name":"first"' in await run("info", "--json")
    assert "first_01.tlog" in await run("delete", "first", "--yes")
    assert f"no recordings in {gateway.recorder.folder}" in await run("info")
    assert [path.name for path in gateway.recorder.folder.iterdir()] == [CATALOGUE_NAME]


async def test_start_without_a_recording_has_a_distinct_exit_code(gateway: RecorderBench) -> None:
    gateway.recorder.folder.write_text("a file in its place")
    assert "blocked" in await run("start", code=1)
    assert "exists" in await run("status")


async def test_recorder_that_waits_for_arming_is_shown_with_its_memory(
    tmp_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    bench = RecorderBench(tmp_path / "recordings", clock, mode="armed")
    server = ControlServer(socket_path("run"), recorder_verbs(bench.recorder))
    await server.start()
    try:
        await bench.turn()
        clock.advance(21.0)
        assert "waits for arming, with 21 s in memory" in await run("status")
    finally:
        server.close()
        bench.recorder.close()
