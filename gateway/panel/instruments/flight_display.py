"""The primary flight display: drawn in the browser, at the screen's own rate."""

from nicegui.element import Element

from gateway.panel.view_context import WEB


class FlightDisplay(Element, component=WEB / "flight_display.js"):
    """Horizon, roll arc, pitch ladder, heading ribbon, speed and altitude tapes, climb.

    It draws what the page's own feed brings to the browser (`window.mavgate`), in the page's units;
    nothing of it passes through Python. Between two moments the attitude turns on by the body's
    rates. Give it a size by style or classes; anything from 160 x 120 pixels on can be read.
    """
