"""One parameter: its name, meaning, range and default, and the field that changes it."""

import math
from typing import Any

from nicegui import ui

from gateway.panel.dialogues import Dialogue
from gateway.panel.state.fields import unit_text
from gateway.panel.state.parameters import ParameterMeta, is_same_value
from gateway.panel.view_context import NotAllowedError, ViewContext
from gateway.printable import printable


class ParameterRow:
    """A row, built at the current place of the page.

    Parameters
    ----------
    context : ViewContext
        The page.
    dialogue : Dialogue
        With the aircraft.
    meta : ParameterMeta
        Metadata of the parameter.
    """

    def __init__(self, context: ViewContext, dialogue: Dialogue, meta: ParameterMeta) -> None:
        self._context = context
        self._meta = meta
        self._system_id = dialogue.parameters.system_id
        self._shown: object = None
        value = dialogue.parameters.entries[meta.name].value
        self._settled: float | None = value
        """What the field holds while nothing else is typed."""
        with ui.element("div").classes("parameter") as self._row:
            self._row.props["data-name"] = meta.name
            with ui.element("div"):
                ui.label(printable(meta.name)).classes("name")
                meaning = ui.label(printable(meta.short)).classes("meaning")
                meaning.tooltip(printable(meta.long or meta.short))
                ui.label(printable(_range_of(meta))).classes("range")
                self._trouble = ui.label().classes("trouble").props("role=alert")
            self._field = self._build_field(value)
        self.refresh(dialogue)

    def refresh(self, dialogue: Dialogue) -> None:
        """Show the aircraft's present value."""
        name, parameters = self._meta.name, dialogue.parameters
        value, trouble = parameters.entries[name].value, parameters.refused.get(name, "")
        pending = name in parameters.pending
        if (value, trouble, pending) == self._shown:
            return
        self._shown = (value, trouble, pending)
        self._trouble.set_text("waiting for the answer …" if pending else printable(trouble))
        self._trouble.set_visibility(bool(trouble) or pending)
        changed = math.isfinite(self._meta.default) and not is_same_value(value, self._meta.default)
        self._row.classes(add="changed" if changed else "", remove="" if changed else "changed")
        if pending:
            return
        # What is typed and not sent yet stays; what is the same needs no writing over.
        settled = self._settled
        is_shown = settled is not None and is_same_value(settled, value)
        if self._field.value == settled and not is_shown:
            self._settled = value
            self._field.set_value(value)

    def _build_field(self, value: float) -> Any:
        field: Any
        meta, may = self._meta, self._context.may_change
        if meta.choices:
            options = {number: printable(text) for number, text in meta.choices}
            options.setdefault(value, f"{value:g}")
            field = ui.select(options, value=value, on_change=lambda e: self._set(e.value))
            field.props("dense outlined options-dense")
        else:
            field = ui.number(value=value, suffix=printable(unit_text(meta.unit)), format="%.7g")
            field.props("dense outlined step=any hide-bottom-space")
            # Only a finished value is sent, not each typed digit.
            field.on("keydown.enter", lambda: self._set(field.value))
            field.on("blur", lambda: self._set(field.value))
        field.props["aria-label"] = meta.name
        field.set_enabled(may)
        return field

    def _set(self, value: float | None) -> None:
        self._settled = value
        if value is None:
            return
        name, dialogues = self._meta.name, self._context.parts.dialogues
        parameters = dialogues.of(self._system_id).parameters
        kept = parameters.entries[name].value
        if name not in parameters.pending and is_same_value(value, kept):
            return
        try:
            self._context.check_may_change()
            dialogues.change(self._system_id, name, float(value))
        except (ValueError, NotAllowedError) as error:
            ui.notify(printable(str(error)), type="negative")
            return
        self._shown = None


def _range_of(meta: ParameterMeta) -> str:
    parts = []
    if math.isfinite(meta.low) or math.isfinite(meta.high):
        low = f"{meta.low:g}" if math.isfinite(meta.low) else "any"
        high = f"{meta.high:g}" if math.isfinite(meta.high) else "any"
        parts.append(f"{low} to {high} {unit_text(meta.unit)}".strip())
    elif meta.unit:
        parts.append(unit_text(meta.unit))
    if math.isfinite(meta.default):
        word = next((text for number, text in meta.choices if number == meta.default), None)
        parts.append(f"default {word or f'{meta.default:g}'}")
    return " · ".join(parts)
