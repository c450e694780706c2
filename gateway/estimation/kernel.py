"""The compiled estimators with the common interface: one sample live, or a whole log."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from gateway.compiled import address_of
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation import columns as col
from gateway.estimation import record as rec
from gateway.estimation.eskf import filter as kernels
from gateway.estimation.eskf.latency import KNOWN_STD_S, latency_std, latency_to_use
from gateway.estimation.eskf.settings import Gains
from gateway.estimation.eskf.state import State
from gateway.estimation.record import FloatArray, IntArray
from gateway.estimation.reference import EarthField, EarthLocation, ReferenceSettings
from gateway.records import BaroSample, GpsFix, ImuSample, NavState

_ROW: Final = struct.Struct(f"={col.IMU_COLUMNS}d")
"""Writes the row of one sample in half the time that numpy needs for a tuple."""

Aiding = tuple[int, BaroSample | GpsFix]
"""A height or a fix, with the number of the IMU sample before which it arrived."""


@dataclass(frozen=True, slots=True)
class SampleLog:
    """A whole log as arrays; each kind in the order of time."""

    imu_time_us: IntArray
    imu: FloatArray
    """Shape (n, IMU_COLUMNS)."""
    baro_time_us: IntArray
    baro_alt_m: FloatArray
    gps_time_us: IntArray
    """Time of arrival."""
    gps: FloatArray
    """Shape (m, GPS_COLUMNS)."""


def log_arrays(log: SampleLog) -> tuple[SampleLog, kernels.LogArrays]:
    """Return a log with contiguous arrays, and their addresses, valid while the arrays exist."""
    log = SampleLog(*(np.ascontiguousarray(getattr(log, field.name)) for field in fields(log)))
    numbers = {field.name: address_of(getattr(log, field.name)) for field in fields(log)}
    numbers["imu_count"] = len(log.imu_time_us)
    numbers["baro_count"] = len(log.baro_time_us)
    numbers["gps_count"] = len(log.gps_time_us)
    return log, rec.filled_record(kernels.LogArrays, numbers)


class FoundLatency(NamedTuple):
    """A GPS latency that was estimated in manoeuvres."""

    latency_s: float
    std_s: float


class Kernels(NamedTuple):
    """The state record of an estimator, and its entry points, which take state and gains."""

    state: type
    begin_state: EntryPoint[[int, int]]
    imu_steps: EntryPoint[[int, int, int, int, int, int]]
    gps_step: EntryPoint[[int, int, int, int]]
    baro_step: EntryPoint[[int, int, float]] | None = None
    """None if the estimator does not use a barometer."""


class CompiledEstimator:
    """An estimator of compiled kernels with one state record.

    Parameters
    ----------
    kernels : Kernels
    gains : object
        A record of constants.
    reference : ReferenceSettings
        GPS latency and declination.
    """

    def __init__(self, kernels: Kernels, gains: Any, reference: ReferenceSettings) -> None:
        self._kernels, self.gains = kernels, gains
        self._gains_at = address_of(gains)
        self._reference = reference
        self._earth = EarthField(reference)
        self._time_us = np.zeros(1, np.int64)
        self._row, self._fix = np.zeros(col.IMU_COLUMNS), np.zeros(col.GPS_COLUMNS)
        self._output = np.empty(col.NAV_COLUMNS)
        # Setting an item of an array would take five times as long.
        self._time_view, self._row_view = self._time_us.data, self._row.data
        self._time_at, self._row_at = address_of(self._time_us), address_of(self._row)
        self._fix_at, self._output_at = address_of(self._fix), address_of(self._output)
        self._begin()

    def reset(self) -> None:
        """Discard everything except the settings."""
        self._earth.reset()
        self._begin()

    def _begin(self) -> None:
        self._use(rec.new_record(self._kernels.state))
        self._kernels.begin_state(self._at, self._gains_at)

    def _use(self, record: Any) -> None:
        self._state, self._at = record, address_of(record)
        self._step = self._kernels.imu_steps.bound(
            self._at, self._gains_at, 1, self._time_at, self._row_at, self._output_at
        )

    def snapshot(self) -> bytes:
        """Return the complete state, including the position on the Earth."""
        return msgspec.msgpack.encode((rec.pack_record(self._state), self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Continue from a snapshot; raises ValueError for another estimator's."""
        kind = tuple[rec.Packed, EarthLocation | None]
        packed, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._use(rec.unpack_record(self._kernels.state, packed))

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample, and return the state at its time; see `select.Estimator`."""
        self._time_view[0] = sample.time_us
        _ROW.pack_into(self._row_view, 0, *col.imu_row(sample))
        self._step()
        return col.nav_state(sample.time_us, self._output)

    def update_baro(self, sample: BaroSample) -> None:
        """Use one barometer sample; only the Kalman filter does."""
        if (step := self._kernels.baro_step) is not None:
            step(self._at, self._gains_at, sample.alt_pressure_m)

    def update_gps(self, fix: GpsFix) -> None:
        """Use one GPS fix at its arrival; it is compared with the state at its time of validity."""
        self._fix[:] = col.gps_row(fix, self._reference, self._earth)
        self._kernels.gps_step(self._at, self._gains_at, fix.time_us, self._fix_at)

    def fix_row(self, fix: GpsFix) -> col.GpsRow:
        """Return the row of one fix of a log that is processed as arrays."""
        return col.gps_row(fix, self._reference, self._earth)

    def run_in_arrival_order(
        self,
        time_us: IntArray,
        imu: FloatArray,
        aiding: Sequence[Aiding],
        on_fix: Callable[[], None] | None = None,
    ) -> FloatArray:
        """Advance over samples, and heights and fixes between them, in the order of arrival.

        Parameters
        ----------
        time_us : ndarray, shape (n,)
            Times of the IMU samples.
        imu : ndarray, shape (n, IMU_COLUMNS)
        aiding : sequence of tuple
            Heights and fixes in order, each with the number (up to n) of the sample before which it
            arrived.
        on_fix : callable, optional
            Called after each fix.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        arrays = (
            np.ascontiguousarray(time_us),
            np.ascontiguousarray(imu),
            np.empty((len(time_us), col.NAV_COLUMNS)),
        )
        starts = [(address_of(array), array.strides[0]) for array in arrays]
        begin = 0
        for end, record in (*aiding, (len(time_us), None)):
            if end > begin:
                rows = (start + begin * size for start, size in starts)
                self._kernels.imu_steps(self._at, self._gains_at, end - begin, *rows)
                begin = end
            if isinstance(record, BaroSample):
                self.update_baro(record)
            elif isinstance(record, GpsFix):
                self.update_gps(record)
                if on_fix is not None:
                    on_fix()
        return arrays[2]


ESKF: Final = Kernels(
    State, kernels.begin_state, kernels.imu_steps, kernels.gps_step, kernels.baro_step
)


class KernelEstimator(CompiledEstimator):
    """The Kalman filter; its parameters are those of `CompiledEstimator`."""

    _state: State
    gains: Gains

    def __init__(self, gains: Gains, reference: ReferenceSettings) -> None:
        super().__init__(ESKF, gains, reference)

    @property
    def state(self) -> State:
        """A copy of the state."""
        return rec.copy_record(self._state)

    @property
    def gps_latency_s(self) -> tuple[float, float]:
        """The latency in use, which may be corrected by motion, and that of the settings."""
        used_s = float(self._state.gps_latency_s)
        return used_s, self._reference.gps_latency_s

    def latency_of(self, log: SampleLog) -> float:
        """Return the GPS latency of a whole log, s: the set or the estimated one."""
        other = KernelEstimator(self.gains, self._reference)
        other.restore(self.snapshot())
        other.run(log)
        found, set_s = other.found_latency(), self._reference.gps_latency_s
        return set_s if found is None else latency_to_use(found.latency_s, set_s)

    def found_latency(self) -> FoundLatency | None:
        """Return the GPS latency estimated in manoeuvres so far; None if there is no estimate."""
        std_s = latency_std(self._state)
        if std_s > KNOWN_STD_S:
            return None
        return FoundLatency(float(self._state.latency_found[0]), std_s)

    def run(self, log: SampleLog) -> FloatArray:
        """Advance over a whole log, with exactly the same result as sample by sample.

        Parameters
        ----------
        log : SampleLog
            Before each IMU sample, the barometer samples and fixes that are not later are used.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        out = np.empty((len(log.imu_time_us), col.NAV_COLUMNS))
        log, arrays = log_arrays(log)
        kernels.run(self._at, self._gains_at, address_of(arrays), address_of(out))
        return out
