"""Frames waiting for a slow link: bounded, urgent ones first, numbered as they leave.

Four queues. Answers that a person waits for, and after them attitudes, are urgent; other telemetry
is usual; parameters, missions and files are bulk. An urgent frame leaves first, but after a few of
them a frame of another queue is sent, so that a parameter list is slow on a slow radio but
completes. When the bound is reached the oldest telemetry is dropped, usual before urgent, and
answers last: telemetry is repeated, an answer is not. Bulk has a bound of its own, since all
parameters arrive at once. Where a link is slower than the telemetry, old telemetry expires: it
would otherwise be as late as the queue is long.

Frames leave in another order than they arrived, and some are dropped; so our own frames are
numbered and signed when they leave. Loss that a ground station shows is then only that of the link.
"""

from collections import deque
from collections.abc import Callable
from typing import Final

from gateway.hub.numbering import Numbering, Waiting
from gateway.hub.routing_table import Origin
from gateway.wire.frame_editing import renumbered
from gateway.wire.mavlink_messages import ids_of
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame

ANSWER_IDS: Final = ids_of("HEARTBEAT", "COMMAND_INT", "COMMAND_LONG", "COMMAND_ACK", "STATUSTEXT")
"""Messages whose loss is not made up by the next one."""
URGENT_IDS: Final = ids_of(
    *("ATTITUDE", "ATTITUDE_QUATERNION", "ATTITUDE_QUATERNION_COV"),
    *("MANUAL_CONTROL", "RC_CHANNELS_OVERRIDE"),
)
COMPONENT_INFORMATION, COMPONENT_INFORMATION_BASIC, EVENT = 395, 396, 410
"""Messages that the dialect lacks."""
BULK_IDS: Final = ids_of(
    *("PARAM_REQUEST_READ", "PARAM_REQUEST_LIST", "PARAM_VALUE", "PARAM_SET", "PARAM_MAP_RC"),
    *("PARAM_EXT_REQUEST_READ", "PARAM_EXT_REQUEST_LIST", "PARAM_EXT_VALUE", "PARAM_EXT_SET"),
    *("PARAM_EXT_ACK", "MISSION_REQUEST_PARTIAL_LIST", "MISSION_WRITE_PARTIAL_LIST"),
    *("MISSION_ITEM", "MISSION_ITEM_INT", "MISSION_REQUEST", "MISSION_REQUEST_INT"),
    *("MISSION_SET_CURRENT", "MISSION_REQUEST_LIST", "MISSION_COUNT", "MISSION_CLEAR_ALL"),
    *("MISSION_ITEM_REACHED", "MISSION_ACK", "SET_GPS_GLOBAL_ORIGIN", "GPS_GLOBAL_ORIGIN"),
    *("FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_LIST", "LOG_ENTRY", "LOG_REQUEST_DATA", "LOG_DATA"),
    *("LOG_ERASE", "LOG_REQUEST_END", "AUTOPILOT_VERSION", "PROTOCOL_VERSION"),
    *("COMPONENT_METADATA", "SERVO_OUTPUT_RAW"),
) | {COMPONENT_INFORMATION, COMPONENT_INFORMATION_BASIC, EVENT}
"""Parameters, mission transfers, files, logs, versions: requested, and waited for."""
NOT_TELEMETRY_IDS: Final = ANSWER_IDS | BULK_IDS
"""Messages that are never dropped while there is room, because they are not repeated."""
BULK_BYTES: Final = 16_384
"""Least size of the bulk queue, bytes: the parameters of three aircraft."""
URGENT_RUN: Final = 4
"""Maximum urgent frames in a row before a frame of another queue."""


class SendQueue:
    """A queue in front of one slow link: at most `max_bytes` wait, in addition to bulk.

    The newest frame is always accepted. Our own frames are numbered and signed as they leave; one
    that was overtaken is signed again, since its timestamp is too early. `system_here` returns the
    id at the gateway of a sender that has another one on the link. Frames of others for which
    `is_numbered` returns True are numbered too, and never signed.
    """

    def __init__(
        self,
        max_bytes: int,
        is_own: Callable[[Origin], bool],
        signer: FrameSigner,
        system_here: Callable[[int], int] | None = None,
        is_numbered: Callable[[Origin], bool] = lambda _: False,
    ) -> None:
        self.max_bytes = max_bytes
        self._is_own = is_own
        self._system_here = system_here
        self.max_bulk_bytes = max(max_bytes, BULK_BYTES)
        self._numbering = Numbering(lambda origin: is_own(origin) or is_numbered(origin))
        self._signer = signer
        self._sizes = [0, 0]
        """Waiting bytes of all but bulk, and of bulk."""
        self._answers: deque[Waiting] = deque()
        self._urgent: deque[Waiting] = deque()
        self._usual: deque[Waiting] = deque()
        self._bulk: deque[Waiting] = deque()
        self._run = 0
        self._bulk_turn = False

    def __len__(self) -> int:
        return sum(map(len, (self._answers, self._urgent, self._usual, self._bulk)))

    @property
    def size(self) -> int:
        """Waiting bytes."""
        return sum(self._sizes)

    def encode(self, frame: MavFrame, now_us: int) -> bytes:
        """Return the bytes of a frame that leaves at once, because none waits."""
        return self._encode(frame, self._numbering.enter(frame), now_us)

    def push(self, frame: MavFrame, now_us: int) -> int:
        """Add a frame to the queue of its message; return how many older ones were dropped."""
        message_id, size, dropped = frame.message_id, len(frame.data), 0
        if message_id in BULK_IDS:
            queue = self._bulk
            while queue and self._sizes[1] + size > self.max_bulk_bytes:
                self._take(queue)
                dropped += 1
        else:
            queue = self._usual
            if message_id in URGENT_IDS:
                queue = self._urgent
            elif message_id in ANSWER_IDS:
                queue = self._answers
            while self._sizes[0] and self._sizes[0] + size > self.max_bytes:
                self._take(self._usual or self._urgent or self._answers)
                dropped += 1
        queue.append(Waiting(frame, self._numbering.enter(frame), now_us))
        self._sizes[queue is self._bulk] += size
        return dropped

    def expire(self, before_us: int) -> int:
        """Drop the telemetry that was added before a time; return the number of frames."""
        dropped = 0
        for queue in (self._usual, self._urgent):
            while queue and queue[0].since_us < before_us:
                self._take(queue)
                dropped += 1
        return dropped

    def pop(self, now_us: int) -> bytes | None:
        """Return the bytes of the frame that leaves next, or None if the queue is empty."""
        urgent = self._answers or self._urgent
        others = bool(self._usual or self._bulk)
        if urgent and not (others and self._run >= URGENT_RUN):
            self._run += 1
            return self._encode(*self._take(urgent), now_us)
        if not others:
            return None
        self._run = 0
        self._bulk_turn = not self._bulk_turn
        first, second = self._usual, self._bulk
        if self._bulk_turn:
            first, second = second, first
        return self._encode(*self._take(first or second), now_us)

    def clear(self) -> int:
        """Discard all frames; return their number."""
        count = len(self)
        for queue in (self._answers, self._urgent, self._usual, self._bulk):
            queue.clear()
        self._sizes = [0, 0]
        return count

    def _take(self, queue: deque[Waiting]) -> tuple[MavFrame, int | None]:
        taken = queue.popleft()
        self._sizes[queue is self._bulk] -= len(taken.frame.data)
        return taken.frame, taken.step

    def _encode(self, frame: MavFrame, step: int | None, now_us: int) -> bytes:
        if step is None:
            return frame.data
        sequence = self._numbering.leave(frame, step)
        if not self._is_own(frame.origin):
            return renumbered(frame, sequence).data
        system = self._system_here(frame.origin[0]) if self._system_here else None
        return self._signer.sequence_and_sign(frame, sequence, now_us, system).data
