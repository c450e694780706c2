"""Several fields over the last minutes, on one chart that scrolls in the browser."""

import math
from collections.abc import Sequence
from typing import Final

from nicegui import ui

from gateway.clock import unix_time_us
from gateway.panel.state.fields import FloatArray, IntArray, fields_csv, shown_unit
from gateway.panel.view_context import WEB, ViewContext
from gateway.printable import printable

ANSWER_S: Final = 60.0
"""Longest wait for the browser: drawing a picture takes seconds of a small or busy computer."""

Points = tuple[IntArray, FloatArray]
"""Times in ms since 1970, and values."""


class StripChart(ui.echart, component=WEB / "strip_chart.js"):
    """A chart that follows the time until it is paused; wheel and drag pause and zoom it.

    It emits `ready` once fields can be set, and `paused` when the operator paused it.
    """

    def __init__(self) -> None:
        super().__init__({})
        # The browser draws the chart by itself.
        self._update_method = None

    def set_fields(
        self, fields: Sequence[tuple[str, str]], points: Sequence[Points], now_ms: float
    ) -> None:
        """Show these fields from now on.

        Parameters
        ----------
        fields : sequence of (str, str)
            Their names and units; each unit gets its own axis.
        points : sequence of (ndarray, ndarray)
            Existing data of each: times in ms since 1970, values.
        now_ms : float
            The present time on the same clock.
        """
        named = [{"name": printable(name), "unit": unit} for name, unit in fields]
        self.run_method("set_fields", named, [_plain(p) for p in points], now_ms)

    def append(self, points: Sequence[Points], now_ms: float) -> None:
        """Add new data, field by field."""
        self.run_method("append", [_plain(p) for p in points], now_ms)

    def pause(self, *, paused: bool) -> None:
        """Pause, or follow the time again."""
        self.run_method("pause", paused)

    def set_window(self, seconds: int) -> None:
        """Set how much of the past is shown."""
        self.run_method("set_window", seconds)

    async def span_ms(self) -> tuple[float, float]:
        """Return the visible span, in ms since 1970."""
        begin, end = await self.run_method("range", timeout=ANSWER_S)
        return float(begin), float(end)

    async def picture(self) -> str:
        """Return the chart as a data URL of a PNG."""
        return str(await self.run_method("picture", timeout=ANSWER_S))


class LiveChart:
    """A strip chart of any fields of the selected aircraft, fed from their history.

    Parameters
    ----------
    context : ViewContext
        The page.
    fields : sequence of str
        Message and field of each; see `FieldHistory.series`.
    """

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
        """Send all data, as after another aircraft was selected."""
        if not self._is_ready:
            return
        self._sent_us = {}
        history, system_id = self._context.parts.history, self._context.system_id or 0
        named = [(name, shown_unit(history.unit(system_id, name))[1]) for name in self.fields]
        self.element.set_fields(named, self._news(), unix_time_us() / 1000)

    def refresh(self) -> None:
        """Send the new data."""
        if not (self._is_ready and self.fields):
            return
        history, system_id = self._context.parts.history, self._context.system_id or 0
        if any(name not in self._sent_us and history.unit(system_id, name) for name in self.fields):
            # The unit is known only since the first message of its kind came.
            self.reload()
            return
        self.element.append(self._news(), unix_time_us() / 1000)

    async def table(self) -> str:
        """Return the visible data as CSV."""
        begin_ms, end_ms = await self.element.span_ms()
        zero_us = self._zero_unix_us()
        history, system_id = self._context.parts.history, self._context.system_id or 0
        begin_us, end_us = round(begin_ms * 1000) - zero_us, round(end_ms * 1000) - zero_us
        shown = {name: shown_unit(history.unit(system_id, name)) for name in self.fields}
        series = {}
        for name, (factor, _) in shown.items():
            time_us, values = history.series(system_id, name, begin_us, end_us)
            series[name] = (time_us, values * factor)
        units = {name: unit for name, (_, unit) in shown.items()}
        return fields_csv(series, units, zero_us)

    def _on_ready(self) -> None:
        self._is_ready = True
        self.reload()

    def _zero_unix_us(self) -> int:
        return unix_time_us() - self._context.now_us

    def _news(self) -> list[Points]:
        history, system_id = self._context.parts.history, self._context.system_id or 0
        zero_us, found = self._zero_unix_us(), []
        for name in self.fields:
            time_us, values = history.series(system_id, name, self._sent_us.get(name, -1))
            if len(time_us):
                self._sent_us[name] = int(time_us[-1])
            factor, _ = shown_unit(history.unit(system_id, name))
            found.append(((time_us + zero_us) // 1000, values * factor))
        return found


def _plain(points: Points) -> tuple[list[int], list[float | None]]:
    """Convert to JSON, which has no NaN; a 32-bit float has seven digits."""
    time_ms, values = points
    return time_ms.tolist(), [
        float(f"{value:.7g}") if math.isfinite(value) else None for value in values.tolist()
    ]
