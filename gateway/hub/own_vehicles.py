"""Which systems are ours, and the frames that greet a new client."""

from typing import Final

from gateway.hub.routing_table import Origin
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame

HEARTBEAT_ID: Final = 0
HOME_POSITION_ID: Final = 242
GREETING: Final = (HEARTBEAT_ID, HOME_POSITION_ID)
"""In this order: a vehicle exists, and its home."""
OWN_FRESH_US: Final = 5 * US_PER_S
"""A system whose heartbeat we have not sent for so long is no longer ours: a playback ended."""


class OwnVehicles:
    """Remember the newest greeting frames of our vehicles and the clients that wait for them.

    A new client is greeted just before the next frame of a vehicle, with the sequence numbers
    before it, so that its stream begins without a gap.
    """

    def __init__(self) -> None:
        self._seen_us: dict[Origin, int] = {}
        self._frames: dict[Origin, dict[int, MavFrame]] = {}
        self._waiting: dict[Origin, list[int]] = {}

    @property
    def has_waiting(self) -> bool:
        """Whether a client waits for a greeting."""
        return bool(self._waiting)

    def register(self, frame: MavFrame, now_us: int) -> bool:
        """Register a frame of ours, maybe for greetings; return whether its vehicle is new."""
        origin, message_id = frame.origin, frame.message_id
        is_new = not self.is_own(origin, now_us)
        if not is_new and message_id not in GREETING:
            return False
        if is_new:
            # Frames that an earlier playback sent of this system are outdated.
            self._frames[origin] = {}
        self._seen_us[origin] = now_us
        if message_id in GREETING:
            self._frames[origin][message_id] = frame
        return is_new

    def is_own(self, origin: Origin, now_us: int) -> bool:
        """Return whether a system and component is one of our vehicles."""
        seen_us = self._seen_us.get(origin)
        return seen_us is not None and now_us - seen_us <= OWN_FRESH_US

    def systems(self, now_us: int) -> list[int]:
        """Return the system ids of our vehicles, oldest first."""
        return [origin[0] for origin in self._seen_us if self.is_own(origin, now_us)]

    def await_greeting(self, client_id: int) -> None:
        """Queue a new client for the greetings of every vehicle."""
        for origin in self._frames:
            self._waiting.setdefault(origin, []).append(client_id)

    def remove(self, client_id: int) -> None:
        """Do not greet a client that has gone."""
        for origin, waiting in list(self._waiting.items()):
            if client_id in waiting:
                waiting.remove(client_id)
            if not waiting:
                del self._waiting[origin]

    def greet(self, origin: Origin) -> tuple[list[int], list[MavFrame]]:
        """Return the clients that wait for a vehicle, and the frames to send them first."""
        clients = self._waiting.pop(origin, [])
        known = self._frames.get(origin, {})
        return clients, [known[message_id] for message_id in GREETING if message_id in known]
