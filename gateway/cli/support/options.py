"""Declarations of options; the user's global ones: settings file, control socket; requests.

The settings import all stages, and with them NumPy. Commands that do not read settings must not
wait for that, so they are imported where they are read.
"""

from __future__ import annotations

from collections.abc import Collection
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from gateway.live.control_socket import find_socket, live_sockets, request
from gateway.output import check_ending

if TYPE_CHECKING:
    from gateway.config import GatewaySettings
    from gateway.recordings.recorded_table import ReadOptions

USER_CONFIG: Final = Path("~/.config/mavgate/gateway.toml")

CONFIG: Final[ContextVar[Path | None]] = ContextVar("config", default=None)
"""Settings file given by the user."""
SOCKET: Final[ContextVar[Path | None]] = ContextVar("socket", default=None)
"""Control socket given by the user."""


@cache
def extend() -> None:
    """Load the extensions, which can add kinds of endpoints; an error ends the command."""
    # Imported late, because searching for installed packages takes 20 ms.
    from gateway.extensions import load_extensions

    load_extensions()


def read_settings(file: Path | None = None) -> GatewaySettings:
    """Read settings from a given file, the user's choice, the user's default file, or defaults."""
    from gateway.config import GatewaySettings, load

    extend()
    file = file or CONFIG.get()
    if file is None and not settings_file().exists():
        return GatewaySettings()
    return load(file or settings_file())


def settings_file() -> Path:
    """Return the settings file that the user gave, or the default one, which may not exist."""
    return CONFIG.get() or USER_CONFIG.expanduser()


def option(names: str, text: str, default: Any = None, **how: Any) -> Any:
    """Return an option of a command, with its names, separated by spaces, and its help."""
    return typer.Option(default, *names.split(), help=text, **how)


def argument(text: str, default: Any = None, **how: Any) -> Any:
    """Return an argument of a command, with its help; required by the default `...`."""
    return typer.Argument(default, help=text, **how)


def output_file(
    text: str, endings: Collection[str], names: str = "--output -o", default: Any = None
) -> Any:
    """Return an option for a file to write with one of these suffixes."""

    def check(path: Path | None) -> Path | None:
        if path is not None:
            check_ending(path, endings)
        return path

    return option(names, text, default, callback=check)


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings according to the settings."""
    return Path(settings.recording.folder).expanduser()


def read_options(settings: GatewaySettings, columns: Path | None = None, **how: Any) -> ReadOptions:
    """Return options for reading flights: column map, limits of the settings, and `how`."""
    from gateway.config import load_aircraft
    from gateway.pipeline import PipelineSettings
    from gateway.recordings.reading import read_column_map
    from gateway.recordings.recorded_table import ReadOptions

    return ReadOptions(
        PipelineSettings(settings.default_aircraft, load_aircraft(settings)),
        unpacked_limit=settings.recording.unpacked_limit,
        columns=None if columns is None else read_column_map(columns),
        **how,
    )


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
