"""A frame of the simulated receiver, and when it leaves."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class TimedFrame:
    """The bytes of one serial frame, delimiter included."""

    time_s: float
    """True time since the start at which its last bit leaves the receiver; never goes back."""
    data: bytes
    damaged: int = 0
    """Number of bytes that differ from those that the receiver sent."""
