"""The radio between nodes and receiver, the receiver, and its serial line.

Theory of operation. Each node sends one payload after the other. A payload that is disturbed is
repeated by the radio chip, which delays it and all after it; it is lost after the last retry. The
receiver timestamps arriving payloads with its own clock and queues them for the serial line; if the
queue is full they are dropped and counted. The time of a frame is that of its last bit on the line.

Nodes and radio are simulated only as far as the next frame requires, so memory use is constant, and
no frame takes much longer to compute than others.
"""

import heapq
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np

from gateway.records import PipeCounters
from gateway.simulator.flight import START_UNIX_US, SimulatedAircraft
from gateway.simulator.node import Node, Sent, nodes_of
from gateway.simulator.sensors import Chance, DeviceClock, generator
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.units import BITS_PER_BYTE
from gateway.wire.framing import encode_frame
from gateway.wire.payloads import (
    PIPES,
    Header,
    Payload,
    ReceiverStatusFrame,
    encode_payload,
    encode_radio,
    encode_receiver_status,
)

ATTEMPT_S: Final = 0.00045
"""Time on air at 1 Mbit/s: 130 us of settling, and 40 bytes with preamble, address and CRC."""
RETRY_S: Final = 0.00075
"""Time to a retry: the timeout of the acknowledgement and the chip's auto-retransmit delay."""
RETRIES: Final = 5
RETRY_SHARE: Final = 0.08
"""Proportion of transmissions that must be repeated."""

RECEIVER_BOOT_US: Final = 1_618_033
RECEIVER_SKEW_SHARE: Final = 0.5
HANDLING_S: Final = 0.0001
LINE_BUFFER_BYTES: Final = 512
REPORT_ROOM_BYTES: Final = 80
"""Bytes of the queue reserved for the status frame, so that a full line can still be reported."""
STATUS_S: Final = 1.0
LAST_VEHICLE_ID: Final = 31
CHANNEL: Final = 76
NOISE_PERCENT: Final = 2
POWER_ON: Final = 1

UINT8: Final = 1 << 8
UINT16: Final = 1 << 16
UINT32: Final = 1 << 32


@dataclass(frozen=True, slots=True)
class _Arrival:
    time_s: float
    path: "_RadioPath"
    header: Header
    payload: Payload
    lost: bool = False


class _RadioPath:
    """Radio of one node: order, retries, losses and duplicates."""

    def __init__(self, node: Node, pipe: int, settings: SimulatorSettings) -> None:
        self.pipe = pipe
        self.last_seq: int | None = None
        self._node = node
        vehicle_id, node_id = node.node_id.vehicle_id, node.node_id.node_id
        self._rng = np.random.default_rng([settings.seed, vehicle_id, Chance.RADIO, node_id])
        self._free_s = 0.0
        self._seq = 0
        self._losing = False
        self._duplicates = settings.radio_duplicates
        # Gilbert's two-state channel: the long-term proportion of losses is `radio_loss`.
        self._leave_loss = 1.0 / settings.radio_burst
        enter = settings.radio_loss / (settings.radio_burst * (1.0 - settings.radio_loss))
        self._enter_loss = min(enter, 1.0)

    def arrivals(self) -> Iterator[_Arrival]:
        """Send all payloads of the node, and yield the arrivals in order of time."""
        for sent in self._node.sent():
            yield from self._send(sent)

    def _send(self, sent: Sent) -> Iterator[_Arrival]:
        seq, self._seq = self._seq, (self._seq + 1) % UINT16
        change, luck, twice = self._rng.random(3).tolist()
        self._losing = change >= self._leave_loss if self._losing else change < self._enter_loss
        retries = RETRIES
        if not self._losing:
            # The number of retries is geometric; it is limited, so this is never a loss.
            retries = min(int(math.log(1.0 - luck) / math.log(RETRY_SHARE)), RETRIES)
        start_s = max(sent.time_s, self._free_s)
        arrival_s = start_s + ATTEMPT_S + retries * RETRY_S
        self._free_s = arrival_s
        self._node.radio_retries += retries
        header = Header(self._node.node_id, seq, sent.node_time_us % UINT32)
        if self._losing:
            self._node.radio_failed += 1
            yield _Arrival(arrival_s, self, header, sent.payload, lost=True)
            return
        yield _Arrival(arrival_s, self, header, sent.payload)
        if twice < self._duplicates:
            # The acknowledgement was lost, and the chip did not detect the duplicate.
            self._free_s += RETRY_S
            self._node.radio_retries += 1
            yield _Arrival(self._free_s, self, header, sent.payload)


class SimulatedReceiver:
    """The receiver on the ground, with its serial line."""

    def __init__(self, settings: SimulatorSettings, nodes: Sequence[Node]) -> None:
        self._settings = settings
        self._clock = DeviceClock(RECEIVER_BOOT_US, settings.clock_skew_ppm * RECEIVER_SKEW_SHARE)
        self._paths = [_RadioPath(node, k % PIPES, settings) for k, node in enumerate(nodes)]
        self._received = [0] * PIPES
        self._lost = [0] * PIPES
        self._dropped = 0
        self._frame_seq = 0
        self._line_free_s = 0.0

    def frames(self, until_s: float = math.inf) -> Iterator[TimedFrame]:
        """Yield the serial frames in order of time; must be called only once."""
        frames = self._clean_frames(until_s)
        if self._settings.corrupt_bytes > 0.0:
            rng = generator(self._settings, 0, Chance.LINE)
            frames = damage(frames, self._settings.corrupt_bytes, rng)
        return frames

    def _clean_frames(self, until_s: float) -> Iterator[TimedFrame]:
        paths = [path.arrivals() for path in self._paths]
        status_s = STATUS_S
        for arrival in heapq.merge(*paths, key=attrgetter("time_s")):
            if arrival.time_s >= until_s:
                break
            while status_s <= arrival.time_s:
                yield from self._report(status_s)
                status_s += STATUS_S
            if not arrival.lost:
                yield from self._pass_on(arrival)
        while status_s < until_s:
            yield from self._report(status_s)
            status_s += STATUS_S

    def _pass_on(self, arrival: _Arrival) -> Iterator[TimedFrame]:
        path = arrival.path
        self._received[path.pipe] += 1
        if path.last_seq is not None:
            gap = (arrival.header.seq - path.last_seq - 1) % UINT16
            # A duplicate appears as a gap of 65 535.
            self._lost[path.pipe] += gap if gap < UINT16 // 2 else 0
        path.last_seq = arrival.header.seq
        stamp_us = self._clock.at(arrival.time_s) % UINT32
        packet = encode_payload(arrival.header, arrival.payload)
        content = encode_radio(self._frame_seq, path.pipe, stamp_us, packet)
        yield from self._write(arrival.time_s, content, LINE_BUFFER_BYTES - REPORT_ROOM_BYTES)

    def _report(self, time_s: float) -> Iterator[TimedFrame]:
        counters = zip(self._received, self._lost, strict=True)
        status = ReceiverStatusFrame(
            frame_seq=self._frame_seq,
            receiver_time_us=self._clock.at(time_s) % UINT32,
            channel=CHANNEL,
            noise_percent=NOISE_PERCENT,
            uart_dropped=self._dropped % UINT16,
            reset_cause=POWER_ON,
            pipes=tuple(PipeCounters(received, lost, 0) for received, lost in counters),
        )
        yield from self._write(time_s, encode_receiver_status(status), LINE_BUFFER_BYTES)

    def _write(self, time_s: float, content: bytes, room: int) -> Iterator[TimedFrame]:
        # A dropped frame also has a number, so that the gateway detects the gap.
        self._frame_seq = (self._frame_seq + 1) % UINT8
        data = encode_frame(content)
        byte_s = BITS_PER_BYTE / self._settings.baud
        queued = max(self._line_free_s - time_s, 0.0) / byte_s
        if queued + len(data) > room:
            self._dropped += 1
            return
        start_s = max(time_s + HANDLING_S, self._line_free_s)
        self._line_free_s = start_s + len(data) * byte_s
        yield TimedFrame(self._line_free_s, data)


def simulate(settings: SimulatorSettings, start_unix_us: int = START_UNIX_US) -> SimulatedReceiver:
    """Create the receiver and all aircraft in the settings.

    `start_unix_us` is the UTC that GPS reports at the start, limited to 2000 to 2254.
    Raises ValueError if the last aircraft's id is too large.
    """
    last_id = settings.vehicle_id + settings.vehicles - 1
    if last_id > LAST_VEHICLE_ID:
        raise ValueError(f"vehicle ids up to {last_id}; the protocol allows {LAST_VEHICLE_ID}")
    nodes: list[Node] = []
    for index in range(settings.vehicles):
        nodes += nodes_of(SimulatedAircraft(settings, index, start_unix_us), settings)
    return SimulatedReceiver(settings, nodes)


def damage(
    frames: Iterator[TimedFrame], share: float, rng: np.random.Generator
) -> Iterator[TimedFrame]:
    """Replace a share of the bytes by any other value."""
    for frame in frames:
        data = np.frombuffer(frame.data, dtype=np.uint8)
        hit = rng.random(len(data)) < share
        flips = rng.integers(1, UINT8, len(data), dtype=np.uint8) * hit
        yield TimedFrame(frame.time_s, (data ^ flips).tobytes(), int(hit.sum()))
