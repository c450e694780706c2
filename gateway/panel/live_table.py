"""A table that is updated in place: only changed cells are sent to the browser."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

from nicegui import ui

Cells = Sequence[tuple[str, str]]
"""Text and style class of each cell of a row; `""` for none, `good`, `warn` or `bad`."""

BUTTON_PROPS: Final = "flat dense round size=sm"


@dataclass(frozen=True, slots=True)
class RowButton:
    """A button at the end of each row."""

    icon: str
    title: str
    """Its tooltip."""
    act: Callable[[str], object]
    """Called with the key of its row."""


class LiveTable:
    """Rows with a key each.

    Parameters
    ----------
    columns : sequence of str
        Headings; the first column is text, the others figures.
    empty : str
        Shown while there are no rows.
    buttons : sequence of RowButton
        At the end of each row.
    """

    def __init__(
        self,
        columns: Sequence[str],
        empty: str,
        *,
        buttons: Sequence[RowButton] = (),
    ) -> None:
        self._buttons = buttons
        self._cells: dict[str, list[ui.label]] = {}
        self._shown: dict[str, Cells] = {}
        self._rows: dict[str, ui.element] = {}
        with ui.element("div").classes("table-frame"), ui.element("table").classes("table"):
            with ui.element("thead"), ui.element("tr"):
                for heading in (*columns, *([""] if buttons else [])):
                    with ui.element("th"):
                        ui.label(heading)
            self._body = ui.element("tbody")
        self._empty = ui.label(empty).classes("soft nothing")

    def show(self, rows: Mapping[str, Cells]) -> None:
        """Show these rows, in this order."""
        self._empty.set_visibility(not rows)
        if list(rows) != list(self._rows):
            self._body.clear()
            self._rows.clear()
            self._cells.clear()
            self._shown.clear()
            with self._body:
                for key, cells in rows.items():
                    self._make(key, cells)
            return
        for key, cells in rows.items():
            if cells == self._shown[key]:
                continue
            shown = self._shown[key]
            for label, (text, kind), old in zip(self._cells[key], cells, shown, strict=True):
                if (text, kind) != old:
                    label.set_text(text)
                    label.classes(replace=kind)
            self._shown[key] = cells

    def _make(self, key: str, cells: Cells) -> None:
        self._cells[key], self._shown[key] = [], cells
        with ui.element("tr").props(f'data-key="{key}"') as row:
            for text, kind in cells:
                with ui.element("td"):
                    self._cells[key].append(ui.label(text).classes(kind))
            if self._buttons:
                with ui.element("td").classes("acts"):
                    for entry in self._buttons:
                        button = ui.button(icon=entry.icon, on_click=partial(entry.act, key))
                        button.props(f'{BUTTON_PROPS} aria-label="{entry.title}"')
        self._rows[key] = row
