"""MAVLink systems that encode numbered frames, and readers of their bytes."""

from typing import Any

from pymavlink.dialects.v20 import all as every_dialect
from pymavlink.dialects.v20 import common as dialect

from gateway.records import Outgoing
from gateway.wire.mavlink_signing import EPOCH_2015_US, TICK_US, FrameSigner, SigningClock
from gateway.wire.mavlink_splitter import Event, MavFrame, frame_of, message_id_of, split_datagram

STATION = 190
"""Component id of a ground station."""
KEY = bytes(32)
"""Signing key of a signed sender."""
TIMESTAMP = 30_000_000_000_000
"""Signing timestamp at which the time of `signer` begins, and that of `strict` ends."""


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
