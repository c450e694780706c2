"""Detect frames that a fleet sent to its stations and that return through a site that they feed.

Hubs forward frames unchanged, so a frame of a vehicle that equals one sent recently for another
vehicle has most likely returned. Two aircraft of one type also send equal frames: heartbeats
differ only in the sequence number, and many aircraft have the same system id. So equal frames of
vehicles with equal ids prove nothing, and frames of a vehicle that has an id are dropped only after
a whole run of returned ones. Frames marked as created by the site's own gateway are not checked.
"""

from typing import Final

import msgspec

from gateway.fleet.id_map import SiteVehicle
from gateway.hub.duplicates import FrameMemory
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame

SPAN_US: Final = 3 * US_PER_S
"""Longest time of the way through a site and back, over two slow links."""
MAX_FRAMES: Final = 1 << 15
"""Maximum frames of a span: 200 aircraft at 50 messages/s; two spans take some 20 MB."""
MAX_CHANCE: Final = 8
"""Maximum run of frames that may equal those of another vehicle by chance."""
MAX_KINDS: Final = 1 << 14
"""Maximum stored kinds, messages times vehicles; more are forged."""
NO_SITE: Final = ""
"""Site of the ground stations here."""


class _Sent(msgspec.Struct, frozen=True, gc=False):
    """A frame that was sent to the stations here."""

    time_us: int
    vehicle: SiteVehicle
    is_proof: bool
    """Whether no other vehicle may send the same frame by itself."""


class LoopDetection:
    """Frames sent recently in both directions, and vehicles that only return such frames."""

    def __init__(self) -> None:
        self._given: FrameMemory[_Sent] = FrameMemory(SPAN_US, MAX_FRAMES)
        self._sent: FrameMemory[int] = FrameMemory(SPAN_US, MAX_FRAMES)
        """Frames changed for a site, with the time until which they may return."""
        self._newest: dict[tuple[SiteVehicle, int, int], bytes] = {}
        """Newest payload of each message of each component of a vehicle."""
        self._runs: dict[SiteVehicle, int] = {}
        """Number of successive returned frames of each vehicle."""
        self._proven: set[SiteVehicle] = set()
        """Vehicles proven to return frames, until they send a new one."""
        self.looped = 0
        """Number of frames sent to a site that a client here has returned."""

    def record_given(self, frame: MavFrame, vehicle: SiteVehicle, now_us: int) -> None:
        """Store a frame of a vehicle that is sent to the ground stations here."""
        kind, payload = (vehicle, frame.origin[1], frame.message_id), frame.payload
        before = self._newest.get(kind)
        if before is None and len(self._newest) >= MAX_KINDS:
            self._newest.clear()
        self._newest[kind] = payload
        self._given.turn(now_us)
        self._given.put(frame.data, _Sent(now_us, vehicle, before not in (None, payload)))

    def record_sent(self, frame: MavFrame, changed: MavFrame, now_us: int) -> None:
        """Store a frame of a client here, as received and as sent to a site."""
        station = SiteVehicle(NO_SITE, frame.origin[0])
        self.record_given(frame, station, now_us)
        if changed.data != frame.data:
            self.record_given(changed, station, now_us)
            self._sent.turn(now_us)
            self._sent.put(changed.data, now_us + 2 * SPAN_US)

    def is_returned(
        self, frame: MavFrame, vehicle: SiteVehicle, *, has_id: bool, now_us: int
    ) -> bool:
        """Return whether a frame of a site has been here before."""
        known = self._given.get(frame.data)
        if known is None or known.vehicle == vehicle or now_us - known.time_us > 2 * SPAN_US:
            self._runs.pop(vehicle, None)
            self._proven.discard(vehicle)
            return False
        run = self._runs[vehicle] = self._runs.get(vehicle, 0) + 1
        if known.is_proof:
            self._proven.add(vehicle)
        is_proven = vehicle in self._proven
        if has_id:
            return is_proven and run > MAX_CHANCE
        # Two vehicles with the same id may send equal frames, unless one id was changed.
        is_other_id = known.vehicle.system_id != vehicle.system_id
        was_changed = is_other_id or known.vehicle.site == NO_SITE
        return is_proven or was_changed or run <= MAX_CHANCE

    def is_returned_by_client(self, frame: bytes, now_us: int) -> bool:
        """Return whether a client here returns a frame sent to a site, and count it."""
        until_us = self._sent.get(frame)
        if until_us is None or now_us > until_us:
            return False
        self.looped += 1
        return True
