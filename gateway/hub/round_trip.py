"""Round-trip times, measured by requests that clients answer automatically.

Some ground stations answer PING, others only TIMESYNC; both are sent. The requests come from a
separate component, so they leave no gap in the sequence numbers of the vehicle, and no answer to
the vehicle is mistaken for an answer to them. A gateway without a vehicle of its own sends them in
the name of a system that it routes, because programs ignore frames of system 0. Requests of another
gateway are answered by that component too and not forwarded: they measure this one link.
"""

from collections import Counter, deque
from typing import Final

from pymavlink.dialects.v20 import all as dialect

from gateway.records import EVERYBODY
from gateway.units import NS_PER_US, US_PER_S
from gateway.wire.mavlink_splitter import MavFrame, frame_of

PROBE_COMPONENT: Final = dialect.MAV_COMP_ID_USER75
"""The last id for private use; MAVROS and Cockpit use 240, that of the UDP bridge."""
MAX_ASKED: Final = 256
"""Rounds whose answers are recognised: those of a minute, some a second."""
LONGEST_US: Final = 60 * US_PER_S
"""An answer to an older request is ignored."""
NOBODY: Final = 0
MEASURING: Final = frozenset({dialect.MAVLINK_MSG_ID_PING, dialect.MAVLINK_MSG_ID_TIMESYNC})


def is_of_gateway(frame: MavFrame) -> bool:
    """Return whether a frame is a round-trip request or answer of another gateway."""
    return frame.origin[1] == PROBE_COMPONENT and frame.message_id in MEASURING


class RoundTrip:
    """Build round-trip requests and read the answers; number all frames of the component."""

    def __init__(self) -> None:
        self._sender = dialect.MAVLink(None, NOBODY, PROBE_COMPONENT)
        self._reader = dialect.MAVLink(None)
        self._numbers: Counter[int] = Counter()
        """Frames of the component so far, by system."""
        self._sent_us: deque[int] = deque(maxlen=MAX_ASKED)

    def encode(self, message: dialect.MAVLink_message, system: int) -> MavFrame:
        """Return the next frame of the component in a system."""
        self._sender.srcSystem, self._sender.seq = system, self._numbers[system] & 0xFF
        self._numbers[system] += 1
        return frame_of(bytes(message.pack(self._sender)))

    def ask(self, system: int, now_us: int) -> list[MavFrame]:
        """Build the requests of one round."""
        self._sent_us.append(now_us)
        return [
            self.encode(dialect.MAVLink_ping_message(now_us, self._numbers[system], 0, 0), system),
            self.encode(dialect.MAVLink_timesync_message(0, now_us * NS_PER_US), system),
        ]

    def is_returned(self, frame: MavFrame) -> bool:
        """Return whether a frame is a request of ours that has come back."""
        if not is_of_gateway(frame) or frame.origin[0] not in self._numbers:
            return False
        if (asked := self._decode(frame)) is None:
            return False
        if frame.message_id == dialect.MAVLINK_MSG_ID_PING:
            return frame.target == EVERYBODY and asked.time_usec in self._sent_us
        return asked.tc1 == 0 and asked.ts1 in (us * NS_PER_US for us in self._sent_us)

    def read(self, frame: MavFrame, now_us: int) -> int | None:
        """Return the round trip in microseconds if a frame answers a request of ours."""
        message_id = frame.message_id
        if message_id == dialect.MAVLINK_MSG_ID_PING:
            answer = self._decode(frame)
            if answer is None or answer.target_component != PROBE_COMPONENT:
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
        """Answer a round-trip request of another gateway; None if it is an answer itself."""
        asked = self._decode(frame)
        if asked is None or frame.target != EVERYBODY:
            return None
        if frame.message_id == dialect.MAVLINK_MSG_ID_PING:
            answer = dialect.MAVLink_ping_message(asked.time_usec, asked.seq, *frame.origin)
            return self.encode(answer, system)
        if asked.tc1 == 0:
            answer = dialect.MAVLink_timesync_message(now_us * NS_PER_US, asked.ts1)
            return self.encode(answer, system)
        return None

    def _decode(self, frame: MavFrame) -> dialect.MAVLink_message | None:
        try:
            messages = self._reader.parse_buffer(frame.data)
        except dialect.MAVError:
            return None
        return messages[0] if messages else None
