"""Signatures of a site's frames: checked with its passphrase, replays rejected.

Each stream (link, system, component) has a sliding window of signing timestamps, as IPsec has of
sequence numbers [1]_: Zenoh sends commands, answers and texts with a higher priority than
telemetry, so frames of one stream may overtake each other. A timestamp is accepted once, and only
if it is newer than the end of the window. The first one of a stream must not be more than a minute
behind the clock of the fleet, as MAVLink demands [2]_.

References
----------
.. [1] RFC 4303, section 3.4.3.
.. [2] https://mavlink.io/en/guide/message_signing.html
"""

import hmac
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

from gateway.vehicle.signing import NEW_STREAM_TICKS, TICKS_PER_S, SigningClock
from gateway.wire.mavlink_signing import HASH_BYTES, TIMESTAMP_BYTES, signature_hash
from gateway.wire.mavlink_splitter import SIGNATURE_SIZE, MavFrame

WINDOW_TICKS: Final = 5 * TICKS_PER_S
"""Zenoh gives up a message that has waited for 5 s, so none is overtaken for longer."""
MAX_STREAMS: Final = 1024
"""Streams of one site; only a holder of the passphrase begins one."""


class Rejection(StrEnum):
    """Why a frame of a site with a passphrase is dropped; also the name of its counter."""

    UNSIGNED = "unsigned"
    FORGED = "forged"
    REPLAYED = "replayed"


@dataclass(slots=True)
class _Window:
    newest: int
    seen: set[int] = field(default_factory=set)
    """Accepted timestamps within the window."""
    pruned: int = 0
    """Newest timestamp when `seen` was last pruned."""

    def accepts(self, timestamp: int) -> bool:
        if timestamp <= self.newest - WINDOW_TICKS or timestamp in self.seen:
            return False
        self.newest = max(self.newest, timestamp)
        self.seen.add(timestamp)
        if self.newest - self.pruned > WINDOW_TICKS:
            self.pruned = self.newest
            self.seen = {each for each in self.seen if each > self.newest - WINDOW_TICKS}
        return True


class SiteSignatures:
    """Check and renew the signatures of one site.

    Parameters
    ----------
    key : bytes
        32 bytes, derived from the site's passphrase.
    unix_us_at_zero : int
        Unix time, in microseconds, when the gateway clock was zero.
    """

    def __init__(self, key: bytes, unix_us_at_zero: int) -> None:
        self._key = key
        self._clock = SigningClock(unix_us_at_zero)
        self._windows: dict[tuple[int, int, int], _Window] = {}

    def check(self, frame: MavFrame, now_us: int) -> Rejection | None:
        """Return why a frame of the site is rejected; None if it is accepted.

        Parameters
        ----------
        frame : MavFrame
            As it was published.
        now_us : int
            Gateway time.
        """
        if not frame.signed:
            return Rejection.UNSIGNED
        if not self.is_genuine(frame):
            return Rejection.FORGED
        data = frame.data
        timestamp = int.from_bytes(data[-HASH_BYTES - TIMESTAMP_BYTES : -HASH_BYTES], "little")
        stream = (data[-SIGNATURE_SIZE], *frame.origin)
        window = self._windows.get(stream)
        if window is None:
            oldest = self._clock.timestamp(now_us) - NEW_STREAM_TICKS
            if timestamp < oldest or len(self._windows) >= MAX_STREAMS:
                return Rejection.REPLAYED
            window = self._windows[stream] = _Window(timestamp)
        return None if window.accepts(timestamp) else Rejection.REPLAYED

    def is_genuine(self, frame: MavFrame) -> bool:
        """Return whether a signed frame was signed with the passphrase."""
        wanted = signature_hash(self._key, frame.data[:-HASH_BYTES])
        return hmac.compare_digest(wanted, frame.data[-HASH_BYTES:])

    def renewed(self, body: bytes, former: MavFrame) -> bytes:
        """Sign a changed frame with the link and the timestamp of the former one.

        Parameters
        ----------
        body : bytes
            The changed frame up to its checksum.
        former : MavFrame
            The frame before the change.
        """
        signed = body + former.data[-SIGNATURE_SIZE:-HASH_BYTES]
        return signed + signature_hash(self._key, signed)
