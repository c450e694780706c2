"""An area of a map, cut out of a larger file by ranges of bytes."""

import math
from pathlib import Path

import httpx
import pytest
from pmtiles.tile import TileType, zxy_to_tileid

from gateway.panel import map_area
from gateway.panel.map_area import (
    EARTH_M,
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
from tests.panel.test_map_tiles import picture, write_pmtiles

pytestmark = pytest.mark.io
ADDRESS = "https://maps.example/world.pmtiles"


def write_world(path: Path, kind: TileType = TileType.PNG) -> None:
    """Write a map of the world up to zoom 5."""
    tiles = [(z, x, y) for z in range(6) for x in range(1 << z) for y in range(1 << z)]
    write_pmtiles(path, kind, "someone", sorted(tiles, key=lambda one: zxy_to_tileid(*one)))


@pytest.fixture
def world(tmp_path: Path) -> Path:
    path = tmp_path / "world.pmtiles"
    write_world(path)
    return path


def test_length_is_read_in_metres_kilometres_and_nautical_miles() -> None:
    read = [length_m(text) for text in ("5km", "800 m", "2nm", "12")]
    assert read == pytest.approx([5000, 800, 3704, 12])
    for text in ("", "km", "-5km", "5 parsec"):
        with pytest.raises(ValueError, match=f"{text!r} is no length"):
            length_m(text)


@pytest.mark.parametrize(
    ("positions", "box"),
    [
        ([(60.0, 20.0)], (59.0, 18.0, 61.0, 22.0)),
        ([(-60.0, 20.0), (0.0, 30.0), (math.nan, 0.0)], (-61.0, 18.0, 1.0, 32.0)),
        ([(84.5, -179.0)], (83.5, -180.0, 85.0, -168.57)),
    ],
    ids=["one position", "both hemispheres", "near the pole and the 180th meridian"],
)
def test_box_has_the_margin_on_every_side(
    positions: list[tuple[float, float]], box: tuple[float, ...]
) -> None:
    degree_m = math.radians(1.0) * EARTH_M
    assert box_around(positions, degree_m) == pytest.approx(box, abs=0.01)


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


def test_too_large_area_is_refused(
    world: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_area, "MAX_TILES", 20)
    with pytest.raises(MapAreaError, match="21 tiles are too many"):
        extract_area(open_source(str(world)), tmp_path / "x", (-80, -179, 80, 179), 2)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("source", "text"),
    [
        ("https://tile.example/{z}/{x}/{y}.png", "tile servers forbid"),
        ("gone.pmtiles", "No such file"),
        (ADDRESS, "no ranges"),
        ("vectors.pmtiles", "its tiles are MVT"),
    ],
)
def test_unusable_source_is_refused(
    source: str, text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_world(tmp_path / "vectors.pmtiles", TileType.MVT)
    client = httpx.Client(transport=httpx.MockTransport(lambda _: httpx.Response(200)))
    with pytest.raises(MapAreaError, match=text):
        extract_area(open_source(source, client), tmp_path / "x", (0, 0, 1, 1), 3)


def test_command_writes_into_the_folder_of_tiles(world: Path, tmp_path: Path) -> None:
    config = tmp_path / "gateway.toml"
    config.write_text(f'[panel]\ntiles_folder = "{tmp_path}/tiles"\n')
    words = ("47.0,8.0", world, "--name", "Home field", "-c", config)
    invoke("map", *words, code=0)
    assert (tmp_path / "tiles" / "Home field.pmtiles").is_file()
    assert "already" in invoke("map", *words, code=2).output
