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
        frame = ui.element("div").classes("table-frame").props("tabindex=0")
        with frame, ui.element("table").classes("table"):
            with ui.element("thead"), ui.element("tr"):
                for heading in columns:
                    with ui.element("th").props("scope=col"):
                        ui.label(heading)
                if buttons:
                    ui.element("td")
            self._body = ui.element("tbody")
        self._empty = ui.label(empty).classes("soft nothing")

    def show(self, rows: Mapping[str, Cells]) -> None:
        """Show these rows, in this order."""
        self._empty.set_visibility(not rows)
        for key in self._rows.keys() - rows.keys():
            self._rows.pop(key).delete()
            del self._cells[key], self._shown[key]
        for place, (key, cells) in enumerate(rows.items()):
            if key not in self._rows:
                with self._body:
                    self._make(key, cells)
            # A row that stays keeps its elements: a click on its button finds them.
            row = self._rows[key]
            if self._body.default_slot.children[place] is not row:
                row.move(target_index=place)
            self._update(key, cells)

    def _update(self, key: str, cells: Cells) -> None:
        shown = self._shown[key]
        if cells == shown:
            return
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
