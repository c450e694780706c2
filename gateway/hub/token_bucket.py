"""A token bucket: what may be spent at once, and how fast it fills again."""

from dataclasses import dataclass

from gateway.units import US_PER_S


@dataclass(slots=True)
class Purse:
    """Something that is spent, in bytes; who is in debt waits until it has filled.

    Parameters
    ----------
    rate : int
        Bytes a second by which it fills.
    burst : int
        Most that it holds.
    level : float
        What is there; below zero is a debt.
    filled_us : int
        When it was filled last.
    """

    rate: int
    burst: int
    level: float
    filled_us: int = 0

    def fill(self, now_us: int) -> None:
        """Add what has come since the last time."""
        gain = (now_us - self.filled_us) * self.rate / US_PER_S
        self.level = min(self.burst, self.level + gain)
        self.filled_us = now_us

    def wait_us(self) -> int:
        """Return how long until something may be taken; 0 is now."""
        return 0 if self.level > 0 else round((1 - self.level) * US_PER_S / self.rate)
