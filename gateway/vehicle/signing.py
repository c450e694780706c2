"""MAVLink 2 signing: authenticate clients on a network where anybody may send.

A signature is the first 48 bits of SHA-256 over key and frame; a timestamp in units of 10 us
since 2015 inside it makes every frame unique, so that a recorded one cannot be sent again. A
stream is one link of one component. Its timestamp must grow; a new stream must not be more than a
minute behind our own clock.

The newest timestamp of every stream is kept over restarts and passphrase changes; otherwise a
recorded command could be replayed after a restart of the gateway. The kept timestamps are ahead of
the received ones by `RESERVE_TICKS`, so that a busy stream is written only every few seconds: after
a crash a stream is accepted again once its timestamps have passed the reserve.

The check is our own, not pymavlink's: that one stores the timestamp of a stream before it has
checked the signature, so a single forged frame would lock the true sender out.

References
----------
.. [1] https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
import hmac
from collections.abc import Mapping
from typing import Final

TICKS_PER_S: Final = 100_000
RESERVE_TICKS: Final = 5 * TICKS_PER_S
MAX_KEYS: Final = 16
MAX_STREAMS: Final = 256
"""Only holders of the key make streams, so untrusted clients never reach this."""

Stream = tuple[int, int, int]
"""Link, system, component."""
KeptTimestamps = dict[str, dict[str, int]]
"""By the id of the key, then by the stream as `link.system.component`."""


def key_id_of(key: bytes) -> str:
    """Return an identifier of a key that does not reveal it."""
    return hashlib.sha256(b"mavgate key" + key).hexdigest()[:16]


class SigningTimestamps:
    """The timestamps that one vehicle has accepted.

    Parameters
    ----------
    kept : mapping, optional
        What `to_keep` returned in an earlier run.
    """

    def __init__(self, kept: Mapping[str, Mapping[str, int]] | None = None) -> None:
        self._newest = {
            key_id: {_stream(text): timestamp for text, timestamp in streams.items()}
            for key_id, streams in (kept or {}).items()
        }
        self._kept = {key_id: dict(streams) for key_id, streams in self._newest.items()}
        self.is_due = False
        """Whether `to_keep` has something that must be written."""

    def newest(self, key_id: str, stream: Stream) -> int | None:
        """Return the newest timestamp of a stream under a key; None if it is new."""
        return self._newest.get(key_id, {}).get(stream)

    def has_room(self, key_id: str) -> bool:
        """Return whether one more stream can be followed under a key."""
        return len(self._newest.get(key_id, {})) < MAX_STREAMS

    def add(self, key_id: str, stream: Stream, timestamp: int) -> None:
        """Add an accepted timestamp."""
        streams = self._newest.pop(key_id, {})
        # The key that was used last comes last.
        self._newest[key_id] = streams
        streams[stream] = timestamp
        for removed in list(self._newest)[:-MAX_KEYS]:
            del self._newest[removed]
            self._kept.pop(removed, None)
        if timestamp > self._kept.get(key_id, {}).get(stream, -1):
            self._kept.setdefault(key_id, {})[stream] = timestamp + RESERVE_TICKS
            self.is_due = True

    def to_keep(self) -> KeptTimestamps:
        """Return what to write now, so that no frame accepted so far is accepted again."""
        self.is_due = False
        return _texts(self._kept)

    def exact(self) -> KeptTimestamps:
        """Return the timestamps without the reserve, for a clean shutdown."""
        return _texts(self._newest)


def _texts(found: Mapping[str, Mapping[Stream, int]]) -> KeptTimestamps:
    return {
        key_id: {".".join(map(str, stream)): timestamp for stream, timestamp in streams.items()}
        for key_id, streams in found.items()
    }


def _stream(text: str) -> Stream:
    link, system, component = (int(part) for part in text.split("."))
    return link, system, component


SIGNATURE_BYTES: Final = 13
KEY_BYTES: Final = 32
EPOCH_2015_US: Final = 1_420_070_400_000_000
TICK_US: Final = 10
NEW_STREAM_TICKS: Final = 60 * TICKS_PER_S
"""Largest age of the first timestamp of a stream."""
GPS_TOLERANCE_US: Final = 2_000_000


def key_from_passphrase(passphrase: str) -> bytes:
    """Derive the key as ground stations do: SHA-256 of the passphrase."""
    return hashlib.sha256(passphrase.encode()).digest()


class SigningClock:
    """The timestamps of one signer.

    Parameters
    ----------
    unix_us_at_zero : int
        Unix time when the gateway clock was zero.
    """

    def __init__(self, unix_us_at_zero: int) -> None:
        self._offset_us = unix_us_at_zero - EPOCH_2015_US

    def set_gps_time(self, unix_us_at_zero: int) -> None:
        """Use GPS time if the machine's differs from it by more than the latency."""
        offset_us = unix_us_at_zero - EPOCH_2015_US
        if abs(offset_us - self._offset_us) > GPS_TOLERANCE_US:
            self._offset_us = offset_us

    def timestamp(self, now_us: int) -> int:
        """Return the time in signing ticks."""
        return max(0, self._offset_us + now_us) // TICK_US


class Verifier:
    """Check the signatures of frames that clients send.

    Parameters
    ----------
    key : bytes
        32 bytes.
    clock : SigningClock
        Of the gateway.
    book : SigningTimestamps, optional
        The timestamps accepted so far; updated with every accepted frame.
    """

    def __init__(
        self, key: bytes, clock: SigningClock, book: SigningTimestamps | None = None
    ) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"signing key of {len(key)} bytes; it must have {KEY_BYTES}")
        self._key = key
        self._key_id = key_id_of(key)
        self._clock = clock
        self._book = SigningTimestamps() if book is None else book

    def accepts(self, frame: bytes, now_us: int) -> bool:
        """Return whether a whole frame is signed by a holder of the key, and not a replay.

        Parameters
        ----------
        frame : bytes
            A whole MAVLink 2 frame whose signed bit is set.
        now_us : int
            Gateway clock.

        Returns
        -------
        bool
        """
        signature = frame[-6:]
        wanted = hashlib.sha256(self._key + frame[:-6]).digest()[:6]
        if not hmac.compare_digest(signature, wanted):
            return False
        stream = (frame[-SIGNATURE_BYTES], frame[5], frame[6])
        timestamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._book.newest(self._key_id, stream)
        if newest is None:
            if timestamp < self._clock.timestamp(now_us) - NEW_STREAM_TICKS:
                return False
            if not self._book.has_room(self._key_id):
                return False
        elif timestamp <= newest:
            return False
        self._book.add(self._key_id, stream, timestamp)
        return True
