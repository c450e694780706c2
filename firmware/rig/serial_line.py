"""A UART's receiver on the line of another, which may send at another speed."""

from collections.abc import Callable
from typing import Final

from firmware.rig.bench import PS_PER_S

_BITS: Final = 10
"""Start, eight data bits, stop."""


class LineSampler:
    """Samples the bits of one sender at the speed of the receiver.

    At another speed it gives what a UART gives: wrong bytes and framing errors.

    Parameters
    ----------
    take : callable
        Called with each byte and whether its stop bit was low.
    """

    def __init__(self, take: Callable[[int, bool], None]) -> None:
        self._take = take
        self._lows: list[tuple[int, int]] = []
        """Times in ps between which the line is low, in order."""
        self._ready_ps = 0
        self._baud = 0.0

    @property
    def busy(self) -> bool:
        """Whether bits are still to be sampled."""
        return bool(self._lows)

    def send(self, start_ps: int, byte: int, baud: float) -> None:
        """Put one byte on the line."""
        bit_ps = PS_PER_S / baud
        levels = [0, *(byte >> k & 1 for k in range(8)), 1]
        for k, level in enumerate(levels):
            if level:
                continue
            begin, end = start_ps + round(k * bit_ps), start_ps + round((k + 1) * bit_ps)
            if self._lows and self._lows[-1][1] >= begin:
                self._lows[-1] = (self._lows[-1][0], end)
            else:
                self._lows.append((begin, end))

    def receive(self, now_ps: int, baud: float) -> None:
        """Sample the line up to the present time at the receiver's speed."""
        if baud != self._baud:
            self._baud, self._ready_ps = baud, now_ps
        if not baud:
            self._lows.clear()
            return
        bit_ps = PS_PER_S / baud
        while self._lows:
            start_ps = self._lows[0][0]
            if start_ps < self._ready_ps:
                # An edge inside a byte: the receiver waits for the next one.
                self._lows.pop(0)
                continue
            if start_ps + (_BITS - 0.5) * bit_ps > now_ps:
                return
            self._sample(start_ps, bit_ps)

    def _sample(self, start_ps: int, bit_ps: float) -> None:
        if self._level(start_ps + 0.5 * bit_ps):
            self._ready_ps = start_ps + round(0.5 * bit_ps)  # too short for a start bit
            return
        byte = sum(self._level(start_ps + (1.5 + k) * bit_ps) << k for k in range(8))
        stop_ps = start_ps + (_BITS - 0.5) * bit_ps
        stop_low = not self._level(stop_ps)
        self._ready_ps = round(stop_ps)
        self._take(byte, stop_low)

    def _level(self, at_ps: float) -> bool:
        for begin, end in self._lows:
            if begin > at_ps:
                return True
            if at_ps < end:
                return False
        return True
