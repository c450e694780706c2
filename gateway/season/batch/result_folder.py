"""The folder of a batch's results: what is done is kept there whole, or is not there at all."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import msgspec

from gateway.output import write_new
from gateway.season.batch.flight_tasks import Files, FlightResult

RESULTS: Final = "results"
PARTIAL: Final = ".partial"
"""Where files are written before they are put in their place."""


class ResultFolder:
    """Results of many recordings.

    Raises OSError if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        (folder / RESULTS).mkdir(parents=True, exist_ok=True)

    @contextmanager
    def held(self) -> Iterator[None]:
        """Keep other runs out, and remove what was left half written: by a killed one, or by this.

        Raises OSError if another run is at work in it.
        """
        descriptor = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            _lock(descriptor, self.folder)
            self._clear()
            try:
                yield
            finally:
                self._clear()
        finally:
            # Processes that were forked meanwhile have it open, too.
            with suppress(OSError):
                fcntl.flock(descriptor, fcntl.LOCK_UN)
            os.close(descriptor)

    def find(self, key: str) -> FlightResult | None:
        """Return a result that is kept with all its files; None if it is to be made."""
        found = _read(self._path(key))
        if found is None or not all((self.folder / name).exists() for name in found.files):
            return None
        return found

    def keep(self, result: FlightResult, files: Files) -> None:
        """Write a result: its files first, all under other names, then itself."""
        staged = self.folder / PARTIAL / result.key
        for name, content in files.items():
            path = staged / name
            path.parent.mkdir(parents=True, exist_ok=True)
            write_new(path, [content])
        # What belongs together (a page and its figures) is a folder, and is put in place at once.
        for unit in {Path(*Path(name).parts[:2]) for name in files}:
            target = self.folder / unit
            target.parent.mkdir(exist_ok=True)
            if target.is_dir():
                shutil.rmtree(target)
            (staged / unit).replace(target)
        shutil.rmtree(staged, ignore_errors=True)
        write_new(self._path(result.key), [msgspec.json.encode(result)], overwrite=True)

    def _clear(self) -> None:
        """Remove what was not put in its place."""
        shutil.rmtree(self.folder / PARTIAL, ignore_errors=True)

    def _path(self, key: str) -> Path:
        return self.folder / RESULTS / f"{key}.json"


def _lock(descriptor: int, folder: Path) -> None:
    """Lock a folder as long as it is open; the lock ends with the process, however that ends."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        text = "another mavgate batch writes its results here; wait, or name another folder"
        raise OSError(errno.EBUSY, text, str(folder)) from error
    except OSError:
        # Some network disks have no locks.
        return


def read_results(folder: Path) -> Iterator[FlightResult]:
    """Read all results of a folder, the newest last; raises OSError if there is none.

    Those of one tick of the file system's clock stand by name.
    """
    paths = list((folder / RESULTS).iterdir())
    for path in sorted(paths, key=lambda path: (path.stat().st_mtime_ns, path.name)):
        if path.suffix == ".json" and (found := _read(path)) is not None:
            yield found


def _read(path: Path) -> FlightResult | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=FlightResult)
    except (FileNotFoundError, msgspec.DecodeError):
        return None
