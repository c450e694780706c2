"""The settings of a command: which file, and errors for a wrong one.

The settings import every stage, and with them NumPy: a command that never reads them must not wait
for that, so they are imported where they are read.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from gateway.cli.support.terminal import refuse

if TYPE_CHECKING:
    from gateway.aircraft import AircraftSettings
    from gateway.config import GatewaySettings
    from gateway.pipeline import PipelineSettings
    from gateway.recordings.reading import ReadOptions

USER_CONFIG: Final = Path("~/.config/mavgate/gateway.toml")

ConfigOption = Annotated[
    Path | None,
    typer.Option(
        "--config", "-c", help=f"Settings file; by default gateway.toml in {USER_CONFIG.parent}."
    ),
]


def load_settings(file: Path | None) -> GatewaySettings:
    """Load the given settings, the user's own, or the defaults."""
    from gateway.config import GatewaySettings, load

    if file is None:
        file = USER_CONFIG.expanduser()
        if not file.exists():
            return GatewaySettings()
    return load(file)


def or_refuse(read: Callable[[], GatewaySettings]) -> GatewaySettings:
    """Read settings at the start of a command, which ends if they are wrong."""
    from gateway.config import ConfigError

    try:
        return read()
    except ConfigError as error:
        refuse(str(error))


def read_settings(file: Path | None) -> GatewaySettings:
    """Load the settings; end the command if they are wrong."""
    return or_refuse(lambda: load_settings(file))


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings in these settings."""
    return Path(settings.recording.folder).expanduser()


def read_aircraft(settings: GatewaySettings) -> dict[int, AircraftSettings]:
    """Load the settings of single aircraft."""
    from gateway.config import ConfigError, load_aircraft

    try:
        return load_aircraft(settings)
    except ConfigError as error:
        refuse(str(error))


def read_options(settings: GatewaySettings, **how: Any) -> ReadOptions:
    """Return how flights are read: the limits of the settings, and further fields by name."""
    from gateway.recordings.reading import ReadOptions

    current = pipeline_settings(settings)
    return ReadOptions(current, unpacked_limit=settings.recording.unpacked_limit, **how)


def pipeline_settings(settings: GatewaySettings) -> PipelineSettings:
    """Return the pipeline's settings, the single aircraft's files included."""
    from gateway.pipeline import PipelineSettings

    return PipelineSettings(settings.default_aircraft, read_aircraft(settings))
