"""Recordings wherever they are: local paths, and anything that fsspec opens by a URL."""

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import msgspec

from gateway.edges.disk.recording_streams import CHUNK, GZIP
from gateway.edges.disk.recordings import parts_together, recording_name
from gateway.season.hangar.indexing import ENDINGS, digest_of, recordings_below

MARK: Final = "://"
"""What makes a name a URL."""
OF_ONE_PROCESS: Final = "memory"
"""A file system that no other process sees: its files travel with the work."""


class StorageError(Exception):
    """A place that cannot be reached; the text says which and why."""


class StoredFile(msgspec.Struct, frozen=True):
    """One file of a recording."""

    place: str
    """Local path or URL."""
    data: bytes | None = None
    """The file itself, where no other process could read it."""


class BatchItem(msgspec.Struct, frozen=True):
    """One recording to work on: its parts, in order."""

    parts: tuple[StoredFile, ...]

    @property
    def place(self) -> str:
        """Where its first part is: what it is called."""
        return self.parts[0].place


def is_url(name: str) -> bool:
    """Return whether a name is a URL and no path."""
    return MARK in name


def has_fsspec() -> bool:
    """Return whether URLs can be opened here."""
    return find_spec("fsspec") is not None


def items_of(names: Sequence[str], *, each_file: bool = False) -> list[BatchItem]:
    """Find the recordings that are meant.

    Parameters
    ----------
    names : sequence of str
        Files, folders, and URLs of either, with `*` too. The parts of one recording become one
        item; where there are tables of a recording, its tlogs are left out.
    each_file : bool
        Let every file be an item of its own.

    Raises
    ------
    StorageError
        If there is nothing of a name, or its storage cannot be reached.
    """
    places = list(dict.fromkeys(place for name in names for place in _places(name)))
    if each_file:
        return [BatchItem((_part(place),)) for place in places]
    by_path = {Path(place): place for place in places}
    with_table = {_series(path) for path in by_path if _ending(path) == ".csv"}
    wanted = [p for p in by_path if _ending(p) == ".csv" or _series(p) not in with_table]
    return [
        BatchItem(tuple(_part(by_path[path]) for path in paths)) for paths in parts_together(wanted)
    ]


def digest_of_item(item: BatchItem) -> str:
    """Return the SHA-256 of a recording's files; raises OSError."""
    with local_files(item) as paths:
        digests = [digest_of(path) for path in paths]
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


@contextmanager
def local_files(item: BatchItem) -> Iterator[list[Path]]:
    """Have the files of a recording on this machine's disk.

    Yields
    ------
    list of Path
        Those that came from elsewhere are gone afterwards.

    Raises
    ------
    OSError
        If one cannot be read.
    """
    if not any(part.data is not None or is_url(part.place) for part in item.parts):
        yield [Path(part.place) for part in item.parts]
        return
    with TemporaryDirectory(prefix="mavgate-") as folder:
        yield [_fetched(part, Path(folder, str(number))) for number, part in enumerate(item.parts)]


def _fetched(part: StoredFile, folder: Path) -> Path:
    if part.data is None and not is_url(part.place):
        return Path(part.place)
    folder.mkdir()
    path = folder / part.place.rsplit("/", 1)[-1]
    if part.data is not None:
        path.write_bytes(part.data)
        return path
    storage, remote = _storage(part.place)
    with storage.open(remote, "rb") as source, path.open("wb") as target:
        shutil.copyfileobj(source, target, CHUNK)
    return path


def _places(name: str) -> list[str]:
    if not is_url(name):
        path = Path(name)
        return [str(found) for found in recordings_below(path)] if path.is_dir() else [name]
    storage, remote = _storage(name)
    try:
        if "*" in remote:
            found = storage.glob(remote)
        elif storage.isdir(remote):
            found = storage.find(remote)
        else:
            return [name]
    except (OSError, ValueError) as error:
        raise StorageError(f"{name}: {error}") from error
    places = [storage.unstrip_protocol(place) for place in sorted(found)]
    places = [place for place in places if _ending(Path(place)) in ENDINGS]
    if not places:
        raise StorageError(f"{name}: no recording is there ({', '.join(ENDINGS)})")
    return places


def _part(place: str) -> StoredFile:
    if not is_url(place):
        return StoredFile(str(Path(place).absolute()))
    storage, remote = _storage(place)
    local = OF_ONE_PROCESS in (storage.protocol, *storage.protocol)
    return StoredFile(place, storage.cat_file(remote) if local else None)


def _storage(url: str) -> tuple[Any, str]:
    """Return a file system of fsspec and the path in it; raises StorageError."""
    fsspec = import_module("fsspec")
    try:
        storage, remote = fsspec.core.url_to_fs(url)
    except (ImportError, ValueError, OSError) as error:
        raise StorageError(f"{url}: {error}") from error
    return storage, remote


def _ending(path: Path) -> str:
    return Path(path.name.removesuffix(GZIP)).suffix


def _series(path: Path) -> tuple[Path, str]:
    return path.parent, recording_name(path)
