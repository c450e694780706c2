"""Home as parameters: three coordinates that change one at a time, and who set them."""

from dataclasses import replace
from typing import Any, Final

import numpy as np

from gateway.settings import Settings
from gateway.vehicle.actions import Answer, Reply
from gateway.vehicle.home import Home, HomeParameters, Place
from gateway.vehicle.telemetry.telemetry import Telemetry

NUMBERS: Final = {"lat_deg": "lat_deg", "lon_deg": "lon_deg", "alt_m": "alt_amsl_m"}
"""The parameters' keys, and the parts of a place that they are."""


class HomeService:
    """Set and forget home, and decide which home is kept over a restart.

    A home that the GPS measured is measured again at every start, which may be at another field;
    one that an operator set is kept. A command keeps it at once, a parameter when the parameters
    are stored.
    """

    def __init__(self, telemetry: Telemetry) -> None:
        self.kept: Place | None = None
        self._telemetry = telemetry
        self._entered: set[str] = set()
        """Numbers that were set while there was no home."""

    @property
    def home(self) -> Home | None:
        """The present home."""
        return self._telemetry.home

    def put(self, place: Place, now_us: int) -> list[Answer]:
        """Set home for an operator, and send HOME_POSITION."""
        self._entered.clear()
        return [Reply(m) for m in self._telemetry.set_home(Home(place, now_us, "operator"))]

    def restore(self, place: Place) -> None:
        """Start with the home that was kept."""
        self.kept = place
        self._telemetry.set_home(Home(place, 0, "operator"))

    def keep(self) -> None:
        """Keep the present home over a restart if an operator set it; else keep none."""
        home = self.home
        self.kept = home.place if home is not None and home.source == "operator" else None

    def parameters(self) -> HomeParameters:
        """Return home as parameters."""
        home = self.home
        if home is None:
            return HomeParameters()
        numbers = {key: getattr(home.place, part) for key, part in NUMBERS.items()}
        return HomeParameters(source=home.source, **numbers)

    def change(self, settings: Settings, key: str, now_us: int) -> list[Answer]:
        """Apply the change of one parameter.

        Parameters
        ----------
        settings : HomeParameters
            With the change in it.
        key : str
            What changed.
        now_us : int
            Gateway clock.

        Returns
        -------
        list of Answer

        Raises
        ------
        ValueError
            If there is no such home to name a source of.
        """
        value: Any = getattr(settings, key)
        if key == "source":
            return self._change_source(value, now_us)
        part, home = NUMBERS[key], self.home
        if home is not None:
            if _same(value, getattr(home.place, part)):
                # A parameter is less precise than home; a list that is written back must not round
                # it.
                return []
            return self.put(replace(home.place, **{part: value}), now_us)
        self._entered.add(key)
        if self._entered < set(NUMBERS):
            return []
        return self.put(Place(*(getattr(settings, each) for each in NUMBERS)), now_us)

    def _change_source(self, source: str, now_us: int) -> list[Answer]:
        home = self.home
        if source == "none":
            self._entered.clear()
            self._telemetry.forget_home()
            return []
        if home is None or (source, home.source) == ("gps", "operator"):
            raise ValueError("there is no such home")
        return [] if source == home.source else self.put(home.place, now_us)


def _same(a: float, b: float) -> bool:
    return bool(np.float32(a) == np.float32(b))
