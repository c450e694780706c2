"""Several fields over the last minutes, on one chart that scrolls in the browser."""

import math
from collections.abc import Sequence
from typing import Final

from nicegui import ui

from gateway.panel.state.field_history import FloatArray, IntArray
from gateway.panel.view_context import WEB

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
        named = [{"name": name, "unit": unit} for name, unit in fields]
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


def _plain(points: Points) -> tuple[list[int], list[float | None]]:
    """Convert to JSON, which has no NaN; a 32-bit float has seven digits."""
    time_ms, values = points
    return time_ms.tolist(), [
        float(f"{value:.7g}") if math.isfinite(value) else None for value in values.tolist()
    ]
