"""A frame of the simulated receiver, and the time at which it is sent."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimedFrame:
    """The bytes of one serial frame, delimiter included."""

    time_s: float
    """True time since the start at which its last bit is sent; never decreases."""
    data: bytes
    damaged: int = 0
    """Number of bytes that differ from those sent by the receiver."""
