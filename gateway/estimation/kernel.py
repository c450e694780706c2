"""What a compiled estimator looks like from outside: one sample live, or a whole log."""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, Generic, TypeVar, cast

import msgspec
import numpy as np

from gateway.compiled import address_of
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation.alignment.gps_latency import LatencyState
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

_ROW: Final = struct.Struct(f"={IMU_COLUMNS}d")
"""Fills the row of one sample in half the time that numpy takes for a tuple."""

Heard = tuple[int, BaroSample | GpsFix]
"""A height or a fix, and the number of the IMU sample before which it arrived."""

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
    """`(state, gains, count, imu_time_us, imu, count, baro_before, baro_alt_m, count, gps_before,
    gps_time_us, gps, output_rows)`; before which sample each height and each fix is taken."""
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
        self._row_view = self._row.data
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
    def gps_latency_s(self) -> tuple[float, float]:
        """The latency in use, which the motion may have corrected, and the one that is set."""
        used_s = float(cast(LatencyState, self._state).gps_latency_s)
        return used_s, self._reference.gps_latency_s

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
        self._time_us[0] = sample.time_us
        _ROW.pack_into(self._row_view, 0, *imu_row(sample))
        self._kernels.imus(
            self._at, self._gains_at, 1, self._time_at, self._row_at, self._output_at
        )
        return nav_state(sample.time_us, self._output)

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
        return self._run(
            log,
            _taken_before(log.imu_time_us, log.baro_time_us),
            _taken_before(log.imu_time_us, log.gps_time_us),
        )

    def _run(self, log: SampleLog, baro_before: IntArray, gps_before: IntArray) -> FloatArray:
        """Run the compiled loop; see `Kernels.run`."""
        out = np.empty((len(log.imu_time_us), NAV_COLUMNS))
        kinds = (
            (log.imu_time_us, log.imu),
            (baro_before, log.baro_alt_m),
            (gps_before, log.gps_time_us, log.gps),
        )
        # Their addresses hold only while the arrays are kept.
        arrays = [[*map(np.ascontiguousarray, kind)] for kind in kinds]
        arguments = [number for kind in arrays for number in (len(kind[0]), *map(address_of, kind))]
        self._kernels.run(self._at, self._gains_at, *arguments, address_of(out))
        return out

    def run_as_heard(
        self, time_us: IntArray, imu: FloatArray, heard: Sequence[Heard]
    ) -> FloatArray:
        """Advance over samples and what arrived between them, in the order of arrival.

        Parameters
        ----------
        time_us : ndarray, shape (n,)
            Of the IMU samples.
        imu : ndarray, shape (n, IMU_COLUMNS)
        heard : sequence of tuple
            Heights and fixes in their order, each with the number of the sample before which it
            arrived: up to n.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            One row per IMU sample.
        """
        # The compiled loop takes heights first: it is interrupted where one came after a fix.
        cuts = {k for (k, a), (m, b) in pairwise(heard) if k == m and _is_fix(a) > _is_fix(b)}
        pieces = []
        begin = 0
        for end in [*sorted(cuts - {len(time_us)}), len(time_us)]:
            within = [(k - begin, r) for k, r in heard if begin <= k < end and k not in cuts]
            pieces.append(self._run_piece(time_us[begin:end], imu[begin:end], within))
            for k, record in heard:
                if k == end:
                    self._take(record)
            begin = end
        return np.concatenate(pieces)

    def _run_piece(self, time_us: IntArray, imu: FloatArray, heard: Sequence[Heard]) -> FloatArray:
        heights = [(k, r.alt_pressure_m) for k, r in heard if isinstance(r, BaroSample)]
        fixes = [(k, r.time_us, self.fix_row(r)) for k, r in heard if isinstance(r, GpsFix)]
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


def _is_fix(record: BaroSample | GpsFix) -> bool:
    return isinstance(record, GpsFix)


def _taken_before(imu_time_us: IntArray, time_us: IntArray) -> IntArray:
    """Return before which IMU sample each of a queue is taken: the first that is not earlier."""
    reached = np.searchsorted(np.maximum.accumulate(imu_time_us), time_us)
    return np.maximum.accumulate(reached)
