"""The catalogue of recordings for the page: reloaded when it changed, and searched."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

from gateway.season.catalogue.catalogue_file import (
    CATALOGUE_NAME,
    CatalogueError,
    Row,
    find_flights,
)

OPERATORS: Final = frozenset("<>=")
"""Characters that make a search a condition."""

NO_CATALOGUE: Final = "Run mavgate catalogue to fill in duration, distance, height and loss."


class RecordingFacts:
    """The rows of a folder's catalogue by recording, if it has one."""

    def __init__(self) -> None:
        self._asked: tuple[Path, tuple[int, int] | None, str] | None = None
        self._rows: dict[str, Row] = {}
        self._found: frozenset[str] | None = None
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
