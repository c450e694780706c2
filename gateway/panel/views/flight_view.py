"""View 1: flight display, numbers, the aircraft in 3D from two viewpoints, map, timeline."""

from typing import Final

from nicegui import ui
from nicegui.element import Element

from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.views.map_view import FlightMap
from gateway.panel.widgets.recorder import RecorderControls

THREE: Final = ui.scene
"""The 3D library is that of NiceGUI's own scene, whose import registers it with the page."""


class FlightDisplay(Element, component=WEB / "flight_display.js"):
    """The primary flight display, drawn by the browser at the screen's own rate.

    Between two updates the attitude is extrapolated by the body rates. It is legible from 160 x 120
    pixels on.
    """


class FlightScene(Element, component=WEB / "flight_scene.js"):
    """The aircraft in 3D, drawn by the browser from the telemetry."""


class NumberStrip(Element, component=WEB / "number_strip.js"):
    """The flight in numbers, each with its unit and, once it is old, its age."""


class FlightTimeline(Element, component=WEB / "flight_timeline.js"):
    """The current flight over time, in which the page can go back."""


def build(context: ViewContext) -> None:
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
        with ui.element("div").classes("flight-foot card"):
            FlightTimeline()
            RecorderControls(context)
