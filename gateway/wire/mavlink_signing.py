"""MAVLink 2 signing: keys, timestamps, signing of sent frames, checks of received ones [1]_.

A signature is the first 48 bits of SHA-256 over key and frame; a timestamp in units of 10 us since
2015 inside it makes every frame unique, so that a recorded one cannot be sent again. A stream is
the frames of one component on one link; its first timestamp must not be more than a minute behind
our own clock.

A frame is signed when it is sent, because only then its sequence number and its order are final:
before, it may be renumbered, be overtaken, or be kept for a new client, and a receiver drops a
frame whose signing timestamp is earlier than that of the previous frame.

There are two policies against replays:

| received                              | accepted once, and                                     |
| ------------------------------------- | ------------------------------------------------------ |
| from a client: `Verifier`             | only if later than all before of its stream            |
| over Zenoh, where frames of different | only if it is at most a window behind the newest,      |
| priority overtake: `WindowVerifier`   | as IPsec does with sequence numbers [2]_               |

The newest timestamp of every stream of a client is kept over restarts and passphrase changes;
otherwise a recorded command could be replayed after a restart of the gateway. The kept timestamps
are ahead of the received ones by `RESERVE_TICKS`, so that a busy stream is written only every few
seconds: after a crash a stream is accepted again once its timestamps have passed the reserve.

The check is our own, because pymavlink's stores the timestamp of a stream before it has checked the
signature, so a single forged frame would lock the true sender out.

References
----------
.. [1] https://mavlink.io/en/guide/message_signing.html
.. [2] RFC 4303, section 3.4.3.
"""

import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from gateway.wire.frame_editing import Sign, edit_frame, renumbered
from gateway.wire.mavlink_splitter import SIGNATURE_SIZE, MavFrame

KEY_BYTES: Final = 32
HASH_BYTES: Final = 6
OWN_LINK: Final = 0
KEPT_LINK: Final = 255
"""Link id of kept answers: a separate stream, since the vehicle's clock may differ from ours."""
EPOCH_2015_US: Final = 1_420_070_400_000_000
TICK_US: Final = 10
TICKS_PER_S: Final = 100_000
NEW_STREAM_TICKS: Final = 60 * TICKS_PER_S
"""Maximum age of the first timestamp of a stream."""
GPS_TOLERANCE_US: Final = 2_000_000
BEHIND_S: Final = 2.0
"""Age from which a rejected timestamp counts as a clock error, not as a repeated frame."""

_TIMESTAMP: Final = slice(-12, -HASH_BYTES)
"""Bytes of the timestamp: between the link id and the hash."""
_TIMESTAMP_BYTES: Final = 6
RESERVE_TICKS: Final = 5 * TICKS_PER_S
MAX_KEYS: Final = 16
MAX_STREAMS: Final = 256
"""Maximum streams: only holders of the key begin one, so untrusted clients never reach this."""
KeptTimestamps = dict[str, dict[str, int]]
"""Timestamps by the id of the key, then by the stream as `link.system.component`."""
WINDOW_TICKS: Final = 5 * TICKS_PER_S
"""Size of the window: Zenoh drops a message that has waited for 5 s, so none is later."""
MAX_WINDOWS: Final = 1024
"""Maximum streams of one site; only a holder of the passphrase begins one."""


def key_from_passphrase(passphrase: str) -> bytes:
    """Derive the key as ground stations do: SHA-256 of the passphrase."""
    return hashlib.sha256(passphrase.encode()).digest()


def signature(key: bytes, link: int, timestamp: int, content: bytes) -> bytes:
    """Return the signature that follows the content of a frame, which ends with the checksum."""
    begin = bytes((link,)) + timestamp.to_bytes(_TIMESTAMP_BYTES, "little")
    return begin + _hash(key, content + begin)


def is_genuine(key: bytes, data: bytes) -> bool:
    """Return whether a signed frame was signed with this key."""
    return hmac.compare_digest(_hash(key, data[:-HASH_BYTES]), data[-HASH_BYTES:])


def renewed(key: bytes, data: bytes) -> Sign:
    """Return the signer of a changed frame, with the link and timestamp of the former one."""
    return partial(signature, key, data[-SIGNATURE_SIZE], timestamp_of(data))


def timestamp_of(data: bytes) -> int:
    """Return the timestamp of a signed frame."""
    return int.from_bytes(data[_TIMESTAMP], "little")


def _hash(key: bytes, data: bytes) -> bytes:
    return hashlib.sha256(key + data).digest()[:HASH_BYTES]


class SigningClock:
    """The time for signing timestamps."""

    def __init__(self, unix_us_at_zero: int) -> None:
        """Start with the Unix time when the gateway clock was zero."""
        self._offset_us = unix_us_at_zero - EPOCH_2015_US

    def set_gps_time(self, unix_us_at_zero: int) -> None:
        """Use GPS time if the machine's time differs from it by more than the latency."""
        offset_us = unix_us_at_zero - EPOCH_2015_US
        if abs(offset_us - self._offset_us) > GPS_TOLERANCE_US:
            self._offset_us = offset_us

    def timestamp(self, now_us: int) -> int:
        """Return gateway time in units of 10 us since 2015."""
        return max(0, self._offset_us + now_us) // TICK_US

    def oldest(self, now_us: int) -> int:
        """Return the earliest timestamp with which a stream may start."""
        return self.timestamp(now_us) - NEW_STREAM_TICKS


class FrameSigner:
    """Number our own frames, and sign those of systems that have a key."""

    def __init__(self, clock: SigningClock | None = None) -> None:
        self.keys: dict[int, bytes] = {}
        """Signing keys by system id; set by the stage that owns the vehicles."""
        self.shared_key = b""
        """Key of the settings, used even without a vehicle of the gateway; empty for none."""
        self._clock = clock
        self._newest = 0
        """Newest timestamp, since each must be later than the previous one."""

    def renewal(self, frame: MavFrame) -> Sign | None:
        """Return the signer of a changed frame, with the key of its signature; None if unknown."""
        key = self.key_of(frame)
        return None if key is None else renewed(key, frame.data)

    def key_of(self, frame: MavFrame) -> bytes | None:
        """Return the key with which a frame was signed; None if it is unknown."""
        keys = {self.shared_key, *self.keys.values()} - {b""}
        return next((key for key in keys if is_genuine(key, frame.data)), None)

    def signed(self, frame: MavFrame, key: bytes, now_us: int) -> MavFrame:
        """Return an answer in the name of another system, signed by its key."""
        return edit_frame(frame, sign=self._sign(key, KEPT_LINK, now_us)) or frame

    def _sign(self, key: bytes, link: int, now_us: int) -> Sign:
        timestamp = self._clock.timestamp(now_us) if self._clock else 0
        self._newest = max(self._newest + 1, timestamp)
        return partial(signature, key, link, self._newest)

    def sequence_and_sign(
        self, frame: MavFrame, sequence: int, now_us: int, system: int | None = None
    ) -> MavFrame:
        """Return a frame with this sequence number, signed again if its system has a key.

        `system` is the one that has the key; by default the sender. A frame of an unknown message,
        or one signed by another sender, is returned unchanged; one of version 1 is numbered and
        never signed.
        """
        key = self.keys.get(frame.origin[0] if system is None else system) if self.keys else None
        if key is None or self._clock is None:
            return frame if frame.sequence == sequence else renumbered(frame, sequence)
        sign = self._sign(key, OWN_LINK, now_us)
        return edit_frame(frame, sequence=sequence, sign=sign) or frame


class SigningTimestamps:
    """The timestamps that one vehicle has accepted, including those of earlier runs."""

    def __init__(self, kept: Mapping[str, Mapping[str, int]] | None = None) -> None:
        self._newest = _copied(kept or {})
        self._kept = _copied(self._newest)
        self.is_due = False
        """Whether `to_keep` has changes to be written."""

    def accept(self, key_id: str, stream: str, timestamp: int, oldest: int) -> bool:
        """Add a timestamp later than the last, or for a new stream one not before `oldest`."""
        streams = self._newest.get(key_id, {})
        is_known = stream in streams
        if timestamp < (streams[stream] + 1 if is_known else oldest):
            return False
        if not is_known and len(streams) >= MAX_STREAMS:
            return False
        streams[stream] = timestamp
        # The key that was used last is stored last.
        self._newest.pop(key_id, None)
        self._newest[key_id] = streams
        for removed in list(self._newest)[:-MAX_KEYS]:
            del self._newest[removed]
            self._kept.pop(removed, None)
        if timestamp > self._kept.get(key_id, {}).get(stream, -1):
            self._kept.setdefault(key_id, {})[stream] = timestamp + RESERVE_TICKS
            self.is_due = True
        return True

    def to_keep(self) -> KeptTimestamps:
        """Return the timestamps to write now, so that no accepted frame is accepted again."""
        self.is_due = False
        return _copied(self._kept)

    def exact(self) -> KeptTimestamps:
        """Return the timestamps without the reserve, for a clean shutdown."""
        return _copied(self._newest)


def _copied(found: Mapping[str, Mapping[str, int]]) -> KeptTimestamps:
    return {key_id: dict(streams) for key_id, streams in found.items()}


class Verifier:
    """Check the signatures of frames that clients send, and keep their timestamps."""

    def __init__(
        self, key: bytes, clock: SigningClock, timestamps: SigningTimestamps | None = None
    ) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(f"signing key of {len(key)} bytes; it must have {KEY_BYTES}")
        self._key = key
        self._key_id = hashlib.sha256(b"mavgate key" + key).hexdigest()[:16]
        """Identifier of the key that does not reveal it."""
        self._clock = clock
        self._timestamps = SigningTimestamps() if timestamps is None else timestamps

    def rejection(self, data: bytes, now_us: int) -> str:
        """Return the reason why a signed frame is rejected; empty if it is accepted."""
        if not is_genuine(self._key, data):
            return "signed with another passphrase"
        stream = f"{data[-SIGNATURE_SIZE]}.{data[5]}.{data[6]}"
        timestamp, oldest = timestamp_of(data), self._clock.oldest(now_us)
        if self._timestamps.accept(self._key_id, stream, timestamp, oldest):
            return ""
        behind_s = (self._clock.timestamp(now_us) - timestamp) / TICKS_PER_S
        if behind_s >= BEHIND_S:
            # Two digits, so that frames of one sender with different delays share one entry.
            return f"its clock is {float(f'{behind_s:.2g}'):.0f} s behind"
        return "its signing timestamp was used before"


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


class WindowVerifier:
    """Check and renew signatures of frames that may overtake each other."""

    def __init__(self, key: bytes, unix_us_at_zero: int) -> None:
        self._key = key
        self._clock = SigningClock(unix_us_at_zero)
        self._windows: dict[tuple[int, int, int], _Window] = {}

    def check(self, frame: MavFrame, now_us: int) -> str:
        """Return the counter of the reason for a rejection; empty if the frame is accepted."""
        if not frame.signed:
            return "unsigned"
        if not self.is_genuine(frame):
            return "forged"
        timestamp = timestamp_of(frame.data)
        stream = (frame.data[-SIGNATURE_SIZE], *frame.origin)
        window = self._windows.get(stream)
        if window is None:
            if timestamp < self._clock.oldest(now_us) or len(self._windows) >= MAX_WINDOWS:
                return "replayed"
            window = self._windows[stream] = _Window(timestamp)
        return "" if window.accepts(timestamp) else "replayed"

    def is_genuine(self, frame: MavFrame) -> bool:
        """Return whether a signed frame was signed with the passphrase."""
        return is_genuine(self._key, frame.data)

    def renewal(self, frame: MavFrame) -> Sign:
        """Return the signer of a changed frame; see `renewed`."""
        return renewed(self._key, frame.data)
