"""Views that other packages add to the page.

This file imports nothing of the page, so that no other command becomes slower by an added view.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from gateway.panel.view_context import ViewContext


@dataclass(frozen=True, slots=True)
class View:
    """One view of the page."""

    key: str
    """Name in the page's source."""
    title: str
    icon: str
    """Name of a Material icon, which NiceGUI includes."""
    build: Callable[[ViewContext], object]


ADDED_VIEWS: Final[dict[str, View]] = {}


def add_view(title: str, icon: str, location: str) -> View:
    """Add a view to every page that is opened from now on, below the page's own.

    Parameters
    ----------
    title : str
        A short word for the rail.
    icon : str
        Name of a Material icon.
    location : str
        Module and function, `package.module:build`, that create the view's NiceGUI elements. It is
        imported when a page first shows it, and called with a
        `gateway.panel.view_context.ViewContext`.

    Returns
    -------
    View

    Raises
    ------
    ValueError
        If it was added before.
    """
    if location in ADDED_VIEWS:
        raise ValueError(f"view {location!r} is added twice")
    view = ADDED_VIEWS[location] = View(location, title, icon, partial(_build, location))
    return view


def _build(location: str, context: ViewContext) -> None:
    module, _, function = location.partition(":")
    getattr(import_module(module), function)(context)
