"""Which outlet gets which frame, in which order and with which sequence number.

Theory of operation. The first frame of each (system, component, message) makes a plan: the outlets
that take every such frame, those that take it at a limited rate, and those that do not take it.
Plans are discarded when an outlet or a requested rate changes, so the usual frame costs one
dictionary look-up and one call per outlet.

A frame that one outlet does not get (filtered, limited, or an answer to another client) leaves a
gap in the sequence numbers there, which ground stations show as radio loss. So our own frames are
renumbered for those outlets: each outlet remembers how many it was not given, and all outlets that
lack the same number share one copy, which is signed too if our vehicle signs. Frames of other
vehicles are never touched; a filter on those does show as loss.

What goes to an outlet of a known width is counted, and thinned once a second so that it fits: see
`width.py`.
"""

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from gateway.hub.bandwidth import HIGH_LATENCY2, HIGH_LATENCY2_BYTES, NARROW, Width
from gateway.hub.endpoint import Endpoint
from gateway.hub.option_values import NO_MESSAGES
from gateway.records import ClientInterval
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import (
    key_of,
    message_id_of,
    origin_of,
    restamp,
    sequence_of,
)

Transmit = Callable[[bytes, int], None]
"""Hands a frame and its message id to a transport."""

SEQUENCE_MASK: Final = 0xFF
SLACK_SHIFT: Final = 2
"""A limited frame may come a quarter of its interval early, or jitter would halve the rate."""

MAX_PLANS: Final = 4096
"""A vehicle sends some fifty kinds of message; forged headers must not fill the memory."""


@dataclass(slots=True)
class _Stamp:
    """How many frames of one component an outlet was not given, modulo 256."""

    skipped: int = 0


@dataclass(slots=True, eq=False)
class _Outlet:
    client_id: int
    transmit: Transmit
    endpoint: Endpoint
    width: Width | None = None
    answered: int = 0
    """Bytes of answers since the last plan of the width."""
    wishes: dict[tuple[int, int], int] = field(default_factory=dict)
    stamps: dict[tuple[int, int], _Stamp] = field(default_factory=dict)

    def stamp_of(self, origin: tuple[int, int]) -> _Stamp:
        stamp = self.stamps.get(origin)
        if stamp is None:
            if len(self.stamps) >= MAX_PLANS:
                self.stamps.clear()
            stamp = self.stamps[origin] = _Stamp()
        return stamp

    def interval_us(self, key: bytes, plan: "_Plan") -> int:
        """Return the least time between two frames; the settings bound a client's request."""
        endpoint, message_id, system = self.endpoint, plan.message_id, plan.origin[0]
        if not endpoint.passes(message_id):
            return NO_MESSAGES
        if 0 < endpoint.budget < NARROW:
            if message_id != HIGH_LATENCY2:
                return NO_MESSAGES
            return round(HIGH_LATENCY2_BYTES * US_PER_S / endpoint.budget)
        if message_id == HIGH_LATENCY2 and plan.is_ours and message_id not in endpoint.allow:
            # All that it says goes there in full.
            return NO_MESSAGES
        limit = endpoint.interval_us.get(message_id, 0)
        wish = self.wishes.get((system, message_id), 0)
        if NO_MESSAGES in (limit, wish):
            return NO_MESSAGES
        return max(limit, wish, self.width.interval_us(key) if self.width else 0)


@dataclass(slots=True, eq=False)
class _Lane:
    """One kind of frame on its way to one outlet."""

    client_id: int
    transmit: Transmit
    stamp: _Stamp
    interval_us: int
    due_us: int = 0

    def is_due(self, now_us: int) -> bool:
        slack_us = self.interval_us >> SLACK_SHIFT
        if now_us < self.due_us - slack_us:
            return False
        self.due_us = max(self.due_us, now_us - slack_us) + self.interval_us
        return True

    def change(self, interval_us: int) -> None:
        """Let the frame that is next be as far from the last one as later ones will be."""
        if self.due_us:
            self.due_us += interval_us - self.interval_us
        self.interval_us = interval_us


@dataclass(slots=True)
class _Plan:
    message_id: int
    origin: tuple[int, int]
    is_ours: bool
    open: list[_Lane] = field(default_factory=list)
    limited: list[_Lane] = field(default_factory=list)
    closed: list[_Stamp] = field(default_factory=list)

    def due(self, now_us: int) -> list[_Lane]:
        """Return the lanes that get a frame now; those for which it is too soon skip its number."""
        lanes = list(self.open)
        for lane in self.limited:
            if lane.is_due(now_us):
                lanes.append(lane)
            else:
                _skip(lane.stamp)
        return lanes


class Fanout:
    """Give frames to outlets by their filters, rates and addresses.

    Parameters
    ----------
    seal : callable
        Numbers, and signs, each frame of ours that leaves.
    """

    def __init__(self, seal: Seal = restamp) -> None:
        self._seal = seal
        self._outlets: dict[int, _Outlet] = {}
        self._plans: dict[bytes, _Plan] = {}
        self._is_metered = False
        self._offered: dict[bytes, tuple[int, int, int]] = {}
        """Message id, frames and bytes of each kind since the last plan of the widths."""
        self._thinned_us = 0

    def add(self, client_id: int, transmit: Transmit, endpoint: Endpoint) -> None:
        """Let an outlet take part from the next frame on."""
        self._outlets[client_id] = _Outlet(client_id, transmit, endpoint, _width(endpoint))
        self._change()

    def remove(self, client_id: int) -> None:
        """Forget an outlet; unknown ids are ignored."""
        if self._outlets.pop(client_id, None):
            self._change()

    def reconfigure(self, client_id: int, endpoint: Endpoint) -> None:
        """Apply changed lists and rates from the next frame on."""
        if outlet := self._outlets.get(client_id):
            if outlet.endpoint.budget != endpoint.budget:
                outlet.width = _width(endpoint)
            outlet.endpoint = endpoint
            self._change()

    def set_interval(self, wish: ClientInterval) -> None:
        """Apply a client's requested rate; that of a client that has gone is ignored."""
        if outlet := self._outlets.get(wish.client_id):
            outlet.wishes[wish.system_id, wish.message_id] = wish.interval_us
            self._plans.clear()

    def publish(self, frame: bytes, now_us: int) -> None:
        """Send one of our own frames to every outlet that takes it."""
        plan = self._plans.get(key_of(frame)) or self._make_plan(frame, is_ours=True)
        message_id = plan.message_id
        if self._is_metered:
            self.meter(key_of(frame), message_id, 1, len(frame))
        sequence = sequence_of(frame)
        copies: dict[int, bytes] = {}
        for lane in plan.due(now_us) if plan.limited else plan.open:
            skipped = lane.stamp.skipped
            if skipped not in copies:
                copies[skipped] = self._seal(frame, sequence - skipped & SEQUENCE_MASK)
            lane.transmit(copies[skipped], message_id)
        for stamp in plan.closed:
            _skip(stamp)

    def align(self, client_ids: Sequence[int]) -> None:
        """Send outlets to one peer the same frames, number for number, from now on.

        A rate that one of them requested holds for all; where they differ, the first decides.
        """
        outlets = [self._outlets[key] for key in client_ids if key in self._outlets]
        origins = {origin for outlet in outlets for origin in outlet.stamps}
        wishes = {k: v for outlet in reversed(outlets) for k, v in outlet.wishes.items()}
        for outlet in outlets:
            outlet.wishes = dict(wishes)
            for origin in origins:
                outlet.stamp_of(origin).skipped = outlets[0].stamp_of(origin).skipped
        self._plans.clear()

    def answer(self, frame: bytes, client_ids: Collection[int]) -> None:
        """Send one of our own frames to some outlets only, past their filters."""
        origin = origin_of(frame)
        # A copy: an outlet that breaks at this frame removes itself.
        for outlet in tuple(self._outlets.values()):
            stamp = outlet.stamp_of(origin)
            if outlet.client_id in client_ids:
                outlet.answered += len(frame)
                sequence = sequence_of(frame) - stamp.skipped & SEQUENCE_MASK
                outlet.transmit(self._seal(frame, sequence), message_id_of(frame))
            else:
                _skip(stamp)

    def forward(self, frame: bytes, source_id: int, now_us: int) -> None:
        """Pass another system's broadcast on to all outlets but the one it came from."""
        plan = self._plans.get(key_of(frame)) or self._make_plan(frame, is_ours=False)
        if self._is_metered:
            self.meter(key_of(frame), plan.message_id, 1, len(frame))
        for lane in plan.open:
            if lane.client_id != source_id:
                lane.transmit(frame, plan.message_id)
        for lane in plan.limited:
            if lane.client_id != source_id and lane.is_due(now_us):
                lane.transmit(frame, plan.message_id)

    def takers(self, frame: bytes, source_id: int) -> list[int] | None:
        """Return who gets all frames like this one from a source; None if that varies."""
        plan = self._plans.get(key_of(frame)) or self._make_plan(frame, is_ours=False)
        if plan.limited:
            return None
        return [lane.client_id for lane in plan.open if lane.client_id != source_id]

    def deliver(self, frame: bytes, client_ids: Iterable[int]) -> None:
        """Pass a frame on to some outlets, past their filters, untouched."""
        message_id = message_id_of(frame)
        for client_id in client_ids:
            if outlet := self._outlets.get(client_id):
                outlet.answered += len(frame)
                outlet.transmit(frame, message_id)

    def thin(self, now_us: int) -> bool:
        """Thin the frames to outlets of a known width so that they fit; call it once a second.

        Returns
        -------
        bool
            Whether an outlet that got all frames of a kind gets fewer now, or all of them again.
        """
        if not self._is_metered or now_us - self._thinned_us < US_PER_S:
            return False
        elapsed_s = (now_us - self._thinned_us) / US_PER_S
        self._thinned_us = now_us
        for outlet in self._outlets.values():
            if outlet.width is not None:
                outlet.width.plan(self._offered, outlet.answered, elapsed_s)
                outlet.answered = 0
        self._offered = {}
        stale = [key for key, plan in self._plans.items() if self._rethin(key, plan)]
        for key in stale:
            del self._plans[key]
        return bool(stale)

    def _rethin(self, key: bytes, plan: _Plan) -> bool:
        """Give a plan's lanes new intervals; return whether one belongs to another list now."""
        is_stale = False
        for lanes, is_limited in ((plan.open, False), (plan.limited, True)):
            for lane in lanes:
                outlet = self._outlets[lane.client_id]
                if outlet.width is not None:
                    # In place: a new lane would send at once.
                    lane.change(outlet.interval_us(key, plan))
                    is_stale |= (lane.interval_us > 0) != is_limited
        return is_stale

    def meter(self, key: bytes, message_id: int, frames: int, size: int) -> None:
        """Count frames that went to all who take them, whichever way they went."""
        _, known_frames, known_size = self._offered.get(key, (0, 0, 0))
        if self._is_metered and len(self._offered) < MAX_PLANS:
            self._offered[key] = message_id, known_frames + frames, known_size + size

    def note_buffer(self, client_id: int, free_percent: int) -> None:
        """Take in how much of the buffer of an outlet's radio is free."""
        outlet = self._outlets.get(client_id)
        if outlet is not None and outlet.width is not None:
            outlet.width.note_buffer(free_percent)

    def _change(self) -> None:
        self._plans.clear()
        self._is_metered = any(outlet.width for outlet in self._outlets.values())

    def _make_plan(self, frame: bytes, *, is_ours: bool) -> _Plan:
        if len(self._plans) >= MAX_PLANS:
            self._plans.clear()
        origin = origin_of(frame)
        plan = _Plan(message_id_of(frame), origin, is_ours)
        for outlet in self._outlets.values():
            interval_us = outlet.interval_us(key_of(frame), plan)
            if interval_us == NO_MESSAGES:
                if is_ours:
                    plan.closed.append(outlet.stamp_of(origin))
                continue
            lane = _Lane(outlet.client_id, outlet.transmit, outlet.stamp_of(origin), interval_us)
            (plan.limited if interval_us else plan.open).append(lane)
        self._plans[key_of(frame)] = plan
        return plan


def _skip(stamp: _Stamp) -> None:
    stamp.skipped = (stamp.skipped + 1) & SEQUENCE_MASK


def _width(endpoint: Endpoint) -> Width | None:
    return Width(endpoint.budget) if endpoint.budget >= NARROW else None
