"""The whole tracker on the bench: IMU node, GPS node, receiver."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from firmware.rig.bench import PS_PER_S
from firmware.rig.boards import Board, GpsNode, ImuNode, Receiver, Setup
from gateway.simulator.timed_frame import TimedFrame

IMU_CLOCK_PPM: Final = 40.0
GPS_CLOCK_PPM: Final = -30.0
RECEIVER_CLOCK_PPM: Final = 15.0
"""Crystals as they are bought."""
PIECE_S: Final = 0.005


@dataclass
class Tracker:
    """The three boards.

    Parameters
    ----------
    setup : Setup
        Seed, world, air and programs.
    noise : bool
        Whether the MPU6050 model adds noise of its own; a simulated flight has it already.
    """

    setup: Setup
    noise: bool = True

    def __post_init__(self) -> None:
        self.receiver = Receiver(self.setup, RECEIVER_CLOCK_PPM)
        self.imu = ImuNode(self.setup, IMU_CLOCK_PPM, noise=self.noise)
        self.gps = GpsNode(self.setup, GPS_CLOCK_PPM)

    @property
    def boards(self) -> tuple[Board, ...]:
        """All of them."""
        return self.receiver, self.imu, self.gps

    def close(self) -> None:
        """Free the chips."""
        for board in self.boards:
            board.close()

    def run_for(self, seconds: float) -> list[tuple[int, int]]:
        """Run on; return the receiver's bytes, each with the time of its end in ps."""
        self.setup.bench.run_for(seconds)
        return self.receiver.take_bytes()

    def frames(self) -> Iterator[TimedFrame]:
        """Run on for ever; give the receiver's frames, each at the time of its last bit."""
        partial = bytearray()
        while True:
            for end_ps, byte in self.run_for(PIECE_S):
                partial.append(byte)
                if byte == 0:
                    yield TimedFrame(end_ps / PS_PER_S, bytes(partial))
                    partial.clear()
