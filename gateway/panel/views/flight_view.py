"""View 1: the primary flight display, the aircraft in 3D from two viewpoints, the map."""

from typing import Final

from nicegui import ui
from nicegui.element import Element

from gateway.panel.view_context import WEB, ViewContext
from gateway.panel.views.map_view import FlightMap

THREE: Final = ui.scene
"""The 3D library is that of NiceGUI's own scene, whose import registers it with the page."""


class FlightDisplay(Element, component=WEB / "flight_display.js"):
    """The primary flight display, drawn by the browser at the screen's own rate.

    Between two updates the attitude is extrapolated by the body rates. It is legible from 160 x 120
    pixels on.
    """


class FlightScene(Element, component=WEB / "flight_scene.js"):
    """The aircraft in 3D, drawn by the browser from the telemetry."""


def build(context: ViewContext) -> None:
    """Build the view."""
    with ui.element("div").classes("flight"):
        with ui.element("div").classes("flight-instruments card"):
            FlightDisplay().classes("fill")
        with ui.element("div").classes("flight-map card"):
            FlightMap(context, full=False)
        with ui.element("div").classes("flight-scene card"):
            FlightScene()
