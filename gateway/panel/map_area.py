"""An area of a map as a PMTiles file for use without a network, cut out of a larger one.

A PMTiles file on a web server is read by ranges of bytes, one request at a time, and only as far as
the area requires. Tile servers with `{z}/{x}/{y}` in their addresses forbid such downloads, and are
refused.
"""

import math
import re
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import httpx
from pmtiles.tile import zxy_to_tileid
from pmtiles.writer import Writer

from gateway import __version__
from gateway.panel.map_tiles import GetBytes, PmTiles, file_reader
from gateway.printable import reason_of
from gateway.units import DEGE7_PER_DEG

EARTH_M: Final = 6_378_137.0
MAX_TILES: Final = 20_000
MAX_BYTES: Final = 500_000_000
MAX_PIECE: Final = 16 << 20
"""Maximum bytes of one request: a directory or a tile is smaller."""
TIMEOUT_S: Final = 30.0
SPANS: Final = {"m": 1.0, "km": 1000.0, "mi": 1609.344, "nm": 1852.0}

Box = tuple[float, float, float, float]
"""South, west, north, east, deg."""


class MapAreaError(Exception):
    """An area cannot be fetched; the text gives the reason."""


def length_m(text: str) -> float:
    """Return a length such as `5km` in metres; raises ValueError for anything else."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*(m|km|mi|nm)?\s*", text, re.IGNORECASE)
    if match is None:
        raise ValueError(f"{text!r} is no length; write 5km, 800m, 3mi or 2nm")
    return float(match[1]) * SPANS[(match[2] or "m").lower()]


def box_around(
    positions: Iterator[tuple[float, float]] | list[tuple[float, float]], m: float
) -> Box:
    """Return the box that contains some positions with a margin in metres."""
    known = [(lat, lon) for lat, lon in positions if math.isfinite(lat) and math.isfinite(lon)]
    if not known:
        raise MapAreaError("there is no position")
    lats, lons = zip(*known, strict=True)
    up = math.degrees(m / EARTH_M)
    aside = up / max(math.cos(math.radians(max(map(abs, lats)))), 0.01)
    south, north = max(min(lats) - up, -85.0), min(max(lats) + up, 85.0)
    return south, max(min(lons) - aside, -180.0), north, min(max(lons) + aside, 179.999999)


def tiles_in(box: Box, zoom: int) -> list[tuple[int, int]]:
    """Return column and row of the tiles of a zoom that cover a box."""
    south, west, north, east = box
    (left, top), (right, bottom) = _tile(north, west, zoom), _tile(south, east, zoom)
    return [(x, y) for x in range(left, right + 1) for y in range(top, bottom + 1)]


def open_source(source: str, client: httpx.Client | None = None) -> GetBytes:
    """Return a function that reads ranges of bytes of a PMTiles file on a web server or a disk.

    Raises MapAreaError if the source is a tile server.
    """
    if "{" in source:
        raise MapAreaError(
            "tile servers forbid bulk downloads: give the address of a PMTiles file whose owner "
            "permits extracts"
        )
    if not source.startswith(("http://", "https://")):
        return file_reader(Path(source).expanduser())
    agent = {"user-agent": f"mavgate/{__version__}", "accept-encoding": "identity"}
    client = client or httpx.Client(headers=agent, timeout=TIMEOUT_S, follow_redirects=True)

    @lru_cache(maxsize=64)
    def get_bytes(offset: int, length: int) -> bytes:
        if length > MAX_PIECE:
            raise MapAreaError(f"{source}: it is damaged, or no PMTiles file")
        headers = {"range": f"bytes={offset}-{offset + length - 1}"}
        try:
            with client.stream("GET", source, headers=headers) as answer:
                if answer.status_code != httpx.codes.PARTIAL_CONTENT:
                    raise MapAreaError(f"{source}: no ranges of bytes ({answer.status_code})")
                data = b""
                for chunk in answer.iter_raw():
                    data += chunk
                    if len(data) > length:
                        break
        except httpx.HTTPError as error:
            raise MapAreaError(f"{source}: {error}") from error
        return data[:length]

    return get_bytes


def extract_area(
    get_bytes: GetBytes,
    target: Path,
    box: Box,
    max_zoom: int,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> int:
    """Copy the tiles of a box into a new PMTiles file, and return how many there are.

    Raises MapAreaError if the source is no raster map, or the area is too large.
    """
    try:
        reader = PmTiles(get_bytes)
    except (OSError, ValueError) as error:
        raise MapAreaError(f"the source cannot be used: {reason_of(error)}") from error
    header = reader.header
    zooms = range(header["min_zoom"], min(max_zoom, header["max_zoom"]) + 1)
    wanted = [(z, x, y) for z in zooms for x, y in tiles_in(box, z)]
    if len(wanted) > MAX_TILES:
        raise MapAreaError(
            f"{len(wanted)} tiles are too many (at most {MAX_TILES}); take a smaller radius or zoom"
        )
    count = size = 0
    with target.open("xb") as file:
        writer = Writer(file)
        for number, (z, x, y) in enumerate(sorted(wanted, key=lambda one: zxy_to_tileid(*one)), 1):
            on_progress(number, len(wanted))
            if (data := reader.get(z, x, y)) is None:
                continue
            count, size = count + 1, size + len(data)
            if size > MAX_BYTES:
                raise MapAreaError(f"the area has more than {MAX_BYTES // 1_000_000} MB")
            writer.write_tile(zxy_to_tileid(z, x, y), data)
        if not count:
            raise MapAreaError("the source has no tiles there")
        writer.finalize(_header_of(header, box, zooms), reader.metadata())
    return count


def _header_of(header: dict[str, Any], box: Box, zooms: range) -> dict[str, Any]:
    south, west, north, east = (round(value * DEGE7_PER_DEG) for value in box)
    return {
        "tile_type": header["tile_type"],
        "tile_compression": header["tile_compression"],
        "min_zoom": zooms[0],
        "max_zoom": zooms[-1],
        "min_lon_e7": west,
        "min_lat_e7": south,
        "max_lon_e7": east,
        "max_lat_e7": north,
        "center_zoom": zooms[-1],
        "center_lon_e7": (west + east) // 2,
        "center_lat_e7": (south + north) // 2,
    }


def _tile(lat_deg: float, lon_deg: float, zoom: int) -> tuple[int, int]:
    count = 1 << zoom
    lat = math.radians(lat_deg)
    x = (lon_deg + 180.0) / 360.0 * count
    y = (1.0 - math.asinh(math.tan(lat)) / math.pi) / 2.0 * count
    return min(max(int(x), 0), count - 1), min(max(int(y), 0), count - 1)
