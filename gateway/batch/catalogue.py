"""Catalogue of the recordings in a folder: a SQLite file that is updated and queried."""

import math
import os
import sqlite3
import struct
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from hashlib import file_digest
from operator import itemgetter
from pathlib import Path, PurePath
from typing import Any, Final, get_type_hints
from urllib.parse import quote

import msgspec

from gateway.batch.executors import Executor, WorkFailed
from gateway.batch.facts import CataloguedFlight, Flown, Segments, flights_of
from gateway.printable import UserError
from gateway.recordings.file_format import NO_RECORDING, has_signature
from gateway.recordings.files import GZIP, FlightError, open_file
from gateway.recordings.formats.maps import track_feature
from gateway.recordings.index import as_text, recording_name
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.recording import open_recording
from gateway.recordings.summary import read_summary
from gateway.records import NAN
from gateway.units import DEG_PER_DEGE7, M_PER_CM
from gateway.vehicle_state.positions import TrackPoint

CATALOGUE_NAME: Final = "catalogue.sqlite"
SCHEMA: Final = 3
"""Version of the schema; a catalogue of another version is recreated."""
BUSY_S: Final = 10.0
"""Time that a writer waits for another one to finish, s."""

_FILE_COLUMNS: Final = {
    "path": "TEXT NOT NULL", "name": "TEXT NOT NULL", "kind": "TEXT", "size": "INTEGER NOT NULL",
    "modified": "INTEGER NOT NULL", "digest": "TEXT NOT NULL", "error": "TEXT",
}  # fmt: skip
_SQL: Final = {int | None: "INTEGER", float | None: "REAL", str | None: "TEXT"}
_FACT_COLUMNS: Final = {name: _SQL[kind] for name, kind in get_type_hints(CataloguedFlight).items()}
COLUMNS: Final = (*_FILE_COLUMNS, *_FACT_COLUMNS)
"""Columns that a query can use."""
_POSITION: Final = struct.Struct("<iii")
"""A position: latitude and longitude in 1e-7 deg, height in cm."""
_UNKNOWN: Final = -(1 << 31)
"""Unknown height; as a latitude, an interruption of the track."""
_BREAK: Final = _POSITION.pack(_UNKNOWN, 0, 0)
_DAMAGED: Final = "if it is damaged or not a catalogue, delete it and index again"
_NOT_WRITABLE: Final = "make the folder of the recordings writable, or copy them"
_REMEDIES: Final = {
    sqlite3.SQLITE_FULL: "make room on the disk and index again",
    sqlite3.SQLITE_BUSY: "another process is indexing; wait for its end",
    sqlite3.SQLITE_READONLY: _NOT_WRITABLE,
    sqlite3.SQLITE_CANTOPEN: _NOT_WRITABLE,
}

Row = dict[str, Any]
ENDINGS: Final = (".tlog", ".csv")
"""Suffixes of recordings; other files are checked for the first bytes of known formats."""
LATEST_NS: Final = 2**63 - 1
"""Greatest integer that SQLite stores; the modification time of a file may exceed it."""
KEEP_S: Final = 1.0
"""Interval of storing the files read so far, which bounds the loss by an interruption."""
Wanted = tuple[str, str]
"""Path relative to the folder, and the known digest, or empty if unknown."""


class CatalogueError(UserError):
    """A catalogue that cannot be read, or an invalid query."""


@dataclass(frozen=True, slots=True)
class CataloguedFile:
    """A file with the state at its last reading, and a flight for each of its vehicles."""

    path: str
    """Path relative to the folder of the catalogue."""
    name: str
    """Name of the recording to which the file belongs."""
    kind: str | None
    size: int
    modified_ns: int
    digest: str
    """SHA-256 of the content, hexadecimal."""
    error: str | None = None
    flights: tuple[Flown, ...] = ()
    """One flight per vehicle; empty for an unreadable file."""


class Catalogue:
    """The catalogue, open for writing."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / CATALOGUE_NAME
        with _catalogue_errors(self.path), ExitStack() as opened:
            self._db = opened.enter_context(closing(sqlite3.connect(self.path, timeout=BUSY_S)))
            if not self._is_made():
                self._make()
            opened.pop_all()

    def close(self) -> None:
        """Commit the changes, and close the catalogue."""
        with _catalogue_errors(self.path), closing(self._db):
            self._db.commit()

    def known(self) -> dict[str, tuple[int, int, str]]:
        """Return size, modification time and digest of every file, by path."""
        with _catalogue_errors(self.path):
            rows = self._db.execute("SELECT DISTINCT path, size, modified, digest FROM flights")
            return {path: (*stamp, digest) for path, *stamp, digest in rows}

    def put(self, files: Iterable[CataloguedFile]) -> None:
        """Replace the rows of files, all or none of them."""
        with _catalogue_errors(self.path), self._db:
            for file in files:
                self._delete(file.path)
                self._insert(file)

    def touch(self, path: str, modified_ns: int) -> None:
        """Store a new modification time of a file whose content is unchanged."""
        with _catalogue_errors(self.path), self._db:
            self._db.execute("UPDATE flights SET modified = ? WHERE path = ?", (modified_ns, path))

    def discard(self, paths: Iterable[str]) -> None:
        """Remove files that no longer exist."""
        with _catalogue_errors(self.path), self._db:
            for path in paths:
                self._delete(path)

    def _is_made(self) -> bool:
        return bool(self._db.execute("PRAGMA user_version").fetchone()[0] == SCHEMA)

    def _make(self) -> None:
        columns = {**_FILE_COLUMNS, **_FACT_COLUMNS}
        listed = ", ".join(f"{name} {kind}" for name, kind in columns.items())
        with self._db:
            # Another process may just have created the tables, and filled them.
            self._db.execute("BEGIN IMMEDIATE")
            if self._is_made():
                return
            self._db.execute("DROP TABLE IF EXISTS flights")
            self._db.execute("DROP TABLE IF EXISTS tracks")
            self._db.execute(f"CREATE TABLE flights (id INTEGER PRIMARY KEY, {listed})")
            self._db.execute("CREATE INDEX flights_path ON flights (path)")
            self._db.execute("CREATE TABLE tracks (id INTEGER PRIMARY KEY, places BLOB NOT NULL)")
            self._db.execute(f"PRAGMA user_version = {SCHEMA}")

    def _delete(self, path: str) -> None:
        ids = "SELECT id FROM flights WHERE path = ?"
        self._db.execute(f"DELETE FROM tracks WHERE id IN ({ids})", (path,))
        self._db.execute("DELETE FROM flights WHERE path = ?", (path,))

    def _insert(self, file: CataloguedFile) -> None:
        of_file = (file.path, file.name, file.kind, file.size, file.modified_ns, file.digest)
        marks = ", ".join("?" * len(COLUMNS))
        for facts, track in file.flights or ((CataloguedFlight(), []),):
            cursor = self._db.execute(
                f"INSERT INTO flights ({', '.join(COLUMNS)}) VALUES ({marks})",
                (*of_file, file.error, *msgspec.structs.astuple(facts)),
            )
            if track:
                packed = _BREAK.join(b"".join(map(_packed, points)) for points in track)
                self._db.execute("INSERT INTO tracks VALUES (?, ?)", (cursor.lastrowid, packed))


def find_flights(folder: Path, where: str = "") -> list[Row]:
    """Return the flights of a catalogue that satisfy a condition.

    Raises CatalogueError if there is no catalogue, or the condition is invalid.
    """
    with _open_read_only(folder) as db:
        rows = _select(db, ", ".join(COLUMNS), where)
        return [dict(zip(COLUMNS, row, strict=True)) for row in rows]


class FlightFigures(msgspec.Struct, frozen=True):
    """Duration in s, distance over ground in m, greatest height in m, share of lost samples.

    None if unknown.
    """

    duration: float
    distance: float | None = None
    highest: float | None = None
    height_above: str | None = None
    """Zero of the height: `home` or `first position`."""
    loss: float | None = None


Figures = dict[PurePath, dict[int | None, FlightFigures]]
"""Figures by recording (path with folder) and by vehicle."""


def figures_of(rows: Iterable[Row]) -> Figures:
    """Sum up the recordings of a catalogue; all lists of recordings use this function.

    The tables and tlogs of a recording contain the same flight: the tlog's positions have priority,
    since it contains home, and the table's loss. The parts of a recording are added up; unreadable
    ones are left out.
    """
    parts: dict[tuple[PurePath, int | None], list[Row]] = {}
    for row in rows:
        if row["error"] is None:
            key = (PurePath(row["path"]).with_name(row["name"]), row["vehicle"])
            parts.setdefault(key, []).append(row)
    found: Figures = {}
    for (path, vehicle), of_flight in parts.items():
        lengths_s: defaultdict[str, float] = defaultdict(float)
        for row in of_flight:
            lengths_s[row["kind"]] += row["duration"] or 0.0
        located = _rows_with(of_flight, "distance", "tlog")
        distances = [row["distance"] for row in located]
        highest = [row for row in located if row["highest"] is not None]
        top = max(highest, key=itemgetter("highest"), default={})
        losses = [row["loss"] for row in _rows_with(of_flight, "loss", "table")]
        found.setdefault(path, {})[vehicle] = FlightFigures(
            max(lengths_s.values()),
            sum(distances) if distances else None,
            top.get("highest"),
            top.get("height_above"),
            sum(losses) / len(losses) if losses else None,
        )
    return found


def _rows_with(rows: list[Row], column: str, preferred: str) -> list[Row]:
    """Return the rows of one kind of file, if possible the preferred one, that have a value."""
    known = [row for row in rows if row[column] is not None]
    kind = max((row["kind"] for row in known), key=lambda kind: kind == preferred, default="")
    return [row for row in known if row["kind"] == kind]


def geojson_of(folder: Path, where: str = "") -> dict[str, Any]:
    """Return the tracks of flights as GeoJSON; see `find_flights`."""
    with _open_read_only(folder) as db:
        packed = dict(db.execute("SELECT id, places FROM tracks"))
        found = [
            (row[0], dict(zip(COLUMNS, row[1:], strict=True)))
            for row in _select(db, f"id, {', '.join(COLUMNS)}", where)
        ]
    tracks = [
        track_feature(_unpacked(packed[number]), row) for number, row in found if number in packed
    ]
    return {"type": "FeatureCollection", "features": tracks}


@contextmanager
def _open_read_only(folder: Path) -> Iterator[sqlite3.Connection]:
    path = folder / CATALOGUE_NAME
    # If the disk is full, indexing leaves an empty file.
    if not path.exists() or not path.stat().st_size:
        raise CatalogueError(f"{folder} has no catalogue yet; `mavgate info {folder}` creates one")
    with _catalogue_errors(path):
        db = sqlite3.connect(
            f"file:{quote(str(path.absolute()))}?mode=ro", uri=True, timeout=BUSY_S
        )
        try:
            if db.execute("PRAGMA user_version").fetchone()[0] != SCHEMA:
                raise CatalogueError(
                    f"{path} is of another version; `mavgate info {folder}` recreates it"
                )
            yield db
        finally:
            db.close()


def _select(db: sqlite3.Connection, columns: str, where: str) -> Sequence[tuple[Any, ...]]:
    """Run a query with a condition in SQL, on a connection that only reads."""
    condition = f"WHERE ({where}\n)" if where.strip() else ""
    try:
        return db.execute(
            f"SELECT {columns} FROM flights {condition} ORDER BY began, path"
        ).fetchall()
    except (sqlite3.Error, sqlite3.Warning, ValueError) as error:
        raise CatalogueError(
            f"--where {where[:200]!r}: {error}; write a condition such as "
            f"'duration > 300 and loss > 0.05', of {', '.join(COLUMNS)}"
        ) from error


@contextmanager
def _catalogue_errors(path: Path) -> Iterator[None]:
    """Raise SQLite's errors as CatalogueError, with the catalogue's path and a remedy."""
    try:
        yield
    except sqlite3.Error as error:
        # The lowest byte is the basic error code; the others make it more specific.
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF
        raise CatalogueError(f"{path}: {error}; {_REMEDIES.get(code, _DAMAGED)}") from error


def _packed(at: TrackPoint) -> bytes:
    alt_cm = round(at.alt_amsl_m * 100.0) if math.isfinite(at.alt_amsl_m) else _UNKNOWN
    return _POSITION.pack(
        round(at.lat_deg / DEG_PER_DEGE7), round(at.lon_deg / DEG_PER_DEGE7), alt_cm
    )


def _unpacked(packed: bytes) -> Segments:
    segments: Segments = [[]]
    for lat, lon, alt_cm in _POSITION.iter_unpack(packed):
        if lat == _UNKNOWN:
            segments.append([])
            continue
        alt_m = NAN if alt_cm == _UNKNOWN else alt_cm * M_PER_CM
        at = TrackPoint(0, lat * DEG_PER_DEGE7, lon * DEG_PER_DEGE7, alt_m)
        segments[-1].append(at)
    return segments


@dataclass(frozen=True, slots=True)
class IndexReport:
    """Counts of an indexing run."""

    read: int
    unchanged: int
    gone: int
    broken: int
    """Number of unreadable files among those that were read."""


def index_folder(
    folder: Path,
    options: ReadOptions,
    executor: Executor,
    on_progress: Callable[[int, int], None] | None = None,
) -> IndexReport:
    """Update the catalogue of a folder.

    Raises CatalogueError if the catalogue cannot be written.
    """
    with closing(Catalogue(folder)) as catalogue:
        known = catalogue.known()
        there = {as_text(str(path.relative_to(folder))): path for path in recordings_below(folder)}
        gone = known.keys() - there.keys()
        catalogue.discard(gone)
        wanted = [
            (str(path.relative_to(folder)), known[name][2] if name in known else "")
            for name, path in there.items()
            if name not in known or _stamp_if_there(path) != known[name][:2]
        ]
        read = broken = 0
        waiting: list[CataloguedFile] = []
        kept_s = time.monotonic()
        try:
            for number, outcome in executor.run(partial(read_file, folder, options), wanted):
                name, digest = wanted[number]
                file = _file_of(folder, name, outcome)
                read += 1
                if file.digest and file.digest == digest:
                    catalogue.touch(file.path, file.modified_ns)
                else:
                    waiting.append(file)
                    broken += file.error is not None
                if time.monotonic() - kept_s > KEEP_S:
                    catalogue.put(waiting)
                    waiting, kept_s = [], time.monotonic()
                if on_progress is not None:
                    on_progress(read, len(wanted))
        finally:
            catalogue.put(waiting)
    return IndexReport(read, len(there) - len(wanted), len(gone), broken)


def recordings_below(folder: Path) -> Iterator[Path]:
    """Find all files that may be recordings, sorted by path; hidden ones are skipped."""
    for inner, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(inner, name)
            if not name.startswith(".") and path.is_file() and _may_be_recording(path):
                yield path


def read_file(folder: Path, options: ReadOptions, wanted: Wanted) -> CataloguedFile:
    """Read one file for the catalogue; a failure is stored as its `error`."""
    name, known_digest = wanted
    path = folder / name
    found = CataloguedFile(as_text(name), as_text(recording_name(path)), None, 0, 0, "")
    try:
        size, modified_ns = _stamp(path)
        found = replace(found, size=size, modified_ns=modified_ns, digest=digest_of(path))
        if found.digest == known_digest:
            return found
        recording = open_recording(path)
        found = replace(found, kind=recording.kind)
        flights = tuple(flights_of(read_summary(recording, None, lambda: options)))
    except OSError as error:
        return replace(found, error=error.strerror or as_text(str(error)))
    except (FlightError, ValueError) as error:
        return replace(found, error=as_text(str(error).removeprefix(f"{path}: ")))
    return replace(found, flights=flights, error=None if flights else NO_RECORDING)


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file's bytes; raises OSError."""
    with open_file(path) as file:
        return file_digest(file, "sha256").hexdigest()


def _file_of(folder: Path, name: str, outcome: CataloguedFile | WorkFailed) -> CataloguedFile:
    if isinstance(outcome, CataloguedFile):
        return outcome
    path = folder / name
    size, modified_ns = _stamp_if_there(path) or (0, 0)
    recording = as_text(recording_name(path))
    return CataloguedFile(as_text(name), recording, None, size, modified_ns, "", outcome.reason)


def _stamp(path: Path) -> tuple[int, int]:
    found = path.stat()
    return found.st_size, min(found.st_mtime_ns, LATEST_NS)


def _stamp_if_there(path: Path) -> tuple[int, int] | None:
    try:
        return _stamp(path)
    except OSError:
        return None


def _may_be_recording(path: Path) -> bool:
    if path.name.removesuffix(GZIP).endswith(ENDINGS):
        return True
    try:
        return has_signature(path)
    except OSError:
        return False
