"""The running gateway, player or fleet that a command asks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gateway.cli.support.options import CONFIG, SOCKET, folder_of, read_settings
from gateway.live.control_socket import find_socket, live_sockets, request


def ask(
    verb: str,
    params: dict[str, Any] | None = None,
    *,
    of: str = "run",
    wait_s: float | None = None,
) -> Any:
    """Send a request to the running gateway, or player."""
    return request(socket_of(of), verb, params, timeout_s=wait_s)


def socket_of(of: str) -> Path:
    """Return the selected gateway's socket; raises ControlError if there is none."""
    return SOCKET.get() or find_socket(of)


def is_running() -> bool:
    """Return whether a gateway of this user runs."""
    return SOCKET.get() is not None or bool(live_sockets("run"))


def recordings_folder() -> Path:
    """Return the folder of recordings: the running gateway's, unless settings are given."""
    if CONFIG.get() is None and is_running():
        return Path(ask("record.status")["folder"])
    return folder_of(read_settings())
