"""Elements that several views share: headings, dialogues, uploads, tables, the recorder, charts."""

import math
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from nicegui import ui
from nicegui.element import Element
from nicegui.elements.mixins.text_element import TextElement
from nicegui.events import GenericEventArguments
from pymavlink.dialects.v20 import all as mavlink

from gateway.clock import unix_time_us
from gateway.live.control_socket import ControlError
from gateway.panel.playback import PlaybackError
from gateway.panel.recording_jobs import ExportError
from gateway.panel.state.fields import FloatArray, IntArray, fields_csv, shown_unit
from gateway.panel.uplink import CommandFailedError
from gateway.panel.view_context import WEB, NotAllowedError, ViewContext
from gateway.printable import printable
from gateway.recordings.index import RecordingError

FAILURES: Final = (
    ControlError, CommandFailedError, ExportError, NotAllowedError, PlaybackError, RecordingError,
    OSError,
)  # fmt: skip
WRITE: Final = 1.0
"""Value of PREFLIGHT_STORAGE_PARAMETER_ACTION: store the parameters."""
Cells = Sequence[str | tuple[str, ...]]
"""Each cell is a text, or a text with style class, icon and track. The class is `""`, `good`,
`warn`, `bad`, `info` or `soft`; the icon is the name of a Material icon; the track, corners of a
line in a box of 46 by 24, is optional."""
REFRESH_S: Final = 0.5
IDLE: Final = "idle"
LOOKS: Final = {"recording": "bad", "opening": "warn", "blocked": "bad", "idle": ""}
ANSWER_S: Final = 60.0
"""Timeout of the browser: drawing an image takes seconds on a small or busy computer."""
Points = tuple[IntArray, FloatArray]
"""Times in ms since 1970, and values."""


def heading(text: str) -> TextElement:
    """Add the heading of a card."""
    return TextElement(tag="h2", text=text).classes("title")


def icon_button(icon: str, title: str, act: Callable[..., Any]) -> ui.button:
    """Add a round button with an icon; the title is its tooltip, and read by screen readers."""
    button = ui.button(icon=icon, on_click=act).props("flat round dense")
    button.props["aria-label"] = button.props["title"] = title
    return button


def choice(
    label: str, options: Any, value: Any, on_change: Callable[..., Any] | None = None
) -> ui.select:
    """Add a choice with a label that screen readers read."""
    select = ui.select(options, value=value, on_change=on_change)
    select.props("dense outlined options-dense").props["aria-label"] = label
    return select


class UploadButton(Element, component=WEB / "upload_button.js"):
    """Upload a file; emits `uploaded` with the result, which is also shown on the page."""

    def __init__(
        self, context: ViewContext, path: str, accept: str, *, label: str, title: str
    ) -> None:
        super().__init__()
        self._props |= {"path": path, "accept": accept, "label": label, "title": title}
        self._props["limit"] = context.parts.settings.upload_limit_mb * 1_000_000
        self.on("uploaded", _show_upload)


def _show_upload(event: GenericEventArguments) -> None:
    text = printable(str(event.args["text"]))
    ui.notify(text, type="positive" if event.args["ok"] else "negative")


@contextmanager
def notify_failure(context: ViewContext) -> Iterator[None]:
    """Show on the page the reason why a request was not carried out."""
    try:
        yield
    except FAILURES as error:
        text = printable(str(error))
        if context.parts.uplink.is_local or not isinstance(error, ControlError):
            ui.notify(text, type="negative", multi_line=True)
        else:
            ui.notify(f"only a gateway on this machine can: {text}", type="negative")


@contextmanager
def asking(title: str, look: str = "") -> Iterator[ui.dialog]:
    """Open a dialog with a title, the elements built in the block, and a button that cancels."""
    dialog = ui.dialog()
    # A screen reader announces the dialog by this name.
    dialog.props["aria-label"] = title
    with dialog, ui.card().classes("asks"):
        ui.label(printable(title)).classes("title").classes(look)
        yield dialog
        ui.button("Cancel", on_click=dialog.close).props("no-caps flat")
    dialog.on("hide", dialog.delete)
    dialog.open()


@contextmanager
def progress_shown(text: str) -> Iterator[None]:
    """Show a text on the page while the block runs."""
    note = ui.notification(printable(text), spinner=True, timeout=None, type="ongoing")
    try:
        yield
    finally:
        note.dismiss()


def close_and(
    dialog: ui.dialog, act: Callable[[], Awaitable[Any]]
) -> Callable[[], Awaitable[None]]:
    """Return a function for a button in a dialog, which closes the dialog and then acts.

    Its notifications appear on the page: the dialog is deleted before a slow link has answered.
    """
    page = ui.context.client

    async def run() -> None:
        dialog.close()
        with page:
            await act()

    return run


def confirm(
    question: str, word: str, act: Callable[[], Awaitable[Any]], *, grave: bool = True
) -> None:
    """Ask for confirmation, and then act; the button of a destructive action is red."""
    with asking(question) as dialog:
        button = ui.button(word, on_click=close_and(dialog, act)).props("no-caps")
        button.props("color=negative" if grave else "")


def allow(button: ui.button, reason: str = "") -> None:
    """Enable a button; with a reason disable it, and show the reason as its tooltip."""
    button.set_enabled(not reason)
    if button.props.get("title", "") != reason:
        button.props["title"] = reason


async def store_parameters(context: ViewContext, done: str) -> bool:
    """Request the selected aircraft to store its parameters; return whether it has stored them."""
    try:
        await context.command(mavlink.MAV_CMD_PREFLIGHT_STORAGE, WRITE)
    except CommandFailedError as error:
        ui.notify(f"Not stored: {error}", type="negative")
        return False
    ui.notify(done, type="positive")
    return True


@dataclass(frozen=True, slots=True)
class RowButton:
    """A button at the end of each row."""

    icon: str
    title: str
    act: Callable[[str], object]


class DataTable(Element, component=WEB / "data_table.js"):
    """Rows with a key each."""

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
        shown = []
        for key, row in rows.items():
            cells = [(cell, "") if isinstance(cell, str) else cell for cell in row]
            printed = [[printable(text), *rest] for text, *rest in cells]
            shown.append({"key": key, "cells": printed})
        if shown != self._rows:
            self._rows = shown
            self.props["rows"] = shown

    async def _on_act(self, event: GenericEventArguments) -> None:
        number, key = event.args
        if any(row["key"] == key for row in self._rows):
            result = self._buttons[int(number)].act(key)
            if hasattr(result, "__await__"):
                await result


class RecorderControls:
    """A line with the recorder's state and buttons, built at the current position in the page."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        with ui.element("div").classes("line recorder"):
            self._state = ui.label().classes("chip").props("data-role=recorder")
            self._detail = ui.label().classes("soft figure spring")
            self._line = ui.element("div").classes("line")
            self._buttons: dict[str, ui.button] = {}
            if context.may_change:
                with self._line:
                    self._build_buttons()
        context.every(REFRESH_S, self.refresh)
        self.refresh()

    def refresh(self) -> None:
        """Show the recorder's state."""
        recorder = self._context.parts.watch.recorder
        self._line.set_visibility(recorder is not None)
        if recorder is None:
            self._state.set_text("no gateway on this machine")
            self._detail.set_text("")
            return
        self._state.set_text(recorder["state"])
        self._state.classes(LOOKS.get(recorder["state"], ""), replace="chip")
        self._detail.set_text(printable(_detail_of(recorder)))
        for verb, button in self._buttons.items():
            allow(button, why_not(verb, recorder))

    def _build_buttons(self) -> None:
        for text, icon, look, value, act in (
            ("Start", "fiber_manual_record", "color", "negative", partial(self._ask, "start")),
            ("Stop", "stop", "outline", True, partial(self._ask, "stop")),
            ("Save …", "save", "flat", True, self._ask_save),
            ("Delete …", "delete", "flat", True, self._ask_delete),
        ):
            verb = text.removesuffix(" …")
            button = ui.button(text, icon=icon, on_click=act).props("no-caps dense")
            button.props["aria-label"] = f"{verb} recording"
            button.props[look] = value
            self._buttons[verb.lower()] = button

    async def _ask(self, verb: str, done: str = "", **params: Any) -> None:
        with notify_failure(self._context):
            await self._context.ask(f"record.{verb}", **params)
            if done:
                ui.notify(printable(done), type="positive")
            await self._context.parts.watch.refresh()
            self.refresh()

    def _ask_save(self) -> None:
        with asking("Name for this recording, or the last one") as dialog:
            name = ui.input().props('dense outlined autofocus aria-label="Name of the recording"')
            save = close_and(dialog, lambda: self._save(name.value.strip()))
            name.on("keydown.enter", save)
            ui.button("Save", on_click=save).props("no-caps")

    async def _save(self, name: str) -> None:
        await self._ask("rename", f"Saved as {name}", name=name)

    async def _ask_delete(self) -> None:
        with notify_failure(self._context):
            name = (self._context.parts.watch.recorder or {}).get("name", "")
            if name not in (each["name"] for each in await self._context.ask("record.list")):
                ui.notify("This recording is deleted already.", type="warning")
                return
            delete = partial(self._ask, "delete", f"{name} is deleted", name=name)
            confirm(f"Delete the last recording, {name}, permanently?", "Delete", delete)


def why_not(verb: str, recorder: Mapping[str, Any]) -> str:
    """Return the reason why the recorder cannot `start`, `stop`, `save` or `delete` now, or ""."""
    is_idle = recorder["state"] == IDLE
    if verb == "start":
        is_under_way = recorder["state"] in ("recording", "opening")
        return "A recording is in progress." if is_under_way else ""
    if verb == "stop":
        return "Nothing is being recorded." if is_idle else ""
    if not recorder["name"]:
        return "Nothing was recorded yet."
    return "Stop the recording first." if verb == "delete" and not is_idle else ""


def _detail_of(recorder: dict[str, Any]) -> str:
    parts = [recorder["reason"]] if recorder["reason"] else []
    if recorder["name"] and recorder["state"] != IDLE:
        parts += [recorder["name"], f"{recorder['part_bytes'] / 1e6:.1f} MB"]
    parts += [f"{recorder['free_bytes'] / 1e9:.1f} GB free in {recorder['folder']}"]
    return " · ".join(parts)


class StripChart(ui.echart, component=WEB / "strip_chart.js"):
    """A chart that follows the time until it is paused; wheel and drag pause and zoom it.

    It emits `ready` once fields can be set, and `paused` when the operator paused it.
    """

    def __init__(self) -> None:
        super().__init__({})
        # Only the browser changes the content of the chart.
        self._update_method = None

    def set_fields(
        self, fields: Sequence[tuple[str, str]], points: Sequence[Points], now_ms: float
    ) -> None:
        """Show these fields from now on."""
        named = [{"name": printable(name), "unit": unit} for name, unit in fields]
        self.run_method("set_fields", named, [_plain(p) for p in points], now_ms)

    def append(self, points: Sequence[Points], now_ms: float) -> None:
        """Add new data, field by field."""
        self.run_method("append", [_plain(p) for p in points], now_ms)

    def pause(self, *, paused: bool) -> None:
        """Pause, or follow the time again."""
        self.run_method("pause", paused)

    def set_window(self, seconds: int) -> None:
        """Set the length of the shown past."""
        self.run_method("set_window", seconds)

    async def span_ms(self) -> tuple[float, float]:
        """Return the visible span, in ms since 1970."""
        begin, end = await self.run_method("range", timeout=ANSWER_S)
        return float(begin), float(end)

    async def picture(self) -> str:
        """Return the chart as a data URL of a PNG."""
        return str(await self.run_method("picture", timeout=ANSWER_S))


class LiveChart:
    """A strip chart of any fields of the selected aircraft, fed from their history."""

    def __init__(self, context: ViewContext, fields: Sequence[str]) -> None:
        self._context = context
        self.fields = list(fields)
        self._sent_us: dict[str, int] = {}
        self._is_ready = False
        self.element = StripChart().classes("strip")
        self.element.on("ready", self._on_ready)

    def choose(self, fields: Sequence[str]) -> None:
        """Show other fields."""
        self.fields = list(fields)
        self.reload()

    def reload(self) -> None:
        """Send all data, as after the selection of another aircraft."""
        if not self._is_ready:
            return
        self._sent_us = {}
        named = [(name, self._unit(name)[1]) for name in self.fields]
        self.element.set_fields(named, self._new_points(), unix_time_us() / 1000)

    def refresh(self) -> None:
        """Send the new data."""
        if not (self._is_ready and self.fields):
            return
        if any(name not in self._sent_us and self._unit(name)[1] for name in self.fields):
            # The unit is known only after the first message of its kind.
            self.reload()
            return
        self.element.append(self._new_points(), unix_time_us() / 1000)

    async def table(self) -> str:
        """Return the visible data as CSV."""
        begin_ms, end_ms = await self.element.span_ms()
        zero_us = self._context.zero_unix_us
        span = (round(begin_ms * 1000) - zero_us, round(end_ms * 1000) - zero_us)
        series = {name: self._series(name, *span) for name in self.fields}
        return fields_csv(series, {name: self._unit(name)[1] for name in self.fields}, zero_us)

    def _unit(self, name: str) -> tuple[float, str]:
        return shown_unit(self._context.received.unit(name))

    def _series(self, name: str, after_us: int, until_us: int | None = None) -> Points:
        time_us, values = self._context.received.series(name, after_us, until_us)
        return time_us, values * self._unit(name)[0]

    def _on_ready(self) -> None:
        self._is_ready = True
        self.reload()

    def _new_points(self) -> list[Points]:
        zero_us, found = self._context.zero_unix_us, []
        for name in self.fields:
            time_us, values = self._series(name, self._sent_us.get(name, -1))
            if len(time_us):
                self._sent_us[name] = int(time_us[-1])
            found.append(((time_us + zero_us) // 1000, values))
        return found


def _plain(points: Points) -> tuple[list[int], list[float | None]]:
    """Convert to lists for JSON, without NaN, and with the seven digits of a 32-bit float."""
    time_ms, values = points
    return time_ms.tolist(), [
        float(f"{value:.7g}") if math.isfinite(value) else None for value in values.tolist()
    ]
