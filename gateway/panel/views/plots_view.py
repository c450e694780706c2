"""View 7: any numeric field of any message as strip charts over the last minutes."""

import base64
from typing import Any, Final

from nicegui import ui

from gateway.panel.view_context import ViewContext
from gateway.panel.widgets import LiveChart, icon_button
from gateway.printable import printable

REFRESH_S: Final = 0.25
CHOICES_S: Final = 2.0
MAX_STRIPS: Final = 8
WINDOWS: Final = {15: "15 s", 60: "1 min", 120: "2 min", 300: "5 min"}
FIRST: Final = (
    ("ATTITUDE.roll", "ATTITUDE.pitch"),
    ("VFR_HUD.alt", "VFR_HUD.climb"),
)
"""Default fields, which every vehicle sends."""


class PlotsView:
    """The strips and their common controls."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._strips: list[_Strip] = []
        self._names: list[str] = []
        self._paused = False
        self._window_s = 60
        with ui.element("div").classes("tools"):
            self._pause = ui.button("Pause", icon="pause", on_click=self._toggle).props("no-caps")
            self._pause.props("unelevated dense").mark("plots-pause")
            window = ui.toggle(WINDOWS, value=60, on_change=self._on_window)
            window.props('dense no-caps unelevated aria-label="Span of time"')
            ui.element("div").classes("spring")
            add = ui.button("Add a chart", icon="add", on_click=lambda: self._add(()))
            add.props("flat dense no-caps")
        self._column = ui.element("div").classes("strips")
        for fields in FIRST:
            self._add(fields)
        self._context.on_select(self._reload)
        self._context.every(REFRESH_S, self._refresh)
        self._context.every(CHOICES_S, self._offer)

    def remove(self, strip: "_Strip") -> None:
        """Remove a chart."""
        self._strips.remove(strip)
        strip.card.delete()

    def on_hand(self) -> None:
        """Pause all charts when the user pauses one."""
        self._set_paused(paused=True)

    def _add(self, fields: tuple[str, ...]) -> None:
        if len(self._strips) >= MAX_STRIPS:
            ui.notify(f"at most {MAX_STRIPS} charts", type="warning")
            return
        with self._column:
            strip = _Strip(self, self._context, fields)
        strip.offer(self._names)
        strip.chart.element.set_window(self._window_s)
        self._strips.append(strip)

    def _toggle(self) -> None:
        self._set_paused(paused=not self._paused)

    def _set_paused(self, *, paused: bool) -> None:
        self._paused = paused
        self._pause.set_text("Resume" if paused else "Pause")
        self._pause.props["icon"] = "play_arrow" if paused else "pause"
        for strip in self._strips:
            strip.chart.element.pause(paused=paused)

    def _on_window(self, event: Any) -> None:
        self._window_s = event.value
        for strip in self._strips:
            strip.chart.element.set_window(event.value)

    def _reload(self) -> None:
        self._offer()
        for strip in self._strips:
            strip.chart.reload()

    def _refresh(self) -> None:
        for strip in self._strips:
            strip.chart.refresh()

    def _offer(self) -> None:
        fields = self._context.received.fields().items()
        names = [f"{kind}.{field}" for kind, inner in fields for field in inner]
        if names != self._names:
            self._names = names
            for strip in self._strips:
                strip.offer(names)


class _Strip:
    """One chart with the choice of its fields."""

    def __init__(self, view: PlotsView, context: ViewContext, fields: tuple[str, ...]) -> None:
        self._fields = list(fields)
        with ui.element("div").classes("card strip-card") as self.card:
            with ui.element("div").classes("strip-head"):
                self._choice = ui.select(
                    {name: name for name in self._fields},
                    value=self._fields,
                    multiple=True,
                    with_input=True,
                    on_change=self._on_choice,
                ).classes("strip-choice")
                self._choice.props('use-chips dense borderless aria-label="Fields"')
                self._choice.props('placeholder="Choose fields: ATTITUDE.roll, …"')
                icon_button("image", "Save as PNG", self._save_png)
                icon_button("table_view", "Save as CSV", self._save_csv)
                icon_button("close", "Remove this chart", lambda: view.remove(self))
            self.chart = LiveChart(context, fields)
            self.chart.element.on("paused", view.on_hand)

    def offer(self, names: list[str]) -> None:
        options = {name: printable(name) for name in sorted({*names, *self._fields})}
        self._choice.set_options(options, value=self._fields)

    def _on_choice(self, event: Any) -> None:
        if list(event.value) != self._fields:
            self._fields = list(event.value)
            self.chart.choose(self._fields)

    async def _save_png(self) -> None:
        url = await self.chart.element.picture()
        ui.download.content(base64.b64decode(url.partition(",")[2]), "plot.png", "image/png")

    async def _save_csv(self) -> None:
        ui.download.content(await self.chart.table(), "plot.csv", "text/csv")
