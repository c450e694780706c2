"""An area of a map, cut out of a larger file by ranges of bytes."""

from pathlib import Path

import httpx
import pytest
from pmtiles.tile import Compression, TileType, zxy_to_tileid
from pmtiles.writer import Writer

from gateway.panel import map_area
from gateway.panel.map_area import (
    MapAreaError,
    box_around,
    extract_area,
    length_m,
    open_source,
    tiles_in,
)
from gateway.panel.map_tiles import MapTiles, styles_of
from gateway.panel.panel_settings import PanelSettings
from tests.kit.cli import invoke
from tests.panel.test_map_tiles import picture

pytestmark = pytest.mark.io
ADDRESS = "https://maps.example/world.pmtiles"


def write_world(path: Path, kind: TileType = TileType.PNG) -> None:
    """Write a map of the world up to zoom 5, every tile of a shade of its own."""
    with path.open("wb") as file:
        writer = Writer(file)
        tiles = [(z, x, y) for z in range(6) for x in range(1 << z) for y in range(1 << z)]
        for tile in sorted(tiles, key=lambda one: zxy_to_tileid(*one)):
            writer.write_tile(zxy_to_tileid(*tile), picture(sum(tile) % 256))
        header = {
            "tile_type": kind, "tile_compression": Compression.NONE, "min_zoom": 0, "max_zoom": 5,
            "min_lon_e7": 0, "min_lat_e7": 0, "max_lon_e7": 0, "max_lat_e7": 0, "center_zoom": 0,
            "center_lon_e7": 0, "center_lat_e7": 0,
        }  # fmt: skip
        writer.finalize(header, {"attribution": "someone"})


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / "world.pmtiles"
    write_world(path)
    return path


@pytest.mark.parametrize(
    ("text", "metres"), [("5km", 5000), ("800 m", 800), ("2nm", 3704), ("12", 12)]
)
def test_length_is_read_in_metres_kilometres_and_nautical_miles(text: str, metres: float) -> None:
    assert length_m(text) == pytest.approx(metres)


@pytest.mark.parametrize("text", ["", "km", "-5km", "5 parsec"])
def test_invalid_length_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="no length"):
        length_m(text)


async def test_extracted_area_is_a_map_style(world: Path, tmp_path: Path) -> None:
    asked: list[str] = []
    data = world.read_bytes()

    def answer(request: httpx.Request) -> httpx.Response:
        asked.append(request.headers["range"])
        begin, end = map(int, asked[-1].removeprefix("bytes=").split("-"))
        return httpx.Response(206, content=iter([data[begin : end + 1]]))

    client = httpx.Client(transport=httpx.MockTransport(answer))
    box = box_around([(47.0, 8.0), (47.1, 8.1)], 5000.0)
    folder = tmp_path / "tiles"
    folder.mkdir()
    count = extract_area(open_source(ADDRESS, client), folder / "Field.pmtiles", box, 16)
    assert count == 6
    assert len(asked) < 20
    settings = PanelSettings(tiles_folder=str(folder), map_styles=())
    (style,) = styles_of(settings)
    assert style.name == "Field"
    ((x, y),) = tiles_in(box, 5)
    assert await MapTiles(settings).tile(0, 5, x, y) == picture((5 + x + y) % 256)
    assert await MapTiles(settings).tile(0, 5, 0, 0) is None


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("https://tile.example/{z}/{x}/{y}.png", "tile servers forbid"),
        ("gone.pmtiles", "No such file"),
    ],
)
def test_forbidden_or_unreadable_source_is_refused(source: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(MapAreaError, match=text):
        extract_area(open_source(source), tmp_path / "x", (0, 0, 1, 1), 3)


def test_area_of_too_many_tiles_is_refused(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_area, "MAX_TILES", 20)
    with pytest.raises(MapAreaError, match="21 tiles are too many"):
        extract_area(open_source(str(world)), tmp_path / "x", (-80, -179, 80, 179), 2)
    assert not (tmp_path / "x").exists()


def test_server_without_ranges_and_vector_tiles_are_refused(world: Path, tmp_path: Path) -> None:
    client = httpx.Client(transport=httpx.MockTransport(lambda _: httpx.Response(200)))
    with pytest.raises(MapAreaError, match="no ranges"):
        extract_area(open_source(ADDRESS, client), tmp_path / "x", (0, 0, 1, 1), 3)
    write_world(world, TileType.MVT)
    with pytest.raises(MapAreaError, match="its tiles are MVT"):
        extract_area(open_source(str(world)), tmp_path / "x", (0, 0, 1, 1), 3)


def test_command_writes_into_the_folder_of_tiles(world: Path, tmp_path: Path) -> None:
    config = tmp_path / "gateway.toml"
    config.write_text(f'[panel]\ntiles_folder = "{tmp_path}/tiles"\n')
    command = ["map", "get", "--source", str(world), "--around", "47.0,8.0", "--name", "Home field"]
    done = invoke(*command, "--config", config)
    assert done.exit_code == 0, done.output
    assert (tmp_path / "tiles" / "Home field.pmtiles").is_file()
    again = invoke(*command, "--config", config)
    assert again.exit_code != 0
    assert "already" in again.output
