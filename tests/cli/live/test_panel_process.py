"""The panel ends with the gateway, before the event loop does."""

import asyncio
import logging
import sys
from pathlib import Path

import pytest

from gateway.cli.live import panel as panel_command
from gateway.cli.live.panel import LONGEST_RECORD, OneLineFormatter, PanelProcess
from gateway.live.log_limit import LogLimit

STUBBORN = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); "
SAYING = "import time; print('panel: here', flush=True); time.sleep(100)"


async def control_socket() -> Path:
    return Path("no.sock")


def panel_that_runs(code: str) -> PanelProcess:
    """Return a panel whose child process runs some Python code instead."""
    panel = PanelProcess()
    panel._command = [sys.executable, "-c", code]
    return panel


async def link_of(panel: PanelProcess) -> str:
    """Start a panel, and wait for the address that it prints."""
    panel.start(control_socket)
    async with asyncio.timeout(60.0):
        while not panel.link:
            await asyncio.sleep(0.01)
    return panel.link


@pytest.mark.io
@pytest.mark.parametrize(
    ("begin", "is_started", "code"), [("", True, -15), (STUBBORN, True, -9), ("", False, -15)]
)
async def test_closing_waits_for_the_end_of_the_process(
    begin: str, is_started: bool, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(panel_command, "END_S", 0.2 if begin else 60.0)
    panel = panel_that_runs(begin + SAYING)
    if is_started:
        await link_of(panel)
    else:
        panel.launch()
    await panel.close()
    assert panel._child is not None
    assert panel._child.returncode == code


@pytest.mark.io
async def test_too_long_line_is_skipped_and_the_next_read() -> None:
    panel = panel_that_runs("print('x' * 200_000); " + SAYING)
    assert await link_of(panel) == "here"
    await panel.close()


@pytest.mark.io
async def test_launched_panel_receives_the_path_of_the_control_socket() -> None:
    panel = panel_that_runs("print('panel: ' + input(), flush=True); input()")
    panel.launch()
    assert await link_of(panel) == "no.sock"
    await panel.close()


async def test_panel_is_closed_while_it_waits_for_the_gateway() -> None:
    panel = PanelProcess()
    panel.start(asyncio.get_running_loop().create_future)
    await asyncio.sleep(0)
    await panel.close()
    assert panel._child is None


def deep(depth: int) -> None:
    """Raise an error under many frames, no two of which are alike and so folded into one."""
    if depth:
        deeper(depth - 1)
    else:
        raise OSError("the reason, with \x1b[2J and a\nline break")


def deeper(depth: int) -> None:
    deep(depth)


@pytest.mark.parametrize("depth", [3, 20, 150])
async def test_traceback_of_the_panel_is_one_record_that_ends_with_its_error(
    depth: int, caplog: pytest.LogCaptureFixture
) -> None:
    try:
        deep(depth)
    except OSError as error:
        cause = (OSError, error, error.__traceback__)
    record = logging.LogRecord("x", logging.ERROR, "", 0, "It failed", (), cause)
    line = OneLineFormatter("%(message)s").format(record)
    assert "\n" not in line
    assert len(line) < LONGEST_RECORD + 100
    stream = asyncio.StreamReader()
    stream.feed_data(line.encode() + b"\n")
    stream.feed_eof()
    limit = LogLimit()
    caplog.handler.addFilter(limit)
    await PanelProcess()._read(stream)
    caplog.handler.removeFilter(limit)
    (logged,) = caplog.records
    assert logged.getMessage().startswith("panel: It failed\n")
    assert logged.getMessage().endswith("OSError: the reason, with \\x1b[2J and a\nline break")
