"""The catalogue of recordings for the page: reloaded when it changed, and searched."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from gateway.batch.catalogue import CATALOGUE_NAME, CatalogueError, Row, find_flights, geojson_of

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

        Parameters
        ----------
        folder : Path
            Of the recordings.
        search : str
            A part of a name, or a condition as for `mavgate catalogue list --where`.
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
