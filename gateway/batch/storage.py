"""Access recordings anywhere: local paths, and URLs that fsspec can open."""

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from hashlib import sha256
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import msgspec

from gateway.batch.catalogue import ENDINGS, digest_of, recordings_below
from gateway.batch.executors import WorkError
from gateway.recordings.files import GZIP
from gateway.recordings.index import parts_together, recording_name

MARK: Final = "://"
"""Separator after the scheme of a URL; local paths do not contain it."""
HERE: Final = "file"
"""Scheme of the local file system, which requires no package."""
REMOTE_ENDINGS: Final = (*ENDINGS, ".parquet", ".ulg", ".bin")
"""Suffixes of recordings in remote folders, whose files are not opened to recognise formats."""
STAMPS: Final = (
    "ETag", "etag", "md5Hash", "generation", "mtime", "LastModified", "last_modified", "updated",
)  # fmt: skip
"""Keys under which storages report the version or the last modification of a file."""
PACKAGES: Final = {
    "s3": "s3fs", "s3a": "s3fs", "gs": "gcsfs", "gcs": "gcsfs", "sftp": "paramiko",
    "ssh": "paramiko", "az": "adlfs", "abfs": "adlfs", "http": "aiohttp", "https": "aiohttp",
}  # fmt: skip
"""Packages that fsspec requires in addition, by the scheme of the URL."""
_USER: Final = re.compile(r"(?<=://)[^/@]*@")


class StorageError(WorkError):
    """A location that cannot be accessed; the text states the location and the reason."""


class BatchItem(msgspec.Struct, frozen=True):
    """One recording to be processed: its parts, in order."""

    locations: tuple[str, ...]

    @property
    def location(self) -> str:
        """Path or URL of the first part, without user name and password."""
        return without_user(self.locations[0])

    @property
    def is_fetched(self) -> bool:
        """Whether a part of the recording is remote."""
        return any(map(is_url, self.locations))


def is_url(name: str) -> bool:
    """Return whether fsspec has to open it; `file://` counts too."""
    return MARK in name


def without_user(url: str) -> str:
    """Return a URL without user name and password, so that it can be shown and stored."""
    return _USER.sub("", url)


def items_of(names: Sequence[str]) -> list[BatchItem]:
    """Find the recordings for some names.

    Raises StorageError if a name matches nothing, or its storage cannot be accessed.
    """
    locations = list(dict.fromkeys(location for name in names for location in _locations(name)))
    by_path = {Path(location): location for location in locations}
    with_table = {_series(path) for path in by_path if _ending(path) == ".csv"}
    wanted = [p for p in by_path if _ending(p) == ".csv" or _series(p) not in with_table]
    return [
        BatchItem(tuple(_plain(by_path[path]) for path in paths))
        for paths in parts_together(wanted)
    ]


def stamp_of_item(item: BatchItem) -> str:
    """Return a hexadecimal digest that changes when a recording changes.

    It is the SHA-256 of local files, or of the versions that a storage reports, so that remote
    files are not fetched; raises OSError and StorageError.
    """
    if item.is_fetched:
        stamps = [_stamp_of(location) for location in item.locations]
        if all(stamps):
            return sha256("\n".join(stamps).encode()).hexdigest()
    with local_files(item) as paths:
        return digest_of_files(paths)


def digest_of_files(paths: Sequence[Path]) -> str:
    """Return the SHA-256 of a recording's files; raises OSError."""
    digests = [digest_of(path) for path in paths]
    return digests[0] if len(digests) == 1 else sha256("".join(digests).encode()).hexdigest()


@contextmanager
def local_files(item: BatchItem) -> Iterator[list[Path]]:
    """Provide the files of a recording on the local disk."""
    if not item.is_fetched:
        yield [Path(location) for location in item.locations]
        return
    with TemporaryDirectory(prefix="mavgate-") as folder:
        yield [
            _fetched(location, Path(folder, str(k))) for k, location in enumerate(item.locations)
        ]


def _fetched(location: str, folder: Path) -> Path:
    if not is_url(location):
        return Path(location)
    folder.mkdir()
    path = folder / location.rsplit("/", 1)[-1]
    storage, remote = _storage(location)
    with _storage_errors(location):
        storage.get_file(remote, str(path))
    return path


def _locations(name: str) -> list[str]:
    if not is_url(name):
        path = Path(name)
        return [str(found) for found in recordings_below(path)] if path.is_dir() else [name]
    storage, remote = _storage(name)
    with _storage_errors(name):
        if "*" in remote:
            found = storage.glob(remote)
        elif storage.isdir(remote):
            found = storage.find(remote)
        else:
            return [name]
    # The path of a remote file lacks the host of its URL.
    plain = name.rstrip("/")
    begin = plain.removesuffix(remote) if plain.endswith(remote) else None
    locations = [
        storage.unstrip_protocol(location) if begin is None else begin + location
        for location in sorted(found)
        if _ending(Path(location)) in REMOTE_ENDINGS
    ]
    if not locations:
        endings = ", ".join(REMOTE_ENDINGS)
        raise StorageError(f"{without_user(name)}: contains no recording ({endings})")
    return locations


def _plain(location: str) -> str:
    if not is_url(location):
        return str(Path(location).absolute())
    storage, remote = _storage(location)
    protocols = {storage.protocol} if isinstance(storage.protocol, str) else {*storage.protocol}
    return remote if HERE in protocols else location


def _stamp_of(location: str) -> str:
    """Return a file's location, size and modification as its storage reports them, or empty."""
    if not is_url(location):
        return ""
    storage, remote = _storage(location)
    with _storage_errors(location):
        facts = storage.info(remote)
    stamps = [str(facts[name]) for name in STAMPS if facts.get(name)]
    return "\t".join([without_user(location), str(facts.get("size")), *stamps]) if stamps else ""


def _storage(url: str) -> tuple[Any, str]:
    """Return a file system of fsspec and the path on it; raises StorageError."""
    fsspec = import_module("fsspec")
    try:
        with _storage_errors(url):
            storage, remote = fsspec.core.url_to_fs(url)
    except ImportError as error:
        package = PACKAGES.get(url.partition(MARK)[0])
        how = f"{sys.executable} -m pip install {package}" if package else str(error)
        raise StorageError(f"{without_user(url)}: needs another package:\n{how}") from error
    return storage, remote


@contextmanager
def _storage_errors(url: str) -> Iterator[None]:
    """Raise any exception of a storage as StorageError, except for missing packages."""
    try:
        yield
    except (ImportError, StorageError):
        raise
    except FileNotFoundError as error:
        raise StorageError(f"{without_user(url)}: does not exist") from error
    # The storages of fsspec raise exceptions of their own packages.
    except Exception as error:
        text = str(error) or type(error).__name__
        raise StorageError(f"{without_user(url)}: {without_user(text)}") from error


def _ending(path: Path) -> str:
    return Path(path.name.removesuffix(GZIP)).suffix


def _series(path: Path) -> tuple[Path, str]:
    return path.parent, recording_name(path)
