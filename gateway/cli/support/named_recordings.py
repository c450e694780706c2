"""A recording by its name, as `mavgate record list` shows it, wherever a file is taken."""

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from gateway.cli.support.asking import ask, is_running
from gateway.cli.support.settings_options import read_settings
from gateway.config import GatewaySettings
from gateway.edges.disk.recordings import RecordingError, find_recording
from gateway.flights.reading import FlightError

Wanted = Literal["tlogs", "tables", "all"]
"""Which files of a recording a command wants; the others where it has none of these."""


def recordings_folder(config: Path | None) -> Path:
    """Return where the recordings are: of the gateway that runs, unless settings are named."""
    if config is None and is_running():
        return Path(ask("record.status")["folder"])
    return folder_of(read_settings(config))


def folder_of(settings: GatewaySettings) -> Path:
    """Return where these settings put recordings."""
    return Path(settings.recording.folder).expanduser()


def files_of(names: Iterable[Path], folder: Path, wanted: Wanted) -> list[Path]:
    """Put the files of recordings in the place of their names; a path stays what it is.

    Parameters
    ----------
    names : iterable of Path
        Files, or names of recordings; `last` is the newest.
    folder : Path
        Where the recordings are.
    wanted : str
        Which of a recording's files.

    Raises
    ------
    FlightError
        If there is neither such a file nor such a recording.
    """
    return [file for name in names for file in _files_of(name, folder, wanted)]


def _files_of(name: Path, folder: Path, wanted: Wanted) -> list[Path]:
    if name.exists() or name.name != str(name):
        return [name]
    try:
        files = list(find_recording(folder, str(name)).files)
    except RecordingError as error:
        raise FlightError(
            f"{name}: no such file, and no recording of that name in {folder}; "
            "`mavgate record list` shows them"
        ) from error
    if wanted == "all":
        return files
    ending = ".tlog" if wanted == "tlogs" else ".csv"
    return [file for file in files if file.suffix == ending] or files
