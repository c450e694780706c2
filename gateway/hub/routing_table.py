"""Paths to systems, and the kinds of the systems behind each client.

Routing follows the MAVLink guide: a frame without a target is sent to all clients but its sender; a
frame with a target system only to clients from which that system (and component, if it was ever
received) was received. One deviation: broadcasts of a ground station are sent only to clients with
vehicles. Stations need no messages of each other, and scripts take the first heartbeat they receive
for the vehicle's.

Only trusted clients belong in the routing table: it decides who receives which frames.
"""

from collections.abc import Callable
from ctypes import c_int64
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

from gateway.hub.frame_stream import FrameStream
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import boot_time_us
from gateway.wire.mavlink_splitter import MavFrame

Origin = tuple[int, int]
"""System and component id."""

MAX_ORIGINS: Final = 1024
"""Maximum per client: every possible system id with four components each, of 3 kB each."""
MAX_ADDRESSED: Final = 16
"""Maximum systems and components that one is known to have addressed: scripts address a few."""
ROUTE_FRESH_US: Final = 10 * US_PER_S
"""A path on which a system was received this recently is preferred to stale ones."""
MEMORY_US: Final = 30 * US_PER_S
"""Duplicates are recognised for this long: longer than a congested mobile network delays them."""
REPEAT_US: Final = US_PER_S
"""Maximum delay of a copy of a frame on the same path: that of a radio."""
REPORTED_US: Final = 3 * US_PER_S
"""Maximum age of a start time: most vehicles send messages with it several times a second."""
SAME_START_US: Final = 5 * US_PER_S
"""Difference of start times beyond which they are two vehicles: no link delays by so much, and two
are seldom switched on at the same moment."""


class SenderKind(Enum):
    """What the heartbeats of a system and component on one path show."""

    UNKNOWN = auto()
    STATION = auto()
    VEHICLE = auto()
    """An autopilot, not that of an antenna tracker."""
    OTHER = auto()


def _kind_of(heartbeat: MavFrame) -> SenderKind:
    if heartbeat.is_station_heartbeat:
        return SenderKind.STATION
    is_vehicle = heartbeat.is_autopilot_heartbeat and not heartbeat.is_tracker_heartbeat
    return SenderKind.VEHICLE if is_vehicle else SenderKind.OTHER


@dataclass(slots=True)
class SystemPath:
    """One system as received from one client."""

    since_us: int
    """Time of its first frame after a timeout."""
    stream: FrameStream = field(default_factory=FrameStream)
    """Frames of the system on all its paths."""
    kind: SenderKind = SenderKind.UNKNOWN
    other_us: int = -ROUTE_FRESH_US
    """When the newest heartbeat was received that is not a ground station's."""
    addressed: set[Origin] = field(default_factory=set)
    """Systems and components that it has addressed."""
    lag_us: int = 0
    """Delay relative to the fastest path, measured by the newest copy."""
    copied_us: int = 0
    """When the newest copy was received."""
    booted_us: int | None = None
    """When the system started, computed from the newest frame with its time since start."""
    booted_heard_us: int = 0
    """When that frame was received."""
    heard: c_int64 = field(default_factory=c_int64)
    """When it was received last, in memory that the compiled step writes too."""

    def __post_init__(self) -> None:
        """Begin with its first frame."""
        self.heard_us = self.since_us

    @property
    def heard_us(self) -> int:
        """When it was received last."""
        return self.heard.value

    @heard_us.setter
    def heard_us(self, heard_us: int) -> None:
        self.heard.value = heard_us

    @property
    def is_station(self) -> bool:
        """Whether it is a ground station's."""
        return self.kind is SenderKind.STATION

    def read_heartbeat(self, frame: MavFrame, now_us: int) -> bool:
        """Note the kind of a heartbeat's sender; return whether it has changed.

        A station that shares its id with another program counts as that one: if each heartbeat
        changed the kind, each would change the routes.
        """
        kind, before = _kind_of(frame), self.kind
        if kind is not SenderKind.STATION:
            self.other_us = now_us
        elif now_us - self.other_us < ROUTE_FRESH_US:
            return False
        self.kind = kind
        return kind is not before

    def note_address(self, target: Origin) -> None:
        """Note that it has addressed a system and component."""
        if len(self.addressed) < MAX_ADDRESSED:
            self.addressed.add(target)

    def note_boot(self, frame: MavFrame, now_us: int) -> None:
        """Compute when the system started, if a frame contains its time since start."""
        booted_us = boot_time_us(frame, now_us)
        if booted_us is not None:
            self.booted_us, self.booted_heard_us = booted_us, now_us

    def is_another_vehicle(self, other: "SystemPath", now_us: int) -> bool:
        """Return whether another path of the same id leads to another vehicle.

        Frames arrive on both, none of them a copy, and the two start times differ.
        """
        if self.booted_us is None or other.booted_us is None:
            return False
        both = (self, other)
        return (
            all(now_us - path.booted_heard_us <= REPORTED_US for path in both)
            and all(not path.copied_us or now_us - path.copied_us > MEMORY_US for path in both)
            and abs(self.booted_us - other.booted_us) > SAME_START_US
        )

    def is_fresh(self, now_us: int) -> bool:
        """Return whether a frame was received recently."""
        return now_us - self.heard_us <= ROUTE_FRESH_US

    def is_prompt(self, now_us: int) -> bool:
        """Return whether copies were received recently, and without much delay."""
        return max(self.lag_us, now_us - self.copied_us) <= REPEAT_US


@dataclass(frozen=True, slots=True)
class LinkSystems:
    """The systems received from one client, by the kinds of their components."""

    all: frozenset[int] = frozenset()
    vehicles: frozenset[int] = frozenset()
    others: frozenset[int] = frozenset()
    """Those that have sent a heartbeat that is neither a vehicle's nor a station's."""
    has_station: bool = False
    has_only_stations: bool = True
    """Also where nothing is received."""

    def are_only_others(self, system: int) -> bool:
        """Return whether there are vehicles, all others than a system, and nothing else."""
        has_display = self.has_station or not self.others <= self.vehicles
        return bool(self.vehicles) and not has_display and system not in self.all


NO_SYSTEMS: Final = LinkSystems()


def _systems_of(paths: dict[Origin, SystemPath]) -> LinkSystems:
    def having(kind: SenderKind) -> frozenset[int]:
        return frozenset(origin[0] for origin, path in paths.items() if path.kind is kind)

    stations = sum(path.is_station for path in paths.values())
    return LinkSystems(
        frozenset(origin[0] for origin in paths),
        having(SenderKind.VEHICLE),
        having(SenderKind.OTHER),
        stations > 0,
        stations == len(paths),
    )


class RoutingTable:
    """The clients from which frames of each system were received.

    `changed` is called when cached routes may be wrong: a system has one path more, or fewer, a
    client has another system, or a sender proves to be a station or a vehicle. Of more than
    `max_origins` systems of a client, the one received longest ago is replaced.
    """

    def __init__(
        self, changed: Callable[[], None] = lambda: None, max_origins: int = MAX_ORIGINS
    ) -> None:
        self._changed = changed
        self._max_origins = max_origins
        self._of_client: dict[int, dict[Origin, SystemPath]] = {}
        self._to: dict[Origin, dict[int, SystemPath]] = {}
        """The same paths by system and component."""
        self._systems: dict[int, LinkSystems] = {}
        """The systems by client, until the next change."""

    def register(self, client_id: int, origin: Origin, now_us: int) -> SystemPath | None:
        """Register a client's frame of a system; return the path, or None without room for it."""
        paths = self._to.get(origin)
        path = paths.get(client_id) if paths else None
        is_other = False
        if path is None:
            before = self.systems(client_id)
            path = self._discover(client_id, origin, now_us)
            self._systems.pop(client_id, None)
            is_other = self.systems(client_id) != before
        elif not path.is_fresh(now_us):
            path.since_us = path.heard_us = now_us
        else:
            path.heard_us = now_us
            return path
        if path is not None and (is_other or len(self._to[origin]) > 1):
            self._changed()
        return path

    def newest_sequence(self, origin: Origin) -> int:
        """Return the sequence number of the newest frame of a system; 0 if there is none."""
        paths = self._to.get(origin)
        return next(iter(paths.values())).stream.newest_sequence() if paths else 0

    def streams(self) -> dict[Origin, FrameStream]:
        """Return the frames of each system and component."""
        return {origin: next(iter(paths.values())).stream for origin, paths in self._to.items()}

    def is_shared(self, origin: Origin, now_us: int) -> bool:
        """Return whether a system has been received recently on more than one path."""
        paths = self._to.get(origin)
        if paths is None or len(paths) == 1:
            return False
        return sum(path.is_fresh(now_us) for path in paths.values()) > 1

    def read_heartbeat(
        self, client_id: int, path: SystemPath, frame: MavFrame, now_us: int
    ) -> None:
        """Note the kind of a heartbeat's sender."""
        if path.read_heartbeat(frame, now_us):
            self._systems.pop(client_id, None)
            self._changed()

    def is_station(self, client_id: int, origin: Origin) -> bool:
        """Return whether a system and component of a client is a ground station."""
        path = self._of_client.get(client_id, {}).get(origin)
        return path is not None and path.is_station

    def systems(self, client_id: int) -> LinkSystems:
        """Return the systems of a client by their kinds."""
        paths = self._of_client.get(client_id)
        if not paths:
            return NO_SYSTEMS
        found = self._systems.get(client_id)
        if found is None:
            found = self._systems[client_id] = _systems_of(paths)
        return found

    def clients_with_vehicles(self, source_id: int) -> list[int]:
        """Return the clients, except the source, that have more than stations."""
        return [
            client_id
            for client_id in self._of_client
            if client_id != source_id and not self.systems(client_id).has_only_stations
        ]

    def awaits_answer(
        self, client_id: int, target: Origin, asked: Callable[[Origin], bool]
    ) -> bool:
        """Return whether a target of a client is a station, or a program that has sent a request.

        `asked` returns whether a system and component that it addressed is one of those asked. If
        the component is unknown, the whole system must be such.
        """
        paths = self._of_client.get(client_id, {})
        found = (
            [paths[target]]
            if target in paths
            else [path for origin, path in paths.items() if origin[0] == target[0]]
        )
        return bool(found) and all(
            path.is_station
            or (path.kind is not SenderKind.VEHICLE and any(map(asked, path.addressed)))
            for path in found
        )

    def clashes(self, now_us: int) -> dict[int, tuple[int, int]]:
        """Return the clients with a vehicle whose id an earlier vehicle of another client has.

        The value is the system id, and the client from which that id was received first.
        """
        found: dict[int, tuple[int, int]] = {}
        for origin, paths in self._to.items():
            first, *others = paths
            for client_id in others:
                if paths[client_id].is_another_vehicle(paths[first], now_us):
                    found[client_id] = origin[0], first
        return found

    def remove(self, client_id: int) -> None:
        """Remove all paths of a client."""
        for origin in self._of_client.pop(client_id, {}):
            self._drop(client_id, origin)
        self._systems.pop(client_id, None)
        self._changed()

    def origins(self, client_id: int) -> tuple[Origin, ...]:
        """Return the systems and components received from a client, first received first."""
        return tuple(self._of_client.get(client_id, ()))

    def clients_to(self, target: Origin, source_id: int, now_us: int) -> list[int]:
        """Return the clients from which this component, else this system, was received recently.

        Stale clients are returned only if there is no other, the sender never. Component 0 is the
        whole system.
        """
        exact = [target] if target[1] and self._to.get(target, {}).keys() - {source_id} else []
        for origins in (exact, [origin for origin in self._to if origin[0] == target[0]]):
            found: dict[int, bool] = {}
            for origin in origins:
                for client_id, path in self._to[origin].items():
                    if client_id != source_id:
                        found[client_id] = found.get(client_id, False) or path.is_fresh(now_us)
            if found:
                return sorted(key for key, fresh in found.items() if fresh) or sorted(found)
        return []

    def _discover(self, client_id: int, origin: Origin, now_us: int) -> SystemPath | None:
        known = self._of_client.setdefault(client_id, {})
        if len(known) >= self._max_origins:
            stalest = min(known, key=lambda each: known[each].heard_us)
            if known[stalest].is_fresh(now_us):
                # More live systems than there is room for: adding this one would remove another.
                return None
            del known[stalest]
            self._drop(client_id, stalest)
        paths = self._to.setdefault(origin, {})
        stream = next((path.stream for path in paths.values()), FrameStream())
        known[origin] = paths[client_id] = path = SystemPath(now_us, stream)
        return path

    def _drop(self, client_id: int, origin: Origin) -> None:
        paths = self._to[origin]
        del paths[client_id]
        if not paths:
            del self._to[origin]
