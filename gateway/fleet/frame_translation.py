"""Frames of a site with the ids that its vehicles have here, and back.

Changed are the sender in the header, the system that a message addresses and those that it names;
the checksum is made anew. A signature covers both: with the site's key it is checked first and made
anew, with the link and the time stamp that it had; without the key a signed frame passes only if
nothing changes.
"""

import hashlib
import hmac
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from fastcrc.crc16 import mcrf4xx

from gateway.fleet.id_map import IdMap
from gateway.fleet.loop_watch import LoopWatch
from gateway.fleet.named_systems import changes_of_names
from gateway.units import US_PER_S
from gateway.wire.mavlink_messages import CRC_EXTRA, NO_TARGET, TARGET_OFFSETS
from gateway.wire.mavlink_splitter import (
    SIGNATURE_SIZE,
    START_V2,
    is_signed,
    message_id_of,
    origin_of,
    sequence_of,
    target_of,
)

HASH_BYTES: Final = 6
SEQUENCE_MASK: Final = 0xFF
RATE_MARKS: Final = 6
"""Five seconds between the first and the last."""
MAX_LOST: Final = 128
"""A greater step is a restart rather than a loss."""
MAX_OVERTAKEN: Final = 32
"""Texts and answers have a higher priority on the way: what they overtake comes late, but comes."""


@dataclass(slots=True)
class TranslationCounters:
    """Frames that could not pass."""

    unmapped: int = 0
    """No id is left for their vehicle."""
    unknown: int = 0
    """Their message is unknown, so that no checksum can be made."""
    signed: int = 0
    """They are signed, would change, and there is no passphrase."""
    forged: int = 0
    """Their signature is not of the site's passphrase."""
    looped: int = 0
    """They had been here, and came back through the site."""


@dataclass(slots=True)
class VehicleTraffic:
    """What came of one vehicle."""

    frames: int = 0
    lost: int = 0
    """By the gaps in its sequence numbers."""
    heard_us: int = 0
    marks: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=RATE_MARKS))
    """When it was looked at in the last seconds, and how many frames there were then."""

    def rate_hz(self, now_us: int) -> float:
        """Return the frames a second of the last seconds."""
        since_us, before = self.marks[0]
        return (self.frames - before) * US_PER_S / max(now_us - since_us, US_PER_S)


class _CannotPassError(Exception):
    """A frame stays here; the argument names the counter."""


class FrameTranslation:
    """The frames of one site.

    Parameters
    ----------
    site : str
        Its name.
    ids : IdMap
        Shared by all sites.
    key : bytes, optional
        32 bytes, of the site's passphrase.
    loops : LoopWatch, optional
        Shared by all sites.
    """

    def __init__(
        self, site: str, ids: IdMap, key: bytes | None = None, loops: LoopWatch | None = None
    ) -> None:
        self._site = site
        self._ids = ids
        self._key = key
        self._loops = loops or LoopWatch()
        self._sequences: dict[tuple[int, int], int] = {}
        self.counters = TranslationCounters()
        self.traffic: dict[int, VehicleTraffic] = {}
        """By system id at the site."""

    def mark(self, now_us: int) -> None:
        """Note where the counts are, about once a second: rates are of the last seconds."""
        for traffic in self.traffic.values():
            traffic.marks.append((now_us, traffic.frames))

    def from_site(self, frame: bytes, now_us: int, *, is_own: bool = False) -> bytes | None:
        """Return a frame of the site as it is to be seen here; None if it cannot pass.

        Parameters
        ----------
        frame : bytes
            As it came.
        now_us : int
            Gateway time.
        is_own : bool, optional
            Whether the site's gateway made it, so that it has not been here before; any other frame
            may have come to the site from the ground stations here.
        """
        origin = origin_of(frame)
        vehicle = (self._site, origin[0])
        if not is_own:
            has_id = self.id_of(origin[0]) is not None
            if self._loops.is_back(frame, vehicle, has_id=has_id, now_us=now_us):
                self.counters.looped += 1
                return None
        own_id = self._ids.id_of(*vehicle)
        if own_id is None:
            self.counters.unmapped += 1
            return None
        self._note(frame, origin, now_us)
        given = self._rewritten(frame, own_id, self._id_here)
        if given is not None:
            self._loops.note_given(given, vehicle, now_us)
        return given

    def to_site(self, frame: bytes, now_us: int) -> tuple[int, bytes] | None:
        """Return the system at the site that a frame is for (0: all) and the frame for it.

        None for one that cannot pass, or is for another site's vehicle: one that has got its id
        from a vehicle of this site, where it may be a third one's.
        """
        sender, target = self._id_there(origin_of(frame)[0]), target_of(frame)[0]
        addressed = self._ids.vehicle_of(target)
        if addressed is not None and addressed[0] != self._site:
            return None
        changed = self._rewritten(frame, sender, self._id_there)
        if changed is None:
            return None
        self._loops.note_sent(frame, changed, now_us)
        return self._id_there(target), changed

    def id_of(self, system_id: int) -> int | None:
        """Return the id that a system of the site has here, if it has one."""
        return self._ids.known_id(self._site, system_id)

    def _id_here(self, system_id: int) -> int:
        return self.id_of(system_id) or system_id

    def _id_there(self, own_id: int) -> int:
        vehicle = self._ids.vehicle_of(own_id)
        return vehicle[1] if vehicle is not None and vehicle[0] == self._site else own_id

    def _rewritten(self, frame: bytes, sender: int, rename: Callable[[int], int]) -> bytes | None:
        try:
            return rewrite(frame, sender, rename, self._key)
        except _CannotPassError as error:
            counter = str(error)
            setattr(self.counters, counter, getattr(self.counters, counter) + 1)
            return None

    def _note(self, frame: bytes, origin: tuple[int, int], now_us: int) -> None:
        traffic = self.traffic.setdefault(origin[0], VehicleTraffic())
        if not traffic.marks:
            traffic.marks.append((now_us, 0))
        traffic.frames += 1
        traffic.heard_us = now_us
        sequence = sequence_of(frame)
        if (before := self._sequences.get(origin)) is not None:
            if 0 < (before - sequence & SEQUENCE_MASK) <= MAX_OVERTAKEN:
                traffic.lost = max(0, traffic.lost - 1)
                return
            gap = sequence - before - 1 & SEQUENCE_MASK
            traffic.lost += gap if gap < MAX_LOST else 0
        self._sequences[origin] = sequence


def rewrite(frame: bytes, sender: int, rename: Callable[[int], int], key: bytes | None) -> bytes:
    """Return a frame in which systems have other ids; the same object if nothing changes.

    Parameters
    ----------
    frame : bytes
        A complete frame.
    sender : int
        Who it is from.
    rename : callable
        Turns the id of a system that it addresses or names into the other one; 0 stays 0.
    key : bytes or None
        What signatures are checked and made with.

    Raises
    ------
    _CannotPassError
        If it cannot be changed.
    """
    signed = is_signed(frame)
    if signed and key is not None:
        wanted = hashlib.sha256(key + frame[:-HASH_BYTES]).digest()[:HASH_BYTES]
        if not hmac.compare_digest(wanted, frame[-HASH_BYTES:]):
            raise _CannotPassError("forged")
    target = rename(target_of(frame)[0])
    names = changes_of_names(frame, rename)
    if sender == origin_of(frame)[0] and target == target_of(frame)[0] and not names:
        return frame
    message_id = message_id_of(frame)
    if message_id not in CRC_EXTRA:
        raise _CannotPassError("unknown")
    if signed and key is None:
        raise _CannotPassError("signed")
    version_2 = frame[0] == START_V2
    changed = bytearray(frame[: -SIGNATURE_SIZE if signed else len(frame)])
    changed[5 if version_2 else 3] = sender
    head = 10 if version_2 else 6
    offset = TARGET_OFFSETS.get(message_id, (NO_TARGET, NO_TARGET))[0]
    if NO_TARGET < offset < frame[1]:
        changed[head + offset] = target
    for at, value in names:
        changed[head + at : head + at + len(value)] = value
    crc = mcrf4xx(CRC_EXTRA[message_id], mcrf4xx(bytes(changed[1:-2])))
    changed[-2:] = crc.to_bytes(2, "little")
    if not signed or key is None:
        return bytes(changed)
    body = bytes(changed) + frame[-SIGNATURE_SIZE:-HASH_BYTES]
    return body + hashlib.sha256(key + body).digest()[:HASH_BYTES]
