"""Which systems are ours, and which frames greet a new client at once."""

from typing import Final

from gateway.hub.routing_table import Origin
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import origin_of, restamp, sequence_of

HEARTBEAT_ID: Final = 0
HOME_POSITION_ID: Final = 242
GREETING: Final = (HEARTBEAT_ID, HOME_POSITION_ID)
"""In this order: that there is a vehicle, and its home."""
OWN_FRESH_US: Final = 5 * US_PER_S
"""A system whose heartbeat we have not sent for so long is no longer ours: a playback ended."""


class OwnVehicles:
    """Remember the newest greeting frames of our vehicles and who waits for them.

    A newcomer is greeted just before the next frame of a vehicle, with the two sequence numbers
    before it, so that its stream begins without a gap.

    Parameters
    ----------
    seal : callable
        Numbers, and signs, each frame of ours that leaves.
    """

    def __init__(self, seal: Seal = restamp) -> None:
        self._seal = seal
        self._seen_us: dict[Origin, int] = {}
        self._frames: dict[Origin, dict[int, bytes]] = {}
        self._newcomers: dict[Origin, list[int]] = {}

    @property
    def has_newcomers(self) -> bool:
        """Whether a newcomer waits."""
        return bool(self._newcomers)

    def note(self, frame: bytes, message_id: int, now_us: int) -> bool:
        """Note a frame of ours, maybe for greetings; return whether its vehicle is new."""
        origin = origin_of(frame)
        is_new = not self.is_own(origin, now_us)
        if is_new:
            # What an earlier playback sent of this system is outdated.
            self._frames[origin] = {}
        if is_new or message_id in GREETING:
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
        """Queue a newcomer for the greetings of every vehicle."""
        for origin in self._frames:
            self._newcomers.setdefault(origin, []).append(client_id)

    def forget(self, client_id: int) -> None:
        """Do not greet a client that has gone."""
        for origin, waiting in list(self._newcomers.items()):
            if client_id in waiting:
                waiting.remove(client_id)
            if not waiting:
                del self._newcomers[origin]

    def greet(self, frame: bytes) -> tuple[list[int], list[tuple[bytes, int]]]:
        """Return who waits for the sender of a frame, and the frames to send them first.

        Returns
        -------
        tuple
            Client ids, and frames with their message ids.
        """
        origin = origin_of(frame)
        clients = self._newcomers.pop(origin, [])
        if not clients:
            return [], []
        known = self._frames[origin]
        ids = [message_id for message_id in GREETING if message_id in known]
        first = sequence_of(frame) - len(ids)
        return clients, [
            (self._seal(known[message_id], first + place & 0xFF), message_id)
            for place, message_id in enumerate(ids)
        ]
