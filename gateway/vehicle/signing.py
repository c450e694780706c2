"""MAVLink 2 signing: authenticate clients on a network where anybody may send.

A signature is the first 48 bits of SHA-256 over key and frame; a time stamp in units of 10 us
since 2015 inside it makes every frame unique, so that a recorded one cannot be sent again. A
stream is one link of one component. Its stamp must grow; a stream not heard before must not be
more than a minute behind our own clock.

The check is our own, not pymavlink's: that one stores the time stamp of a stream before it has
checked the signature, so a single forged frame would lock the true sender out.

References
----------
.. [1] https://mavlink.io/en/guide/message_signing.html
"""

import hashlib
import hmac
from typing import Final

from gateway.vehicle.stamp_book import StampBook, mark_of

SIGNATURE_BYTES: Final = 13
KEY_BYTES: Final = 32
EPOCH_2015_US: Final = 1_420_070_400_000_000
TICK_US: Final = 10
NEW_STREAM_TICKS: Final = 60_000_000 // TICK_US
GPS_TOLERANCE_US: Final = 2_000_000


def key_from_passphrase(passphrase: str) -> bytes:
    """Derive the key as ground stations do: SHA-256 of the passphrase."""
    return hashlib.sha256(passphrase.encode()).digest()


class SigningClock:
    """The time stamps of one signer.

    Parameters
    ----------
    unix_us_at_zero : int
        Unix time when the gateway clock was zero.
    """

    def __init__(self, unix_us_at_zero: int) -> None:
        self._offset_us = unix_us_at_zero - EPOCH_2015_US

    def hear_gps(self, unix_us_at_zero: int) -> None:
        """Use GPS time if the machine's differs from it by more than the latency."""
        offset_us = unix_us_at_zero - EPOCH_2015_US
        if abs(offset_us - self._offset_us) > GPS_TOLERANCE_US:
            self._offset_us = offset_us

    def stamp(self, now_us: int) -> int:
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
    book : StampBook, optional
        The time stamps accepted so far; updated with every accepted frame.
    """

    def __init__(self, key: bytes, clock: SigningClock, book: StampBook | None = None) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"signing key of {len(key)} bytes; it must have {KEY_BYTES}")
        self._key = key
        self._mark = mark_of(key)
        self._clock = clock
        self._book = StampBook() if book is None else book

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
        stamp = int.from_bytes(frame[-12:-6], "little")
        newest = self._book.newest(self._mark, stream)
        if newest is None:
            if stamp < self._clock.stamp(now_us) - NEW_STREAM_TICKS:
                return False
            if not self._book.has_room(self._mark):
                return False
        elif stamp <= newest:
            return False
        self._book.note(self._mark, stream, stamp)
        return True
