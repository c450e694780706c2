"""Recordings: download and upload, their catalogue, and exports to other formats.

File names from the browser are always checked: a recording must be one of the existing ones, and
an upload gets a name that follows the rules of recordings. An upload is written to a temporary
file, checked, and only then gets its name. A download is packed while it is sent, so it needs no
space on the disk.

Exports and the catalogue are made by other processes at a lower priority, so that neither the
gateway nor the page waits for them: one export of each role at a time, so that no operator waits
for a viewer. A file is deleted once everyone who asked for it has fetched it.
"""

import asyncio
import json
import logging
import math
import os
import secrets
import shutil
import stat
import tempfile
import time
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Generator, Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from pathlib import Path, PurePath
from typing import Any, BinaryIO, Final
from urllib.parse import quote
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from fastapi import FastAPI
from starlette.background import BackgroundTask
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse

from gateway.batch.catalogue import (
    CATALOGUE_NAME,
    CatalogueError,
    Figures,
    FlightFigures,
    figures_of,
    find_flights,
    geojson_of,
)
from gateway.geometry.angle import wrap_180
from gateway.live.terminal import own_command
from gateway.panel.access import RECORDINGS, ROLE
from gateway.panel.admission import LOCAL, Holder, Places, Role
from gateway.recordings.columns import TableRow
from gateway.recordings.convert import Pieces
from gateway.recordings.files import TABLE, TLOG, format_of
from gateway.recordings.index import Recording, RecordingError, check_free, find_recording
from gateway.recordings.table import TableReader
from gateway.recordings.tlog import TlogScanner

log = logging.getLogger(__name__)

LOOKED_AT: Final = 1 << 20
CHUNK: Final = 1 << 18
KINDS: Final[dict[str | None, str]] = {TLOG: "_01.tlog", TABLE: "_01_v1.csv"}
"""Kinds that can be uploaded, and the ending of their files."""


def add_recording_files(app: FastAPI, folder_of: Callable[[], Path]) -> None:
    """Serve `GET /recordings/NAME` (a ZIP of its files) and `PUT /recordings/NAME`."""

    @app.get(RECORDINGS + "{name}")
    async def _download(name: str) -> Response:
        try:
            files = [
                file
                for file in find_recording(folder_of(), name).files
                if file.is_file() and not file.is_symlink()
            ]
        except RecordingError as error:
            return PlainTextResponse(str(error), HTTPStatus.NOT_FOUND)
        if not files:
            text = f"{name}: links and devices are not sent"
            return PlainTextResponse(text, HTTPStatus.FORBIDDEN)
        disposition = f"attachment; filename*=utf-8''{quote(f'{name}.zip')}"
        return StreamingResponse(
            zip_stream(files),
            media_type="application/zip",
            headers={"content-disposition": disposition},
        )

    @app.put(RECORDINGS + "{name}")
    async def _upload(name: str, request: Request) -> Response:
        folder = folder_of()
        return await answer_upload(
            request, folder, lambda: check_free(folder, name), partial(_recording_name, name)
        )


async def answer_upload(
    request: Request, folder: Path, check: Callable[[], None], name_of: Callable[[Path], str]
) -> Response:
    """Store the body of an operator's request in a folder, and return its file name.

    `check` raises ValueError or RecordingError before anything is received; `name_of` returns the
    name for the received file, or raises ValueError if its contents are wrong. `AccessControl`
    limits the size.
    """
    if request.scope[ROLE] is not Role.OPERATOR:
        return PlainTextResponse("viewers have read-only access", HTTPStatus.FORBIDDEN)
    try:
        check()
        stored = await _store(folder, request.stream(), name_of)
    except ClientDisconnect:
        return PlainTextResponse("interrupted", HTTPStatus.BAD_REQUEST)
    except (RecordingError, ValueError) as error:
        return PlainTextResponse(str(error), HTTPStatus.BAD_REQUEST)
    except OSError as error:
        text = f"cannot be stored: {error.strerror}"
        return PlainTextResponse(text, HTTPStatus.INSUFFICIENT_STORAGE)
    return PlainTextResponse(stored.name, HTTPStatus.CREATED)


def zip_stream(files: Sequence[Path]) -> Generator[bytes]:
    """Pack files into a ZIP archive, piece by piece; links and devices are left out."""
    pieces = Pieces()
    with ZipFile(pieces, "w", ZIP_DEFLATED) as packed:
        for path in files:
            with suppress(OSError), open_regular(path) as file:
                info = ZipInfo.from_file(path, path.name, strict_timestamps=False)
                info.compress_type = ZIP_DEFLATED
                with packed.open(info, "w", force_zip64=True) as entry:
                    while chunk := file.read(CHUNK):
                        entry.write(chunk)
                        yield pieces.taken()
    yield pieces.taken()


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; raises OSError for a link, a pipe or a device."""
    handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(f"{path} is not a regular file")
    return os.fdopen(handle, "rb")


async def _store(
    folder: Path, chunks: AsyncIterator[bytes], name_of: Callable[[Path], str]
) -> Path:
    """Write an upload to a temporary file, and rename it once it is checked."""
    folder.mkdir(parents=True, exist_ok=True)
    fresh = folder / f".upload-{secrets.token_hex(8)}"
    try:
        # Not by `tempfile`, whose files have the mode 0600 whatever the umask is.
        with fresh.open("xb") as file:
            async for chunk in chunks:
                file.write(chunk)
        target = folder / name_of(fresh)
        # A file that was created meanwhile is never overwritten.
        target.touch(exist_ok=False)
        fresh.replace(target)
        return target
    finally:
        with suppress(FileNotFoundError):
            fresh.unlink()


def _recording_name(name: str, path: Path) -> str:
    """Return the file name of an uploaded recording; raises ValueError if it is none."""
    suffix = KINDS.get(_kind(path))
    if suffix is None:
        allowed = " and ".join(str(kind) for kind in KINDS)
        raise ValueError(f"unknown file format: {allowed} are accepted")
    return f"{name}{suffix}"


def _kind(path: Path) -> str | None:
    """Return the kind of an upload by its first bytes; None if it is no recording."""
    kind = format_of(path)
    with path.open("rb") as file:
        head = file.read(LOOKED_AT)
    if kind == TLOG:
        batch = TlogScanner().feed(head, final=True)
        return kind if len(batch) else None
    rows = (event for event in TableReader().feed(head) if isinstance(event, TableRow))
    return kind if kind == TABLE and next(rows, None) is not None else None


OPERATORS: Final = frozenset("<>=")
"""Characters that make a search a condition."""

NO_CATALOGUE: Final = "Duration, distance, height and loss appear once the recordings are indexed."
THUMBNAIL: Final = (46.0, 24.0)
"""Size of the drawing of a track."""
MAX_CORNERS: Final = 60


class RecordingFacts:
    """Figures and tracks of a folder's recordings, if it has a catalogue."""

    def __init__(self) -> None:
        self._asked: tuple[Path, tuple[int, int] | None, str] | None = None
        self._figures: Figures = {}
        self._broken: set[str] = set()
        self._found: frozenset[str] | None = None
        self._tracks: dict[str, str] = {}
        self.trouble = ""
        """Why a search found nothing, or why nothing is known of the recordings."""

    def look(self, folder: Path, search: str = "") -> None:
        """Reload the catalogue if it changed, and search; some tens of ms for thousands of rows.

        A search is a part of a name, or a condition as for `mavgate catalogue list --where`.
        """
        stamp = _stamp(folder)
        if self._asked == (folder, stamp, search):
            return
        self._asked, self.trouble = (folder, stamp, search), "" if stamp else NO_CATALOGUE
        is_condition = not OPERATORS.isdisjoint(search)
        try:
            rows = [] if stamp is None else find_flights(folder)
            self._figures = figures_of(rows)
            self._broken = {row["name"] for row in rows if row["error"] is not None}
            self._tracks = {} if stamp is None else _thumbnails(geojson_of(folder))
            self._found = (
                frozenset(row["name"] for row in find_flights(folder, search))
                if is_condition
                else None
            )
        except CatalogueError as error:
            self.trouble, self._found = str(error), frozenset()

    def of(self, name: str) -> FlightFigures | str | None:
        """Return the figures of the vehicle that a recording holds longest, or "broken"."""
        flown = self._figures.get(PurePath(name), {})
        longest = max(flown.values(), key=lambda figures: figures.duration, default=None)
        return "broken" if longest is None and name in self._broken else longest

    def track(self, name: str) -> str:
        """Return the corners of a recording's track, `x,y` each; empty if unknown."""
        return self._tracks.get(name, "")

    def shows(self, name: str, search: str) -> bool:
        """Return whether a recording matches the search."""
        if self._found is not None:
            return name in self._found
        return search.casefold() in name.casefold()


def _stamp(folder: Path) -> tuple[int, int] | None:
    """Return a stamp that changes with the catalogue; None if there is none."""
    try:
        found = (folder / CATALOGUE_NAME).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size


def _thumbnails(features: dict[str, Any]) -> dict[str, str]:
    """Draw the first track of each recording, north up."""
    found: dict[str, str] = {}
    for feature in features["features"]:
        positions = _line_of(feature["geometry"])
        if len(positions) > 1:
            found.setdefault(feature["properties"]["name"], _corners(positions))
    return found


def _line_of(geometry: dict[str, Any] | None) -> list[list[float]]:
    """Return the positions of a line; a line that crosses the 180th meridian has several parts."""
    if geometry is None:
        return []
    if geometry["type"] == "MultiLineString":
        return [position for part in geometry["coordinates"] for position in part]
    return list(geometry["coordinates"]) if geometry["type"] == "LineString" else []


def _corners(positions: list[list[float]]) -> str:
    """Return the corners of a drawing of a line; its positions are longitude and latitude, deg."""
    width, height = THUMBNAIL
    positions = positions[:: max(1, len(positions) // MAX_CORNERS)]
    first_lon, first_lat, *_ = positions[0]
    shrink = math.cos(math.radians(first_lat))
    points = [(wrap_180(lon - first_lon) * shrink, -lat) for lon, lat, *_ in positions]
    left, top = (min(values) for values in zip(*points, strict=True))
    right, bottom = (max(values) for values in zip(*points, strict=True))
    scale = min((width - 4) / max(right - left, 1e-9), (height - 4) / max(bottom - top, 1e-9))
    return " ".join(f"{2 + (x - left) * scale:.1f},{2 + (y - top) * scale:.1f}" for x, y in points)


EXPORTS: Final = "/exports/"
LOW: Final = ("nice", "-n", "5")
"""Below the gateway and the page, but not so low that a browser that draws leaves nothing."""
EXPORT_S: Final = 900.0
"""Longest time for an export; a first start may compile for a minute of it."""
KEPT_S: Final = 600.0
"""After which a file that was made and not fetched is deleted."""
EXPORTS_OF_SESSION: Final = 2
EXPORTS_OF_ROLE: Final = 4
"""Exports that are being made, or wait for that: one of each role is made at a time."""
MAX_EXPORTED: Final = 1 << 30
"""Bytes of files that were made for one role, and not fetched; the oldest are deleted."""
INDEX_AGAIN_S: Final = 20.0
"""Shortest time between two indexings."""
FORMATS: Final = {
    "csv": ("CSV table", "convert", ".csv"),
    "tlog": ("tlog", "convert", ".tlog"),
    "kml": ("KML (Google Earth)", "convert", ".kml"),
    "gpx": ("GPX", "convert", ".gpx"),
    "mcap": ("MCAP (Foxglove)", "convert", ".mcap"),
    "page": ("Page (one HTML file)", "page", ".html"),
    "report": ("Report (figures and tables)", "report", ".zip"),
}
"""Title, command and ending of the file of each export."""


class ExportError(Exception):
    """A recording cannot be exported; the text says why."""


@dataclass(eq=False)
class _Export:
    """A file that is made, or was."""

    role: Role | None
    task: "asyncio.Task[Path] | None" = None
    users: int = 0
    """Those who have asked for it and not fetched it."""
    token: str = ""
    size: int = 0


class RecordingJobs:
    """The catalogue and the exports of all pages."""

    def __init__(self) -> None:
        self._exports: dict[Hashable, _Export] = {}
        """By role, recording and kind, oldest first."""
        self._places: Places[Hashable] = Places(
            EXPORTS_OF_SESSION, EXPORTS_OF_ROLE, EXPORTS_OF_ROLE
        )
        self._folder: Path | None = None
        self._exporting: dict[Role | None, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._indexing: asyncio.Task[None] | None = None
        self._indexed: object = None
        self._indexed_s = -INDEX_AGAIN_S

    @property
    def is_indexing(self) -> bool:
        """Whether the catalogue is being brought up to date."""
        return self._indexing is not None and not self._indexing.done()

    def index(self, folder: Path, recordings: list[Recording]) -> None:
        """Bring the catalogue of a folder up to date if its recordings have changed."""
        state = (folder, [(each.name, each.size, each.modified_s) for each in recordings])
        waits = time.monotonic() - self._indexed_s < INDEX_AGAIN_S
        if not recordings or self.is_indexing or waits or state == self._indexed:
            return
        self._indexed, self._indexed_s = state, time.monotonic()
        self._indexing = asyncio.get_running_loop().create_task(self._index(folder))

    async def export(self, folder: Path, name: str, kind: str, holder: Holder = LOCAL) -> str:
        """Export a recording, and return the address of the file; an equal one is used again.

        Raises ExportError if it cannot be made; RecordingError if there is no such recording.
        """
        recording = find_recording(folder, name)
        key = (holder.role, folder, name, kind, recording.size, recording.modified_s)
        export = self._exports.get(key)
        if export is None:
            if not self._places.admit(key, holder):
                raise ExportError("other exports are being made; try again in a while")
            export = self._exports[key] = _Export(holder.role)
            export.task = asyncio.create_task(self._export(key, export, folder, name, kind))
        task = export.task
        assert task is not None
        export.users += 1
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            export.users -= 1
            if not export.users:
                task.cancel()
                await asyncio.wait([task])
            raise
        return f"{EXPORTS}{export.token}"

    def close(self) -> None:
        """Delete what was made."""
        if self._indexing is not None:
            self._indexing.cancel()
        for export in self._exports.values():
            if export.task is not None:
                export.task.cancel()
        self._exports.clear()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def serve(self, app: FastAPI) -> None:
        """Serve the files that were made, each under an address that cannot be guessed."""

        @app.get(EXPORTS + "{token}")
        async def _fetch(token: str) -> Response:
            for key, export in self._exports.items():
                if token and export.token == token and export.task is not None:
                    file = export.task.result()
                    fetched = BackgroundTask(self._note_fetched, key, export)
                    return FileResponse(file, filename=file.name, background=fetched)
            return PlainTextResponse("this file is no longer there: export it again", 404)

    async def _note_fetched(self, key: Hashable, export: _Export) -> None:
        export.users -= 1
        if export.users <= 0:
            self._delete(key, export)

    async def _export(
        self, key: Hashable, export: _Export, folder: Path, name: str, kind: str
    ) -> Path:
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="mavgate-export-"))
        token = secrets.token_urlsafe(16)
        work = self._folder / token
        try:
            async with self._exporting[export.role]:
                work.mkdir()
                target = await _make(folder, work, name, kind)
        except BaseException:
            # Half a file of a large recording may take gigabytes.
            shutil.rmtree(work, ignore_errors=True)
            self._exports.pop(key, None)
            raise
        finally:
            self._places.release(key)
        export.token, export.size = token, target.stat().st_size
        self._make_room(export)
        asyncio.get_running_loop().call_later(KEPT_S, self._delete, key, export)
        return target

    def _make_room(self, export: _Export) -> None:
        """Delete the oldest files of a role beyond the limit of bytes."""
        made = [
            (key, each)
            for key, each in self._exports.items()
            if each.role is export.role and each.token
        ]
        excess = sum(each.size for _, each in made) - MAX_EXPORTED
        for key, each in made:
            if excess > 0 and each is not export:
                excess -= each.size
                self._delete(key, each)

    def _delete(self, key: Hashable, export: _Export) -> None:
        if self._folder is not None and self._exports.get(key) is export:
            del self._exports[key]
            shutil.rmtree(self._folder / export.token, ignore_errors=True)

    async def _index(self, folder: Path) -> None:
        try:
            await _run([*own_command("catalogue"), "index", str(folder)])
        except ExportError as error:
            log.info("the recordings in %s are not indexed: %s", folder, error)


async def _make(folder: Path, work: Path, name: str, kind: str) -> Path:
    """Export a recording into an empty folder, and return the only file in it."""
    _, command, suffix = FORMATS[kind]
    target = work / f"{name}{suffix}"
    output = work / name if kind == "report" else target
    # Settings with the folder of the recordings, which commands take names from.
    config = work / "settings.toml"
    config.write_text(f"[recording]\nfolder = {json.dumps(str(folder), ensure_ascii=False)}\n")
    arguments = ["--config", str(config), "-o", str(output), "--", name]
    await _run([*own_command(command), *arguments])
    config.unlink()
    if kind == "report":
        await asyncio.to_thread(_pack, output, target)
        shutil.rmtree(output, ignore_errors=True)
    return target


async def _run(command: list[str]) -> None:
    """Run a command; raises ExportError with its last line, or after the longest time."""
    child = await asyncio.create_subprocess_exec(
        *LOW,
        *command,
        stdin=asyncio.subprocess.DEVNULL,
        stdout=asyncio.subprocess.DEVNULL,
        stderr=asyncio.subprocess.PIPE,
    )
    try:
        async with asyncio.timeout(EXPORT_S):
            _, text = await child.communicate()
    except TimeoutError as error:
        raise ExportError(
            f"not finished after {EXPORT_S / 60.0:.0f} min, and stopped: choose a shorter "
            "recording or another format"
        ) from error
    finally:
        if child.returncode is None:
            with suppress(ProcessLookupError):
                child.kill()
            await child.wait()
    if child.returncode:
        lines = text.decode(errors="replace").strip().splitlines()
        raise ExportError(lines[-1] if lines else f"the command ended with {child.returncode}")


def _pack(folder: Path, target: Path) -> None:
    with ZipFile(target, "w", ZIP_DEFLATED) as packed:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                packed.write(file, file.relative_to(folder.parent))
