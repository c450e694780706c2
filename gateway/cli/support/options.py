"""What the user has named: settings file, control socket, and the file to write.

The settings import every stage, and with them NumPy: a command that never reads them must not wait
for that, so they are imported where they are read.
"""

from __future__ import annotations

from collections.abc import Collection
from contextvars import ContextVar
from enum import StrEnum
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import typer

from gateway.output import check_ending

if TYPE_CHECKING:
    from gateway.config import GatewaySettings
    from gateway.recordings.recorded_table import ReadOptions

USER_CONFIG: Final = Path("~/.config/mavgate/gateway.toml")

CONFIG: Final[ContextVar[Path | None]] = ContextVar("config", default=None)
"""Settings file that the user has named."""
SOCKET: Final[ContextVar[Path | None]] = ContextVar("socket", default=None)
"""Control socket that the user has named."""


class RadioName(StrEnum):
    """The radios of the boards as they are named on the command line."""

    NRF24 = "nrf24"
    SX1276 = "sx1276"


@cache
def extend() -> None:
    """Load the extensions, or end the command; they may add kinds of endpoints to the settings."""
    # Imported late, because the search for installed packages takes 20 ms.
    from gateway.extensions import load_extensions

    load_extensions()


def read_settings(file: Path | None = None) -> GatewaySettings:
    """Load the given settings, those that the user has named, the user's own, or the defaults."""
    from gateway.config import GatewaySettings, load

    extend()
    file = file or CONFIG.get()
    if file is None and not settings_file().exists():
        return GatewaySettings()
    return load(file or settings_file())


def settings_file() -> Path:
    """Return the settings file that the user has named, or the user's own, which may not exist."""
    return CONFIG.get() or USER_CONFIG.expanduser()


def output_file(text: str, endings: Collection[str], *names: str) -> Any:
    """Return the option of a file to write, by default `--output`, that has one of the endings."""

    def check(path: Path | None) -> Path | None:
        if path is not None:
            check_ending(path, endings)
        return path

    return typer.Option(*(names or ("--output", "-o")), help=text, callback=check)


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings in these settings."""
    return Path(settings.recording.folder).expanduser()


def read_options(settings: GatewaySettings, columns: Path | None = None, **how: Any) -> ReadOptions:
    """Return how flights are read: by a column map, the limits of the settings, and `how`."""
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
