"""Recordings by name, as `mavgate record list` shows them, wherever a file is accepted."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from gateway.cli.support.asking import ask, is_running
from gateway.cli.support.settings_options import read_settings
from gateway.recordings.files import FlightError
from gateway.recordings.index import RecordingError, find_recording

if TYPE_CHECKING:
    from gateway.config import GatewaySettings

Wanted = Literal["tlogs", "tables", "all"]
"""Which files of a recording a command uses; the others if it has none of these."""


def recordings_folder(config: Path | None) -> Path:
    """Return the folder of recordings: the running gateway's, unless settings are given."""
    if config is None and is_running():
        return Path(ask("record.status")["folder"])
    return folder_of(read_settings(config))


def folder_of(settings: GatewaySettings) -> Path:
    """Return the folder of recordings in these settings."""
    return Path(settings.recording.folder).expanduser()


def files_of(names: Iterable[Path], folder: Path, wanted: Wanted) -> list[Path]:
    """Replace names of recordings by their files; paths stay unchanged.

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
