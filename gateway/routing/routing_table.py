"""Where systems are, and which frames have been here before.

Routing follows the MAVLink guide: a frame that names nobody goes to everybody but its sender; a
frame that names a system goes only where that system (and component, if it was ever heard) speaks.
Two ways to one system, or a cable that leads back, bring the same bytes twice; all but the first
are dropped, from wherever they come, or they would run round a ring for ever. Memory of frames is
kept only for systems that are heard by more than one way; a copy of what was said before its way
was there passes, for there is no telling it from a program that was started again and repeats its
first frames from another port.

One deviation: what a ground station says to everybody goes only where there are vehicles. Stations
have nothing to tell each other, and scripts take the first heartbeat they hear for the vehicle's.
"""

from dataclasses import dataclass
from typing import Final

from gateway.units import US_PER_S

Origin = tuple[int, int]
"""System and component id."""

MAX_ORIGINS: Final = 32
"""Remembered per client; more are forged, or a network beyond what this table is for."""
ROUTE_FRESH_US: Final = 10 * US_PER_S
"""A way on which a system has spoken so lately is preferred to ways on which it fell silent."""
MAX_STATIONS: Final = 256
MEMORY_US: Final = US_PER_S
"""Copies come within a radio's delay; most links take longer to use up the sequence numbers."""
MEMORY_FRAMES: Final = 8192
"""Per generation: a second of a fast link, at most 2.3 MB."""


@dataclass(slots=True)
class _Way:
    """One system as one client brings it."""

    since_us: int
    """Its first frame after a silence."""
    heard_us: int

    def is_fresh(self, now_us: int) -> bool:
        return now_us - self.heard_us <= ROUTE_FRESH_US


class RoutingTable:
    """Which client has spoken for which system."""

    def __init__(self) -> None:
        self._heard: dict[int, dict[Origin, _Way]] = {}
        self._stations: set[Origin] = set()

    def hear(self, client_id: int, origin: Origin, now_us: int) -> bool:
        """Note that a client has brought a frame of a system; tell whether that is news."""
        ways = self._heard.setdefault(client_id, {})
        way = ways.get(origin)
        if way is not None and way.is_fresh(now_us):
            way.heard_us = now_us
            return False
        if way is not None or len(ways) < MAX_ORIGINS:
            ways[origin] = _Way(now_us, now_us)
        return True

    def is_shared(self, origin: Origin, now_us: int) -> bool:
        """Tell whether a system has been heard of late by more than one way."""
        ways = (ways.get(origin) for ways in self._heard.values())
        return sum(way is not None and way.is_fresh(now_us) for way in ways) > 1

    def since_us(self, client_id: int, origin: Origin) -> int:
        """Return since when a client has brought a system's frames without a long silence."""
        way = self._heard.get(client_id, {}).get(origin)
        return 0 if way is None else way.since_us

    def note_kind(self, origin: Origin, *, is_station: bool) -> None:
        """Note what a heartbeat says of its sender."""
        if not is_station:
            self._stations.discard(origin)
        elif len(self._stations) < MAX_STATIONS:
            self._stations.add(origin)

    def is_station(self, origin: Origin) -> bool:
        """Tell whether a system and component is a ground station."""
        return origin in self._stations

    def ways_to_vehicles(self, source_id: int) -> list[int]:
        """Return the clients, but the source, behind which there is more than ground stations."""
        return [
            client_id
            for client_id, origins in self._heard.items()
            if client_id != source_id and not origins.keys() <= self._stations
        ]

    def forget(self, client_id: int) -> None:
        """Drop what a client has said."""
        self._heard.pop(client_id, None)

    def origins(self, client_id: int) -> tuple[Origin, ...]:
        """Return the systems and components heard from a client, first heard first."""
        return tuple(self._heard.get(client_id, ()))

    def ways_to(self, target: Origin, source_id: int, now_us: int) -> list[int]:
        """Find the clients behind which a target is.

        Parameters
        ----------
        target : tuple of int
            System and component; component 0 is all of the system.
        source_id : int
            The client that asks; never part of the answer.
        now_us : int
            Gateway time.

        Returns
        -------
        list of int
            Clients heard lately with exactly this component, else with this system; silent ones
            only if there is no other. Empty if the target is unknown.
        """
        system, component = target
        of_system: dict[int, bool] = {}
        exact: dict[int, bool] = {}
        for client_id, ways in self._heard.items():
            if client_id == source_id:
                continue
            fresh = [way.is_fresh(now_us) for (known, _), way in ways.items() if known == system]
            if fresh:
                of_system[client_id] = any(fresh)
            if target in ways:
                exact[client_id] = ways[target].is_fresh(now_us)
        found = exact if component and exact else of_system
        return [client_id for client_id, fresh in found.items() if fresh] or list(found)


class LoopGuard:
    """Remember the frames of the last second and tell copies."""

    def __init__(self) -> None:
        self._recent: dict[bytes, int] = {}
        self._older: dict[bytes, int] = {}
        self._turned_us = 0

    def is_copy(self, frame: bytes, since_us: int, now_us: int) -> bool:
        """Note a frame; tell whether the same bytes have come before.

        Parameters
        ----------
        frame : bytes
            A complete frame.
        since_us : int
            Since when its sender brings frames of that system; older ones are no copies.
        now_us : int
            Gateway time.

        Returns
        -------
        bool
        """
        if now_us - self._turned_us >= MEMORY_US or len(self._recent) >= MEMORY_FRAMES:
            self._older, self._recent = self._recent, {}
            self._turned_us = now_us
        known_us = self._recent.get(frame, self._older.get(frame))
        if known_us is not None and known_us >= since_us:
            return True
        self._recent[frame] = now_us
        return False
