"""Armed state and position of vehicles by their messages, for recordings from arming on."""

from collections.abc import Set
from typing import Final

from gateway.vehicle_state.newest import HEARTBEAT_TIMEOUT_US, NewestState, NewestVehicles
from gateway.vehicle_state.positions import RANKS
from gateway.wire.mavlink_messages import HEARTBEAT_ID
from gateway.wire.mavlink_splitter import frame_of, message_id_of

SHOWN: Final = 4
"""Maximum vehicles in the name of a recording."""
WATCHED: Final = frozenset({HEARTBEAT_ID, *RANKS})
VehicleLocations = dict[int, tuple[float, float] | None]
"""Latitude and longitude in degrees by system id; None if they are not known."""


class ArmedWatch:
    """The armed vehicles by their heartbeats, as they pass through the gateway."""

    def __init__(self) -> None:
        self._newest = NewestVehicles()

    def feed(self, frame: bytes, now_us: int) -> None:
        """Process a frame that is recorded."""
        if message_id_of(frame) in WATCHED:
            self._newest.feed(frame_of(frame), now_us)

    def is_armed(self, now_us: int, own: Set[int]) -> bool:
        """Return whether a vehicle is armed, except `own`, whose bit may follow the recording."""
        return bool(self._armed(now_us).keys() - own)

    def vehicles(self, now_us: int) -> VehicleLocations:
        """Return latitude and longitude of each armed vehicle, deg; None without a position."""
        return {
            system_id: None if (at := state.position) is None else (at.lat_deg, at.lon_deg)
            for system_id, state in self._armed(now_us).items()
        }

    def _armed(self, now_us: int) -> dict[int, NewestState]:
        return {
            system_id: state
            for system_id, state in self._newest.states.items()
            if state.is_armed() and state.age_us(now_us, "HEARTBEAT") <= HEARTBEAT_TIMEOUT_US
        }


def label_of(vehicles: VehicleLocations, *, with_location: bool) -> str:
    """Return the end of a recording's name: `-v1-v2-47.3977N-8.5456E`."""
    label = "".join(f"-v{system_id}" for system_id in sorted(vehicles)[:SHOWN])
    known = (at for _, at in sorted(vehicles.items()) if at is not None)
    if with_location and (at := next(known, None)) is not None:
        north, east = "NS"[at[0] < 0], "EW"[at[1] < 0]
        label += f"-{abs(at[0]):.4f}{north}-{abs(at[1]):.4f}{east}"
    return label
