"""Our vehicles: which systems are ours, and the greetings of new clients."""

from typing import Final

from gateway.hub.routing_table import Origin
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS
from gateway.wire.mavlink_splitter import MavFrame

GREETING: Final = (HEARTBEAT_ID, MESSAGE_IDS["HOME_POSITION"])
"""Messages of a greeting, in this order: the vehicle exists, and its home."""
OWN_FRESH_US: Final = 5 * US_PER_S
"""Time without a sent heartbeat after which a system is no longer ours: a playback has ended."""


class OwnVehicles:
    """The newest greeting frames of our vehicles, and the clients that wait for them.

    A new client is greeted just before the next frame of a vehicle, with the sequence numbers
    before it, so that its stream begins without a gap.
    """

    def __init__(self) -> None:
        self._seen_us: dict[Origin, int] = {}
        self._frames: dict[Origin, dict[int, MavFrame]] = {}
        self.waiting: dict[Origin, list[int]] = {}
        """The clients that wait for the greeting of each vehicle."""

    def register(self, frame: MavFrame, now_us: int) -> bool:
        """Register a frame of ours, maybe for greetings; return whether its vehicle is new."""
        origin, message_id = frame.origin, frame.message_id
        seen_us = self._seen_us.get(origin)
        is_new = seen_us is None or now_us - seen_us > OWN_FRESH_US
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
            self.waiting.setdefault(origin, []).append(client_id)

    def remove(self, client_id: int) -> None:
        """Do not greet a client that has gone."""
        for origin, waiting in list(self.waiting.items()):
            if client_id in waiting:
                waiting.remove(client_id)
            if not waiting:
                del self.waiting[origin]

    def greet(self, origin: Origin) -> tuple[list[int], list[MavFrame]]:
        """Return the clients that wait for a vehicle, and the frames to send them first."""
        clients = self.waiting.pop(origin, [])
        known = self._frames.get(origin, {})
        return clients, [known[message_id] for message_id in GREETING if message_id in known]
