"""Systems of an endpoint: which of them pass, and the ids that they have on its link.

Some options select and one renumbers. They apply to both directions:

| option                    | frames to the endpoint           | frames from the endpoint      |
| ------------------------- | -------------------------------- | ----------------------------- |
| `systems=`, `components=` | of these, and addressed to these | addressed to these; of these, |
|                           |                                  | to stations and displays      |
| `not-systems=`            | neither of these nor to these    | the same                      |
| `also=`                   | these messages too               | the same                      |
| `as=LINK:HERE`            | HERE becomes LINK                | LINK becomes HERE             |

All options name ids of this side. Selection uses the header of each frame, and excludes a system
that has not been received so far. Vehicles are sent from an endpoint that selects only frames that
address a selected one, and those of `HARMLESS`: a frame without a target, or with target 0, would
reach an excluded vehicle as well. Answers pass to stations, and to programs that have addressed a
selected system. `Reach` has the rules for frames without a target.

A renumbered frame is another frame: it gets a new checksum, and a new signature if its own is
genuine by a key that the gateway has. Otherwise it is refused, since the gateway cannot sign it.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Final

from gateway.hub.routing_table import ROUTE_FRESH_US, Origin
from gateway.wire.frame_editing import Sign
from gateway.wire.mavlink_messages import CRC_EXTRA, HEARTBEAT_ID, NO_TARGET, TARGET_OFFSETS, ids_of
from gateway.wire.mavlink_splitter import MavFrame
from gateway.wire.system_ids import LAST_ID, rename_systems
from gateway.wire.vehicle_inputs import acts

HARMLESS: Final = ids_of("HEARTBEAT", "SYSTEM_TIME", "TIMESYNC", "PING")
"""Messages that vehicles may receive from systems behind any endpoint."""
MAX_NEIGHBOURS: Final = 64
"""Maximum other systems and components of a link that are known by their heartbeats."""
WAITS: Final = "as=: no autopilot has sent a heartbeat on this link so far"
FILTER_OPTIONS: Final = ("systems", "not-systems", "components")


class Reach(Enum):
    """The links to which a frame from an endpoint that selects may be sent."""

    NOWHERE = auto()
    STATIONS = auto()
    """Those on which only ground stations are received, and those that select no other systems; an
    addressed frame also goes to a program that has addressed a selected system."""
    DISPLAYS = auto()
    """All but those on which only other vehicles are received."""
    SELECTED = auto()
    """All but those on which an excluded vehicle is received."""
    EVERYWHERE = auto()


@dataclass(frozen=True, slots=True)
class SystemFilter:
    """The systems and components that pass an endpoint; empty lets all pass."""

    only: frozenset[int] = frozenset()
    without: frozenset[int] = frozenset()
    components: frozenset[int] = frozenset()
    also: frozenset[int] = frozenset()
    """Messages without a target that pass in addition, by message id."""

    def __bool__(self) -> bool:
        return bool(self.only or self.without or self.components)

    def has(self, origin: Origin) -> bool:
        """Return whether frames of a system and component pass."""
        system, component = origin
        return self.has_system(system) and (not self.components or component in self.components)

    def has_system(self, system: int) -> bool:
        """Return whether a system passes."""
        return system not in self.without and (not self.only or system in self.only)

    def carries(self, frame: MavFrame) -> bool:
        """Return whether a frame without a target passes to the endpoint."""
        is_added = frame.message_id in self.also and frame.origin[0] not in self.without
        return is_added or self.has(frame.origin)

    def lets_out(self, frame: MavFrame) -> bool:
        """Return whether a frame that is addressed, or a station's, passes to the endpoint."""
        if self._excludes(frame):
            return False
        return self.has(frame.origin) or self.lets_send(frame.message_id, frame.target)

    def lets_send(self, message_id: int, target: Origin) -> bool:
        """Return whether a message may reach vehicles: by its target, or since it is harmless.

        Messages without a target component are for the autopilot.
        """
        if not target[0]:
            return message_id in HARMLESS or message_id in self.also
        has_component = TARGET_OFFSETS[message_id][1] != NO_TARGET
        return self.has(target) if has_component else self.has_system(target[0])

    def reach(self, frame: MavFrame, *, from_station: bool) -> Reach:
        """Return where a frame from the endpoint may be sent.

        `from_station` is whether its sender is a ground station behind the endpoint.
        """
        is_selected, message_id = self.has(frame.origin), frame.message_id
        if self._excludes(frame):
            return Reach.NOWHERE
        if frame.target[0] and self.lets_send(message_id, frame.target):
            return Reach.EVERYWHERE
        if not (is_selected or from_station):
            return Reach.NOWHERE
        if frame.target[0]:
            return Reach.STATIONS
        if message_id in HARMLESS:
            return Reach.EVERYWHERE
        if message_id in self.also:
            return Reach.SELECTED
        if not is_selected:
            return Reach.NOWHERE
        return Reach.STATIONS if acts(message_id) else Reach.DISPLAYS

    def _excludes(self, frame: MavFrame) -> bool:
        return frame.origin[0] in self.without or frame.target[0] in self.without


NO_FILTER: Final = SystemFilter()


def ids_from(option: str, text: str) -> frozenset[int]:
    """Read ids, separated by commas; raises ValueError."""
    return frozenset(_id_from(option, part) for part in text.split(",") if part)


def new_ids_from(text: str) -> dict[int, int]:
    """Read the option `as`: `LINK:HERE` for each system, or the id here of the only vehicle.

    Returns the ids here by those of the link; the key 0 is the only vehicle. Raises ValueError.
    """
    found: dict[int, int] = {}
    for part in filter(None, text.split(",")):
        link, colon, here = part.rpartition(":")
        key = _id_from("as", link) if colon else 0
        value = _id_from("as", here)
        if key in found or value in found.values():
            raise ValueError(f"as={text}: an id is given twice")
        found[key] = value
    if 0 in found and len(found) > 1:
        raise ValueError(f"as={text}: write as=11 for one vehicle, as=1:11,2:12 for several")
    return found


def _id_from(option: str, text: str) -> int:
    if text.isascii() and text.isdecimal() and len(text) < 4 and 1 <= int(text) <= LAST_ID:
        return int(text)
    raise ValueError(f"{option} {text!r} is not an id from 1 to {LAST_ID}")


@dataclass(slots=True)
class SystemTranslation:
    """Other ids of systems on one link.

    Parameters
    ----------
    new_ids : dict of int to int
        Ids here by those of the link; the key 0 means the first autopilot of the link.
    renewal : callable
        Returns the signer of a changed frame; None if no key of the gateway fits its signature.
    on_change : callable
        Called when the only vehicle is found, because all routes are then outdated.
    """

    new_ids: dict[int, int]
    renewal: Callable[[MavFrame], Sign | None]
    on_change: Callable[[], None]
    refused: int = 0
    """Frames that could not be renumbered."""
    reason: str = ""
    """Why the last one was refused."""
    _link: dict[int, int] = field(default_factory=dict)
    """Ids of the link by those of this side."""
    _here: dict[int, int] = field(default_factory=dict)
    _neighbours: set[Origin] = field(default_factory=set)
    _received_us: int = 0
    """When a frame of the only vehicle was received last."""

    def __post_init__(self) -> None:
        """Use all ids that are known already."""
        if 0 not in self.new_ids:
            self._use(self.new_ids)

    def _use(self, here: dict[int, int]) -> None:
        self._here = here
        self._link = {value: key for key, value in here.items()}

    def here(self, system: int) -> int:
        """Return the id of a system of the link on this side."""
        return self._here.get(system, system)

    def link(self, system: int) -> int:
        """Return the id of a system of this side on the link."""
        return self._link.get(system, system)

    def has_room_for(self, system: int) -> bool:
        """Return whether the id of a system is not used by another one on the link."""
        return system in self._link or system not in self._here

    def from_link(self, frame: MavFrame, now_us: int) -> MavFrame | None:
        """Return a received frame with the ids of this side; None if it is refused."""
        if 0 in self.new_ids and not self._finds_vehicle(frame, now_us):
            return self._refuse(WAITS)
        system = frame.origin[0]
        if system not in self._here and system in self._link:
            return self._refuse(f"as=: system {system} of this link has the id of another one here")
        return self._changed(frame, self.here(system), self.here)

    def to_link(self, frame: MavFrame) -> MavFrame | None:
        """Return a frame with the ids of the link; None if it is refused."""
        if not self.has_room_for(frame.origin[0]):
            return None
        return self._changed(frame, self.link(frame.origin[0]), self.link)

    def _changed(
        self, frame: MavFrame, sender: int, rename: Callable[[int], int]
    ) -> MavFrame | None:
        sign = self.renewal(frame) if frame.signed else None
        changed = rename_systems(frame, sender, rename, sign=sign)
        if changed is not None:
            return changed
        if frame.message_id not in CRC_EXTRA:
            return self._refuse(f"as=: message {frame.message_id} is unknown here")
        system = frame.origin[0]
        return self._refuse(f"as=: signed frames of system {system} need their signing_passphrase")

    def _refuse(self, reason: str) -> MavFrame | None:
        self.refused += 1
        self.reason = reason
        return None

    def _finds_vehicle(self, frame: MavFrame, now_us: int) -> bool:
        """Find the only vehicle; return whether a frame can be translated already."""
        origin = frame.origin
        if frame.message_id == HEARTBEAT_ID and origin[0] not in self._here:
            if not frame.is_autopilot_heartbeat:
                if len(self._neighbours) < MAX_NEIGHBOURS:
                    self._neighbours.add(origin)
            elif not self._here or now_us - self._received_us > ROUTE_FRESH_US:
                self._use({origin[0]: self.new_ids[0]})
                self.reason = ""
                self.on_change()
        if origin[0] in self._here:
            self._received_us = now_us
            return True
        return bool(self._here) or origin in self._neighbours
