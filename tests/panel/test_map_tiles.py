"""Tiles from files, from a server on loopback, and from the disk when that is gone."""

import gzip
import math
import os
import sqlite3
import struct
import zlib
from collections.abc import AsyncIterator, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from gateway.panel.admission import Role
from gateway.panel.map_tiles import MAX_FILES, MAX_TILE, MapTiles, tidy
from gateway.panel.panel_settings import MapStyle, PanelSettings
from tests.panel.web_client import client_of

pytestmark = pytest.mark.io


def picture(shade: int = 0) -> bytes:
    def part(name: bytes, data: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(name + data))
        return struct.pack(">I", len(data)) + name + data + check

    head = part(b"IHDR", struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0))
    pixel = part(b"IDAT", zlib.compress(bytes((0, shade))))
    return b"\x89PNG\r\n\x1a\n" + head + pixel + part(b"IEND", b"")


def write_mbtiles(file: Path, data: bytes, tiles: Iterable[tuple[int, int, int]]) -> None:
    """Write a file with the same picture in some tiles: zoom, column, row from the south."""
    with sqlite3.connect(file) as database:
        database.execute("create table addresses (zoom_level, tile_column, tile_row)")
        database.executemany("insert into addresses values (?, ?, ?)", tiles)
        database.execute("create table picture (tile_data)")
        database.execute("insert into picture values (?)", (data,))
        database.execute("create view tiles as select * from addresses, picture")
    database.close()


def tiles_around(lat_deg: float, lon_deg: float) -> Iterator[tuple[int, int, int]]:
    """Yield the tiles around a position, in every zoom, as MBTiles counts them."""
    north = math.asinh(math.tan(math.radians(lat_deg))) / math.pi
    for zoom in range(19):
        size = 1 << zoom
        column, row = int((lon_deg / 360 + 0.5) * size), int((north + 1) / 2 * size)
        for x in range(max(column - 12, 0), min(column + 13, size)):
            for y in range(max(row - 12, 0), min(row + 13, size)):
                yield zoom, x, y


async def sent(data: bytes) -> AsyncIterator[bytes]:
    yield data


class Owner:
    """A server of tiles: its answers by path, and the paths that were asked for."""

    def __init__(self) -> None:
        self.answers: dict[str, AsyncIterator[bytes]] = {}
        self.asked: list[str] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.asked.append(request.url.path)
        body = self.answers.get(request.url.path)
        return httpx.Response(404) if body is None else httpx.Response(200, content=body)

    def tiles(self, folder: Path) -> MapTiles:
        made = tiles_in(folder, "http://owner.example/{z}/{x}/{y}.png")
        made._client = httpx.AsyncClient(transport=httpx.MockTransport(self))
        return made


@pytest.fixture
def owner() -> Owner:
    return Owner()


def tiles_in(folder: Path, *urls: str) -> MapTiles:
    """Return the tiles of files in a folder, and of URLs before them."""
    styles = tuple(MapStyle(name="test", url=url) for url in urls)
    return MapTiles(PanelSettings(tiles_folder=str(folder), map_styles=styles))


async def test_tile_is_cached_and_used_while_the_server_has_none(
    tmp_path: Path, owner: Owner
) -> None:
    owner.answers["/3/1/2.png"] = sent(picture())
    assert await owner.tiles(tmp_path).tile(0, 3, 1, 2) == picture()
    owner.answers.clear()
    assert await owner.tiles(tmp_path).tile(0, 3, 1, 2) == picture()
    assert owner.asked == ["/3/1/2.png"]
    (cached,) = (file for file in tmp_path.rglob("*") if file.is_file())
    os.utime(cached, (0, 0))
    assert await owner.tiles(tmp_path).tile(0, 3, 1, 2) == picture()
    assert owner.asked == ["/3/1/2.png"] * 2


async def test_tile_that_is_no_picture_or_endless_is_dropped(tmp_path: Path, owner: Owner) -> None:
    count = 0

    async def endless() -> AsyncIterator[bytes]:
        nonlocal count
        yield picture(1)
        while count < 100 * MAX_TILE:
            count += 1 << 16
            yield bytes(1 << 16)

    owner.answers = {"/0/0/0.png": sent(b"<script>alert(1)</script>"), "/1/0/0.png": endless()}
    for zoom in (0, 1):
        assert await owner.tiles(tmp_path).tile(0, zoom, 0, 0) is None
    assert list(tmp_path.iterdir()) == []
    assert 0 < count < 50 * MAX_TILE, "not all was read"


async def test_unreachable_server_gives_no_tile(tmp_path: Path) -> None:
    tiles = tiles_in(tmp_path, "http://127.0.0.1:9/{z}/{x}/{y}")
    assert await tiles.tile(0, 2, 1, 1) is None


@pytest.mark.parametrize(
    "tile",
    [(0, 0, 1), (0, -1, 0), (3, 8, 0), (25, 0, 0), (-1, 0, 0)],
    ids=["too far south", "too far west", "too far east", "zoom too great", "negative zoom"],
)
async def test_outer_tiles_are_not_asked(
    tmp_path: Path, owner: Owner, tile: tuple[int, int, int]
) -> None:
    tiles = owner.tiles(tmp_path)
    assert await tiles.tile(0, *tile) is None
    assert await tiles.tile(1, 0, 0, 0) is None
    assert owner.asked == []


async def test_rows_of_mbtiles_are_counted_from_the_south(tmp_path: Path) -> None:
    file = tmp_path / "field.mbtiles"
    write_mbtiles(file, picture(), [(2, 1, 0)])
    tiles = tiles_in(tmp_path, str(file))
    assert await tiles.tile(0, 2, 1, 3) == picture()
    assert await tiles.tile(0, 2, 1, 0) is None


def write_pmtiles(
    file: Path,
    kind: TileType = TileType.PNG,
    attribution: str = "",
    tiles: Iterable[tuple[int, int, int]] = ((4, 3, 2),),
) -> None:
    """Write a map of some tiles, in the order of their ids, each of a shade of its own."""
    with file.open("wb") as stream:
        writer = Writer(stream)
        for tile in tiles:
            writer.write_tile(zxy_to_tileid(*tile), picture(sum(tile) % 256))
        ends = ("min_lon_e7", "min_lat_e7", "max_lon_e7", "max_lat_e7")
        zeros = (*ends, "center_zoom", "center_lon_e7", "center_lat_e7")
        header: dict[str, Any] = dict.fromkeys(zeros, 0)
        header |= {"tile_type": kind, "tile_compression": Compression.NONE}
        writer.finalize(header, {"attribution": attribution})


async def test_pmtiles_file_is_a_style_with_its_own_zooms_and_attribution(tmp_path: Path) -> None:
    write_pmtiles(tmp_path / "field.pmtiles", attribution="&lt;b&gt;&copy; <a href='x'>Me</a> & Co")
    tiles = tiles_in(tmp_path)
    (style,) = tiles.styles
    assert (style.name, style.max_zoom, style.attribution) == ("field", 4, "© Me &amp; Co")
    assert await tiles.tile(0, 4, 3, 2) == picture(9)
    assert await tiles.tile(0, 4, 3, 3) is None


def changed(data: bytes, offset: int, value: int, size: int = 8) -> bytes:
    return data[:offset] + value.to_bytes(size, "little") + data[offset + size :]


@cache
def packed_zeros() -> bytes:
    return gzip.compress(bytes(1 << 28), 1)


def hostile_maps(folder: Path) -> dict[str, tuple[bytes, str]]:
    """Make files that are no usable maps, and what is said of each."""
    write_pmtiles(folder / "good", TileType.PNG)
    good = (folder / "good").read_bytes()
    write_pmtiles(folder / "vector", TileType.MVT)
    bomb, text = packed_zeros(), "directory of it"
    long_number = gzip.compress(b"\xff" * (1 << 18))
    return {
        "empty": (b"", "no PMTiles"),
        "text": (b"<script>alert(1)</script>" * 20, "no PMTiles"),
        "begin only": (b"PMTiles", "no PMTiles"),
        "old version": (changed(good, 7, 2, 1), "version is not 3"),
        "unknown kind": (changed(good, 99, 77, 1), "no PMTiles"),
        "vector tiles": ((folder / "vector").read_bytes(), "tiles are MVT"),
        "directory beyond the end": (changed(good, 8, 1 << 40), text),
        "directory beyond all files": (changed(good, 8, (1 << 64) - 1), text),
        "directory of 1 GB": (changed(good, 16, 1 << 30), text),
        "directory that unpacks to 256 MB": (
            changed(changed(good + bomb, 8, len(good)), 16, len(bomb)), text,
        ),
        "number of 2 million bits": (
            changed(changed(good + long_number, 8, len(good)), 16, len(long_number)), text,
        ),
        "tile beyond the end": (changed(good, 56, 1 << 40), "no PNG"),
        "tile that is a script": (good.replace(b"\x89PNG", b"<scr"), "no PNG"),
    }  # fmt: skip


async def test_uploaded_map_is_a_style_and_hostile_ones_are_refused(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    maps, folder = hostile_maps(tmp_path / "made"), tmp_path / "tiles"
    good = (tmp_path / "made" / "good").read_bytes()
    tiles = tiles_in(folder)
    async with client_of(tiles.serve) as client:
        for name, (data, text) in maps.items():
            answer = await client.put(f"/maps/{name}", content=data)
            assert (answer.status_code, text in answer.text) == (400, True), (name, answer.text)
        for name in ("../field", "..%2Ffield", ".hidden", "a" * 33, "%00"):
            assert (await client.put(f"/maps/{name}", content=good)).status_code >= 400
        assert list(folder.iterdir()) == []
        assert (await client.put("/maps/home field", content=good)).status_code == 201
        assert (await client.get("/tiles/0/4/3/2")).content == picture(9)
        assert "already" in (await client.put("/maps/home field", content=good)).text
    assert [style.name for style in tiles.styles] == ["home field"]
    assert [file.name for file in folder.iterdir()] == ["home field.pmtiles"]
    async with client_of(tiles.serve, Role.VIEWER) as viewer:
        assert (await viewer.put("/maps/other", content=good)).status_code == 403
    for number in range(MAX_FILES):
        (folder / f"{number}.pmtiles").touch()
    async with client_of(tiles.serve) as client:
        assert "delete one" in (await client.put("/maps/other", content=good)).text


async def test_hostile_file_in_the_folder_does_not_stop_the_panel(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    folder = tmp_path / "tiles"
    folder.mkdir()
    os.mkfifo(folder / "pipe.pmtiles")
    for name, (data, _) in hostile_maps(tmp_path / "made").items():
        (folder / f"{name[:32]}.pmtiles").write_bytes(data)
    tiles = tiles_in(folder)
    for number, style in enumerate(tiles.styles):
        data = await tiles.tile(number, 4, 3, 2)
        assert not data or "script" in style.name


@pytest.mark.parametrize("name", ["missing.mbtiles", "missing.pmtiles", "broken.pmtiles"])
async def test_broken_map_file_gives_no_tile(tmp_path: Path, name: str) -> None:
    (tmp_path / "broken.pmtiles").write_bytes(b"no tiles at all")
    assert await tiles_in(tmp_path, str(tmp_path / name)).tile(0, 0, 0, 0) is None


def test_oldest_tiles_are_deleted_first(tmp_path: Path) -> None:
    for age in range(5):
        file = tmp_path / f"{age}"
        file.write_bytes(bytes(100))
        os.utime(file, (1e9 - age, 1e9 - age))
    tidy(tmp_path, 250)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["0", "1"]
