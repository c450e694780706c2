"""Controls of the gateway's recorder: start, stop, save, delete."""

from functools import partial
from typing import Any, Final

from nicegui import ui

from gateway.panel.view_context import ViewContext
from gateway.panel.widgets.prompts import closing, confirm, named_dialog, notify_failure
from gateway.printable import printable

REFRESH_S: Final = 0.5
IDLE: Final = "idle"
LOOKS: Final = {"recording": "bad", "opening": "warn", "blocked": "bad", "idle": ""}


class RecorderControls:
    """A line with the recorder's state and buttons, built at the current place of the page.

    Parameters
    ----------
    context : ViewContext
        The page.
    """

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        with ui.element("div").classes("line recorder"):
            self._state = ui.label().classes("chip").props("data-role=recorder")
            self._detail = ui.label().classes("soft figure spring")
            self._buttons = ui.element("div").classes("line")
            if context.may_change:
                with self._buttons:
                    self._build_buttons()
        context.every(REFRESH_S, self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Show the recorder's state."""
        recorder = self._context.parts.watch.recorder
        self._buttons.set_visibility(recorder is not None)
        if recorder is None:
            self._state.set_text("no gateway on this machine")
            self._detail.set_text("")
            return
        self._state.set_text(recorder["state"])
        self._state.classes(replace="chip").classes(LOOKS.get(recorder["state"], ""))
        self._detail.set_text(printable(_detail_of(recorder)))

    def _build_buttons(self) -> None:
        for text, icon, look, act in (
            ("Start", "fiber_manual_record", "no-caps dense color=negative", self._order("start")),
            ("Stop", "stop", "no-caps dense outline", self._order("stop")),
            ("Save …", "save", "no-caps dense flat", self._ask_save),
            ("Delete …", "delete", "no-caps dense flat", self._ask_delete),
        ):
            button = ui.button(text, icon=icon, on_click=act)
            button.props["aria-label"] = f"{text.removesuffix(' …')} recording"
            _apply(button, look)

    def _order(self, verb: str) -> Any:
        async def order() -> None:
            with notify_failure(self._context):
                await self._context.ask(f"record.{verb}")
                await self._refresh_status()

        return order

    async def _refresh_status(self) -> None:
        await self._context.parts.watch.refresh()
        self.refresh()

    def _ask_save(self) -> None:
        with named_dialog("Save the recording") as dialog, ui.card().classes("asks"):
            ui.label("Name for this recording, or the last one").classes("title")
            name = ui.input().props('dense outlined autofocus aria-label="Name of the recording"')
            save = closing(dialog, lambda: self._save(name.value))
            name.on("keydown.enter", save)
            ui.button("Save", on_click=save).props("no-caps")
            ui.button("Cancel", on_click=dialog.close).props("no-caps flat")
        dialog.on("hide", dialog.delete)
        dialog.open()

    async def _save(self, name: str) -> None:
        with notify_failure(self._context):
            await self._context.ask("record.save", name=name.strip())
            ui.notify(f"Saved as {printable(name.strip())}", type="positive")
            await self._refresh_status()

    async def _ask_delete(self) -> None:
        with notify_failure(self._context):
            recordings = await self._context.ask("record.list")
            if not recordings:
                ui.notify("Nothing was recorded yet.", type="warning")
                return
            name = recordings[-1]["name"]
            question = f"Delete the last recording, {name}, permanently?"
            confirm(question, "Delete", partial(self._delete, name))

    async def _delete(self, name: str) -> None:
        with notify_failure(self._context):
            await self._context.ask("record.delete", name=name)
            ui.notify(f"{printable(name)} is deleted", type="positive")
            await self._refresh_status()


def _apply(button: ui.button, look: str) -> None:
    """Set properties of a constant of this file: words, or `name=value`."""
    for part in look.split():
        name, _, value = part.partition("=")
        button.props[name] = value or True


def _detail_of(recorder: dict[str, Any]) -> str:
    parts = [recorder["reason"]] if recorder["reason"] else []
    if recorder["name"] and recorder["state"] != IDLE:
        parts += [recorder["name"], f"{recorder['part_bytes'] / 1e6:.1f} MB"]
    parts += [f"{recorder['free_bytes'] / 1e9:.1f} GB free in {recorder['folder']}"]
    return " · ".join(parts)
