"""The air between the radios: reception, collisions and losses.

Two packets that overlap on one channel destroy each other at every listener, unless the radio
captures the stronger one. Beyond that each packet, data or acknowledgement, is lost to a listener
with the probability `loss`.
"""

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from firmware.rig.bench import Bench

_KEPT_PS: Final = 5_000_000_000
"""How long a packet is remembered, for overlaps: longer than any packet lasts."""


class Transmission(Protocol):
    """A packet of any radio."""

    @property
    def channel(self) -> Hashable:
        """Packets on different channels do not disturb each other."""

    @property
    def duration_ps(self) -> int:
        """Time on the air."""

    @property
    def strength_db(self) -> float:
        """At every listener, relative to other packets."""

    @property
    def capture_db(self) -> float:
        """A packet survives an overlap if it is stronger than the other by this."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A transmission of an nRF24L01+."""

    channel: int
    kbps: int
    address: bytes
    payload: bytes
    identity: int
    is_ack: bool
    no_ack: bool = False
    """The sender requests no acknowledgement."""

    @property
    def duration_ps(self) -> int:
        """Preamble, address, 9 control bits, payload, 2 CRC bytes: specification, section 7.3."""
        bits = 8 * (1 + len(self.address) + len(self.payload) + 2) + 9
        return bits * 1_000_000_000 // self.kbps

    @property
    def strength_db(self) -> float:
        """The same of all packets."""
        return 0.0

    @property
    def capture_db(self) -> float:
        """Overlapping packets are all lost."""
        return math.inf


class Listener(Protocol):
    """A radio."""

    def listens(self, packet: Transmission, start_ps: int) -> bool:
        """Whether it has been receiving such packets since `start_ps` without a break."""

    def hear(self, packet: Transmission) -> None:
        """Take a packet that ended now, undamaged."""


@dataclass(slots=True)
class _OnAir:
    packet: Transmission
    start_ps: int
    end_ps: int
    collided: bool


@dataclass
class Air:
    """The medium.

    Parameters
    ----------
    bench : Bench
    rng : numpy.random.Generator
    loss : float
        Probability that a listener misses a packet.
    noise : float
        Share of the time in which somebody else's carrier stands on the channel.
    """

    bench: Bench
    rng: np.random.Generator
    loss: float = 0.0
    noise: float = 0.0
    listeners: list[Listener] = field(default_factory=list)
    sent: int = 0
    collisions: int = 0
    _packets: list[_OnAir] = field(default_factory=list)

    def send(self, packet: Transmission, sender: Listener, done: Callable[[], None]) -> None:
        """Put a packet on the air now; `done` is called at its end, before it is received."""
        now_ps = self.bench.now_ps
        new = _OnAir(packet, now_ps, now_ps + packet.duration_ps, collided=False)
        self._packets = [p for p in self._packets if p.end_ps > now_ps - _KEPT_PS]
        for other in self._packets:
            if other.packet.channel == packet.channel and other.end_ps > now_ps:
                stronger_db = packet.strength_db - other.packet.strength_db
                other.collided |= -stronger_db < packet.capture_db
                new.collided |= stronger_db < packet.capture_db
        self._packets.append(new)
        self.sent += 1

        def end() -> None:
            done()
            self._deliver(new, sender)

        self.bench.at(new.end_ps, end)

    def carrier(self, channel: Hashable, now_ps: int) -> bool:
        """Whether there is a carrier on the channel."""
        return self.is_busy(channel, now_ps, now_ps) or bool(self.rng.random() < self.noise)

    def is_busy(self, channel: Hashable, from_ps: int, to_ps: int) -> bool:
        """Whether a packet is on the channel during all of this time."""
        return any(
            p.packet.channel == channel and p.start_ps <= from_ps and to_ps < p.end_ps
            for p in self._packets
        )

    def _deliver(self, sent: _OnAir, sender: Listener) -> None:
        if sent.collided:
            self.collisions += 1
            return
        packet = sent.packet
        for listener in self.listeners:
            if listener is sender:
                continue
            heard = listener.listens(packet, sent.start_ps)
            if heard and not (self.loss and self.rng.random() < self.loss):
                listener.hear(packet)
