"""Home as parameters: three numbers that change one at a time, and who set them."""

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
    """Sets home, forgets it, and knows which home is to outlive the gateway.

    A home that the GPS measured is that of one day's field and is measured anew at every start; one
    that an operator set is kept. A command keeps it at once, a parameter when the parameters are
    stored.
    """

    def __init__(self, telemetry: Telemetry) -> None:
        self.kept: Place | None = None
        self._telemetry = telemetry
        self._entered: set[str] = set()
        """Numbers that were set while there was no home."""

    @property
    def home(self) -> Home | None:
        """The home that holds now."""
        return self._telemetry.home

    def put(self, place: Place, now_us: int) -> list[Answer]:
        """Set home by an operator's wish, and tell it."""
        self._entered.clear()
        return [Reply(m) for m in self._telemetry.set_home(Home(place, now_us, "operator"))]

    def restore(self, place: Place) -> None:
        """Begin with the home that was kept."""
        self.kept = place
        self._telemetry.set_home(Home(place, 0, "operator"))

    def keep(self) -> None:
        """Let the present home outlive the gateway if an operator set it; else none does."""
        home = self.home
        self.kept = home.place if home is not None and home.source == "operator" else None

    def parameters(self) -> HomeParameters:
        """Tell home as parameters."""
        home = self.home
        if home is None:
            return HomeParameters()
        numbers = {key: getattr(home.place, part) for key, part in NUMBERS.items()}
        return HomeParameters(source=home.source, **numbers)

    def change(self, settings: Settings, key: str, now_us: int) -> list[Answer]:
        """Carry out the change of one parameter.

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
                # A parameter is less exact than home; a list sent back must not round it.
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
