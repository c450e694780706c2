"""All known aircraft, and the listeners to their messages."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from gateway.panel.state.vehicle_picture import VehiclePicture

AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1: messages of a camera of the same system are ignored."""
FIRST_GROUND_STATION: Final = 250
MAX_VEHICLES: Final = 32
"""More are forged; each may take some MB."""

Listener = Callable[[int, Any, int], None]
"""Called with system id, decoded message and time in µs on the panel's clock."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of an aircraft that is not live."""

    word: str
    """`recorded` or `fused again`."""
    recorded_id: int
    """Its recorded system id."""


class FleetPicture:
    """State from MAVLink, by system id."""

    def __init__(self) -> None:
        self.vehicles: dict[int, VehiclePicture] = {}
        self.origins: dict[int, Origin] = {}
        """Of played aircraft, by their played system ids."""
        self.version = 0
        """Counts the messages, so that a reader knows whether there is new data."""
        self._listeners: list[Listener] = []
        self._on_forget: list[Callable[[int], None]] = []

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with every message, until the returned function is called."""
        self._listeners.append(listener)

        def leave() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return leave

    def on_forget(self, callback: Callable[[int], None]) -> None:
        """Call a function with the system id of every aircraft that is forgotten."""
        self._on_forget.append(callback)

    def forget(self, system_id: int) -> None:
        """Forget an aircraft."""
        self.vehicles.pop(system_id, None)
        self.origins.pop(system_id, None)
        self.version += 1
        for callback in self._on_forget:
            callback(system_id)

    def take(self, message: Any, now_us: int) -> None:
        """Take in one decoded message of any sender.

        Parameters
        ----------
        message : MAVLink_message
            As pymavlink decodes it; those of ground stations and of other components are ignored.
        now_us : int
            The panel's clock.
        """
        system_id = message.get_srcSystem()
        if message.get_srcComponent() != AUTOPILOT or not 0 < system_id < FIRST_GROUND_STATION:
            return
        vehicle = self.vehicles.get(system_id)
        if vehicle is None:
            if len(self.vehicles) >= MAX_VEHICLES:
                return
            vehicle = VehiclePicture(system_id)
            if origin := self.origins.get(system_id):
                vehicle = VehiclePicture(system_id, origin.word, origin.recorded_id)
            self.vehicles[system_id] = vehicle
        vehicle.take(message, now_us)
        self.version += 1
        for listener in self._listeners:
            listener(system_id, message, now_us)
