"""The air between the radios: reception, collisions and losses.

Two packets that overlap on one channel destroy each other at every listener. Beyond that each
packet, data or acknowledgement, is lost to a listener with the probability `loss`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final, Protocol

import numpy as np

from firmware.rig.bench import Bench

_KEPT_PS: Final = 5_000_000_000
"""How long a packet is remembered, for overlaps: longer than any packet lasts."""


@dataclass(frozen=True, slots=True)
class Packet:
    """A transmission on the air."""

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


class Listener(Protocol):
    """A radio."""

    def listens(self, channel: int, kbps: int, start_ps: int) -> bool:
        """Whether it has been receiving there since `start_ps` without a break."""

    def hear(self, packet: Packet) -> None:
        """Take a packet that ended now, undamaged."""


@dataclass(slots=True)
class _OnAir:
    packet: Packet
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

    def send(self, packet: Packet, sender: Listener, done: Callable[[], None]) -> None:
        """Put a packet on the air now; `done` is called at its end, before it is received."""
        now_ps = self.bench.now_ps
        new = _OnAir(packet, now_ps, now_ps + packet.duration_ps, collided=False)
        self._packets = [p for p in self._packets if p.end_ps > now_ps - _KEPT_PS]
        for other in self._packets:
            if other.packet.channel == packet.channel and other.end_ps > now_ps:
                other.collided = new.collided = True
        self._packets.append(new)
        self.sent += 1

        def end() -> None:
            done()
            self._deliver(new, sender)

        self.bench.at(new.end_ps, end)

    def carrier(self, channel: int, now_ps: int) -> bool:
        """Whether there is a carrier on the channel."""
        busy = any(
            p.packet.channel == channel and p.start_ps <= now_ps < p.end_ps for p in self._packets
        )
        return busy or bool(self.rng.random() < self.noise)

    def _deliver(self, sent: _OnAir, sender: Listener) -> None:
        if sent.collided:
            self.collisions += 1
            return
        packet = sent.packet
        for listener in self.listeners:
            if listener is sender:
                continue
            heard = listener.listens(packet.channel, packet.kbps, sent.start_ps)
            if heard and not (self.loss and self.rng.random() < self.loss):
                listener.hear(packet)
