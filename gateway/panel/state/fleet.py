"""State of all aircraft from MAVLink, by system id."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.panel.state.vehicle import LIVE, VehicleState
from gateway.vehicle_state.newest import VehicleComponents

MAX_VEHICLES: Final = 32
"""Maximum aircraft: more are forged, and each may take some MB."""

Listener = Callable[[int, Any, int], None]
"""Called with system id, decoded message and time in µs on the panel's clock."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Origin of an aircraft that is not live."""

    word: str
    """`recorded` or `fused again`."""
    recorded_id: int
    page: str = ""
    """Id of the page that plays it; no other page shows it."""


class FleetState:
    """State from MAVLink, by system id."""

    def __init__(self) -> None:
        self.vehicles: dict[int, VehicleState] = {}
        self.origins: dict[int, Origin] = {}
        """Origins of played aircraft, by their played system ids."""
        self.version = 0
        """Counts the messages, so that a reader can detect new data."""
        self._components = VehicleComponents()
        self._listeners: list[Listener] = []
        self._on_discard: list[Callable[[int], None]] = []

    def visible(self, page: str) -> dict[int, VehicleState]:
        """Return the aircraft that a page shows: live ones, and those that it plays itself."""
        return {
            system_id: vehicle
            for system_id, vehicle in self.vehicles.items()
            if (origin := self.origins.get(system_id)) is None or (page and origin.page == page)
        }

    def listen(self, listener: Listener) -> Callable[[], None]:
        """Call a listener with every message, until the returned function is called."""
        self._listeners.append(listener)

        def leave() -> None:
            if listener in self._listeners:
                self._listeners.remove(listener)

        return leave

    def on_discard(self, callback: Callable[[int], None]) -> None:
        """Call a function with the system id of every aircraft that is discarded."""
        self._on_discard.append(callback)

    def discard(self, system_id: int) -> None:
        """Discard an aircraft and its origin."""
        self.vehicles.pop(system_id, None)
        self.origins.pop(system_id, None)
        self.version += 1
        for callback in self._on_discard:
            callback(system_id)

    def update(self, message: Any, now_us: int) -> None:
        """Update the state of the sender, unless it is a ground station or another component."""
        system_id, component_id = message.get_srcSystem(), message.get_srcComponent()
        is_beat = message.get_msgId() == mavlink.MAVLINK_MSG_ID_HEARTBEAT
        autopilot = message.autopilot if is_beat else None
        if not self._components.includes(system_id, component_id, autopilot):
            return
        vehicle = self.vehicles.get(system_id)
        if vehicle is None:
            if len(self.vehicles) >= MAX_VEHICLES:
                return
            origin = self.origins.get(system_id, Origin(LIVE, system_id))
            vehicle = VehicleState(system_id, origin.word, origin.recorded_id)
            self.vehicles[system_id] = vehicle
        vehicle.update(message, now_us)
        self.version += 1
        for listener in self._listeners:
            listener(system_id, message, now_us)
