"""Work on recordings in other processes: their catalogue, and exports to other formats.

One export and one indexing run at a time, at the lowest priority, so that neither the gateway nor
the page waits for them. The rows of the catalogue are reloaded when it changed, and searched.
"""

import asyncio
import logging
import math
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from zipfile import ZIP_DEFLATED, ZipFile

from fastapi import FastAPI
from starlette.responses import FileResponse, PlainTextResponse, Response

from gateway.batch.catalogue import CATALOGUE_NAME, CatalogueError, Row, find_flights, geojson_of
from gateway.live.terminal import own_command
from gateway.recordings.index import Recording, find_recording

OPERATORS: Final = frozenset("<>=")
"""Characters that make a search a condition."""

NO_CATALOGUE: Final = "Duration, distance, height and loss appear once the recordings are indexed."
THUMBNAIL: Final = (46.0, 24.0)
"""Size of the drawing of a track."""
MAX_CORNERS: Final = 60


class RecordingFacts:
    """The rows of a folder's catalogue by recording, if it has one."""

    def __init__(self) -> None:
        self._asked: tuple[Path, tuple[int, int] | None, str] | None = None
        self._rows: dict[str, Row] = {}
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
            self._rows = {} if stamp is None else _by_name(find_flights(folder))
            self._tracks = {} if stamp is None else _thumbnails(geojson_of(folder))
            self._found = (
                frozenset(row["name"] for row in find_flights(folder, search))
                if is_condition
                else None
            )
        except CatalogueError as error:
            self.trouble, self._found = str(error), frozenset()

    def of(self, name: str) -> Row | None:
        """Return the row of a recording."""
        return self._rows.get(name)

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


def _by_name(rows: Sequence[Row]) -> dict[str, Row]:
    """Choose one row per recording: of its longest file, preferably a table."""
    found: dict[str, Row] = {}
    for row in rows:
        before = found.get(row["name"])
        if before is None or _weight(row) > _weight(before):
            found[row["name"]] = row
    return found


def _weight(row: Row) -> tuple[bool, float]:
    return row["kind"] == "table", row["duration"] or 0.0


def _thumbnails(features: dict[str, Any]) -> dict[str, str]:
    """Draw the first track of each recording, north up."""
    found: dict[str, str] = {}
    for feature in features["features"]:
        places = _line_of(feature["geometry"])
        if len(places) > 1:
            found.setdefault(feature["properties"]["name"], _corners(places))
    return found


def _line_of(geometry: dict[str, Any] | None) -> list[list[float]]:
    """Return the places of a line; a line that crosses the 180th meridian has several parts."""
    if geometry is None:
        return []
    if geometry["type"] == "MultiLineString":
        return [place for part in geometry["coordinates"] for place in part]
    return list(geometry["coordinates"]) if geometry["type"] == "LineString" else []


def _corners(places: list[list[float]]) -> str:
    width, height = THUMBNAIL
    places = places[:: max(1, len(places) // MAX_CORNERS)]
    shrink = math.cos(math.radians(places[0][1]))
    east = [(place[0] - places[0][0] + 540.0) % 360.0 - 180.0 for place in places]
    points = [(x * shrink, -place[1]) for x, place in zip(east, places, strict=True)]
    left, top = (min(values) for values in zip(*points, strict=True))
    right, bottom = (max(values) for values in zip(*points, strict=True))
    scale = min((width - 4) / max(right - left, 1e-9), (height - 4) / max(bottom - top, 1e-9))
    return " ".join(f"{2 + (x - left) * scale:.1f},{2 + (y - top) * scale:.1f}" for x, y in points)


log = logging.getLogger(__name__)

PATH: Final = "/exports/"
LOWEST: Final = ("nice", "-n", "19")
EXPORT_S: Final = 900.0
"""Longest time for an export; a first start may compile for a minute of it."""
KEPT_S: Final = 600.0
"""After which a file that was made and not fetched is deleted."""
MAX_WAITING: Final = 4
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


@dataclass(slots=True)
class _Made:
    file: Path
    made_s: float


class RecordingJobs:
    """The catalogue and the exports of all pages."""

    def __init__(self) -> None:
        self._made: dict[str, _Made] = {}
        self._folder: Path | None = None
        self._exporting = asyncio.Lock()
        self._waiting = 0
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

    async def export(self, folder: Path, name: str, kind: str) -> str:
        """Export a recording, and return the address of the file.

        Raises ExportError if it cannot be made; RecordingError if there is no such recording.
        """
        if self._waiting >= MAX_WAITING:
            raise ExportError("other exports are being made; try again in a while")
        find_recording(folder, name)
        self._waiting += 1
        try:
            async with self._exporting:
                return await self._export(folder, name, kind)
        finally:
            self._waiting -= 1

    def close(self) -> None:
        """Delete what was made."""
        if self._indexing is not None:
            self._indexing.cancel()
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)

    def serve(self, app: FastAPI) -> None:
        """Serve the files that were made, each under an address that cannot be guessed."""

        @app.get(PATH + "{token}")
        async def _fetch(token: str) -> Response:
            made = self._made.get(token)
            if made is None or not made.file.is_file():
                return PlainTextResponse("this file is no longer there: export it again", 404)
            return FileResponse(made.file, filename=made.file.name)

    async def _export(self, folder: Path, name: str, kind: str) -> str:
        self._delete_old()
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="mavgate-export-"))
        token = secrets.token_urlsafe(16)
        place = self._folder / token
        place.mkdir()
        try:
            target = await _make(folder, place, name, kind)
        except BaseException:
            # Half a file of a large recording may take gigabytes.
            shutil.rmtree(place, ignore_errors=True)
            raise
        self._made[token] = _Made(target, time.monotonic())
        return f"{PATH}{token}"

    def _delete_old(self) -> None:
        for token, made in list(self._made.items()):
            if time.monotonic() - made.made_s > KEPT_S:
                shutil.rmtree(made.file.parent, ignore_errors=True)
                del self._made[token]

    async def _index(self, folder: Path) -> None:
        try:
            await _run([*own_command("catalogue"), "index", str(folder)])
        except ExportError as error:
            log.info("the recordings in %s are not indexed: %s", folder, error)


async def _make(folder: Path, place: Path, name: str, kind: str) -> Path:
    """Export a recording into an empty folder, and return the only file in it."""
    _, command, suffix = FORMATS[kind]
    target = place / f"{name}{suffix}"
    output = place / name if kind == "report" else target
    with _settings_for(folder, place) as config:
        arguments = ["--config", str(config), "-o", str(output), "--", name]
        await _run([*own_command(command), *arguments])
    if kind == "report":
        await asyncio.to_thread(_pack, output, target)
        shutil.rmtree(output, ignore_errors=True)
    return target


@contextmanager
def _settings_for(folder: Path, place: Path) -> Iterator[Path]:
    """Write settings with the folder of the recordings, which commands take names from."""
    config = place / "settings.toml"
    quoted = str(folder).replace("\\", "\\\\").replace('"', '\\"')
    config.write_text(f'[recording]\nfolder = "{quoted}"\n')
    try:
        yield config
    finally:
        with suppress(FileNotFoundError):
            config.unlink()


async def _run(command: list[str]) -> None:
    """Run a command; raises ExportError with its last line, or after the longest time."""
    child = await asyncio.create_subprocess_exec(
        *LOWEST,
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
