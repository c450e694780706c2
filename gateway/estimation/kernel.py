"""What a compiled estimator looks like from outside: one sample live, or a whole log."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import msgspec
import numpy as np

from gateway.compiled import address_of
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.columns import (
    GPS_COLUMNS,
    IMU_COLUMNS,
    NAV_COLUMNS,
    GpsRow,
    gps_row,
    imu_row,
    nav_state,
)
from gateway.estimation.kernel_record import (
    FloatArray,
    IntArray,
    Packed,
    copy_record,
    new_record,
    pack_record,
    unpack_record,
)
from gateway.estimation.reference import EarthField, EarthPlace, ReferenceSettings
from gateway.records import BaroSample, GpsFix, ImuSample, NavState

State = TypeVar("State")
Gains = TypeVar("Gains")


@dataclass(frozen=True, slots=True)
class SampleLog:
    """A whole log as arrays; each kind in the order of its time."""

    imu_time_us: IntArray
    imu: FloatArray
    """Shape (n, IMU_COLUMNS)."""
    baro_time_us: IntArray
    baro_alt_m: FloatArray
    gps_time_us: IntArray
    """Arrival."""
    gps: FloatArray
    """Shape (m, GPS_COLUMNS)."""


@dataclass(frozen=True, slots=True)
class Kernels(Generic[State, Gains]):
    """The compiled functions of one estimator; arrays and records by their addresses."""

    declaration: type[State]
    begin: EntryPoint[[int, int]]
    """`(state, gains)`."""
    imus: EntryPoint[[int, int, int, int, int, int]]
    """`(state, gains, count, times_us, imu_rows, output_rows)`."""
    baro: EntryPoint[[int, int, float]]
    """`(state, gains, alt_m)`."""
    gps: EntryPoint[[int, int, int, int]]
    """`(state, gains, arrival_us, gps_row)`."""
    run: EntryPoint[...]
    """`(state, gains, count and arrays of each kind in a SampleLog, two counters, output_rows)`."""
    earlier: Callable[..., None]
    """`(state, gains, time_us, taken, *arrays of the barometer and the GPS)`, of compiled code."""

    @property
    def live(self) -> tuple[EntryPoint[...], ...]:
        """What a gateway needs, the largest first."""
        return (self.imus, self.gps, self.baro, self.begin)


class KernelEstimator(Generic[State, Gains]):
    """An estimator made of compiled kernels over one record of state.

    Parameters
    ----------
    kernels : Kernels
        The compiled functions.
    gains : Gains
        A record of constants.
    reference : ReferenceSettings
        GPS latency and declination.
    """

    def __init__(
        self, kernels: Kernels[State, Gains], gains: Gains, reference: ReferenceSettings
    ) -> None:
        self._kernels = kernels
        self._gains = gains
        self._gains_at = address_of(gains)
        self._reference = reference
        self._earth = EarthField(reference)
        self._time_us = np.zeros(1, np.int64)
        self._row, self._fix = np.zeros(IMU_COLUMNS), np.zeros(GPS_COLUMNS)
        self._output = np.empty(NAV_COLUMNS)
        self._time_at, self._row_at = address_of(self._time_us), address_of(self._row)
        self._fix_at, self._output_at = address_of(self._fix), address_of(self._output)
        # A first call on a scrap state loads, or compiles, what a sample would wait for.
        self._begin()
        kernels.imus(self._at, self._gains_at, 1, self._time_at, self._row_at, self._output_at)
        kernels.baro(self._at, self._gains_at, 0.0)
        kernels.gps(self._at, self._gains_at, 0, self._fix_at)
        self._begin()

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._earth.reset()
        self._begin()

    def _begin(self) -> None:
        self._use(new_record(self._kernels.declaration))
        self._kernels.begin(self._at, self._gains_at)

    def _use(self, record: State) -> None:
        self._state, self._at = record, address_of(record)

    @property
    def state(self) -> State:
        """A copy of all that the kernel remembers; may be set back."""
        return copy_record(self._state)

    @state.setter
    def state(self, state: State) -> None:
        if getattr(state, "dtype", None) != getattr(self._state, "dtype", None):
            raise TypeError(f"not a state of this estimator: {type(state)}")
        self._use(copy_record(state))

    @property
    def gains(self) -> Gains:
        """The record of constants."""
        return self._gains

    def snapshot(self) -> bytes:
        """Write down all that is remembered, the place on the Earth included."""
        return msgspec.msgpack.encode((pack_record(self._state), self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot; raises ValueError if it is none of this estimator."""
        kind = tuple[Packed, EarthPlace | None]
        packed, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._use(unpack_record(self._kernels.declaration, packed))

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample.

        Parameters
        ----------
        sample : ImuSample
            Its unfiltered values are used.

        Returns
        -------
        NavState
            State at its time.
        """
        self._time_us[0], self._row[:] = sample.time_us, imu_row(sample)
        self._kernels.imus(
            self._at, self._gains_at, 1, self._time_at, self._row_at, self._output_at
        )
        return nav_state(sample.time_us, self._output)

    def update_imus(self, samples: Sequence[ImuSample]) -> list[NavState]:
        """Advance by IMU samples between which nothing else came, as `update_imu` by each."""
        if len(samples) == 1:
            return [self.update_imu(samples[0])]
        count = len(samples)
        rows = np.array([imu_row(sample) for sample in samples]).reshape(-1, IMU_COLUMNS)
        time_us = np.array([sample.time_us for sample in samples], np.int64)
        out = np.empty((count, NAV_COLUMNS))
        self._kernels.imus(self._at, self._gains_at, count, *map(address_of, (time_us, rows, out)))
        return [nav_state(s.time_us, row) for s, row in zip(samples, out, strict=True)]

    def update_baro(self, sample: BaroSample) -> None:
        """Take in one barometer sample.

        Parameters
        ----------
        sample : BaroSample
            Its pressure altitude is used.
        """
        self._kernels.baro(self._at, self._gains_at, sample.alt_pressure_m)

    def update_gps(self, fix: GpsFix) -> None:
        """Take in one GPS fix at its arrival.

        Parameters
        ----------
        fix : GpsFix
            Fused as of the time it was valid.
        """
        self._fix[:] = gps_row(fix, self._reference, self._earth)
        self._kernels.gps(self._at, self._gains_at, fix.time_us, self._fix_at)

    def fix_row(self, fix: GpsFix) -> GpsRow:
        """Lay out one fix of a log that is to be run as arrays."""
        return gps_row(fix, self._reference, self._earth)

    def run(self, log: SampleLog) -> FloatArray:
        """Advance over a whole log; bit for bit what its samples give one at a time.

        Parameters
        ----------
        log : SampleLog
            At each IMU sample, the barometer samples and fixes that are not later come first.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        out = np.empty((len(log.imu_time_us), NAV_COLUMNS))
        times = (log.imu_time_us, log.baro_time_us, log.gps_time_us)
        rows = (log.imu, log.baro_alt_m, log.gps)
        kinds = [
            (np.ascontiguousarray(time_us, np.int64), np.ascontiguousarray(row, np.float64))
            for time_us, row in zip(times, rows, strict=True)
        ]
        arguments = [
            argument
            for time_us, row in kinds
            for argument in (len(time_us), address_of(time_us), address_of(row))
        ]
        taken = np.zeros(2, np.int64)
        self._kernels.run(self._at, self._gains_at, *arguments, address_of(taken), address_of(out))
        return out
