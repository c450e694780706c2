"""The settings file of a command.

The settings import every stage, and with them NumPy: a command that never reads them must not wait
for that, so they are imported where they are read.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

if TYPE_CHECKING:
    from gateway.config import GatewaySettings
    from gateway.recordings.reading import ReadOptions

USER_CONFIG: Final = Path("~/.config/mavgate/gateway.toml")

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help=f"Settings file; by default gateway.toml in {USER_CONFIG.parent}."
    ),
]


def read_settings(file: Path | None) -> GatewaySettings:
    """Load the given settings, the user's own, or the defaults."""
    from gateway.config import GatewaySettings, load

    if file is None:
        file = USER_CONFIG.expanduser()
        if not file.exists():
            return GatewaySettings()
    return load(file)


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings in these settings."""
    return Path(settings.recording.folder).expanduser()


def read_options(settings: GatewaySettings, columns: Path | None = None, **how: Any) -> ReadOptions:
    """Return how flights are read: by a column map, the limits of the settings, and `how`."""
    from gateway.config import load_aircraft
    from gateway.pipeline import PipelineSettings
    from gateway.recordings.reading import ReadOptions, read_column_map

    return ReadOptions(
        PipelineSettings(settings.default_aircraft, load_aircraft(settings)),
        unpacked_limit=settings.recording.unpacked_limit,
        columns=None if columns is None else read_column_map(columns),
        **how,
    )
