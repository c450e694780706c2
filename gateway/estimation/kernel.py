"""The compiled estimator behind the interface of all: one sample live, or a whole log."""

import struct
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from itertools import pairwise
from operator import or_
from typing import Final

import msgspec
import numpy as np

from gateway.compiled import address_of
from gateway.estimation.columns import (
    GPS_COLUMNS,
    IMU_COLUMNS,
    NAV_COLUMNS,
    ROW_FLAGS,
    GpsRow,
    gps_row,
    imu_row,
    nav_state,
)
from gateway.estimation.eskf import filter as kernels
from gateway.estimation.eskf.latency import KNOWN_STD_S, latency_std, latency_to_use
from gateway.estimation.eskf.settings import EskfSettings, Gains, make_gains
from gateway.estimation.eskf.state import State
from gateway.estimation.record import (
    FloatArray,
    IntArray,
    Packed,
    copy_record,
    new_record,
    pack_record,
    unpack_record,
)
from gateway.estimation.reference import EarthField, EarthLocation, ReferenceSettings
from gateway.records import UNKNOWN_VEC3, BaroSample, GpsFix, ImuSample, NavState

_ROW: Final = struct.Struct(f"={IMU_COLUMNS}d")
"""Fills the row of one sample in half the time that numpy takes for a tuple."""

_ROW_FLAGS: Final = reduce(or_, map(int, ROW_FLAGS))
_FLAG_COLUMNS: Final[dict[int, tuple[float, ...]]] = {}
"""The last columns of a row by the flags that they show: they are the same for many samples."""

Aiding = tuple[int, BaroSample | GpsFix]
"""A height or a fix, and the number of the IMU sample before which it arrived."""


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
class FoundLatency:
    """A GPS latency that manoeuvres have shown."""

    latency_s: float
    std_s: float
    used_s: float
    """The same, or the set one where both agree."""


class KernelEstimator:
    """An estimator made of compiled kernels over one record of state.

    Parameters
    ----------
    gains : Gains
        A record of constants.
    reference : ReferenceSettings
        GPS latency and declination.
    """

    def __init__(self, gains: Gains, reference: ReferenceSettings) -> None:
        self._gains = gains
        self._gains_at = address_of(gains)
        self._reference = reference
        self._earth = EarthField(reference)
        self._time_us = np.zeros(1, np.int64)
        self._row, self._fix = np.zeros(IMU_COLUMNS), np.zeros(GPS_COLUMNS)
        self._output = np.empty(NAV_COLUMNS)
        # An item of an array is set five times slower.
        self._time_view, self._row_view = self._time_us.data, self._row.data
        self._time_at, self._row_at = address_of(self._time_us), address_of(self._row)
        self._fix_at, self._output_at = address_of(self._fix), address_of(self._output)
        self._begin()

    def reset(self) -> None:
        """Discard everything except the settings."""
        self._earth.reset()
        self._begin()

    def _begin(self) -> None:
        self._use(new_record(State))
        kernels.begin_state(self._at, self._gains_at)

    def _use(self, record: State) -> None:
        self._state, self._at = record, address_of(record)
        self._step = kernels.imu_steps.bound(
            self._at, self._gains_at, 1, self._time_at, self._row_at, self._output_at
        )

    @property
    def state(self) -> State:
        """A copy of the whole state; may be restored."""
        return copy_record(self._state)

    @state.setter
    def state(self, state: State) -> None:
        if getattr(state, "dtype", None) != getattr(self._state, "dtype", None):
            raise TypeError(f"not a state of this estimator: {type(state)}")
        self._use(copy_record(state))

    @property
    def gps_latency_s(self) -> tuple[float, float]:
        """The latency in use, which the motion may have corrected, and the one that is set."""
        used_s = float(self._state.gps_latency_s)
        return used_s, self._reference.gps_latency_s

    def latency_of(self, log: SampleLog) -> float:
        """Return the GPS latency of a whole log, s: the set one, or that shown by manoeuvres."""
        other = KernelEstimator(self._gains, self._reference)
        other.state = self._state
        other.run(log)
        found = other.found_latency()
        return self._reference.gps_latency_s if found is None else found.used_s

    def found_latency(self) -> "FoundLatency | None":
        """Return the GPS latency that manoeuvres have shown so far; None where none has."""
        std_s = latency_std(self._state)
        if std_s > KNOWN_STD_S:
            return None
        found_s = float(self._state.latency_found[0])
        return FoundLatency(found_s, std_s, latency_to_use(found_s, self._reference.gps_latency_s))

    @property
    def gains(self) -> Gains:
        """The record of constants."""
        return self._gains

    def snapshot(self) -> bytes:
        """Return the whole state, including the position on the Earth."""
        return msgspec.msgpack.encode((pack_record(self._state), self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Continue from a snapshot; raises ValueError for another estimator's."""
        kind = tuple[Packed, EarthLocation | None]
        packed, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._use(unpack_record(State, packed))

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
        self._time_view[0] = sample.time_us
        flags = sample.flags & _ROW_FLAGS
        _ROW.pack_into(
            self._row_view,
            0,
            *sample.accel_b_mps2,
            *sample.gyro_b_radps,
            *(sample.mag_b_ut or UNKNOWN_VEC3),
            *(_FLAG_COLUMNS.get(flags) or _flag_columns(sample)),
        )
        self._step()
        return nav_state(sample.time_us, self._output)

    def update_baro(self, sample: BaroSample) -> None:
        """Use one barometer sample.

        Parameters
        ----------
        sample : BaroSample
            Its pressure altitude is used.
        """
        kernels.baro_step(self._at, self._gains_at, sample.alt_pressure_m)

    def update_gps(self, fix: GpsFix) -> None:
        """Use one GPS fix at its arrival.

        Parameters
        ----------
        fix : GpsFix
            Fused as of the time it was valid.
        """
        self._fix[:] = gps_row(fix, self._reference, self._earth)
        kernels.gps_step(self._at, self._gains_at, fix.time_us, self._fix_at)

    def fix_row(self, fix: GpsFix) -> GpsRow:
        """Lay out one fix of a log that is to be run as arrays."""
        return gps_row(fix, self._reference, self._earth)

    def run(self, log: SampleLog) -> FloatArray:
        """Advance over a whole log, with the same bits as sample by sample.

        Parameters
        ----------
        log : SampleLog
            At each IMU sample, the barometer samples and fixes that are not later come first.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        return self._run(
            log,
            _taken_before(log.imu_time_us, log.baro_time_us),
            _taken_before(log.imu_time_us, log.gps_time_us),
        )

    def _run(self, log: SampleLog, baro_before: IntArray, gps_before: IntArray) -> FloatArray:
        """Run the compiled loop; see `filter.run`."""
        out = np.empty((len(log.imu_time_us), NAV_COLUMNS))
        kinds = (
            (log.imu_time_us, log.imu),
            (baro_before, log.baro_alt_m),
            (gps_before, log.gps_time_us, log.gps),
        )
        # Their addresses hold only while the arrays are kept.
        arrays = [[*map(np.ascontiguousarray, kind)] for kind in kinds]
        arguments = [number for kind in arrays for number in (len(kind[0]), *map(address_of, kind))]
        kernels.run(self._at, self._gains_at, *arguments, address_of(out))  # type: ignore[call-arg]
        return out

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
            Of the IMU samples.
        imu : ndarray, shape (n, IMU_COLUMNS)
        aiding : sequence of tuple
            Heights and fixes in their order, each with the number of the sample before which it
            arrived: up to n.
        on_fix : callable, optional
            Called after each fix.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        # The compiled loop takes heights first: it is interrupted where one came after a fix.
        cuts = {k for (k, a), (m, b) in pairwise(aiding) if k == m and _is_fix(a) > _is_fix(b)}
        if on_fix is not None:
            cuts = {k for k, record in aiding if _is_fix(record)}
        pieces = []
        begin = taken = 0
        for end in [*sorted(cuts - {len(time_us)}), len(time_us)]:
            until = bisect_left(aiding, end, taken, key=_sample_of)
            within = [(k - begin, record) for k, record in aiding[taken:until]]
            pieces.append(self._run_piece(time_us[begin:end], imu[begin:end], within))
            begin, taken = end, bisect_right(aiding, end, until, key=_sample_of)
            for _, record in aiding[until:taken]:
                self._take(record)
                if on_fix is not None and _is_fix(record):
                    on_fix()
        return np.concatenate(pieces)

    def _run_piece(
        self, time_us: IntArray, imu: FloatArray, aiding: Sequence[Aiding]
    ) -> FloatArray:
        heights = [(k, r.alt_pressure_m) for k, r in aiding if isinstance(r, BaroSample)]
        fixes = [(k, r.time_us, self.fix_row(r)) for k, r in aiding if isinstance(r, GpsFix)]
        log = SampleLog(
            imu_time_us=time_us,
            imu=imu,
            baro_time_us=np.empty(0, np.int64),
            baro_alt_m=np.array([alt_m for _, alt_m in heights], np.float64),
            gps_time_us=np.array([arrival_us for _, arrival_us, _ in fixes], np.int64),
            gps=np.array([row for *_, row in fixes], np.float64).reshape(-1, GPS_COLUMNS),
        )
        baro_before = np.array([k for k, _ in heights], np.int64)
        return self._run(log, baro_before, np.array([k for k, *_ in fixes], np.int64))

    def _take(self, record: BaroSample | GpsFix) -> None:
        if isinstance(record, BaroSample):
            self.update_baro(record)
        else:
            self.update_gps(record)


def _flag_columns(sample: ImuSample) -> tuple[float, ...]:
    """Return the columns of a sample's row that show its flags, and keep them."""
    columns = _FLAG_COLUMNS[sample.flags & _ROW_FLAGS] = imu_row(sample)[-len(ROW_FLAGS) :]
    return columns


def _sample_of(aiding: Aiding) -> int:
    return aiding[0]


def _is_fix(record: BaroSample | GpsFix) -> bool:
    return isinstance(record, GpsFix)


def _taken_before(imu_time_us: IntArray, time_us: IntArray) -> IntArray:
    """Return before which IMU sample each of a queue is taken: the first that is not earlier."""
    reached = np.searchsorted(np.maximum.accumulate(imu_time_us), time_us)
    return np.maximum.accumulate(reached)


def estimate_latency(log: SampleLog) -> FoundLatency | None:
    """Estimate the time from the moment for which fixes are valid to their arrival.

    Parameters
    ----------
    log : SampleLog
        A whole flight; the velocities of its fixes are used.

    Returns
    -------
    FoundLatency or None
        None where no manoeuvre shows it, or the fixes have no velocity.
    """
    reference = ReferenceSettings()
    estimator = KernelEstimator(make_gains(EskfSettings(), reference), reference)
    estimator.run(log)
    return estimator.found_latency()
