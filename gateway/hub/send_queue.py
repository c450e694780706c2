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

A link whose bandwidth is known and too small for all telemetry gets each message at a lower rate.
The offered frames are counted by kind of message; when not all of them fit, each kind is thinned by
one factor that is found by bisection, divided by the kind's importance:

    rate = offered * min(1, factor * importance), at least `FLOOR_HZ`

Answers that a client waits for, heartbeats and texts are never thinned; their bytes are subtracted
from the bandwidth first. If even the floors do not fit they are all lowered alike, so that no
message stops. A radio reports in RADIO_STATUS how full its own buffer is, since the air carries
less than the serial line: the used share of the bandwidth decreases while the buffer fills and
increases again slowly. A link of a few bytes a second gets HIGH_LATENCY2 alone, which summarises
the state of a vehicle in 54 bytes.
"""

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Final

from pymavlink.dialects.v20 import all as dialect

from gateway.hub.routing_table import MAX_ORIGINS, Origin
from gateway.units import BITS_PER_BYTE, US_PER_S
from gateway.wire.frame_editing import renumbered
from gateway.wire.mavlink_messages import ids_of
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame

HIGH_LATENCY2: Final = dialect.MAVLINK_MSG_ID_HIGH_LATENCY2
RADIO_STATUS: Final = dialect.MAVLINK_MSG_ID_RADIO_STATUS
SATELLITE_BUDGET: Final = 100
"""Bytes a second, below which a link is a satellite link."""
HIGH_LATENCY2_BYTES: Final = 54
NEVER_THINNED: Final = frozenset(
    {
        dialect.MAVLINK_MSG_ID_HEARTBEAT,
        dialect.MAVLINK_MSG_ID_COMMAND_ACK,
        dialect.MAVLINK_MSG_ID_STATUSTEXT,
        dialect.MAVLINK_MSG_ID_PARAM_VALUE,
    }
)
IMPORTANCE: Final[dict[int, float]] = {
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 4.0,
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: 4.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 4.0,
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: 4.0,
    dialect.MAVLINK_MSG_ID_HOME_POSITION: 4.0,
    dialect.MAVLINK_MSG_ID_VFR_HUD: 2.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE: 2.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 2.0,
}
"""Importance of messages; that of others is 1. Position and health come first, then motion."""
FLOOR_HZ: Final = 0.5
LEAST_FLOOR_SHARE: Final = 0.1
"""Part of this rate that is sent even where answers use all of the bandwidth."""
LEAST_FLOW: Final = 1e-3
"""Bytes a second below which a kind of frame counts as ended."""
SMOOTHING: Final = 0.3
"""Weight of the newest second in the moving averages."""
FULL_PERCENT: Final = 20
LOW_PERCENT: Final = 50
FREE_PERCENT: Final = 90
"""Free percentages of a radio's buffer: below the first two the used share decreases by much or by
little, above the last it increases, as in autopilots."""
LEAST_SHARE: Final = 0.05
STEPS: Final = 20
"""Steps of the bisection, which give the factor to a millionth."""

Key = bytes
"""System, component and message of a frame, as in `MavFrame.key`."""
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
SEQUENCE_MASK: Final = 0xFF
_Queue = deque[tuple[MavFrame, int | None, int]]
"""Frames, their steps (see `Numbering`), and the time at which they were added."""


class Bandwidth:
    """Message intervals on one link of a known bandwidth."""

    def __init__(self, bytes_per_s: int) -> None:
        self.share = 1.0
        """Share of the bandwidth that the radio of the link accepts."""
        self.bytes_per_s = bytes_per_s
        self._offered: dict[Key, tuple[int, float, float]] = {}
        """Message id, and smoothed frames and bytes a second."""
        self._answered = 0.0
        self._intervals_us: dict[Key, int] = {}

    def update_buffer(self, free_percent: int) -> None:
        """Adapt the used share to the free part of a radio's buffer."""
        if free_percent < FULL_PERCENT:
            self.share *= 0.7
        elif free_percent < LOW_PERCENT:
            self.share *= 0.9
        elif free_percent > FREE_PERCENT:
            self.share *= 1.1
        self.share = min(1.0, max(LEAST_SHARE, self.share))

    def interval_us(self, key: Key) -> int:
        """Return the least time between two frames of a kind; 0 if all of them fit."""
        return self._intervals_us.get(key, 0)

    def plan(
        self, offered: Mapping[Key, tuple[int, int, int]], answered: int, elapsed_s: float
    ) -> None:
        """Find new intervals from the frames offered by kind and the answers since the last one."""
        if elapsed_s <= 0:
            return
        for key in self._offered.keys() | offered.keys():
            message_id, frames, size = offered.get(key) or (self._offered[key][0], 0, 0)
            _, rate, flow = self._offered.get(key, (0, frames / elapsed_s, size / elapsed_s))
            rate += SMOOTHING * (frames / elapsed_s - rate)
            flow += SMOOTHING * (size / elapsed_s - flow)
            self._offered[key] = message_id, rate, flow
        self._offered = {key: each for key, each in self._offered.items() if each[2] > LEAST_FLOW}
        self._answered += SMOOTHING * (answered / elapsed_s - self._answered)
        self._intervals_us = self._thinned()

    def _thinned(self) -> dict[Key, int]:
        fixed = sum(flow for i, _, flow in self._offered.values() if i in NEVER_THINNED)
        free = max(0.0, self.bytes_per_s * self.share - fixed - self._answered)
        kinds = {key: each for key, each in self._offered.items() if each[0] not in NEVER_THINNED}
        least = {key: min(1.0, FLOOR_HZ / rate) for key, (_, rate, _) in kinds.items() if rate}
        floors = sum(least[key] * kinds[key][2] for key in least)
        if floors > free:
            squeeze = max(free / floors, LEAST_FLOOR_SHARE)
            parts = {key: part * squeeze for key, part in least.items()}
        else:
            parts = _parts(kinds, least, free)
        return {
            key: round(US_PER_S / (part * kinds[key][1]))
            for key, part in parts.items()
            if part < 1.0
        }


def _parts(
    kinds: Mapping[Key, tuple[int, float, float]], least: Mapping[Key, float], free: float
) -> dict[Key, float]:
    """Return the share of each kind to send, so that together they use `free` bytes a second."""

    def at(factor: float) -> dict[Key, float]:
        return {
            key: max(least[key], min(1.0, factor * IMPORTANCE.get(kinds[key][0], 1.0)))
            for key in least
        }

    low, high = 0.0, 1.0
    if sum(kinds[key][2] for key in least) <= free:
        return at(high)
    for _ in range(STEPS):
        middle = (low + high) / 2
        used = sum(part * kinds[key][2] for key, part in at(middle).items())
        low, high = (middle, high) if used <= free else (low, middle)
    return at(low)


class Numbering:
    """Renumber our own frames where some are dropped and others overtake.

    Each frame keeps its step from the frame before it in our own order; when frames leave, their
    steps add up. So without drops every frame leaves with its own number, gaps of a recording
    included, and with drops the numbers continue without a gap. Frames of others, for whose origin
    `is_own` returns False, are never changed.
    """

    def __init__(self, is_own: Callable[[Origin], bool] | None = None) -> None:
        self._is_own = is_own
        self._last: dict[Origin, list[int | None]] = {}
        """The last number of each origin that entered, and the last with which a frame left."""

    def enter(self, frame: MavFrame) -> int | None:
        """Return a frame's step, to be passed to `leave`; None for a frame of others."""
        origin, sequence = frame.origin, frame.sequence
        if self._is_own is not None and not self._is_own(origin):
            return None
        last = self._last.get(origin)
        if last is None:
            if len(self._last) < MAX_ORIGINS:
                self._last[origin] = [sequence, None]
            return 1
        before, last[0] = last[0], sequence
        assert before is not None
        return sequence - before & SEQUENCE_MASK

    def number(self, frame: MavFrame) -> int:
        """Return the sequence number of a frame that waits in no queue."""
        last, sequence = self._last.get(frame.origin), frame.sequence
        if last is not None and last[0] == last[1]:
            # Nothing was dropped or overtaken so far.
            last[0] = last[1] = sequence
            return sequence
        step = self.enter(frame)
        return sequence if step is None else self.leave(frame, step)

    def leave(self, frame: MavFrame, step: int) -> int:
        """Return the sequence number with which a frame is sent."""
        last = self._last.get(frame.origin)
        if last is None:
            return frame.sequence
        before = last[1]
        wanted = last[1] = frame.sequence if before is None else before + step & SEQUENCE_MASK
        return wanted


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
        self._answers: _Queue = deque()
        self._urgent: _Queue = deque()
        self._usual: _Queue = deque()
        self._bulk: _Queue = deque()
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
        queue.append((frame, self._numbering.enter(frame), now_us))
        self._sizes[queue is self._bulk] += size
        return dropped

    def expire(self, before_us: int) -> int:
        """Drop the telemetry that was added before a time; return the number of frames."""
        dropped = 0
        for queue in (self._usual, self._urgent):
            while queue and queue[0][2] < before_us:
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

    def _take(self, queue: "_Queue") -> tuple[MavFrame, int | None]:
        frame, step, _ = queue.popleft()
        self._sizes[queue is self._bulk] -= len(frame.data)
        return frame, step

    def _encode(self, frame: MavFrame, step: int | None, now_us: int) -> bytes:
        if step is None:
            return frame.data
        sequence = self._numbering.leave(frame, step)
        if not self._is_own(frame.origin):
            return renumbered(frame, sequence).data
        system = self._system_here(frame.origin[0]) if self._system_here else None
        return self._signer.sequence_and_sign(frame, sequence, now_us, system).data


class Packer:
    """Gather frames into datagrams of at most `max_bytes`; a single longer frame goes alone.

    `send` is called with the frames of a datagram when it is full, and when `flush` is called.
    `flush_soon` gets `flush` with the first frame of each datagram, to call it later.
    """

    def __init__(
        self,
        max_bytes: int,
        send: Callable[[list[bytes]], None],
        flush_soon: Callable[[Callable[[], None]], None],
    ) -> None:
        self._max_bytes = max_bytes
        self._send = send
        self._flush_soon = flush_soon
        self._frames: list[bytes] = []
        self._size = 0
        self._is_flush_due = False

    def add(self, frame: bytes) -> None:
        """Add a frame."""
        if self._size + len(frame) > self._max_bytes:
            self._send_frames()
        self._frames.append(frame)
        self._size += len(frame)
        if not self._is_flush_due:
            self._is_flush_due = True
            self._flush_soon(self.flush)

    def flush(self) -> None:
        """Send the gathered frames."""
        self._is_flush_due = False
        self._send_frames()

    def _send_frames(self) -> None:
        frames, self._frames = self._frames, []
        self._size = 0
        if frames:
            self._send(frames)


class Pacer:
    """Keep the driver's buffer of a serial line short, so that urgent frames need not wait for it.

    A driver accepts kilobytes at once, which at 57600 Bd is most of a second. The pacer computes
    when the line of `baud` will have sent them, and allows the next frame `ahead_us` before.
    """

    def __init__(self, baud: int, ahead_us: int) -> None:
        self._baud = baud
        self._ahead_us = ahead_us
        self._free_us = 0

    def delay_us(self, now_us: int) -> int:
        """Return the time until the next frame may be written; 0 is now."""
        return max(0, self._free_us - self._ahead_us - now_us)

    def wrote(self, size: int, now_us: int) -> None:
        """Account for bytes written to the driver."""
        busy_us = math.ceil(size * BITS_PER_BYTE * US_PER_S / self._baud)
        self._free_us = max(self._free_us, now_us) + busy_us
