"""The magnetometer's samples as a cloud on the sphere, and directions not covered yet."""

from typing import Any

from nicegui.element import Element

from gateway.panel.state.dialogue.sphere_cover import CELLS
from gateway.panel.state.field_history import FloatArray
from gateway.panel.view_context import WEB


class FieldSphere(Element, component=WEB / "field_sphere.js"):
    """A sphere that can be turned by mouse and by arrow keys."""

    def __init__(self) -> None:
        super().__init__()
        self._props["cells"] = CELLS.round(4).tolist()

    def show(self, points: FloatArray, seen: list[bool]) -> None:
        """Show these samples.

        Parameters
        ----------
        points : ndarray, shape (n, 3)
            In radii of the sphere, from its centre; body FRD.
        seen : list of bool
            By cell; see `seen_cells`.
        """
        rounded: Any = points.round(3).tolist()
        self.run_method("show", rounded, seen)
