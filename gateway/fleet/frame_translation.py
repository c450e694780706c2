"""Translate the frames of a site to the system ids of its vehicles here, and back.

The translation changes the sender in the header, the system that a message addresses, and systems
that it names in a parameter: the vehicle to follow, the target of a camera. Then it computes the
checksum again. A signature covers all of that: with the site's passphrase it is checked first and
renewed with the same link and timestamp; without the passphrase a signed frame passes only if
nothing changes.

Each signed stream (link, system, component) has a sliding window of signing timestamps, as IPsec
has of sequence numbers [1]_: Zenoh sends commands, answers and texts with a higher priority than
telemetry, so frames of one stream may overtake each other. A timestamp is accepted once, and only
if it is newer than the end of the window. The first one of a stream must not be more than a minute
behind the clock of the fleet, as MAVLink demands [2]_.

References
----------
.. [1] RFC 4303, section 3.4.3.
.. [2] https://mavlink.io/en/guide/message_signing.html
"""

import hmac
import struct
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from gateway.fleet.id_map import IdMap
from gateway.fleet.loop_detection import LoopDetection
from gateway.units import US_PER_S
from gateway.vehicle.requests import NEW_STREAM_TICKS, TICKS_PER_S, SigningClock
from gateway.wire.mavlink_messages import CRC_EXTRA, NO_TARGET, TARGET_OFFSETS, offset_of
from gateway.wire.mavlink_signing import HASH_BYTES, TIMESTAMP_BYTES, signature_hash
from gateway.wire.mavlink_splitter import (
    PAYLOAD_V1,
    PAYLOAD_V2,
    SIGNATURE_SIZE,
    START_V2,
    MavFrame,
    frame_of,
)

WINDOW_TICKS: Final = 5 * TICKS_PER_S
"""Zenoh gives up a message that has waited for 5 s, so none is overtaken for longer."""
MAX_STREAMS: Final = 1024
"""Streams of one site; only a holder of the passphrase begins one."""


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
    """Check and renew the signatures of one site."""

    def __init__(self, key: bytes, unix_us_at_zero: int) -> None:
        self._key = key
        self._clock = SigningClock(unix_us_at_zero)
        self._windows: dict[tuple[int, int, int], _Window] = {}

    def check(self, frame: MavFrame, now_us: int) -> str:
        """Return the counter of why a frame of the site is rejected; empty if it is accepted."""
        if not frame.signed:
            return "unsigned"
        if not self.is_genuine(frame):
            return "forged"
        data = frame.data
        timestamp = int.from_bytes(data[-HASH_BYTES - TIMESTAMP_BYTES : -HASH_BYTES], "little")
        stream = (data[-SIGNATURE_SIZE], *frame.origin)
        window = self._windows.get(stream)
        if window is None:
            oldest = self._clock.timestamp(now_us) - NEW_STREAM_TICKS
            if timestamp < oldest or len(self._windows) >= MAX_STREAMS:
                return "replayed"
            window = self._windows[stream] = _Window(timestamp)
        return "" if window.accepts(timestamp) else "replayed"

    def is_genuine(self, frame: MavFrame) -> bool:
        """Return whether a signed frame was signed with the passphrase."""
        wanted = signature_hash(self._key, frame.data[:-HASH_BYTES])
        return hmac.compare_digest(wanted, frame.data[-HASH_BYTES:])

    def renewed(self, body: bytes, former: MavFrame) -> bytes:
        """Sign a changed frame with the link and the timestamp of the former one."""
        signed = body + former.data[-SIGNATURE_SIZE:-HASH_BYTES]
        return signed + signature_hash(self._key, signed)


SEQUENCE_MASK: Final = 0xFF
RATE_MARKS: Final = 6
"""Marks a second apart: rates are averaged over five seconds."""
MAX_LOST: Final = 128
"""A larger step of the sequence number is a restart rather than a loss."""
MAX_OVERTAKEN: Final = 32
"""Texts and answers have a higher priority on the way: frames that they overtake arrive late."""
MAX_SENDERS: Final = 1024
"""Components of a site whose sequence numbers are remembered; more are forged."""
LAST_ID: Final = 255

Change = tuple[int, bytes]
"""Offset in the payload, and the new bytes there."""

COMMANDS: Final = {
    dialect.MAV_CMD_DO_FOLLOW: (1,),
    dialect.MAV_CMD_DO_SET_ROI_SYSID: (1,),
    dialect.MAV_CMD_DO_GUIDED_MASTER: (1,),
    dialect.MAV_CMD_DO_GIMBAL_MANAGER_CONFIGURE: (1, 3),
    dialect.MAV_CMD_ARM_AUTHORIZATION_REQUEST: (1,),
}
"""Commands, and which of their parameters are system ids."""
CARRIERS: Final[tuple[Any, ...]] = (
    dialect.MAVLink_command_long_message,
    dialect.MAVLink_command_int_message,
    dialect.MAVLink_mission_item_message,
    dialect.MAVLink_mission_item_int_message,
)
COMMAND_OFFSETS: Final = {message.id: offset_of(message, "command") for message in CARRIERS}
PARAM_OFFSETS: Final = {
    message.id: [offset_of(message, f"param{number}") for number in range(1, 5)]
    for message in CARRIERS
}
GIMBALS: Final[Any] = dialect.MAVLink_gimbal_manager_status_message
FIELD_OFFSETS: Final = {
    GIMBALS.id: [
        offset_of(GIMBALS, field) for field in ("primary_control_sysid", "secondary_control_sysid")
    ]
}
NAMING: Final = COMMAND_OFFSETS.keys() | FIELD_OFFSETS.keys()
"""Messages that may name a system."""


@dataclass(slots=True)
class VehicleTraffic:
    """Received frames of one vehicle."""

    frames: int = 0
    lost: int = 0
    """By the gaps in its sequence numbers."""
    received_us: int = 0
    marks: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=RATE_MARKS))
    """Times of the last seconds, and the number of frames until then."""

    def rate_hz(self, now_us: int) -> float:
        """Return the average rate of the last seconds, in frames a second."""
        since_us, before = self.marks[0]
        return (self.frames - before) * US_PER_S / max(now_us - since_us, US_PER_S)


class _CannotPassError(Exception):
    """A frame cannot be translated; the argument names the counter."""


class FrameTranslation:
    """The frames of one site."""

    def __init__(
        self,
        site: str,
        ids: IdMap,
        signatures: SiteSignatures | None = None,
        loops: LoopDetection | None = None,
    ) -> None:
        self._site = site
        self._ids = ids
        self._signatures = signatures
        self._loops = loops or LoopDetection()
        self._sequences: dict[tuple[int, int], int] = {}
        self.counters: Counter[str] = Counter()
        """Dropped frames by cause.

        `unmapped`: no id is left for their vehicle. `unknown`: an unknown message, whose checksum
        cannot be computed. `signed`: it would have to change, and there is no passphrase.
        `unsigned`, `forged` and `replayed` have not passed the check of the site's passphrase.
        `looped`: sent from here, and returned through the site.
        """
        self.traffic: dict[int, VehicleTraffic] = {}
        """By system id at the site."""

    def mark(self, now_us: int) -> None:
        """Record the counts for the rates; called about once a second."""
        for traffic in self.traffic.values():
            traffic.marks.append((now_us, traffic.frames))

    def from_site(self, frame: MavFrame, now_us: int, *, is_own: bool = False) -> MavFrame | None:
        """Return a frame of the site with the ids of this side; None if it is dropped.

        `is_own` if the site's gateway made it, so that it cannot have been here before.
        """
        if self._signatures is not None and (rejection := self._signatures.check(frame, now_us)):
            self.counters[rejection] += 1
            return None
        system_id = frame.origin[0]
        vehicle = (self._site, system_id)
        if not is_own:
            has_id = self.id_of(system_id) is not None
            if self._loops.is_returned(frame, vehicle, has_id=has_id, now_us=now_us):
                self.counters["looped"] += 1
                return None
        own_id = self._ids.id_of(*vehicle)
        if own_id is None:
            self.counters["unmapped"] += 1
            return None
        self._update_traffic(frame, now_us)
        given = self._rewritten(frame, own_id, self._id_here)
        if given is not None:
            self._loops.record_given(given, vehicle, now_us)
        return given

    def to_site(self, frame: MavFrame, now_us: int) -> tuple[int, MavFrame] | None:
        """Return the system at the site that a frame is for (0: all) and the frame for it.

        None for one that cannot be translated, or is for an id that no vehicle of this site has
        (any more): the hub's routes outlive a reassignment, and at the site that id may be a
        third vehicle's, or that of an excluded one.
        """
        sender, target = self._id_there(frame.origin[0]), frame.target[0]
        if target and (self._ids.vehicle_of(target) or ("",))[0] != self._site:
            return None
        signatures = self._signatures
        # The site itself checks for replays: it knows all its streams.
        if signatures is not None and frame.signed and not signatures.is_genuine(frame):
            self.counters["forged"] += 1
            return None
        changed = self._rewritten(frame, sender, self._id_there)
        if changed is None:
            return None
        self._loops.record_sent(frame, changed, now_us)
        return self._id_there(target), changed

    def id_of(self, system_id: int) -> int | None:
        """Return the id that a system of the site has here, if it has one."""
        return self._ids.known_id(self._site, system_id)

    def _id_here(self, system_id: int) -> int:
        return self.id_of(system_id) or system_id

    def _id_there(self, own_id: int) -> int:
        vehicle = self._ids.vehicle_of(own_id)
        return vehicle[1] if vehicle is not None and vehicle[0] == self._site else own_id

    def _rewritten(
        self, frame: MavFrame, sender: int, rename: Callable[[int], int]
    ) -> MavFrame | None:
        try:
            return rewrite(frame, sender, rename, self._signatures)
        except _CannotPassError as error:
            self.counters[str(error)] += 1
            return None

    def _update_traffic(self, frame: MavFrame, now_us: int) -> None:
        origin, sequence = frame.origin, frame.sequence
        traffic = self.traffic.setdefault(origin[0], VehicleTraffic())
        if not traffic.marks:
            traffic.marks.append((now_us, 0))
        traffic.frames += 1
        traffic.received_us = now_us
        if (before := self._sequences.get(origin)) is not None:
            if 0 < (before - sequence & SEQUENCE_MASK) <= MAX_OVERTAKEN:
                traffic.lost = max(0, traffic.lost - 1)
                return
            gap = sequence - before - 1 & SEQUENCE_MASK
            traffic.lost += gap if gap < MAX_LOST else 0
        if before is not None or len(self._sequences) < MAX_SENDERS:
            self._sequences[origin] = sequence


def rewrite(
    frame: MavFrame,
    sender: int,
    rename: Callable[[int], int],
    signatures: SiteSignatures | None,
) -> MavFrame:
    """Return a frame with other ids, itself if nothing changes; raises _CannotPassError."""
    data, message_id = frame.data, frame.message_id
    target = rename(frame.target[0])
    names = changes_of_names(frame, rename)
    if sender == frame.origin[0] and target == frame.target[0] and not names:
        return frame
    if message_id not in CRC_EXTRA:
        raise _CannotPassError("unknown")
    if frame.signed and signatures is None:
        raise _CannotPassError("signed")
    version_2 = data[0] == START_V2
    changed = bytearray(data[: -SIGNATURE_SIZE if frame.signed else len(data)])
    changed[5 if version_2 else 3] = sender
    head = PAYLOAD_V2 if version_2 else PAYLOAD_V1
    offset = TARGET_OFFSETS.get(message_id, (NO_TARGET, NO_TARGET))[0]
    if NO_TARGET < offset < data[1]:
        changed[head + offset] = target
    for at, value in names:
        changed[head + at : head + at + len(value)] = value
    crc = mcrf4xx(CRC_EXTRA[message_id], mcrf4xx(bytes(changed[1:-2])))
    changed[-2:] = crc.to_bytes(2, "little")
    if not frame.signed or signatures is None:
        return frame_of(bytes(changed))
    return frame_of(signatures.renewed(bytes(changed), frame))


def changes_of_names(frame: MavFrame, rename: Callable[[int], int]) -> list[Change]:
    """Return the changes of a payload that names systems whose ids `rename` changes."""
    message_id = frame.message_id
    if message_id not in NAMING:
        return []
    payload = frame.payload
    if offsets := FIELD_OFFSETS.get(message_id):
        named = ((at, payload[at]) for at in offsets if at < len(payload) and payload[at])
        return [(at, bytes((rename(was),))) for at, was in named if rename(was) != was]
    at = COMMAND_OFFSETS[message_id]
    # MAVLink 2 cuts zeros off at the end of a payload.
    command = int.from_bytes(payload[at : at + 2], "little")
    found: list[Change] = []
    for number in COMMANDS.get(command, ()):
        offset = PARAM_OFFSETS[message_id][number - 1]
        (value,) = struct.unpack_from("<f", payload, offset)
        if 0 < value <= LAST_ID and (fresh := rename(int(value))) != value:
            found.append((offset, struct.pack("<f", fresh)))
    return found
