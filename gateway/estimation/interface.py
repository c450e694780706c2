"""What every estimator offers, so that the pipeline need not know which one runs."""

from typing import Protocol

from gateway.records import BaroSample, GpsFix, ImuSample, NavState


class Estimator(Protocol):
    """A causal fusion of samples into navigation states, one aircraft each.

    Samples come in the order of their `time_us`; a sample from the past, a gap, a value that is
    not finite are the estimator's own to survive. No method raises on data.
    """

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample and tell the state at its time."""
        ...

    def update_baro(self, sample: BaroSample) -> None:
        """Take in one barometer sample."""
        ...

    def update_gps(self, fix: GpsFix) -> None:
        """Take in one GPS fix at its arrival; the latency is the estimator's to compensate."""
        ...

    def snapshot(self) -> bytes:
        """Write down all that is remembered."""
        ...

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot to the last bit; raises ValueError if it is not its own."""
        ...

    def reset(self) -> None:
        """Forget everything but the settings."""
        ...
