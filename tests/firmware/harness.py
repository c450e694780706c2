"""A bench whose receiver's bytes come out decoded."""

import itertools
from collections.abc import Callable
from typing import Any, TypeVar

from firmware.rig.bench import PS_PER_S
from firmware.rig.boards import Board, GpsNode, ImuNode, Receiver, Setup
from firmware.rig.world import Moment, Solution, World
from gateway.wire.framing import Fault, FrameDecoder
from gateway.wire.payloads import (
    ForeignFrame,
    Header,
    NodeStatusPayload,
    Payload,
    RadioFrame,
    ReceiverStatusFrame,
    chip_names,
    decode_content,
)

P = TypeVar("P", bound=Payload)

IMU, MAG, BARO, GPS = 1, 2, 4, 8
"""Bits of the sensors in a node's status."""
START_S = 0.45
"""Reset, self-test and set-up of an IMU node."""


def still(**values: Any) -> World:
    """Return a world whose quantities do not change."""
    moment = Moment(**values)
    return World(moment=lambda _time_s: moment)


def always(**values: Any) -> World:
    """Return a world with one solution of the GPS."""
    solution = Solution(**values)
    return World(solution=lambda _time_s: solution)


class Bench:
    """Boards on one time line; `run` gathers what the receiver says.

    Parameters
    ----------
    setup : Setup
    receiver : str
        The receiver's program.
    """

    def __init__(self, setup: Setup, receiver: str = "receiver") -> None:
        self.setup = setup
        self.receiver = Receiver(setup, program=receiver)
        self.boards: list[Board] = [self.receiver]
        self.frames: list[tuple[float, RadioFrame]] = []
        """Every radio frame with the time of its last byte in seconds."""
        self.foreign: list[tuple[float, ForeignFrame]] = []
        self.statuses: list[ReceiverStatusFrame] = []
        self.faults: list[Fault] = []
        self.line: list[tuple[int, int]] = []
        self._decoder = FrameDecoder()

    def imu_node(self, **options: object) -> ImuNode:
        node = ImuNode(self.setup, **options)
        self.boards.append(node)
        return node

    def gps_node(self, **options: object) -> GpsNode:
        node = GpsNode(self.setup, **options)
        self.boards.append(node)
        return node

    def close(self) -> None:
        for board in self.boards:
            board.close()

    @property
    def now_s(self) -> float:
        return self.setup.bench.now_ps / PS_PER_S

    def run(self, seconds: float) -> None:
        self.setup.bench.run_for(seconds)
        for end_ps, byte in self.receiver.take_bytes():
            self.line.append((end_ps, byte))
            for event in self._decoder.feed(bytes([byte])):
                self._take(event, end_ps / PS_PER_S)

    def headers(self, node_id: int) -> list[Header]:
        return [f.header for _, f in self.frames if f.header.node.node_id == node_id]

    def payloads(self, kind: type[P], since_s: float = 0.0) -> list[P]:
        return [f.payload for t, f in self.frames if t >= since_s and isinstance(f.payload, kind)]

    def last(self, kind: type[P]) -> P:
        return self.payloads(kind)[-1]

    def node_status(self, node_id: int) -> NodeStatusPayload:
        found = [
            f.payload
            for _, f in self.frames
            if isinstance(f.payload, NodeStatusPayload) and f.header.node.node_id == node_id
        ]
        return found[-1]

    @property
    def sensors(self) -> tuple[int, int]:
        """Sensors that are present, and those that failed, by the newest report."""
        status = self.last(NodeStatusPayload)
        return status.sensors_present, status.sensors_failed

    @property
    def chips(self) -> tuple[str, ...]:
        """Chips by the newest report."""
        status = self.last(NodeStatusPayload)
        assert status.chips is not None
        return chip_names(status.chips, status.sensors_present)

    def lost(self, node_id: int, since_s: float = 0.0) -> int:
        """Count the gaps in a node's sequence."""
        seqs = [
            f.header.seq
            for t, f in self.frames
            if f.header.node.node_id == node_id and t >= since_s
        ]
        return sum((b - a) % 65536 - 1 for a, b in itertools.pairwise(seqs))

    def _take(self, event: bytes | Fault, time_s: float) -> None:
        content = event if isinstance(event, Fault) else decode_content(event)
        if isinstance(content, Fault):
            self.faults.append(content)
        elif isinstance(content, ReceiverStatusFrame):
            self.statuses.append(content)
        elif isinstance(content, ForeignFrame):
            self.foreign.append((time_s, content))
        else:
            self.frames.append((time_s, content))


MakeBench = Callable[..., Bench]
MakeRig = Callable[..., tuple[Bench, Any]]
"""Makes a bench with one node that has run for some seconds; returns both."""
