"""What every estimator offers, so that the pipeline need not know which one runs."""

from typing import Protocol

from gateway.records import BaroSample, GpsFix, ImuSample, NavState


class Estimator(Protocol):
    """A causal fusion of samples into navigation states, one aircraft each.

    Samples come in the order of their `time_us`; the estimator handles a sample from the past, a
    gap, and a value that is not finite. No method raises on data.
    """

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample and return the state at its time."""
        ...

    def update_baro(self, sample: BaroSample) -> None:
        """Use one barometer sample."""
        ...

    def update_gps(self, fix: GpsFix) -> None:
        """Use one GPS fix at its arrival; the estimator compensates the latency."""
        ...

    def snapshot(self) -> bytes:
        """Return the whole state."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Continue from a snapshot to the last bit; raises ValueError for another estimator's."""
        ...

    def reset(self) -> None:
        """Discard everything except the settings."""
        ...
