"""Which client leads to which system, and which frames have been seen before.

Routing follows the MAVLink guide: a frame without a target goes to everybody but its sender; a
frame with a target system goes only where that system (and component, if it was ever heard) was
heard. Two paths to one system, or a link that leads back, bring the same bytes twice; all but the
first are dropped, whichever client brings them, or they would run round a loop for ever. Frames
are remembered only for systems that are heard by more than one path; a copy of a frame from before
its path existed passes, because it cannot be told from a program that was restarted and repeats
its first frames from another port.

One deviation: broadcasts of a ground station go only where there are vehicles. Stations need no
messages of each other, and scripts take the first heartbeat they receive for the vehicle's.

Only trusted clients belong in here: these tables decide who receives what.
"""

from dataclasses import dataclass
from typing import Final, Generic, TypeVar

from gateway.units import US_PER_S

Origin = tuple[int, int]
"""System and component id."""

MAX_ORIGINS: Final = 256
"""Remembered per client: every system there can be, or fewer with several components each."""
ROUTE_FRESH_US: Final = 10 * US_PER_S
"""A path on which a system was heard this recently is preferred to silent ones."""
MEMORY_US: Final = US_PER_S
"""Copies come within a radio's delay."""
MEMORY_OF_ONE: Final = 224
"""Frames of a component; 256 later one of the same content has the same number and so the same
bytes."""
MEMORY_FRAMES: Final = 8192
"""Per generation: a second of a fast link, at most 2.3 MB."""

Note = TypeVar("Note")


@dataclass(slots=True)
class _Way:
    """One system as one client brings it."""

    since_us: int
    """Its first frame after a silence."""
    heard_us: int
    is_station: bool = False
    """Whether its last heartbeat by this path was a ground station's."""

    def is_fresh(self, now_us: int) -> bool:
        return now_us - self.heard_us <= ROUTE_FRESH_US


class RoutingTable:
    """Which client has brought frames of which system.

    Parameters
    ----------
    max_origins : int, optional
        Remembered per client; a new one replaces the one that has been silent longest.
    """

    def __init__(self, max_origins: int = MAX_ORIGINS) -> None:
        self._max_origins = max_origins
        self._of_client: dict[int, dict[Origin, _Way]] = {}
        self._to: dict[Origin, dict[int, _Way]] = {}
        """The same ways by system and component."""
        self._components: dict[int, set[Origin]] = {}
        """By system."""

    def hear(self, client_id: int, origin: Origin, now_us: int) -> bool:
        """Note that a client has brought a frame of a system.

        Returns
        -------
        bool
            Whether this is a new path to a system, which other parts must take into account.
        """
        ways = self._to.get(origin)
        way = ways.get(client_id) if ways else None
        if way is None:
            return self._discover(client_id, origin, now_us)
        if way.is_fresh(now_us):
            way.heard_us = now_us
            return False
        way.since_us = way.heard_us = now_us
        return len(self._to[origin]) > 1

    def is_shared(self, origin: Origin, now_us: int) -> bool:
        """Return whether a system has been heard recently by more than one path."""
        ways = self._to.get(origin)
        if ways is None or len(ways) == 1:
            return False
        return sum(way.is_fresh(now_us) for way in ways.values()) > 1

    def since_us(self, client_id: int, origin: Origin) -> int:
        """Return since when a client has brought a system's frames without a long silence."""
        way = self._to.get(origin, {}).get(client_id)
        return 0 if way is None else way.since_us

    def note_kind(self, client_id: int, origin: Origin, *, is_station: bool) -> None:
        """Note what a client's heartbeat says about the type of its sender."""
        if way := self._to.get(origin, {}).get(client_id):
            way.is_station = is_station

    def is_station(self, origin: Origin) -> bool:
        """Return whether a system and component is a ground station."""
        ways = self._to.get(origin)
        return ways is not None and any(way.is_station for way in ways.values())

    def ways_to_vehicles(self, source_id: int) -> list[int]:
        """Return the clients, but the source, behind which there is more than ground stations."""
        return [
            client_id
            for client_id, ways in self._of_client.items()
            if client_id != source_id and not all(way.is_station for way in ways.values())
        ]

    def forget(self, client_id: int) -> None:
        """Forget everything about a client."""
        for origin in self._of_client.pop(client_id, {}):
            self._drop(client_id, origin)

    def origins(self, client_id: int) -> tuple[Origin, ...]:
        """Return the systems and components heard from a client, first heard first."""
        return tuple(self._of_client.get(client_id, ()))

    def ways_to(self, target: Origin, source_id: int, now_us: int) -> list[int]:
        """Find the clients that lead to a target.

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
        exact = self._to.get(target, {}) if component else {}
        known = self._components.get(system, set())
        for origins in ({target} if exact.keys() - {source_id} else set(), known):
            found: dict[int, bool] = {}
            for origin in origins:
                for client_id, way in self._to[origin].items():
                    if client_id != source_id:
                        found[client_id] = found.get(client_id, False) or way.is_fresh(now_us)
            if found:
                return sorted(key for key, fresh in found.items() if fresh) or sorted(found)
        return []

    def _discover(self, client_id: int, origin: Origin, now_us: int) -> bool:
        known = self._of_client.setdefault(client_id, {})
        if len(known) >= self._max_origins:
            stalest = min(known, key=lambda each: known[each].heard_us)
            if known[stalest].is_fresh(now_us):
                # More live systems than there is room for: keeping this one would lose another.
                return False
            del known[stalest]
            self._drop(client_id, stalest)
        known[origin] = way = _Way(now_us, now_us)
        self._to.setdefault(origin, {})[client_id] = way
        self._components.setdefault(origin[0], set()).add(origin)
        return len(self._to[origin]) > 1

    def _drop(self, client_id: int, origin: Origin) -> None:
        ways = self._to[origin]
        del ways[client_id]
        if not ways:
            del self._to[origin]
            components = self._components[origin[0]]
            components.discard(origin)
            if not components:
                del self._components[origin[0]]


class FrameMemory(Generic[Note]):
    """What is known of the newest frames, by their bytes: of one to two spans, bounded.

    Parameters
    ----------
    span_us : int
        How long a generation is.
    most : int
        Frames of a generation; there are two.
    """

    def __init__(self, span_us: int, most: int) -> None:
        self._span_us = span_us
        self._most = most
        self._recent: dict[bytes, Note] = {}
        self._older: dict[bytes, Note] = {}
        self._turned_us = 0

    def turn(self, now_us: int) -> bool:
        """Begin another generation if it is time, and return whether it was."""
        if now_us - self._turned_us < self._span_us and len(self._recent) < self._most:
            return False
        self._older, self._recent = self._recent, {}
        self._turned_us = now_us
        return True

    def get(self, frame: bytes) -> Note | None:
        """Return what is known of a frame."""
        return self._recent.get(frame) or self._older.get(frame)

    def put(self, frame: bytes, note: Note) -> None:
        """Remember a frame."""
        self._recent[frame] = note


class LoopGuard:
    """Remember the frames of the last second and recognise copies."""

    def __init__(self) -> None:
        self._memory: FrameMemory[tuple[int, int, int]] = FrameMemory(MEMORY_US, MEMORY_FRAMES)
        """When a frame came first, by whom, and as which of its component's."""
        self._counts: dict[Origin, int] = {}

    def first_way(
        self, frame: bytes, origin: Origin, client_id: int, since_us: int, now_us: int
    ) -> int | None:
        """Note a frame; return which client brought the same bytes before.

        Parameters
        ----------
        frame : bytes
            A complete frame.
        origin : tuple of int
            Whose it is.
        client_id : int
            Who brings it.
        since_us : int
            Since when that client brings frames of that system; older ones are no copies.
        now_us : int
            Gateway time.

        Returns
        -------
        int or None
            The client that was first, maybe the same one; None if the frame is no copy.
        """
        if self._memory.turn(now_us) and len(self._counts) > MEMORY_FRAMES:
            self._counts.clear()
        known = self._memory.get(frame)
        count = self._counts.get(origin, 0)
        if known is not None and known[0] >= since_us and count - known[2] < MEMORY_OF_ONE:
            return known[1]
        self._memory.put(frame, (now_us, client_id, count))
        self._counts[origin] = count + 1
        return None
