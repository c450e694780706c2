"""Frames that a fleet gave out and that come back to it, through a site that its clients feed.

Frames pass a hub byte for byte, so one that comes from a vehicle and equals one that was given out
lately for another vehicle has most likely gone round. Two aircraft of one type say equal things
too: their heartbeats differ by nothing but their number, and many have the same system id. So what
a vehicle repeats proves nothing where ids are equal by themselves, and one that has an id loses
nothing before a whole run of its frames had been here. What a site has marked as made by its own
gateway is not asked about at all.
"""

from typing import Final

import msgspec

from gateway.fleet.id_map import Vehicle
from gateway.hub.routing_table import FrameMemory
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import START_V2, message_id_of, origin_of

SPAN_US: Final = 3 * US_PER_S
"""Through a site and back, over two slow links."""
MAX_FRAMES: Final = 1 << 15
"""Of a span: 200 aircraft at 50 messages/s; two spans take some 20 MB."""
MAX_CHANCE: Final = 8
"""So many frames in a row are not those of somebody else by chance."""
MAX_KINDS: Final = 1 << 14
"""Of messages and vehicles; more are forged."""
NO_SITE: Final = ""
"""Stations here belong to none."""


class _Given(msgspec.Struct, frozen=True, gc=False):
    """A frame that was given out."""

    time_us: int
    vehicle: Vehicle
    is_proof: bool
    """Whether nobody else says the same by himself."""


class LoopWatch:
    """What was given out lately, on either side, and who brings nothing else."""

    def __init__(self) -> None:
        self._given: FrameMemory[_Given] = FrameMemory(SPAN_US, MAX_FRAMES)
        self._sent: FrameMemory[int] = FrameMemory(SPAN_US, MAX_FRAMES)
        """What was changed for a site, and until when it may come back."""
        self._newest: dict[tuple[Vehicle, int, int], bytes] = {}
        """What a component of a vehicle said last in each message."""
        self._runs: dict[Vehicle, int] = {}
        """How many of its last frames had been here."""
        self._proven: set[Vehicle] = set()
        """Those that have said nothing of their own since they were found out."""
        self.looped = 0
        """What had been sent to a site, and came back by a client here."""

    def note_given(self, frame: bytes, vehicle: Vehicle, now_us: int) -> None:
        """Remember what the ground stations here are given of a vehicle."""
        kind = (vehicle, origin_of(frame)[1], message_id_of(frame))
        head = 10 if frame[0] == START_V2 else 6
        payload = frame[head : head + frame[1]]
        before = self._newest.get(kind)
        if before is None and len(self._newest) >= MAX_KINDS:
            self._newest.clear()
        self._newest[kind] = payload
        self._given.turn(now_us)
        self._given.put(frame, _Given(now_us, vehicle, before not in (None, payload)))

    def note_sent(self, frame: bytes, changed: bytes, now_us: int) -> None:
        """Remember what a client here says, and how it is sent to a site."""
        station = (NO_SITE, origin_of(frame)[0])
        self.note_given(frame, station, now_us)
        if changed != frame:
            self.note_given(changed, station, now_us)
            self._sent.turn(now_us)
            self._sent.put(changed, now_us + 2 * SPAN_US)

    def is_back(self, frame: bytes, vehicle: Vehicle, *, has_id: bool, now_us: int) -> bool:
        """Return whether a frame of a site has been here before.

        Parameters
        ----------
        frame : bytes
            As it came.
        vehicle : Vehicle
            Whose it is by its key and its header.
        has_id : bool
            Whether that vehicle has an id here.
        now_us : int
            Gateway time.
        """
        known = self._given.get(frame)
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
        # Two that have the same id by themselves may say the same; two of which one was changed?
        was_changed = known.vehicle[1] != vehicle[1] or known.vehicle[0] == NO_SITE
        return is_proven or was_changed or run <= MAX_CHANCE

    def came_back(self, frame: bytes, now_us: int) -> bool:
        """Return whether a client here brings what was sent to a site, and count it."""
        until_us = self._sent.get(frame)
        if until_us is None or now_us > until_us:
            return False
        self.looped += 1
        return True
