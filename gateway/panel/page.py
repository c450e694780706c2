"""The page itself: its header with aircraft and state, its views, its keys.

A view is one entry of `VIEWS`; see `view_context.py` for the interface of its file.
"""

import math
from collections.abc import Mapping
from typing import Any, Final

from nicegui import ui
from nicegui.element import Element

from gateway.panel.added_views import ADDED_VIEWS, View
from gateway.panel.admission import Role
from gateway.panel.playback import Playback
from gateway.panel.player_bar import PlayerBar
from gateway.panel.view_context import WEB, PanelParts, ViewContext
from gateway.panel.views.calibration_view import CalibrationView
from gateway.panel.views.events_view import EventsView, build_banner
from gateway.panel.views.flight_view import build_flight, build_map
from gateway.panel.views.link_view import LinkView
from gateway.panel.views.plots_view import PlotsView
from gateway.panel.views.recordings_view import RecordingsView
from gateway.panel.views.tuning_view import TuningView
from gateway.panel.widgets import icon_button, notify_failure
from gateway.printable import NO_RECEIVER, printable, receiver_state
from gateway.units import counted

STATE_S: Final = 0.5
PANEL_CLIENT: Final = "panel"
"""Name of the panel's own port and client at the gateway."""
SILENT_S: Final = 3.0
THEMES: Final = {None: "brightness_auto", False: "light_mode", True: "dark_mode"}


VIEWS: Final = (
    View("flight", "Flight", "flight", build_flight),
    View("map", "Map", "map", build_map),
    View("link", "Link", "cell_tower", LinkView),
    View("recordings", "Recordings", "video_library", RecordingsView),
    View("calibration", "Calibration", "tune", CalibrationView),
    View("tuning", "Tuning", "settings", TuningView),
    View("plots", "Plots", "show_chart", PlotsView),
    View("events", "Events", "notifications", EventsView),
)
"""Views in the order of the rail and of the keys 1 to 9; added views follow."""


def build_page(parts: PanelParts, role: Role) -> None:
    """Build the page for one browser."""
    page = ui.context.client
    playback = Playback(parts.uplink, parts.fleet, page.id)
    page.on_delete(playback.close)
    _Page(ViewContext(parts, role, parts.settings.units, playback, page.id))


class PageRail(Element, component=WEB / "page_rail.js"):
    """The choice of views, drawn by the browser, which also handles the page's keys.

    It emits `show` with the key of a view, `theme`, and `toggle` for the space bar.
    """


class _Page:
    """The elements of one browser's page; a view is built when it is first shown."""

    def __init__(self, context: ViewContext) -> None:
        self._context = context
        self._views = {view.key: view for view in (*VIEWS, *ADDED_VIEWS.values())}
        self._built: set[str] = set()
        self._panels: dict[str, ui.element] = {}
        self._dark = ui.dark_mode(None)
        self._names: dict[int, str] = {}
        self._chips: list[tuple[str, str]] = []
        self._shown_lines: list[str] = []
        with ui.element("div").classes("shell") as self._shell:
            self._build_head()
            with ui.element("div").classes("banners"):
                self._build_playback_bar()
                self._build_waiting()
                build_banner(self._context)
            self._build_rail()
            with ui.element("div").classes("stage"):
                for view in self._views.values():
                    panel = self._panels[view.key] = ui.element("section").classes("view")
                    panel.props["data-view"] = view.key
                    panel.props["aria-label"] = view.title
            PlayerBar(self._context)
        ui.timer(STATE_S, self._refresh)
        self._refresh()
        self.show(VIEWS[0].key)

    def show(self, key: str) -> None:
        """Note that the browser shows a view; build it at the first time."""
        if key not in self._views:
            return
        self._context.shown = key
        if key not in self._built:
            self._built.add(key)
            self._context.building = key
            with self._panels[key]:
                self._views[key].build(self._context)

    def _build_head(self) -> None:
        with ui.element("header").classes("head"):
            with ui.element("h1").classes("brand"):
                ui.label("mavgate")
            self._choice = ui.select({}, on_change=self._on_choice).classes("choice")
            self._choice.props('dense options-dense borderless aria-label="Aircraft"')
            self._state = ui.element("div").classes("chips").props("role=status")
            ui.element("div").classes("spring")
            if self._context.role is Role.VIEWER:
                ui.label("viewer").classes("chip warn")
            units = ui.select(
                {"metric": "metric", "imperial": "imperial", "aviation": "aviation"},
                value=self._context.units,
                on_change=self._on_units,
            ).classes("choice")
            units.props('dense options-dense borderless aria-label="Units"')
            self._theme = icon_button(THEMES[None], "Light or dark", self._next_theme)

    def _build_playback_bar(self) -> None:
        with ui.element("div").classes("playback-bar").props("role=status") as self._bar:
            ui.icon("smart_display")
            self._bar_text = ui.label().classes("figure banner-title")
            self._bar_name = ui.label()
            back = ui.button("Back to live", on_click=self._on_back)
            back.props("no-caps dense unelevated color=white text-color=black")
        self._bar.set_visibility(False)

    def _build_waiting(self) -> None:
        """Build the card that is shown before the first aircraft, with the ways to add one."""
        with ui.element("div").classes("card padded waiting").props("data-role=waiting") as card:
            self._waiting, self._waiting_lines = card, ui.element("div")
            if self._context.may_change:
                link = ui.button("Add a source by its URL, or a phone by its QR code")
                link.on_click(lambda: self._rail.run_method("show", "link"))
                link.props("no-caps dense")

    def _show_waiting(self) -> None:
        is_waiting = not self._context.vehicles
        self._waiting.set_visibility(is_waiting)
        lines = waiting_lines(self._context.parts.watch.status) if is_waiting else []
        if lines != self._shown_lines:
            self._shown_lines = lines
            self._waiting_lines.clear()
            with self._waiting_lines:
                for line in lines:
                    ui.label(printable(line))

    def _on_back(self) -> None:
        self._context.playback.close()
        self._refresh()

    def _build_rail(self) -> None:
        self._rail = PageRail()
        self._rail.props["views"] = [
            {"key": view.key, "title": view.title, "icon": view.icon}
            for view in self._views.values()
        ]
        self._rail.props["units"] = self._context.units
        self._rail.props["page"] = self._context.page
        self._rail.on("show", lambda event: self.show(event.args))
        self._rail.on("theme", self._next_theme)
        self._rail.on("toggle", self._on_space)

    async def _on_space(self) -> None:
        if not self._context.playback.name:
            return
        with notify_failure(self._context):
            self._context.check_may_change()
            await self._context.playback.toggle()

    def _next_theme(self) -> None:
        order = list(THEMES)
        self._dark.value = order[(order.index(self._dark.value) + 1) % len(order)]
        self._theme.props["icon"] = THEMES[self._dark.value]

    def _on_units(self, event: Any) -> None:
        self._context.units = event.value
        self._rail.props["units"] = event.value

    def _on_choice(self, event: Any) -> None:
        self._context.select(event.value)
        self._rail.props["system_id"] = event.value

    def _refresh(self) -> None:
        context = self._context
        names = {key: vehicle.title for key, vehicle in sorted(context.vehicles.items())}
        if names != self._names:
            origins = context.parts.fleet.origins
            played = [key for key in names.keys() - self._names.keys() if key in origins]
            self._names = names
            wanted = min(played, default=context.system_id)
            first = next(iter(names), None)
            self._choice.set_options(names, value=wanted if wanted in names else first)
        self._show_playback()
        self._show_waiting()
        if (chips := _state_of(context)) != self._chips:
            self._chips = chips
            self._state.clear()
            with self._state:
                for text, kind in chips:
                    ui.label(text).classes("chip").classes(kind)

    def _show_playback(self) -> None:
        playback, status = self._context.playback, self._context.playback.status
        shown = self._context.is_playback
        if shown != self._bar.visible:
            self._bar.set_visibility(shown)
            self._shell.classes(replace="shell playback" if shown else "shell")
        if shown and status is not None:
            position, duration = (_clock(status[key]) for key in ("position_s", "duration_s"))
            self._bar_text.set_text(f"PLAYBACK {position} of {duration}")
            self._bar_name.set_text(printable(playback.name))


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


def waiting_lines(status: Mapping[str, Any] | None) -> list[str]:
    """Describe what is configured and what was received while there is no aircraft."""
    if status is None:
        return ["No aircraft yet, and no gateway runs on this machine: start `mavgate run`."]
    report, sources = status["report"], status["report"]["sources"]
    state = (report["port"], report["connected"], report["bytes_received"], report["frames"])
    configured = [receiver_state(*state), *(f"source {one['url']}" for one in sources)]
    ports = [one["name"] for one in status["listeners"] if one["name"] != PANEL_CLIENT]
    configured += [f"listening on {name}" for name in ports]
    received = [("receiver", report["frames"], "frame")]
    received += [(one["url"], one["records"], "record") for one in sources]
    received += [
        (one["name"], one["received"], "frame")
        for one in status["clients"]
        if not one["name"].startswith(PANEL_CLIENT)
    ]
    counts = [f"{counted(count, noun)} of {name}" for name, count, noun in received if count]
    return [
        "No aircraft yet.",
        f"Configured: {'; '.join(filter(None, configured)) or 'no receiver, source or port'}.",
        f"Received: {'; '.join(counts) or 'nothing'}.",
    ]


def _mode_of(context: ViewContext) -> str:
    status = context.parts.watch.status
    if status is None:
        return "MAVLink"
    if status["simulated"]:
        return "simulation"
    report = status["report"]
    if report["port"] != NO_RECEIVER:
        return "serial"
    return "sources" if report["sources"] else "router"


def _state_of(context: ViewContext) -> list[tuple[str, str]]:
    """Summarise the state of the selected aircraft: texts and their severity."""
    vehicle = context.vehicle
    if vehicle is None:
        return [("waiting for an aircraft", "warn")]
    now = vehicle.instant(context.now_us)
    has_fix = now.fix_type >= 3
    sats = f"GPS {now.satellites:.0f} sats" if math.isfinite(now.satellites) else "GPS fix"
    fix = sats if has_fix else "no GPS fix"
    gps = (fix, "good" if has_fix else "bad")
    if not vehicle.is_live:
        return [("playback", "recorded"), (fix, "" if has_fix else "bad")]
    if not math.isfinite(now.silent_s):
        return [("no heartbeat yet", "bad")]
    if now.silent_s > SILENT_S:
        return [(f"silent for {now.silent_s:.0f} s", "bad")]
    chips = [("link", "good"), (_mode_of(context), ""), gps]
    recorder = context.parts.watch.recorder
    if recorder is not None and recorder["state"] != "idle":
        chips.append(("● REC" if recorder["state"] == "recording" else "not recording", "bad"))
    return chips
