"""The panel's port, and what it logs as a part of a gateway."""

import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from gateway.panel import panel_server
from gateway.panel.panel_server import PanelError
from gateway.panel.panel_settings import PanelSettings
from tests.kit.cli import invoke, reset_logging

pytestmark = pytest.mark.io


@pytest.fixture
def taken() -> Iterator[PanelSettings]:
    with socket.create_server(("127.0.0.1", 0)) as other:
        yield PanelSettings(address="127.0.0.1", port=other.getsockname()[1])


def test_panel_of_a_gateway_takes_another_port_if_its_own_is_in_use(
    taken: PanelSettings, caplog: pytest.LogCaptureFixture
) -> None:
    with panel_server._bound(taken, or_any=True) as bound:
        assert bound.getsockname()[1] not in (0, taken.port)
    assert f"127.0.0.1:{taken.port} is in use" in caplog.text


def test_standalone_panel_reports_the_port_in_use(taken: PanelSettings) -> None:
    with pytest.raises(PanelError, match=f"{taken.port}: Address already in use; --tcp-port"):
        panel_server.run_panel(taken, Path(), None, None, print, attached=False)


def test_log_lines_of_an_attached_panel_have_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_panel(*_: object, **__: object) -> None:
        logging.getLogger("gateway").info("a page was opened")
        logging.getLogger("gateway").warning("the port is taken")

    reset_logging(monkeypatch)
    monkeypatch.setattr(panel_server, "run_panel", run_panel)
    monkeypatch.setattr(os, "nice", lambda _: 0)
    attached = invoke("panel", "--attached", answers="run.sock\n")
    assert attached.output == "the port is taken\n"
