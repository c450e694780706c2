"""A strip chart fed from the fields' history."""

from collections.abc import Sequence

from gateway.clock import unix_time_us
from gateway.panel.instruments.strip_chart import Points, StripChart
from gateway.panel.state.field_csv import fields_csv
from gateway.panel.view_context import ViewContext


class LiveChart:
    """One chart of any fields of the selected aircraft, built at the current place of the page.

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
        named = [(name, history.unit(system_id, name)) for name in self.fields]
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
        series = {name: history.series(system_id, name, begin_us, end_us) for name in self.fields}
        units = {name: history.unit(system_id, name) for name in self.fields}
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
            found.append(((time_us + zero_us) // 1000, values))
        return found
