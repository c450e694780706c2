"""The primary flight display: drawn in the browser, at the screen's own rate."""

from nicegui.element import Element

from gateway.panel.view_context import WEB


class FlightDisplay(Element, component=WEB / "flight_display.js"):
    """Horizon, roll arc, pitch ladder, heading ribbon, speed and altitude tapes, climb.

    It draws the data of the page's feed (`window.mavgate`) in the browser, in the page's units,
    without Python. Between two updates the attitude is extrapolated by the body rates. Set its
    size by style or classes; it is legible from 160 x 120 pixels on.
    """
