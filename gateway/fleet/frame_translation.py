"""Translate the frames of a site to the system ids of its vehicles here, and back.

The translation changes the sender in the header, the system that a message addresses, and systems
in its parameters, such as the vehicle to follow or the target of a camera. Then it computes the
checksum again. A signature covers all of these: with the site's passphrase it is checked first and
renewed with the same link and timestamp; without the passphrase a signed frame passes only
unchanged.
"""

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from gateway.fleet.id_map import IdMap, SiteVehicle
from gateway.fleet.loop_detection import LoopDetection
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_signing import WindowVerifier
from gateway.wire.mavlink_splitter import MavFrame
from gateway.wire.system_ids import rename_systems

SEQUENCE_MASK: Final = 0xFF
RATE_MARKS: Final = 6
"""Number of marks, one a second: rates are averaged over five seconds."""
MAX_LOST: Final = 128
"""A larger step of the sequence number is a restart, not a loss."""
MAX_OVERTAKEN: Final = 32
"""Maximum lateness in frames: texts and answers have a higher priority and overtake others."""
MAX_SENDERS: Final = 1024
"""Maximum components of a site whose sequence numbers are stored; more are forged."""


@dataclass(slots=True)
class VehicleTraffic:
    """Received frames of one vehicle."""

    frames: int = 0
    lost: int = 0
    """Lost frames, from the gaps in its sequence numbers."""
    received_us: int = 0
    marks: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=RATE_MARKS))
    """Times of the last seconds, each with the number of frames until then."""

    def rate_hz(self, now_us: int) -> float:
        """Return the average rate of the last seconds, in frames a second."""
        since_us, before = self.marks[0]
        return (self.frames - before) * US_PER_S / max(now_us - since_us, US_PER_S)


class FrameTranslation:
    """The frames of one site."""

    def __init__(
        self,
        site: str,
        ids: IdMap,
        signatures: WindowVerifier | None = None,
        loops: LoopDetection | None = None,
    ) -> None:
        self._site = site
        self._ids = ids
        self._signatures = signatures
        self._loops = loops or LoopDetection()
        self._sequences: dict[tuple[int, int], int] = {}
        self.counters: Counter[str] = Counter()
        """Dropped frames by cause.

        `unmapped`: no id is left for their vehicle. `unknown`: an unknown message, whose checksum
        cannot be computed. `signed`: it must be changed, and there is no passphrase.
        `unsigned`, `forged` and `replayed` did not pass the check with the site's passphrase.
        `looped`: sent from here, and returned through the site.
        """
        self.traffic: dict[int, VehicleTraffic] = {}
        """Traffic of each vehicle by its system id at the site."""

    def mark(self, now_us: int) -> None:
        """Record the counts for the rates; called about once a second."""
        for traffic in self.traffic.values():
            traffic.marks.append((now_us, traffic.frames))

    def from_site(self, frame: MavFrame, now_us: int, *, is_own: bool = False) -> MavFrame | None:
        """Return a frame of the site with the fleet's ids; None if it is dropped.

        `is_own` if the site's gateway created it, so that it cannot be a returned frame.
        """
        if self._signatures is not None and (rejection := self._signatures.check(frame, now_us)):
            self.counters[rejection] += 1
            return None
        system_id = frame.origin[0]
        vehicle = SiteVehicle(self._site, system_id)
        if not is_own:
            has_id = self.id_of(system_id) is not None
            if self._loops.is_returned(frame, vehicle, has_id=has_id, now_us=now_us):
                self.counters["looped"] += 1
                return None
        own_id = self._ids.id_of(*vehicle)
        if own_id is None:
            self.counters["unmapped"] += 1
            return None
        self._update_traffic(frame, now_us)
        given = self._rewritten(frame, own_id, self._id_here)
        if given is not None:
            self._loops.record_given(given, vehicle, now_us)
        return given

    def to_site(self, frame: MavFrame, now_us: int) -> tuple[int, MavFrame] | None:
        """Return the system at the site to which a frame is addressed (0: all), and its frame.

        None for a frame that cannot be translated, or whose target id no vehicle of this site has
        (any more): the hub's routes outlive a reassignment, and at the site the id may belong to
        a third vehicle, or to an excluded one.
        """
        sender, target = self._id_there(frame.origin[0]), frame.target[0]
        addressed = self._ids.vehicle_of(target) if target else None
        if target and (addressed is None or addressed.site != self._site):
            return None
        signatures = self._signatures
        # The site checks for replays itself, because it has all its streams.
        if signatures is not None and frame.signed and not signatures.is_genuine(frame):
            self.counters["forged"] += 1
            return None
        changed = self._rewritten(frame, sender, self._id_there)
        if changed is None:
            return None
        self._loops.record_sent(frame, changed, now_us)
        return self._id_there(target), changed

    def id_of(self, system_id: int) -> int | None:
        """Return the id of a system of the site in the fleet, if it has one."""
        return self._ids.known_id(self._site, system_id)

    def _id_here(self, system_id: int) -> int:
        return self.id_of(system_id) or system_id

    def _id_there(self, own_id: int) -> int:
        vehicle = self._ids.vehicle_of(own_id)
        return vehicle.system_id if vehicle and vehicle.site == self._site else own_id

    def _rewritten(
        self, frame: MavFrame, sender: int, rename: Callable[[int], int]
    ) -> MavFrame | None:
        signatures = self._signatures
        sign = signatures.renewal(frame) if signatures is not None and frame.signed else None
        changed = rename_systems(frame, sender, rename, sign=sign)
        if changed is None:
            self.counters["signed" if frame.message_id in CRC_EXTRA else "unknown"] += 1
        return changed

    def _update_traffic(self, frame: MavFrame, now_us: int) -> None:
        origin, sequence = frame.origin, frame.sequence
        traffic = self.traffic.setdefault(origin[0], VehicleTraffic())
        if not traffic.marks:
            traffic.marks.append((now_us, 0))
        traffic.frames += 1
        traffic.received_us = now_us
        if (before := self._sequences.get(origin)) is not None:
            if 0 < (before - sequence & SEQUENCE_MASK) <= MAX_OVERTAKEN:
                traffic.lost = max(0, traffic.lost - 1)
                return
            gap = sequence - before - 1 & SEQUENCE_MASK
            traffic.lost += gap if gap < MAX_LOST else 0
        if before is not None or len(self._sequences) < MAX_SENDERS:
            self._sequences[origin] = sequence
