"""Requests to the running gateway, player or fleet."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gateway.cli.support.options import CONFIG, SOCKET, folder_of, read_settings
from gateway.live.control_socket import find_socket, live_sockets, request


def ask(verb: str, *, of: str = "run", wait_s: float | None = None, **params: Any) -> Any:
    """Send a request to the running gateway, player or fleet, and return the answer."""
    return request(socket_of(of), verb, params, timeout_s=wait_s)


def socket_of(of: str) -> Path:
    """Return the socket of the selected gateway; raises ControlError if there is none."""
    return SOCKET.get() or find_socket(of)


def is_running() -> bool:
    """Return whether a gateway can be asked; a socket that the user gave is not tried."""
    return SOCKET.get() is not None or bool(live_sockets("run"))


def recordings_folder() -> Path:
    """Return the folder of recordings of the running gateway, or of the given settings."""
    if CONFIG.get() is None and is_running():
        return Path(ask("record.status")["folder"])
    return folder_of(read_settings())
