"""Keeping the catalogue of a folder: what changed is read, by many processes, the rest is not."""

import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Final

from gateway.recordings.files import (
    CHUNK,
    GZIP,
    NO_RECORDING,
    OTHER_FORMATS,
    FileKind,
    FlightError,
    first_bytes,
    kind_of,
    open_recording,
    other_format,
    read_batches,
    read_chunks,
)
from gateway.recordings.index import as_text, recording_name
from gateway.recordings.reading import ReadOptions, open_rows
from gateway.season.catalogue.catalogue_file import Catalogue, CataloguedFile
from gateway.season.executors import Executor, WorkFailed
from gateway.season.statistics.recording_tally import Flown, TableSkimmer, TlogTally, tally_rows

ENDINGS: Final = (".tlog", ".csv")
"""Files of other endings are looked at where a format knows their first bytes."""
CHUNK_FILES: Final = 8
"""Files that one process reads before it reports."""
LATEST_NS: Final = 2**63 - 1
"""The greatest number that SQLite keeps; a file's time may lie beyond it."""
KEEP_S: Final = 1.0
"""What is read is stored so often: an interruption costs no more than that."""

Wanted = tuple[str, str]
"""Path from the folder on, and the digest that is known of it or nothing."""


@dataclass(frozen=True, slots=True)
class IndexReport:
    """What an indexing did."""

    read: int = 0
    unchanged: int = 0
    gone: int = 0
    broken: int = 0
    """Of those that were read."""


def index_folder(
    folder: Path,
    options: ReadOptions,
    executor: Executor,
    on_progress: Callable[[int, int], None] | None = None,
) -> IndexReport:
    """Bring the catalogue of a folder up to date.

    Raises CatalogueError if the catalogue cannot be written.
    """
    catalogue = Catalogue(folder)
    try:
        known = catalogue.known()
        there = {as_text(str(path.relative_to(folder))): path for path in recordings_below(folder)}
        gone = known.keys() - there.keys()
        catalogue.forget(gone)
        wanted = [
            (str(path.relative_to(folder)), known[name][2] if name in known else "")
            for name, path in there.items()
            if name not in known or _stamp_if_there(path) != known[name][:2]
        ]
        report = IndexReport(unchanged=len(there) - len(wanted), gone=len(gone))
        return _read_all(catalogue, folder, options, executor, wanted, on_progress, report)
    finally:
        catalogue.close()


def recordings_below(folder: Path) -> Iterator[Path]:
    """Find all files that may be recordings, by path; hidden ones and folders are passed over."""
    for place, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(place, name)
            if not name.startswith(".") and path.is_file() and _may_be_recording(path):
                yield path


def read_file(folder: Path, options: ReadOptions, wanted: Wanted) -> CataloguedFile:
    """Read one file for the catalogue; whatever is wrong with it stands in its `error`."""
    name, known_digest = wanted
    path = folder / name
    found = CataloguedFile(as_text(name), as_text(recording_name(path)), None, 0, 0, "")
    try:
        size, modified_ns = _stamp(path)
        found = replace(found, size=size, modified_ns=modified_ns, digest=digest_of(path))
        if found.digest == known_digest:
            return found
        found = replace(found, kind=_kind_name(path))
        flights = tuple(_flights_in(path, options))
    except OSError as error:
        return replace(found, error=error.strerror or as_text(str(error)))
    except (FlightError, ValueError) as error:
        return replace(found, error=as_text(str(error).removeprefix(f"{path}: ")))
    return replace(found, flights=flights, error=None if flights else NO_RECORDING)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes; raises OSError."""
    digest = sha256()
    with open_recording(path) as file:
        while data := file.read(CHUNK):
            digest.update(data)
    return digest.hexdigest()


def _read_all(
    catalogue: Catalogue,
    folder: Path,
    options: ReadOptions,
    executor: Executor,
    wanted: list[Wanted],
    on_progress: Callable[[int, int], None] | None,
    report: IndexReport,
) -> IndexReport:
    pieces = [wanted[k : k + CHUNK_FILES] for k in range(0, len(wanted), CHUNK_FILES)]
    waiting: list[CataloguedFile] = []
    kept_s, done = time.monotonic(), 0
    try:
        for number, outcome in executor.run(partial(_read_piece, folder, options), pieces):
            piece = pieces[number]
            files = (
                [_unread(folder, name, outcome.reason) for name, _ in piece]
                if isinstance(outcome, WorkFailed)
                else outcome
            )
            known = {as_text(name): digest for name, digest in piece}
            same = [file for file in files if file.digest and file.digest == known[file.path]]
            for file in same:
                catalogue.touch(file.path, file.modified_ns)
            fresh = [file for file in files if file not in same]
            waiting += fresh
            report = replace(
                report,
                read=report.read + len(files),
                broken=report.broken + sum(file.error is not None for file in fresh),
            )
            if time.monotonic() - kept_s > KEEP_S:
                catalogue.put(waiting)
                waiting, kept_s = [], time.monotonic()
            done += len(piece)
            if on_progress is not None:
                on_progress(done, len(wanted))
    finally:
        catalogue.put(waiting)
    return report


def _read_piece(folder: Path, options: ReadOptions, piece: list[Wanted]) -> list[CataloguedFile]:
    return [read_file(folder, options, wanted) for wanted in piece]


def _unread(folder: Path, name: str, reason: str) -> CataloguedFile:
    path = folder / name
    size, modified_ns = _stamp_if_there(path) or (0, 0)
    recording = as_text(recording_name(path))
    return CataloguedFile(as_text(name), recording, None, size, modified_ns, "", reason)


def _stamp(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, min(found.st_mtime_ns, LATEST_NS)


def _stamp_if_there(path: Path) -> tuple[int, int] | None:
    """Return the same; None of a file that has gone meanwhile."""
    try:
        return _stamp(path)
    except OSError:
        return None


def _may_be_recording(path: Path) -> bool:
    if path.name.removesuffix(GZIP).endswith(ENDINGS):
        return True
    try:
        begin = first_bytes(path)
    except OSError:
        return False
    return any(knows(begin) for knows in OTHER_FORMATS.values())


def _kind_name(path: Path) -> str:
    kind = kind_of(path)
    return other_format(path) if kind is FileKind.OTHER else kind.value


def _flights_in(path: Path, options: ReadOptions) -> list[Flown]:
    kind = kind_of(path)
    if kind is FileKind.TLOG:
        tlog = TlogTally()
        for batch in read_batches(path):
            tlog.add(batch)
        return tlog.flown()
    if kind is FileKind.TABLE:
        table = TableSkimmer()
        for data in read_chunks(path):
            table.feed(data)
        return table.flown()
    rows = open_rows(path, options)
    return tally_rows(rows.plain_rows, rows.header)
