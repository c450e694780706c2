"""Tiles of the map: from a file, or from the network with a cache on disk.

Browsers load tiles only from this panel, so that cached tiles work without a network, and the
map's owner does not see the users.
"""

import asyncio
import hashlib
import logging
import re
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Final

import httpx
from fastapi import FastAPI
from pmtiles.reader import MmapSource, Reader
from pmtiles.tile import MagicNumberNotFound
from starlette.responses import Response

from gateway import __version__
from gateway.panel.panel_settings import MapStyle, PanelSettings

log = logging.getLogger(__name__)

FRESH_S: Final = 30 * 86_400
"""An older tile is fetched again, and still used if that fails."""
MAX_TILE: Final = 1 << 20
"""Bytes of a tile; reading stops beyond it."""
TIMEOUT_S: Final = 6.0
AT_ONCE: Final = 4
"""Parallel requests to one server, as tile servers' policies ask."""
TIDY_EVERY: Final = 200
"""Tiles fetched between two checks of the folder's size."""
MAX_ZOOM: Final = 24
BROWSER_S: Final = 3600
MAX_FILES: Final = 16
STYLE_NAME: Final = re.compile(r"[\w .-]{1,32}")
SIGNATURES: Final = (
    (b"\x89PNG", "image/png"),
    (b"\xff\xd8\xff", "image/jpeg"),
    (b"RIFF", "image/webp"),
)


def kind_of_image(data: bytes) -> str | None:
    """Return the media type of a picture by its first bytes; None for anything else."""
    return next((kind for head, kind in SIGNATURES if data.startswith(head)), None)


def styles_of(settings: PanelSettings) -> list[MapStyle]:
    """Return the styles of the settings, and one for each PMTiles file in the tiles' folder."""
    folder = Path(settings.tiles_folder).expanduser()
    found = [
        MapStyle(name=path.stem[:32], url=str(path), max_zoom=MAX_ZOOM)
        for path in sorted(folder.glob("*.pmtiles"))[:MAX_FILES]
        if STYLE_NAME.fullmatch(path.stem[:32])
    ]
    return [*settings.map_styles, *found]


class MapTiles:
    """The styles of the settings.

    Parameters
    ----------
    settings : PanelSettings
        Styles, folder and its limit.
    """

    def __init__(self, settings: PanelSettings) -> None:
        self._folder = Path(settings.tiles_folder).expanduser()
        self._limit = settings.tiles_limit_mb * 1_000_000
        self._sources = [self._source(style) for style in styles_of(settings)]
        self._fetched = 0
        self._turns = asyncio.Semaphore(AT_ONCE)
        self._client: httpx.AsyncClient | None = None

    def serve(self, app: FastAPI) -> None:
        """Serve `/tiles/STYLE/Z/X/Y`; without a tile the page shows the grid."""

        @app.get("/tiles/{style}/{z}/{x}/{y}")
        async def _tile(style: int, z: int, x: int, y: int) -> Response:
            data = await self.tile(style, z, x, y)
            kind = None if data is None else kind_of_image(data)
            if kind is None:
                return Response(status_code=204, headers={"cache-control": "no-store"})
            headers = {"cache-control": f"max-age={BROWSER_S}"}
            return Response(data, media_type=kind, headers=headers)

    async def tile(self, style: int, z: int, x: int, y: int) -> bytes | None:
        """Return one tile; None if there is none, or it cannot be fetched.

        Parameters
        ----------
        style : int
            Place in the settings.
        z, x, y : int
            Zoom, column from the west, row from the north.
        """
        inside = 0 <= z <= MAX_ZOOM and 0 <= x < 1 << z and 0 <= y < 1 << z
        if not inside or not 0 <= style < len(self._sources):
            return None
        source = self._sources[style]
        if isinstance(source, MapStyle):
            return await self._kept_or_fetched(source, z, x, y)
        return await asyncio.to_thread(source, z, x, y)

    def _source(self, style: MapStyle) -> MapStyle | Callable[[int, int, int], bytes | None]:
        if style.url.startswith(("http://", "https://")):
            return style
        path = Path(style.url).expanduser()
        try:
            return _open_pmtiles(path) if path.suffix == ".pmtiles" else _open_mbtiles(path)
        except (OSError, ValueError, MagicNumberNotFound, sqlite3.Error) as error:
            log.warning(
                "map style %r: %s: %s", style.name, path, str(error) or "is no PMTiles file"
            )
            return lambda *_: None

    async def _kept_or_fetched(self, style: MapStyle, z: int, x: int, y: int) -> bytes | None:
        folder = hashlib.sha256(style.url.encode()).hexdigest()[:16]
        file = self._folder / folder / str(z) / str(x) / str(y)
        kept = await asyncio.to_thread(_read, file)
        if kept is not None and time.time() - kept[1] < FRESH_S:
            return kept[0]
        data = await self._fetch(style.url.format(z=z, x=x, y=y))
        if data is None:
            return None if kept is None else kept[0]
        await asyncio.to_thread(self._keep, file, data)
        return data

    async def _fetch(self, url: str) -> bytes | None:
        if self._client is None:
            # A packed answer could become larger than its limit when unpacked.
            headers = {"user-agent": f"mavgate/{__version__}", "accept-encoding": "identity"}
            self._client = httpx.AsyncClient(headers=headers, timeout=TIMEOUT_S)
        async with self._turns:
            try:
                async with self._client.stream("GET", url) as answer:
                    if answer.status_code != httpx.codes.OK:
                        return None
                    data = b""
                    async for chunk in answer.aiter_raw():
                        data += chunk
                        if len(data) > MAX_TILE:
                            return None
            except httpx.HTTPError as error:
                log.debug("%s: %s", url, error)
                return None
        return data if kind_of_image(data) else None

    def _keep(self, file: Path, data: bytes) -> None:
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            fresh = file.with_suffix(".new")
            fresh.write_bytes(data)
            fresh.replace(file)
        except OSError as error:
            log.debug("tile not kept: %s", error)
        self._fetched += 1
        if self._fetched % TIDY_EVERY == 0:
            tidy(self._folder, self._limit)


def tidy(folder: Path, limit: int) -> None:
    """Delete the oldest files below a folder until the rest is within a limit in bytes."""
    files = []
    for file in folder.rglob("*"):
        if file.is_file() and file.suffix != ".pmtiles":
            stat = file.stat()
            files.append((stat.st_mtime, stat.st_size, file))
    excess = sum(size for _, size, _ in files) - limit
    for _, size, file in sorted(files, key=lambda entry: entry[0]):
        if excess <= 0:
            return
        file.unlink(missing_ok=True)
        excess -= size


def _read(file: Path) -> tuple[bytes, float] | None:
    try:
        return file.read_bytes(), file.stat().st_mtime
    except OSError:
        return None


def _open_mbtiles(path: Path) -> Callable[[int, int, int], bytes | None]:
    """Open an MBTiles file: SQLite, whose rows count from the south."""
    if not path.is_file():
        raise FileNotFoundError("there is no such file")
    place = f"{path.resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(place, uri=True)) as database:
        database.execute("select tile_data from tiles limit 1")

    def get(z: int, x: int, y: int) -> bytes | None:
        ask = "select tile_data from tiles where zoom_level=? and tile_column=? and tile_row=?"
        with closing(sqlite3.connect(place, uri=True)) as database:
            row = database.execute(ask, (z, x, (1 << z) - 1 - y)).fetchone()
        return None if row is None else bytes(row[0])

    return get


def _open_pmtiles(path: Path) -> Callable[[int, int, int], bytes | None]:
    with path.open("rb") as file:
        reader = Reader(MmapSource(file))
    reader.header()
    get: Callable[[int, int, int], bytes | None] = reader.get
    return get
