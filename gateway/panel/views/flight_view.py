"""View 1: the primary flight display, the aircraft in 3D from two viewpoints, the map."""

from nicegui import ui

from gateway.panel.view_context import ViewContext


def build(context: ViewContext) -> None:
    """Build the view."""
    with ui.element("div").classes("flight"):
        ui.element("div").classes("flight-display card")
        ui.element("div").classes("flight-scene card")
    del context
