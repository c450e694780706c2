"""The folder of recordings: listing, and safe renaming and deletion.

A recording `NAME` consists of all files `NAME_01.tlog`, `NAME_01_v1.csv`, `NAME_02.tlog` etc.
"""

import contextlib
import itertools
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from gateway.output import sync_folder
from gateway.printable import UserError

_FILE_NAME: Final = re.compile(r"(?P<name>.+)_(?P<part>\d{2,})(?:_v\d+)?\.(?:tlog|csv)")
_SURROGATE: Final = re.compile("[\ud800-\udfff]")
"""Python's encoding of bytes in a file name that are not UTF-8; JSON cannot contain it."""
MAX_NAME: Final = 100
NEWEST: Final = "last"
"""Name that always means the newest recording."""


@dataclass(frozen=True, slots=True)
class Recording:
    """All files of one recording."""

    name: str
    files: tuple[Path, ...]
    size: int
    modified_s: float
    """Time of the last modification, s since 1970."""


class RecordingError(UserError, ValueError):
    """A request that cannot be carried out; the text states the reason."""


def check_name(name: str) -> str:
    """Check the name that a user gives a recording."""
    if name == NEWEST:
        raise ValueError(f"{name!r} is not a name for a recording: it always means the newest")
    sound = all(c.isalnum() or c in " .-_" for c in name) and len(name.encode()) <= MAX_NAME
    if not sound or not name[:1].isalnum() or name.endswith((" ", ".")):
        raise ValueError(
            f"{name!r} is not a name for a recording: at most {MAX_NAME} letters, digits, spaces, "
            "dots, hyphens and underscores, beginning with a letter or digit"
        )
    return name


def part_of(path: Path) -> int:
    """Return the part number of a recording's file; raises ValueError for any other file."""
    match = _FILE_NAME.fullmatch(path.name)
    if match is None:
        raise ValueError(f"{path} is not part of a recording")
    return int(match["part"])


def is_file_name(name: str) -> bool:
    """Return whether a name is that of a recording's file, without directories."""
    return _FILE_NAME.fullmatch(name) is not None and not {"/", "\0"} & set(name)


def recording_name(path: Path) -> str:
    """Return the name of a file's recording; for other files, the file's own name."""
    match = _FILE_NAME.fullmatch(path.name)
    return path.name if match is None else match["name"]


def as_text(name: str) -> str:
    r"""Return a file name in printable form: bytes that are not UTF-8 as `\xNN`."""
    return os.fsencode(name).decode(errors="backslashreplace")


def parts_together(paths: Iterable[Path]) -> list[list[Path]]:
    """Group consecutive parts of a recording; any other file is a group of its own."""
    found: list[list[Path]] = []
    newest: dict[tuple[Path, str, str], list[Path]] = {}
    for path in paths:
        match = _FILE_NAME.fullmatch(path.name)
        if match is None:
            found.append([path])
            continue
        series = (path.parent, match["name"], path.name[match.end("part") :])
        before = newest.get(series)
        if before is not None and part_of(before[-1]) < part_of(path):
            before.append(path)
        else:
            newest[series] = [path]
            found.append(newest[series])
    return found


def list_recordings(folder: Path) -> list[Recording]:
    """List the recordings of a folder, newest last; empty if the folder does not exist.

    Recordings of the same modification time are sorted by name.
    """
    files: dict[str, list[Path]] = {}
    with contextlib.suppress(FileNotFoundError):
        for path in sorted(folder.iterdir()):
            match = _FILE_NAME.fullmatch(path.name)
            if match and not _SURROGATE.search(path.name) and path.is_file():
                files.setdefault(match["name"], []).append(path)
    found = []
    for name, paths in files.items():
        stats = []
        for path in paths:
            with contextlib.suppress(FileNotFoundError):
                stats.append(path.stat())
        size, modified_s = sum(s.st_size for s in stats), [s.st_mtime for s in stats]
        found.append(Recording(name, tuple(paths), size, max(modified_s, default=0.0)))
    return sorted(found, key=lambda recording: (recording.modified_s, recording.name))


def find_recording(folder: Path, name: str) -> Recording:
    """Find a recording by name; `last` means the newest, unless a recording has that name.

    Raises RecordingError if there is none.
    """
    recordings = list_recordings(folder)
    for recording in recordings:
        if recording.name == name:
            return recording
    if name == NEWEST and recordings:
        return recordings[-1]
    raise RecordingError(f"no recording {name!r} in {folder}")


def free_name(folder: Path, wanted: str) -> str:
    """Return the wanted name, with a number appended if a recording has it already."""
    taken = {recording.name for recording in list_recordings(folder)}
    names = (wanted if n == 1 else f"{wanted}-{n}" for n in itertools.count(1))
    return next(name for name in names if name not in taken)


def check_free(folder: Path, name: str) -> None:
    """Check that a name is free for a recording; raises RecordingError if not."""
    try:
        check_name(name)
    except ValueError as error:
        raise RecordingError(str(error)) from error
    if free_name(folder, name) != name:
        raise RecordingError(f"there is a recording {name!r} already in {folder}")


def rename_recording(folder: Path, name: str, to_name: str) -> Recording:
    """Rename a recording with `move_recording`, and sync its folder."""
    moved = move_recording(folder, name, to_name)
    sync_folder(folder)
    return moved


def move_recording(folder: Path, name: str, to_name: str) -> Recording:
    """Rename a recording, even while it is being written; never overwrites a file.

    Raises RecordingError if there is no such recording, or the new name is taken or invalid.
    """
    recording = find_recording(folder, name)
    check_free(folder, to_name)
    for path in recording.files:
        target = folder / (to_name + path.name.removeprefix(recording.name))
        try:
            # Reserves the name without overwriting, also on file systems without hard links.
            target.touch(exist_ok=False)
        except FileExistsError as error:
            raise RecordingError(f"{target} already exists") from error
        path.replace(target)
    return find_recording(folder, to_name)


def delete_recording(folder: Path, name: str) -> Recording:
    """Delete the files of a recording, and return it.

    Raises RecordingError if there is no such recording.
    """
    recording = find_recording(folder, name)
    for path in recording.files:
        path.unlink()
    sync_folder(folder)
    return recording
