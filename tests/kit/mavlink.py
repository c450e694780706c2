"""MAVLink systems that encode numbered frames, and readers of their bytes."""

import math
import random
import struct
from collections.abc import Iterator
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as every_dialect
from pymavlink.dialects.v20 import common as dialect

from gateway.records import Outgoing
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_messages import (
    CRC_EXTRA,
    DEFINITIONS,
    NO_TARGET,
    TARGET_OFFSETS,
    layout_of,
)
from gateway.wire.mavlink_signing import EPOCH_2015_US, TICK_US, FrameSigner, SigningClock
from gateway.wire.mavlink_splitter import (
    SIGNATURE_SIZE,
    SIGNED,
    Event,
    MavFrame,
    frame_of,
    message_id_of,
    split_datagram,
)

STATION = 190
"""Component id of a ground station."""
KEY = bytes(32)
"""Signing key of a signed sender."""
TIMESTAMP = 30_000_000_000_000
"""Signing timestamp at which the time of `signer` begins, and that of `strict` ends."""


KIND = {kind.msgname: kind for kind in every_dialect.mavlink_map.values()}


def message_of(name: str, **fields: Any) -> Any:
    """Return a message by its name; fields that are not given are zero or empty."""
    kind = KIND[name]
    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for field, form in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        empty = b"" if form == "char" else [0] * lengths[field] if lengths[field] else 0
        fields.setdefault(field, empty)
    return kind(**fields)


def packed(
    message: Any,
    system: int = 1,
    component: int = 1,
    *,
    sequence: int = 0,
    version: int = 2,
    signing: tuple[bytes, int, int] | None = None,
) -> bytes:
    """Encode one message; `signing` contains the key, link and timestamp of its signature."""
    link = dialect.MAVLink(None, system, component)
    link.seq = sequence
    if signing is not None:
        link.signing.secret_key, link.signing.link_id, link.signing.timestamp = signing
        link.signing.sign_outgoing = True
    return bytes(message.pack(link, force_mavlink1=version == 1))


INTEGER_BITS = {"int8_t": 8, "int16_t": 16, "int32_t": 32, "int64_t": 54}
INTEGER_BITS |= {f"u{form}": min(bits, 53) for form, bits in INTEGER_BITS.items()}
"""Bits of a field's type; of the longest those that JSON transports."""


def random_message(
    kind: Any, chance: random.Random, letters: bytes = b"ABCxyz_09", **given: Any
) -> Any:
    """Fill a message with values that its fields can have, half of them zero."""

    def value(name: str, form: str) -> Any:
        if chance.random() < 0.5:
            return 0
        if form in ("float", "double"):
            bits = chance.randbytes(8)
            some = struct.unpack("<d" if form == "double" else "<fxxxx", bits)[0]
            return chance.choice([-1.5, math.nan, math.inf, some, chance.uniform(-1e6, 1e6)])
        low = 0 if form.startswith("u") else -(1 << INTEGER_BITS[form] - 1)
        span = range(low, low + (1 << INTEGER_BITS[form]))
        enum = kind.fieldenums_by_name.get(name)
        if enum and kind.fielddisplays_by_name.get(name) != "bitmask" and chance.random() < 0.8:
            return chance.choice([each for each in every_dialect.enums[enum] if each in span])
        return chance.choice(span)

    lengths = dict(zip(kind.ordered_fieldnames, kind.array_lengths, strict=True))
    for name, form in zip(kind.fieldnames, kind.fieldtypes, strict=True):
        if name in given:
            continue
        if form == "char":
            size = chance.randint(0, lengths[name]) if lengths[name] else 1
            given[name] = bytes(chance.choices(letters, k=size))
        else:
            several = [value(name, form) for _ in range(lengths[name] or 1)]
            given[name] = several if lengths[name] else several[0]
    return kind(**given)


def frame_with(
    message_id: int, payload: bytes, origin: tuple[int, int] = (1, 1), *, version: int = 2
) -> bytes:
    """Return a frame with any payload bytes, also of a message that no dialect contains."""
    if version == 1:
        head = bytes((0xFE, len(payload), 0, *origin, message_id))
    else:
        head = bytes((0xFD, len(payload), 0, 0, 0, *origin)) + message_id.to_bytes(3, "little")
    crc: int = mcrf4xx(CRC_EXTRA.get(message_id, b"\0"), mcrf4xx(head[1:] + payload))
    return head + payload + crc.to_bytes(2, "little")


class Sender:
    """A MAVLink system that numbers its frames, and signs them with `KEY` if wanted.

    With component `STATION` its heartbeat is a ground station's.
    """

    def __init__(self, system: int = 1, component: int = 1, *, signed: bool = False) -> None:
        self.link = dialect.MAVLink(None, system, component)
        self.is_station = component == STATION
        if signed:
            self.link.signing.secret_key = KEY
            self.link.signing.link_id = 1
            self.link.signing.timestamp = 1
            self.link.signing.sign_outgoing = True

    def pack(self, message: Any) -> bytes:
        """Encode any message with the next sequence number."""
        frame = bytes(message.pack(self.link))
        self.link.seq = (self.link.seq + 1) % 256
        return frame

    def heartbeat(self, *, armed: bool = False) -> bytes:
        kind = dialect.MAV_TYPE_GCS if self.is_station else dialect.MAV_TYPE_FIXED_WING
        mode = dialect.MAV_MODE_FLAG_SAFETY_ARMED if armed else 0
        return self.pack(dialect.MAVLink_heartbeat_message(kind, 0, mode, 0, 4, 3))

    def attitude(self, time_ms: int = 5) -> bytes:
        return self.pack(dialect.MAVLink_attitude_message(time_ms, 0, 0, 0, 0, 0, 0))

    def raw_imu(self) -> bytes:
        return self.pack(dialect.MAVLink_raw_imu_message(5, 1, 2, 3, 4, 5, 6, 7, 8, 9))

    def home(self) -> bytes:
        quaternion = [1, 0, 0, 0]
        return self.pack(
            dialect.MAVLink_home_position_message(1, 2, 3, 0, 0, 0, quaternion, 0, 0, 0)
        )

    def command(self, system: int, component: int) -> bytes:
        return self.pack(
            dialect.MAVLink_command_long_message(system, component, 512, 0, 1, 0, 0, 0, 0, 0, 0)
        )

    def ack(self) -> bytes:
        return self.pack(dialect.MAVLink_command_ack_message(512, 0))


def signer(key: bytes = KEY) -> FrameSigner:
    """Return a signer of system 1."""
    signer = FrameSigner(SigningClock(EPOCH_2015_US + TIMESTAMP * TICK_US))
    signer.keys[1] = key
    return signer


def strict(key: bytes = KEY) -> Any:
    """Return a receiver by pymavlink that accepts only frames signed with a key."""
    receiver = dialect.MAVLink(None)
    receiver.signing.secret_key, receiver.signing.timestamp = key, TIMESTAMP
    return receiver


def read_back(data: bytes, key: bytes | None = None) -> Any:
    """Decode a frame; pymavlink raises if the checksum or, with a key, the signature is wrong."""
    link = every_dialect.MAVLink(None, 255, 0)
    if key is not None:
        link.signing.secret_key, link.signing.timestamp = key, 1
    return link.decode(bytearray(data))


def outgoing(frame: bytes, client_id: int | None = None) -> Outgoing:
    """Return a frame of ours as the vehicle returns it."""
    return Outgoing(frame, message_id_of(frame), client_id)


def frames_of(events: list[Event]) -> list[bytes]:
    """Return the bytes of the frames among a splitter's events."""
    return [event.data for event in events if isinstance(event, MavFrame)]


def frames_in(data: bytes) -> list[bytes]:
    """Split a datagram; return the bytes of its frames."""
    return frames_of(split_datagram(data))


def numbered(system: int, sequence: int, message: Any = None) -> MavFrame:
    """Return a frame of a system with a sequence number; by default a heartbeat."""
    message = message or dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3)
    return frame_of(packed(message, system, sequence=sequence))


def raw_frame(message_id: int, data: bytes) -> MavFrame:
    """Return a frame with arbitrary bytes, for queues that never look into them."""
    return MavFrame(data, b"", message_id, (1, 1), (0, 0), 0, False)


def every_message(*targets: int) -> Iterator[MavFrame]:
    """Yield each message of the dialect with zeros, for each target if it has one."""
    for message_id in sorted(DEFINITIONS):
        for target in targets if message_id in TARGET_OFFSETS else (0,):
            yield _with_target(message_id, target)


def _with_target(message_id: int, target: int) -> MavFrame:
    size = layout_of(message_id).itemsize
    head = bytes((0xFD, size, 0, 0, 0, 0, 0)) + message_id.to_bytes(3, "little")
    blank = frame_of(head + bytes(size) + bytes(2))
    names = {"target", "target_system"} & set(layout_of(message_id).names or ())
    fields = dict.fromkeys(names, target)
    if target and TARGET_OFFSETS[message_id][1] != NO_TARGET:
        fields["target_component"] = 1
    return edit_frame(blank, fields=fields) or blank


def sent_by(frame: MavFrame, system: int, component: int, *, signed: bool = False) -> MavFrame:
    """Return a frame with another sender, and with a signature of zeros if wanted."""
    data = bytearray(frame.data)
    data[2] = SIGNED if signed else 0
    data[5:7] = system, component
    data[-2:] = mcrf4xx(bytes(data[1:-2]) + CRC_EXTRA[frame.message_id]).to_bytes(2, "little")
    return frame_of(bytes(data) + bytes(SIGNATURE_SIZE if signed else 0))
