"""A token bucket, the only rate limit that allows bursts: of bytes, texts or lines."""

from dataclasses import dataclass, field

from gateway.units import US_PER_S


@dataclass(slots=True)
class TokenBucket:
    """A bucket that is full at first; a negative level blocks until it has refilled."""

    rate: float
    """Tokens added in a second."""
    burst: float
    """Capacity."""
    filled_us: int = 0
    """Time of the last refill."""
    level: float = field(init=False)

    def __post_init__(self) -> None:
        """Begin with a full bucket."""
        self.level = self.burst

    def refill(self, now_us: int) -> None:
        """Add the tokens since the last refill."""
        gain = (now_us - self.filled_us) * self.rate / US_PER_S
        self.level = min(self.burst, self.level + gain)
        self.filled_us = now_us

    def take(self, now_us: int, tokens: float = 1.0) -> bool:
        """Take tokens, and return True, if there are enough."""
        self.refill(now_us)
        if self.level < tokens:
            return False
        self.level -= tokens
        return True

    def wait_us(self) -> int:
        """Return the time until the level is positive; 0 is now."""
        return 0 if self.level > 0 else round((1 - self.level) * US_PER_S / self.rate)
