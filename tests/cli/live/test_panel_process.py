"""The panel ends with the gateway, before the event loop does."""

import asyncio
import sys
from pathlib import Path

import pytest

from gateway.cli.support import panel_process
from gateway.cli.support.panel_process import PanelProcess

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
SAYING = "import time; print('panel: here', flush=True); time.sleep(100)"


async def control_socket() -> Path:
    return Path("no.sock")


@pytest.mark.io
@pytest.mark.parametrize(("begin", "code"), [("", -15), (STUBBORN, -9)])
async def test_it_has_ended_when_it_is_closed(
    begin: str, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_process, "END_S", 0.2 if begin else 60.0)
    panel = PanelProcess(None)
    panel._command = [sys.executable, "-c", begin + SAYING]
    panel.start(control_socket)
    while not panel.link:
        await asyncio.sleep(0.01)
    await panel.close()
    assert panel._child is not None
    assert panel._child.returncode == code


@pytest.mark.io
async def test_a_line_of_any_length_leaves_the_next_to_be_read() -> None:
    panel = PanelProcess(None)
    panel._command = [sys.executable, "-c", "print('x' * 200_000); " + SAYING]
    panel.start(control_socket)
    async with asyncio.timeout(60.0):
        while not panel.link:
            await asyncio.sleep(0.01)
    await panel.close()


async def test_it_is_closed_while_it_waits_for_the_gateway() -> None:
    panel = PanelProcess(None)
    panel.start(asyncio.get_running_loop().create_future)  # type: ignore[arg-type]
    await asyncio.sleep(0)
    await panel.close()
    assert panel._child is None
