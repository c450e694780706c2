"""Token buckets, the only rate limit that allows bursts: of bytes, texts or lines."""

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


class ClientQuotas:
    """A bucket for each trusted client, and a single one for all untrusted clients.

    They share it because a refused one could return from another address.
    """

    def __init__(
        self, rate: float, burst: float, untrusted_rate: float, untrusted_burst: float
    ) -> None:
        self._rate, self._burst = rate, burst
        self.shared = TokenBucket(untrusted_rate, untrusted_burst)
        """The bucket of the untrusted."""
        self._buckets: dict[int, TokenBucket] = {}

    def of(self, client_id: int, now_us: int, *, trusted: bool) -> TokenBucket:
        """Return the bucket of a client, which is another one once its trust has changed."""
        bucket = self._buckets.get(client_id)
        if bucket is None or (bucket is self.shared) == trusted:
            bucket = TokenBucket(self._rate, self._burst, now_us) if trusted else self.shared
            self._buckets[client_id] = bucket
        return bucket

    def known(self, client_id: int) -> TokenBucket | None:
        """Return the bucket of a client, if `of` was called for it."""
        return self._buckets.get(client_id)

    def remove_client(self, client_id: int) -> None:
        """Discard the bucket of a client that has gone; the shared one keeps its level."""
        self._buckets.pop(client_id, None)
