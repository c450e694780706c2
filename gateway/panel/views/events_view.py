"""View 8: the aircraft's texts with time and severity; and the page's banners."""

from datetime import datetime
from typing import Any, Final

from nicegui import ui

from gateway.panel.state.alerts import Alert, AlertLevel, alerts_of
from gateway.panel.state.vehicle import TimedText
from gateway.panel.view_context import ViewContext
from gateway.panel.widgets import Cells, DataTable, choice
from gateway.printable import printable

REFRESH_S: Final = 0.5
SEVERITIES: Final = (
    "Emergency", "Alert", "Critical", "Error", "Warning", "Notice", "Info", "Debug",
)  # fmt: skip
"""Names by MAV_SEVERITY."""
SHOWN: Final = {7: "everything", 5: "notice and above", 4: "warning and above", 2: "critical"}
LOOKS: Final = ("bad", "bad", "bad", "bad", "warn", "info", "info", "soft")
ICONS: Final = {"bad": "error", "warn": "warning", "info": "info", "soft": "bug_report"}
"""Icon of each look, because colour alone is not accessible to everybody."""


def build_banner(context: ViewContext) -> None:
    """Build the banners of alerts; shown above every view."""
    shown: list[Alert] = []
    area = ui.element("div").props('role=alert aria-live="assertive"')

    def refresh() -> None:
        nonlocal shown
        vehicle = context.vehicle
        if vehicle is None or not vehicle.is_live:
            # Alerts of a recording would look like present ones.
            alerts = []
        else:
            alerts = alerts_of(vehicle, context.parts.watch.status, context.now_us)
        if alerts == shown:
            return
        shown = alerts
        area.clear()
        with area:
            for alert in alerts:
                _build_alert(alert)

    ui.timer(REFRESH_S, refresh)


def _build_alert(alert: Alert) -> None:
    grave = alert.level is AlertLevel.CRITICAL
    with ui.element("div").classes("banner bad" if grave else "banner warn"):
        ui.icon("report" if grave else "warning")
        ui.label(printable(alert.title)).classes("banner-title")
        ui.label(printable(alert.detail))


class EventsView:
    """The log of one page."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._drawn: object = None
        with ui.element("div").classes("tools"):
            self._least = choice("Severity", SHOWN, 7, self._refresh)
            self._search = ui.input(placeholder="Search", on_change=self._refresh)
            self._search.props('dense outlined clearable aria-label="Search in the texts"')
            ui.element("div").classes("spring")
            save = ui.button("Save as CSV", icon="table_view", on_click=self._save)
            save.props("flat dense no-caps")
        with ui.element("div").classes("card events"):
            self._table = DataTable(("Time", "Severity", "Text"), "No texts yet.")
        self._context.on_select(self._refresh)
        self._context.every(REFRESH_S, self._refresh)
        self._refresh()

    def _chosen(self) -> list[TimedText]:
        vehicle = self._context.vehicle
        if vehicle is None:
            return []
        wanted = (self._search.value or "").casefold()
        return [
            text
            for text in reversed(vehicle.texts.all)
            if text.severity <= self._least.value and wanted in text.text.casefold()
        ]

    def _refresh(self, _: Any = None) -> None:
        texts = self._chosen()
        state = (self._context.system_id, [(text.number, len(text.text)) for text in texts])
        if state == self._drawn:
            return
        self._drawn = state
        self._table.show({str(text.number): _row(text, self._when(text)) for text in texts})

    def _when(self, text: TimedText) -> datetime:
        unix_us = self._context.zero_unix_us + text.time_us
        return datetime.fromtimestamp(unix_us / 1e6).astimezone()

    def _save(self) -> None:
        lines = ["time,severity,text"]
        for text in reversed(self._chosen()):
            quoted = text.text.replace('"', '""')
            when = self._when(text).isoformat(timespec="milliseconds")
            lines.append(f'{when},{_severity(text)},"{quoted}"')
        ui.download.content("\n".join(lines) + "\n", "events.csv", "text/csv")


def _severity(text: TimedText) -> str:
    return SEVERITIES[min(text.severity, len(SEVERITIES) - 1)]


def _row(text: TimedText, when: datetime) -> Cells:
    look = LOOKS[min(text.severity, len(LOOKS) - 1)]
    return (
        (f"{when:%H:%M:%S}", "soft"),
        (_severity(text), look, ICONS[look]),
        (text.text, look if look in ("bad", "soft") else ""),
    )
