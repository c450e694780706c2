"""Tiles of the map: from a file, or from the network with a cache on disk.

Browsers load tiles only from this panel, so that cached tiles work without a network, and the
map's owner does not learn the users' addresses.
"""

import asyncio
import gzip
import hashlib
import json
import logging
import os
import re
import sqlite3
import time
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import lru_cache, partial
from html import escape, unescape
from http import HTTPStatus
from pathlib import Path
from typing import Any, Final

import httpx
from fastapi import FastAPI
from msgspec.structs import replace
from pmtiles.tile import (
    Compression,
    Entry,
    MagicNumberNotFound,
    SpecVersionUnsupported,
    TileType,
    deserialize_directory,
    deserialize_header,
    find_tile,
    zxy_to_tileid,
)
from starlette.requests import Request
from starlette.responses import Response

from gateway import __version__
from gateway.panel.access import MAPS
from gateway.panel.panel_settings import MapStyle, PanelSettings
from gateway.panel.recording_transfer import answer_upload, open_regular

log = logging.getLogger(__name__)

FRESH_S: Final = 30 * 86_400
"""Age after which a tile is fetched again; it is still used if that fails."""
MAX_TILE: Final = 1 << 20
"""Maximum bytes of a tile; reading stops beyond."""
TIMEOUT_S: Final = 6.0
AT_ONCE: Final = 4
"""Maximum parallel requests to one server, as tile servers' policies require."""
TIDY_EVERY: Final = 200
"""Tiles fetched between two checks of the folder's size."""
MAX_ZOOM: Final = 24
BROWSER_S: Final = 3600
MAX_FILES: Final = 16
STYLE_NAME: Final = re.compile(r"\w[\w .-]{0,31}")
RASTER: Final = {TileType.PNG, TileType.JPEG, TileType.WEBP}
MAX_HEADER: Final = 127
MAX_DIRECTORY: Final = 1 << 19
"""Maximum bytes of a directory, packed and unpacked; those of a large map have up to 200,000."""
MAX_DEPTH: Final = 4
MAX_ATTRIBUTION: Final = 300
MARKUP: Final = re.compile(r"<[^>]*>")
LONG_NUMBER: Final = re.compile(rb"[\x80-\xff]{10}")
"""A number of more than 64 bits: reading a very long one would take minutes."""
BROKEN: Final = (ValueError, EOFError, IndexError, OverflowError, zlib.error)
"""Errors that the library raises for damaged contents."""

GetBytes = Callable[[int, int], bytes]
"""Reads a range of bytes, given its offset and length; fewer at the end of the file."""
GetTile = Callable[[int, int, int], bytes | None]
"""Returns the tile of a zoom, column and row."""
SIGNATURES: Final = (
    (b"\x89PNG", "image/png"),
    (b"\xff\xd8\xff", "image/jpeg"),
    (b"RIFF", "image/webp"),
)


def kind_of_image(data: bytes) -> str | None:
    """Return the media type of an image by its first bytes; None for other data."""
    return next((kind for head, kind in SIGNATURES if data.startswith(head)), None)


class PmTiles:
    """A PMTiles file of raster tiles, read with bounds: its contents may be hostile.

    The library's own reader unpacks directories without a limit. Raises ValueError, with the
    reason, if it is not such a file.
    """

    def __init__(self, get_bytes: GetBytes) -> None:
        self._get_bytes = get_bytes
        try:
            self.header: dict[str, Any] = dict(deserialize_header(get_bytes(0, MAX_HEADER)))
        except (*BROKEN, MagicNumberNotFound) as error:
            raise ValueError("it is no PMTiles file") from error
        except SpecVersionUnsupported as error:
            raise ValueError("its PMTiles version is not 3: convert it") from error
        if self.header["tile_type"] not in RASTER:
            kind = self.header["tile_type"].name
            raise ValueError(f"its tiles are {kind}; the panel draws PNG, JPEG and WEBP")
        self._directory = lru_cache(maxsize=8)(self._read_directory)
        self._directory(self.header["root_offset"], self.header["root_length"])

    @property
    def max_zoom(self) -> int:
        """Greatest zoom of its tiles."""
        return min(int(self.header["max_zoom"]), MAX_ZOOM)

    def get(self, z: int, x: int, y: int) -> bytes | None:
        """Return a tile; None if there is none. Raises ValueError for a damaged directory."""
        wanted = zxy_to_tileid(z, x, y)
        return self._follow(lambda entries: find_tile(entries, wanted))

    def first_tile(self) -> bytes | None:
        """Return the first tile; raises ValueError for a damaged directory."""
        return self._follow(lambda entries: entries[0] if entries else None)

    @property
    def attribution(self) -> str:
        """The map's attribution, whose markup is removed."""
        text = unescape(str(self.metadata().get("attribution") or ""))[:MAX_ATTRIBUTION]
        return escape(MARKUP.sub("", text))

    def metadata(self) -> dict[str, Any]:
        """Return the description of the map, such as its attribution; empty if it is damaged."""
        try:
            data = self._unpacked(self.header["metadata_offset"], self.header["metadata_length"])
            found = json.loads(data)
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _follow(self, choose: Callable[[list[Entry]], Entry | None]) -> bytes | None:
        offset, length = self.header["root_offset"], self.header["root_length"]
        for _ in range(MAX_DEPTH):
            entry = choose(self._directory(offset, length))
            if entry is None:
                return None
            if entry.run_length:
                if entry.length > MAX_TILE:
                    return None
                return self._get_bytes(self.header["tile_data_offset"] + entry.offset, entry.length)
            offset, length = self.header["leaf_directory_offset"] + entry.offset, entry.length
        raise ValueError("its directories are nested too deeply")

    def _read_directory(self, offset: int, length: int) -> list[Entry]:
        data = self._unpacked(offset, length)
        if LONG_NUMBER.search(data):
            raise ValueError("a directory of it is damaged")
        try:
            # The library accepts only packed directories.
            return deserialize_directory(gzip.compress(data, 0))
        except BROKEN as error:
            raise ValueError("a directory of it is damaged") from error

    def _unpacked(self, offset: int, length: int) -> bytes:
        if length > MAX_DIRECTORY:
            raise ValueError("a directory of it is too large")
        data = self._get_bytes(offset, length)
        if self.header["internal_compression"] is Compression.NONE:
            return data
        unpacking = zlib.decompressobj(wbits=31)
        try:
            data = unpacking.decompress(data, MAX_DIRECTORY)
        except zlib.error as error:
            raise ValueError("a directory of it is damaged") from error
        if unpacking.unconsumed_tail:
            raise ValueError("a directory of it is too large")
        return data


def file_reader(path: Path) -> GetBytes:
    """Return a function that reads ranges of bytes of a file; it raises OSError or ValueError."""

    def get_bytes(offset: int, length: int) -> bytes:
        # Not mapped into memory: truncating a mapped file would crash the process.
        with open_regular(path.resolve()) as file:
            try:
                return os.pread(file.fileno(), length, offset)
            except OverflowError as error:
                raise ValueError("a directory of it is damaged") from error

    return get_bytes


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
    """The styles of the settings."""

    def __init__(self, settings: PanelSettings) -> None:
        self._folder = Path(settings.tiles_folder).expanduser()
        self._limit = settings.tiles_limit_mb * 1_000_000
        self.styles: list[MapStyle] = []
        self._sources: list[MapStyle | GetTile] = []
        for style in styles_of(settings):
            self._add(style)
        self._fetched = 0
        self._turns = asyncio.Semaphore(AT_ONCE)
        self._client: httpx.AsyncClient | None = None

    def serve(self, app: FastAPI) -> None:
        """Serve `GET /tiles/STYLE/Z/X/Y` and `PUT /maps/NAME`, which adds a PMTiles file."""

        @app.get("/tiles/{style}/{z}/{x}/{y}")
        async def _tile(style: int, z: int, x: int, y: int) -> Response:
            data = await self.tile(style, z, x, y)
            kind = None if data is None else kind_of_image(data)
            if kind is None:
                return Response(status_code=204, headers={"cache-control": "no-store"})
            headers = {"cache-control": f"max-age={BROWSER_S}"}
            return Response(data, media_type=kind, headers=headers)

        @app.put(MAPS + "{name}")
        async def _upload(name: str, request: Request) -> Response:
            answer = await answer_upload(
                request, self._folder, lambda: self._check_name(name), partial(_map_name, name)
            )
            if answer.status_code == HTTPStatus.CREATED:
                path = self._folder / f"{name}.pmtiles"
                self._add(MapStyle(name=name, url=str(path), max_zoom=MAX_ZOOM))
            return answer

    async def tile(self, style: int, z: int, x: int, y: int) -> bytes | None:
        """Return one tile; None if there is none, or it cannot be fetched."""
        inside = 0 <= z <= MAX_ZOOM and 0 <= x < 1 << z and 0 <= y < 1 << z
        if not inside or not 0 <= style < len(self._sources):
            return None
        source = self._sources[style]
        if isinstance(source, MapStyle):
            return await self._kept_or_fetched(source, z, x, y)
        try:
            return await asyncio.to_thread(source, z, x, y)
        except (OSError, ValueError, sqlite3.Error) as error:
            log.warning("map style %r: %s", self.styles[style].name, error)
            self._sources[style] = _no_tile
            return None

    def _check_name(self, name: str) -> None:
        if not STYLE_NAME.fullmatch(name):
            raise ValueError("a map has a name of at most 32 letters, digits, spaces, and .-_")
        if len([*self._folder.glob("*.pmtiles")]) >= MAX_FILES:
            raise ValueError(f"{self._folder} has {MAX_FILES} maps already: delete one there")
        if os.path.lexists(self._folder / f"{name}.pmtiles"):
            raise ValueError(f"there is a map {name!r} already in {self._folder}")

    def _add(self, style: MapStyle) -> None:
        """Open a style; without its file it has no tiles."""
        source: MapStyle | GetTile = style
        if not style.url.startswith(("http://", "https://")):
            path = Path(style.url).expanduser()
            try:
                if path.suffix == ".pmtiles":
                    map_file = PmTiles(file_reader(path))
                    style = replace(
                        style,
                        max_zoom=min(style.max_zoom, map_file.max_zoom),
                        attribution=style.attribution or map_file.attribution,
                    )
                    source = map_file.get
                else:
                    source = _open_mbtiles(path)
            except (OSError, ValueError, sqlite3.Error) as error:
                log.warning("map style %r: %s: %s", style.name, path, error)
                source = _no_tile
        self.styles.append(style)
        self._sources.append(source)

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
            # A compressed answer could exceed the limit when it is unpacked.
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
    uri = f"{path.resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(uri, uri=True)) as database:
        database.execute("select tile_data from tiles limit 1")

    def get(z: int, x: int, y: int) -> bytes | None:
        ask = "select tile_data from tiles where zoom_level=? and tile_column=? and tile_row=?"
        with closing(sqlite3.connect(uri, uri=True)) as database:
            row = database.execute(ask, (z, x, (1 << z) - 1 - y)).fetchone()
        return None if row is None else bytes(row[0])

    return get


def _map_name(name: str, path: Path) -> str:
    """Return the file name of an uploaded map; raises ValueError if it is not a map."""
    data = PmTiles(file_reader(path)).first_tile()
    if data is None or kind_of_image(data) is None:
        raise ValueError("it has no PNG, JPEG or WEBP tile")
    return f"{name}.pmtiles"


def _no_tile(*_: int) -> bytes | None:
    return None
