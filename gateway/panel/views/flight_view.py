"""Views 1 and 2: flight display, numbers, 3D, timeline; and the map."""

import math
from collections.abc import Awaitable, Callable
from functools import partial
from typing import Final

from nicegui import ui
from nicegui.element import Element
from nicegui.events import GenericEventArguments
from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.access import MAPS
from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.widgets import RecorderControls, UploadButton, confirm, notify_failure
from gateway.vehicle.plan import Location

STYLES_S: Final = 2.0
LEAFLET: Final = ui.leaflet
"""NiceGUI's own map: its import registers the map library with the page."""
THREE: Final = ui.scene
"""NiceGUI's own scene: its import registers the 3D library with the page."""


class FlightMap(Element, component=WEB / "flight_map.js"):
    """The map, drawn by the browser from the telemetry."""

    def __init__(self, context: ViewContext, *, full: bool) -> None:
        super().__init__()
        self._tiles = context.parts.tiles
        self._props["full"] = full
        self._props["base"] = "/web/base_map.json"
        self.refresh()
        context.every(STYLES_S, self.refresh)
        self._props["may_mark"] = full and context.may_change
        if full and context.may_change:
            for kind, act in (("mark", _mark), ("home", _ask_home), ("clear", _clear)):
                self.on(kind, partial(_at, context, act))
            with self:
                upload = UploadButton(
                    context, MAPS, ".pmtiles", label="Add map…", title="Upload a PMTiles file"
                )
            upload.on("uploaded", self.refresh)

    def refresh(self) -> None:
        """Offer the present styles: any page may have added one."""
        styles = [
            {"name": style.name, "attribution": style.attribution, "max_zoom": style.max_zoom}
            for style in self._tiles.styles
        ]
        if styles != self._props.get("styles"):
            self.props["styles"] = styles


def build_map(context: ViewContext) -> None:
    """Build the view."""
    with ui.element("div").classes("card fill"):
        FlightMap(context, full=True)


async def _at(
    context: ViewContext, act: Callable[..., Awaitable[None]], event: GenericEventArguments
) -> None:
    spot = Location(float(event.args["lat_deg"]), float(event.args["lon_deg"]), _ground_m(context))
    with notify_failure(context):
        await act(context, spot)


def _ground_m(context: ViewContext) -> float:
    """Return the height of home for that of the ground, since there is no terrain data."""
    vehicle = context.vehicle
    if vehicle is None:
        return math.nan
    now = vehicle.instant(context.now_us)
    return now.alt_amsl_m if now.home is None else now.home.alt_amsl_m


async def _mark(context: ViewContext, spot: Location) -> None:
    await context.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, at=spot)
    if context.vehicle is not None:
        context.vehicle.exact_mark = spot
    ui.notify("Marked", type="positive")


async def _ask_home(context: ViewContext, spot: Location) -> None:
    if context.vehicle is None:
        return
    title = f"Set home of {context.vehicle.title} to {spot.lat_deg:.6f}, {spot.lon_deg:.6f}?"

    async def act() -> None:
        with notify_failure(context):
            await context.command(mavlink.MAV_CMD_DO_SET_HOME, at=spot)
            ui.notify("Home set", type="positive")

    confirm(title, "Set home", act, grave=False)


async def _clear(context: ViewContext, _: Location) -> None:
    await context.command(mavlink.MAV_CMD_DO_SET_ROI_NONE)
    if context.vehicle is not None:
        context.vehicle.exact_mark = None
        context.vehicle.state.fields.pop("NAV_CONTROLLER_OUTPUT", None)
    ui.notify("Mark cleared", type="positive")


class FlightDisplay(Element, component=WEB / "flight_display.js"):
    """The primary flight display, drawn by the browser at the screen's own rate.

    Between two updates the attitude is extrapolated by the body rates. It is legible from 160 x 120
    pixels on.
    """


class FlightScene(Element, component=WEB / "flight_scene.js"):
    """The aircraft in 3D, drawn by the browser from the telemetry."""


class NumberStrip(Element, component=WEB / "number_strip.js"):
    """The flight in numbers, each with its unit and, if it is old, its age."""


class FlightTimeline(Element, component=WEB / "flight_timeline.js"):
    """The current flight over time, with a handle to show the past."""


def build_flight(context: ViewContext) -> None:
    """Build the view."""
    with ui.element("div").classes("flight"):
        with ui.element("div").classes("flight-numbers card"):
            NumberStrip()
        with ui.element("div").classes("flight-instruments card"):
            FlightDisplay().classes("fill")
        with ui.element("div").classes("flight-map card"):
            FlightMap(context, full=False)
        with ui.element("div").classes("flight-scene card"):
            FlightScene()
        with ui.element("div").classes("flight-foot card live-only"):
            FlightTimeline()
            RecorderControls(context)
