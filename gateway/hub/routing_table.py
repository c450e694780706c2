"""Paths to systems, duplicates and late copies, and pairs of redundant links.

Routing follows the MAVLink guide: a frame without a target is sent to all clients but its sender; a
frame with a target system only to clients from which that system (and component, if it was ever
received) was received. One deviation: broadcasts of a ground station are sent only to clients with
vehicles. Stations need no messages of each other, and scripts take the first heartbeat they receive
for the vehicle's.

Two paths to one system, or a link that leads back, bring the same bytes twice. All but the first
are dropped, whichever client brings them, or they would circulate in a loop for ever. A path that
is seconds behind, as a second LTE link may be, also brings frames that the first path has lost; to
show them would move the aircraft back, so those are dropped too. See `DuplicateFilter`.

Only trusted clients belong in the routing table: it decides who receives which frames.
"""

from array import array
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final, Generic, TypeVar

from gateway.hub.stream_words import ACCEPTED, HALF, LAST, LEADER, LOST, NEWEST_US, STREAM_WORDS
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS, boot_time_us
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
MEMORY_OF_ONE: Final = 224
"""Frames of a component after which the same bytes may be a new frame: sequence numbers repeat
after 256 frames, lost ones included."""
MEMORY_FRAMES: Final = 32_768
"""Maximum per generation, some 200 bytes each: half a minute at 1000 frames a second, 13 MB."""
NEIGHBOURS: Final = 8
"""Sequence numbers before and after a frame that show whether it is late."""

NEW: Final = -1
LATE: Final = 0
"""Results of `DuplicateFilter.check`; client ids are positive."""

REPORTED_US: Final = 3 * US_PER_S
"""Maximum age of a start time: most vehicles send messages with it several times a second."""
SAME_START_US: Final = 5 * US_PER_S
"""Difference of start times beyond which they are two vehicles: no link delays by so much, and two
are seldom switched on at the same moment."""

Note = TypeVar("Note")
LINKED_US: Final = 60 * US_PER_S
"""A pair ends after this time without a copy: it was chance, or one of the links has gone."""
HOME_POSITION_ID: Final = MESSAGE_IDS["HOME_POSITION"]
GREETING: Final = (HEARTBEAT_ID, HOME_POSITION_ID)
"""Messages of a greeting, in this order: the vehicle exists, and its home."""
OWN_FRESH_US: Final = 5 * US_PER_S
"""Time without a sent heartbeat after which a system is no longer ours: a playback has ended."""


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
class FrameStream:
    """The frames of one system and component that were accepted."""

    words: "array[int]" = field(default_factory=lambda: array("q", bytes(8 * STREAM_WORDS)))
    """When the newest frame of each sequence number was sent, as estimated by the lag of its path,
    0 for none; then those of `stream_words`."""

    @property
    def count(self) -> int:
        """The number of accepted frames."""
        return self.words[ACCEPTED]

    @property
    def lost(self) -> int:
        """The number of sequence numbers that were left out."""
        return self.words[LOST]

    @property
    def leader(self) -> int:
        """The client that brought the newest frame."""
        return self.words[LEADER]

    @property
    def newest_us(self) -> int:
        """When the newest frame was sent."""
        return self.words[NEWEST_US]

    def accept(self, sequence: int, client_id: int, sent_us: int) -> None:
        """Register a frame that is neither a copy nor late."""
        words = self.words
        ahead = sequence - words[LAST] & 0xFF
        if not words[ACCEPTED]:
            words[LAST] = sequence
        elif 0 < ahead < HALF:
            words[LOST] += ahead - 1
            words[LAST] = sequence
        words[ACCEPTED] += 1
        words[sequence] = sent_us
        if sent_us >= words[NEWEST_US]:
            words[NEWEST_US], words[LEADER] = sent_us, client_id

    def newest_sequence(self) -> int:
        """Return the number of the newest frame; of several at one time, the last of their run."""
        sent_us = self.words[:256]
        newest_us = max(sent_us)
        return (
            next(
                number
                for number in range(256)
                if sent_us[number] == newest_us != sent_us[number + 1 & 0xFF]
            )
            if newest_us != min(sent_us)
            else 0
        )

    def is_behind(self, sequence: int, limit_us: int) -> bool:
        """Return whether the frames after a number were accepted more than a limit ago.

        The number is behind the newest one if a following number was seen later than a preceding
        one; of a number ahead, the following ones were seen one cycle of the counter ago.
        """
        after = self._nearest(sequence, 1)
        return after > self._nearest(sequence, -1) and self.newest_us - after > limit_us

    def _nearest(self, sequence: int, step: int) -> int:
        for distance in range(step, step * (NEIGHBOURS + 1), step):
            if sent_us := self.words[sequence + distance & 0xFF]:
                return sent_us
        return 0


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
    heard: "array[int]" = field(default_factory=lambda: array("q", [0]))
    """When it was received last, in memory that the compiled step writes too."""

    def __post_init__(self) -> None:
        """Begin with its first frame."""
        self.heard_us = self.since_us

    @property
    def heard_us(self) -> int:
        """When it was received last."""
        return self.heard[0]

    @heard_us.setter
    def heard_us(self, heard_us: int) -> None:
        self.heard[0] = heard_us

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


class FrameMemory(Generic[Note]):
    """Notes on recent frames in two generations, each of at most a time and a number of frames."""

    def __init__(self, span_us: int, most: int) -> None:
        self._span_us = span_us
        self._most = most
        self._recent: dict[Hashable, Note] = {}
        self._older: dict[Hashable, Note] = {}
        self._turned_us = 0

    def turn(self, now_us: int) -> None:
        """Start another generation if it is due."""
        if now_us - self._turned_us >= self._span_us or len(self._recent) >= self._most:
            self._older, self._recent = self._recent, {}
            self._turned_us = now_us

    def get(self, frame: Hashable) -> Note | None:
        """Return the note on a frame."""
        return self._recent.get(frame) or self._older.get(frame)

    def put(self, frame: Hashable, note: Note) -> None:
        """Register a frame with its note."""
        self._recent[frame] = note


class DuplicateFilter:
    """Recognise copies and late frames of systems that are received on several paths.

    Theory of operation. Accepted frames are remembered for `MEMORY_US` by a hash of their bytes,
    sequence number included; a frame with a known hash is a copy. Two exceptions: a copy of a frame
    from before its path existed passes, because it cannot be distinguished from a program that was
    restarted and repeats its first frames from another port; and content that repeats, such as a
    heartbeat's, has the same bytes again after 256 frames: on a path without delay it is new.

    Each copy measures the lag of its path behind the first one. A frame that is not a copy was
    sent about one lag before it arrived; if that is more than a limit before the newest frame of
    its stream, or if its sequence number belongs before frames that old, it is late. (Sequence
    numbers are registered even while there is one path, for when a second one appears.) The path
    that brought the newest frame is always accepted, so a restarted system loses nothing.
    """

    def __init__(self) -> None:
        self._memory: FrameMemory[tuple[int, int, int, int, bool]] = FrameMemory(
            MEMORY_US, MEMORY_FRAMES
        )
        """Times at which a frame was sent and received, its client, its number in the stream, and
        whether the same bytes were accepted before."""

    def check(
        self, frame: MavFrame, client_id: int, path: SystemPath, now_us: int, limit_us: int
    ) -> int:
        """Return `NEW`, `LATE`, or the id of the client that brought the same bytes first.

        A frame older than the newest of its stream by more than `limit_us` is late.
        """
        self._memory.turn(now_us)
        digest = hash(frame.data)
        known = self._memory.get(digest)
        stream = path.stream
        if known is not None:
            sent_us, received_us, first, count, is_repeated = known
            turned = stream.count - count >= MEMORY_OF_ONE
            if first == client_id:
                is_copy = now_us - received_us <= REPEAT_US and not turned
            else:
                is_prompt = client_id == stream.leader or path.is_prompt(now_us)
                is_copy = not (turned and (is_repeated or is_prompt))
            if is_copy and received_us >= path.since_us:
                if first != client_id:
                    path.lag_us, path.copied_us = max(0, now_us - sent_us), now_us
                return first
        sent_us = now_us - path.lag_us
        if client_id != stream.leader and self._is_late(frame, stream, sent_us, now_us, limit_us):
            return LATE
        stream.accept(frame.sequence, client_id, sent_us)
        self._memory.put(digest, (sent_us, now_us, client_id, stream.count, known is not None))
        return NEW

    @staticmethod
    def _is_late(
        frame: MavFrame, stream: FrameStream, sent_us: int, now_us: int, limit_us: int
    ) -> bool:
        if sent_us < stream.newest_us - limit_us:
            return True
        leader_lives = now_us - stream.newest_us <= limit_us
        return leader_lives and stream.is_behind(frame.sequence, limit_us)


class RedundantLinks:
    """Pairs of clients that are links to one peer, because both brought copies of a frame recently.

    Frames that we forward may return and look the same, so only frames that are not forwarded
    count. Both links of a pair get every answer, and also any stream that only one of them
    requested: then both carry the same sequence numbers, and the peer can recognise copies by their
    bytes too. Two ground stations that share an id and were started at the same moment look like
    such a pair: each gets the answers to the other's requests.
    """

    def __init__(self) -> None:
        self._seen_us: dict[tuple[int, int], int] = {}
        self._groups: dict[int, tuple[int, ...]] = {}

    def register(self, first: int, second: int, now_us: int) -> bool:
        """Register that a client brought a copy of another's frame; return if the pair is new."""
        pair = (first, second) if first < second else (second, first)
        is_new = pair not in self._seen_us
        self._seen_us[pair] = now_us
        if is_new:
            self._regroup()
        return is_new

    def group(self, client_id: int) -> tuple[int, ...]:
        """Return all links to a client's peer, the client included, lowest id first."""
        return self._groups.get(client_id, (client_id,))

    def expire(self, now_us: int) -> None:
        """Separate pairs that no longer bring copies."""
        self._part([pair for pair, us in self._seen_us.items() if now_us - us > LINKED_US])

    def remove(self, client_id: int) -> None:
        """Separate a client from all others."""
        self._part([pair for pair in self._seen_us if client_id in pair])

    def _part(self, pairs: list[tuple[int, int]]) -> None:
        for pair in pairs:
            del self._seen_us[pair]
        if pairs:
            self._regroup()

    def _regroup(self) -> None:
        """Join pairs that share a client."""
        groups: dict[int, set[int]] = {}
        for first, second in self._seen_us:
            joined = groups.get(first, {first}) | groups.get(second, {second})
            for client_id in joined:
                groups[client_id] = joined
        self._groups = {client_id: tuple(sorted(group)) for client_id, group in groups.items()}


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
