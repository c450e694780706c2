"""A table that the browser draws from plain data: every text stays text."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nicegui.element import Element
from nicegui.events import GenericEventArguments

from gateway.panel.view_context import WEB
from gateway.printable import printable

Cells = Sequence[tuple[str, ...]]
"""Text, style class, icon and track of each cell; the class is `""`, `good`, `warn`, `bad`,
`info` or `soft`; the icon, a name of a Material icon, and the track, corners of a line in a box of
46 by 24, may be left out."""


@dataclass(frozen=True, slots=True)
class RowButton:
    """A button at the end of each row."""

    icon: str
    title: str
    """Its tooltip."""
    act: Callable[[str], object]
    """Called with the key of its row."""


class DataTable(Element, component=WEB / "data_table.js"):
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
        self, columns: Sequence[str], empty: str = "", *, buttons: Sequence[RowButton] = ()
    ) -> None:
        super().__init__()
        self._buttons = buttons
        self._rows: list[dict[str, Any]] = []
        self._props["columns"] = list(columns)
        self._props["empty"] = empty
        self._props["buttons"] = [[button.icon, button.title] for button in buttons]
        self._props["rows"] = []
        if buttons:
            self.on("act", self._on_act)

    def show(self, rows: Mapping[str, Cells]) -> None:
        """Show these rows, in this order."""
        shown = [
            {"key": key, "cells": [[printable(cell[0]), *cell[1:]] for cell in cells]}
            for key, cells in rows.items()
        ]
        if shown != self._rows:
            self._rows = shown
            self.props["rows"] = shown

    async def _on_act(self, event: GenericEventArguments) -> None:
        number, key = event.args
        if any(row["key"] == key for row in self._rows):
            result = self._buttons[int(number)].act(key)
            if hasattr(result, "__await__"):
                await result
