"""Search in the recordings of a folder by name or by the figures of its catalogue."""

import math
import re
from pathlib import Path, PurePath
from typing import Any, Final

from gateway.batch import catalogue
from gateway.geometry.angle import wrap_180

OPERATORS: Final = frozenset("<>=")
"""Characters that make a search a condition."""
TOKEN: Final = re.compile(
    rf"\b(?:and|or|not|is|null|{'|'.join(catalogue.COLUMNS)})\b|[-+]?\d+(?:\.\d+)?|'[^']*'|[<>=!]+|[()]",
    re.IGNORECASE,
)
"""Parts of a condition from the network: comparisons of columns with constants, and no function."""
MAX_CONDITION: Final = 500
NO_CATALOGUE: Final = "Duration, distance, height and loss appear once the recordings are indexed."
THUMBNAIL: Final = (46.0, 24.0)
MAX_CORNERS: Final = 60


class RecordingFacts:
    """Figures and tracks of a folder's recordings, if it has a catalogue."""

    def __init__(self) -> None:
        self._searched: tuple[Path, tuple[int, int] | None, str] | None = None
        self._figures: catalogue.Figures = {}
        self._broken: set[str] = set()
        self._found: frozenset[str] | None = None
        self._tracks: dict[str, str] = {}
        self.trouble = ""
        """The reason why a search found nothing, or why the recordings have no figures."""

    def look(self, folder: Path, search: str = "") -> None:
        """Reload the catalogue if it changed, and search; some tens of ms for thousands of rows.

        A search is a part of a name, or a condition as for `mavgate info --where`, without
        functions.
        """
        stamp = _stamp(folder)
        if self._searched == (folder, stamp, search):
            return
        self._searched, self.trouble = (folder, stamp, search), "" if stamp else NO_CATALOGUE
        is_condition = not OPERATORS.isdisjoint(search)
        try:
            rows = [] if stamp is None else catalogue.find_flights(folder)
            self._figures = catalogue.figures_of(rows)
            self._broken = {row["name"] for row in rows if row["error"] is not None}
            self._tracks = {} if stamp is None else _thumbnails(catalogue.geojson_of(folder))
            self._found = (
                frozenset(row["name"] for row in catalogue.find_flights(folder, _checked(search)))
                if is_condition
                else None
            )
        except catalogue.CatalogueError as error:
            self.trouble, self._found = str(error), frozenset()

    def of(self, name: str) -> catalogue.FlightFigures | str | None:
        """Return the figures of the longest recorded vehicle of a recording, or "broken"."""
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


def _checked(condition: str) -> str:
    """Return a condition; raises CatalogueError unless it only compares columns."""
    other = TOKEN.sub(" ", condition[:MAX_CONDITION]).split()
    if other or len(condition) > MAX_CONDITION:
        raise catalogue.CatalogueError(
            f"{(other or ['it'])[0][:40]!r} cannot be used here; write a condition such as "
            f"duration > 300 and loss > 0.05, of at most {MAX_CONDITION} characters, with the "
            f"columns {', '.join(catalogue.COLUMNS)}"
        )
    return condition


def _stamp(folder: Path) -> tuple[int, int] | None:
    """Return a value that changes with the catalogue; None without a catalogue."""
    try:
        found = (folder / catalogue.CATALOGUE_NAME).stat()
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
    """Return the positions of a line; one across the 180th meridian is stored in several parts."""
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
