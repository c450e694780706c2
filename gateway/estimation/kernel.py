"""What a compiled estimator looks like from outside: one sample live, or a whole log."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar, cast

import msgspec
import numpy as np

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
Result = TypeVar("Result")


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
    """The compiled functions of one estimator."""

    declaration: type[State]
    start: Callable[[State, Gains], None]
    imu: Callable[..., None]
    """`(state, gains, time_us, *imu_row)`."""
    baro: Callable[[State, Gains, float], None]
    gps: Callable[[State, Gains, int, FloatArray], None]
    write_output: Callable[[State, FloatArray], None]
    """Writes the output row."""
    run: Callable[..., None]
    """`(state, gains, *arrays of a SampleLog, output)`."""


class RecordHandle(Generic[State]):
    """A record as machine code is handed it, by the address of its bytes.

    Compiled code asks a record for its `data`, and numpy's own answer describes all the fields
    anew on every call, which takes several times as long as the work.

    Parameters
    ----------
    record : record
        Stays the same memory for good; another record needs another `RecordHandle`.
    """

    __slots__ = ("data", "record")

    def __init__(self, record: State) -> None:
        self.record = record
        self.data = memoryview(cast(Any, record)).cast("B")


def direct(function: Callable[..., Result]) -> Callable[..., Result]:
    """Find the machine code behind a dispatcher that has compiled for one signature.

    The dispatcher looks the type of every argument up on every call, which for records of many
    fields takes longer than the work. The caller must keep to the types of the first call, and
    hands records over as `RecordHandle`.
    """
    overloads = getattr(function, "overloads", {})
    if len(overloads) != 1:
        return lambda *args: function(
            *(a.record if isinstance(a, RecordHandle) else a for a in args)
        )
    code: Callable[..., Result] = next(iter(overloads.values())).entry_point
    return code


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
        self._gains_handle = RecordHandle(gains)
        self._reference = reference
        self._earth = EarthField(reference)
        self._row = np.empty(NAV_COLUMNS)
        self._state = new_record(kernels.declaration)
        kernels.start(self._state, gains)
        # A first call on a scrap state compiles, or loads, what `direct` then finds.
        scrap = copy_record(self._state)
        kernels.imu(scrap, gains, 0, *([0.0] * IMU_COLUMNS))
        kernels.baro(scrap, gains, 0.0)
        kernels.gps(scrap, gains, 0, np.zeros(GPS_COLUMNS))
        kernels.write_output(scrap, self._row)
        self._imu, self._baro = direct(kernels.imu), direct(kernels.baro)
        self._gps, self._write_output = direct(kernels.gps), direct(kernels.write_output)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._earth.reset()
        self._state = new_record(self._kernels.declaration)
        self._kernels.start(self._state, self._gains)

    @property
    def _state(self) -> State:
        return self._handle.record

    @_state.setter
    def _state(self, record: State) -> None:
        self._handle = RecordHandle(record)

    @property
    def state(self) -> State:
        """A copy of all that the kernel remembers; may be set back."""
        return copy_record(self._state)

    @state.setter
    def state(self, state: State) -> None:
        if getattr(state, "dtype", None) != getattr(self._state, "dtype", None):
            raise TypeError(f"not a state of this estimator: {type(state)}")
        self._state = copy_record(state)

    def snapshot(self) -> bytes:
        """Write down all that is remembered, the place on the Earth included."""
        return msgspec.msgpack.encode((pack_record(self._state), self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot; raises ValueError if it is none of this estimator."""
        kind = tuple[Packed, EarthPlace | None]
        packed, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._state = unpack_record(self._kernels.declaration, packed)

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
        self._imu(self._handle, self._gains_handle, sample.time_us, *imu_row(sample))
        self._write_output(self._handle, self._row)
        return nav_state(sample.time_us, self._row)

    def update_baro(self, sample: BaroSample) -> None:
        """Take in one barometer sample.

        Parameters
        ----------
        sample : BaroSample
            Its pressure altitude is used.
        """
        self._baro(self._handle, self._gains_handle, sample.alt_pressure_m)

    def update_gps(self, fix: GpsFix) -> None:
        """Take in one GPS fix at its arrival.

        Parameters
        ----------
        fix : GpsFix
            Fused as of the time it was valid.
        """
        row = gps_row(fix, self._reference, self._earth)
        self._gps(self._handle, self._gains_handle, fix.time_us, np.array(row))

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
        self._kernels.run(
            self._state,
            self._gains,
            log.imu_time_us,
            log.imu,
            log.baro_time_us,
            log.baro_alt_m,
            log.gps_time_us,
            log.gps,
            out,
        )
        return out
