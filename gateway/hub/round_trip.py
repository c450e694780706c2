"""Round-trip times, measured by requests that clients answer automatically.

Some ground stations answer PING, others only TIMESYNC; both are sent. The requests come from a
separate component, so they leave no gap in the sequence numbers of the vehicle, and no answer to
the vehicle is mistaken for an answer to them. Requests of another gateway are answered by that
component too and not forwarded: they measure this one link.
"""

from collections import deque
from typing import Final

from pymavlink.dialects.v20 import all as dialect

from gateway.hub.routing_table import Origin
from gateway.records import EVERYBODY
from gateway.units import NS_PER_US, US_PER_S
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame, frame_of

PROBE_COMPONENT: Final = dialect.MAV_COMP_ID_USER75
"""The last id for private use; MAVROS and Cockpit use 240, that of the UDP bridge."""
MAX_ASKED: Final = 64
"""Rounds whose answers are recognised: those of a minute, one a second."""
LONGEST_US: Final = 60 * US_PER_S
"""An answer to an older request is ignored."""
NOBODY: Final = 0
MEASURING: Final = frozenset({dialect.MAVLINK_MSG_ID_PING, dialect.MAVLINK_MSG_ID_TIMESYNC})


def is_of_gateway(frame: MavFrame) -> bool:
    """Return whether a frame is a round-trip request or answer of another gateway."""
    return (
        frame.origin[1] == PROBE_COMPONENT
        and frame.message_id in MEASURING
        and frame.target == EVERYBODY
    )


class RoundTrip:
    """Build round-trip requests and read the answers."""

    def __init__(self, signer: FrameSigner) -> None:
        self._signer = signer
        self._sender = dialect.MAVLink(None, NOBODY, PROBE_COMPONENT)
        self._reader = dialect.MAVLink(None)
        self._sent_us: deque[int] = deque(maxlen=MAX_ASKED)

    @property
    def origin(self) -> Origin:
        """System and component that the requests come from; system 0 before the first."""
        return self._sender.srcSystem, PROBE_COMPONENT

    def ask(self, system: int, now_us: int) -> list[MavFrame]:
        """Build the requests of one round."""
        self._sender.srcSystem = system
        self._sent_us.append(now_us)
        return [
            self._encode(message, now_us)
            for message in (
                dialect.MAVLink_ping_message(now_us, self._sender.seq, 0, 0),
                dialect.MAVLink_timesync_message(0, now_us * NS_PER_US),
            )
        ]

    def read(self, frame: MavFrame, now_us: int) -> int | None:
        """Return the round trip in microseconds if a frame answers a request of ours."""
        message_id = frame.message_id
        if message_id == dialect.MAVLINK_MSG_ID_PING:
            answer = self._decode(frame)
            if answer is None or (answer.target_system, answer.target_component) != self.origin:
                return None
            sent_us = answer.time_usec
        elif message_id == dialect.MAVLINK_MSG_ID_TIMESYNC:
            answer = self._decode(frame)
            if answer is None or answer.tc1 == 0 or answer.ts1 % NS_PER_US:
                return None
            sent_us = answer.ts1 // NS_PER_US
        else:
            return None
        if sent_us not in self._sent_us:
            return None
        round_trip_us: int = now_us - sent_us
        return round_trip_us if 0 <= round_trip_us <= LONGEST_US else None

    def answer(self, frame: MavFrame, system: int, now_us: int) -> MavFrame | None:
        """Answer a round-trip request of another gateway."""
        asked = self._decode(frame) if is_of_gateway(frame) else None
        if asked is None:
            return None
        if asked.get_msgId() == dialect.MAVLINK_MSG_ID_PING:
            message = dialect.MAVLink_ping_message(asked.time_usec, asked.seq, *frame.origin)
        elif asked.tc1 == 0:
            message = dialect.MAVLink_timesync_message(now_us * NS_PER_US, asked.ts1)
        else:
            return None
        self._sender.srcSystem = system
        return self._encode(message, now_us)

    def _encode(self, message: dialect.MAVLink_message, now_us: int) -> MavFrame:
        frame, sequence = frame_of(bytes(message.pack(self._sender))), self._sender.seq
        self._sender.seq = (sequence + 1) % 256
        return self._signer.sequence_and_sign(frame, sequence, now_us)

    def _decode(self, frame: MavFrame) -> dialect.MAVLink_message | None:
        try:
            messages = self._reader.parse_buffer(frame.data)
        except dialect.MAVError:
            return None
        return messages[0] if messages else None
