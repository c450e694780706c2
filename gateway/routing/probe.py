"""Round trips: the questions that clients answer by themselves, and which answer is ours.

Some ground stations answer PING, others only TIMESYNC; both are asked. The questions come from a
component of their own (the MAVLink id of a UDP bridge), so they leave no gap in the sequence
numbers of the vehicle and no answer meant for the vehicle is mistaken.
"""

from typing import Final

from pymavlink.dialects.v20 import common as dialect

from gateway.routing.routing_table import Origin
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import Seal
from gateway.wire.mavlink_splitter import message_id_of, restamp

PROBE_COMPONENT: Final = dialect.MAV_COMP_ID_UDP_BRIDGE
LONGEST_US: Final = 60 * US_PER_S
"""An answer to anything older is none."""
NS_PER_US: Final = 1000
NOBODY: Final = 0


class RoundTrip:
    """Ask for round trips and read the answers.

    Parameters
    ----------
    seal : callable
        Numbers, and signs, each question that leaves.
    """

    def __init__(self, seal: Seal = restamp) -> None:
        self._seal = seal
        self._sender = dialect.MAVLink(None, NOBODY, PROBE_COMPONENT)
        self._reader = dialect.MAVLink(None)

    @property
    def origin(self) -> Origin:
        """System and component that the questions come from; system 0 before the first."""
        return self._sender.srcSystem, PROBE_COMPONENT

    def ask(self, system: int, now_us: int) -> list[tuple[bytes, int]]:
        """Build the questions of one round.

        Parameters
        ----------
        system : int
            One of our vehicles, as whose part the gateway speaks.
        now_us : int
            Gateway time; comes back in the answers.

        Returns
        -------
        list of (bytes, int)
            Frames and their message ids.
        """
        self._sender.srcSystem = system
        questions = []
        for message in (
            dialect.MAVLink_ping_message(now_us, self._sender.seq, 0, 0),
            dialect.MAVLink_timesync_message(0, now_us * NS_PER_US),
        ):
            frame = bytes(message.pack(self._sender))
            questions.append((self._seal(frame, self._sender.seq), message.id))
            self._sender.seq = (self._sender.seq + 1) % 256
        return questions

    def read(self, frame: bytes, now_us: int) -> int | None:
        """Return the round trip in microseconds if a frame answers a question of ours."""
        message_id = message_id_of(frame)
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
        round_trip_us: int = now_us - sent_us
        return round_trip_us if 0 <= round_trip_us <= LONGEST_US else None

    def _decode(self, frame: bytes) -> dialect.MAVLink_message | None:
        try:
            messages = self._reader.parse_buffer(frame)
        except dialect.MAVError:
            return None
        return messages[0] if messages else None
