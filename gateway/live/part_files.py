"""The files of one part of a recording, written in the recorder's threads.

Files are only ever appended to, so a power cut at any moment leaves the data that was written
before. Only a record that was written partly is removed again.
"""

import contextlib
import errno
import logging
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from gateway.live.session import part_stem
from gateway.output import sync_folder
from gateway.recordings.index import check_free, free_name, list_recordings, move_recording

log = logging.getLogger(__name__)
RIGHTS: Final = 0o644


@dataclass(frozen=True, slots=True)
class DiskState:
    """Result of a write."""

    part_bytes: int
    """Size of the largest file."""
    free_bytes: int


def free_bytes_near(folder: Path) -> int:
    """Return the free space where a folder is, or would be created."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


def reason_of(error: OSError) -> str:
    """Describe a disk error in a few words: a STATUSTEXT has 50 bytes."""
    known = {
        errno.ENOSPC: "disk is full",
        errno.EDQUOT: "disk quota is used up",
        errno.EROFS: "disk is read-only",
        errno.EACCES: "no right to write",
        errno.ENOENT: "folder has vanished",
        errno.EIO: "disk fails",
    }
    return known.get(error.errno or 0, os.strerror(error.errno or errno.EIO))


class PartFiles:
    """Append to the files of one part, opening each with its first bytes."""

    def __init__(self, folder: Path, session: str, part: int) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self.session = free_name(folder, session) if part == 1 else session
        self._part = part
        self._files: dict[str, int] = {}
        self._sizes: dict[str, int] = {}
        self._has_new_names = False

    def write(self, pieces: Mapping[str, bytes]) -> DiskState:
        """Append to files, without waiting for the physical disk."""
        for ending, data in pieces.items():
            if ending not in self._files:
                self._open(ending)
            self._append(ending, data)
        for file in self._files.values():
            if os.fstat(file).st_nlink == 0:
                raise FileNotFoundError(errno.ENOENT, "removed while it was written")
        return DiskState(max(self._sizes.values(), default=0), free_bytes_near(self._folder))

    def sync_job(self) -> Callable[[], None]:
        """Return a function that waits until all data written so far is on the physical disk.

        It raises OSError if the disk fails. Other threads may write during the wait, but not close.
        """
        folder, self._has_new_names = self._folder if self._has_new_names else None, False
        return partial(_sync, tuple(self._files.values()), folder)

    def rename(self, to_name: str) -> None:
        """Rename the recording between two writes; the folder is not synced."""
        if self.session in {recording.name for recording in list_recordings(self._folder)}:
            move_recording(self._folder, self.session, to_name)
        else:
            check_free(self._folder, to_name)
        self.session = to_name

    def close(self, pieces: Mapping[str, bytes]) -> None:
        """Append the last bytes, sync, close all files, and remove empty ones."""
        try:
            self.write(pieces)
        finally:
            try:
                self.sync_job()()
            finally:
                self._close_all()

    def _close_all(self) -> None:
        files, self._files = self._files, {}
        for ending, file in files.items():
            os.close(file)
            if not self._sizes[ending]:
                self._path(ending).unlink(missing_ok=True)

    def _open(self, ending: str) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | os.O_CLOEXEC
        try:
            self._files[ending] = os.open(self._path(ending), flags, RIGHTS)
        except FileExistsError:
            if self._part != 1 or self._files:
                raise
            self.session = free_name(self._folder, self.session)
            self._files[ending] = os.open(self._path(ending), flags, RIGHTS)
        self._sizes[ending] = 0
        self._has_new_names = True

    def _path(self, ending: str) -> Path:
        return self._folder / (part_stem(self.session, self._part) + ending)

    def _append(self, ending: str, data: bytes) -> None:
        file, size, view = self._files[ending], self._sizes[ending], memoryview(data)
        try:
            while view:
                view = view[os.write(file, view) :]
        except OSError:
            # A full disk writes only the start of the data: remove a partial record.
            with contextlib.suppress(OSError):
                os.ftruncate(file, size)
            raise
        self._sizes[ending] = size + len(data)


def close_behind(
    files: PartFiles, written: Future[DiskState], syncing: Future[None] | None
) -> None:
    """Close a part once its end is written and its last sync has ended; log errors."""
    try:
        try:
            written.result()
        finally:
            files.close({})
        if syncing is not None:
            syncing.result()
    except OSError as error:
        log.warning("Recording: the end of %s is lost: %s", files.session, reason_of(error))


def _sync(files: Iterable[int], folder: Path | None) -> None:
    if folder is not None:
        sync_folder(folder)
    for file in files:
        os.fdatasync(file)
