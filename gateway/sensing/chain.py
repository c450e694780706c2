"""The sensing stage of one aircraft: raw records in, calibrated and filtered samples out."""

import math
from functools import cache
from typing import Annotated, Final

import msgspec
import numpy as np

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.records import (
    UNKNOWN_VEC3,
    BaroRaw,
    BaroSample,
    ImuCalibrated,
    ImuFlags,
    ImuRaw,
    ImuSample,
    Vec3,
)
from gateway.sensing.calibration import (
    IDENTITY3,
    Correction,
    NodeCalibration,
    accel_from_counts,
    gyro_from_counts,
    mag_from_counts,
    new_field_ut,
    temperature_from_counts,
    vectors_from_counts,
)
from gateway.sensing.filters import (
    Coefficients,
    FilterState,
    FloatArray,
    Kind,
    VectorFilter,
    design_highpass,
    design_lowpass,
)
from gateway.sensing.imu_log import ImuLog, IntArray
from gateway.settings import Settings, setting
from gateway.units import US_PER_S

GAP_US: Final = 500_000
"""After a longer gap the filters are reset."""
RATE_WINDOW: Final = 64
"""Samples over which the sample rate is averaged; time stamps jitter by the radio's retries."""
RETUNE_RATIO: Final = 0.1
"""Difference of measured and designed rate that makes a new design worth its small step."""

BLANK: Final = (0, 0, 0)
"""The accelerometer's counts after a reset of the MPU6050; its gyroscope gives none then either."""
_Memory = tuple[float, FilterState | None, FilterState | None, int | None, tuple[int, int]]
"""Rate, low-pass, high-pass, time of the last sample, window of the rate."""


class SensingSettings(Settings, frozen=True):
    """The filters that the gateway applies where a node has not."""

    accel_filter: Annotated[
        Kind, setting("Second-order low-pass on the acceleration: butterworth or chebyshev.")
    ] = "butterworth"
    accel_cutoff_hz: Annotated[
        float, setting("Cutoff of the acceleration's low-pass.", "Hz", ge=0.1, le=500.0)
    ] = 10.0
    chebyshev_ripple_db: Annotated[
        float, setting("Ripple of the Chebyshev filter's pass band.", "dB", ge=0.01, le=6.0)
    ] = 1.0
    gyro_highpass_hz: Annotated[
        float,
        setting(
            "Cutoff of the angular rate's first-order high-pass; 0 for none. It removes the steady "
            "rate of a long turn like a bias. Only the paper's estimator uses it.",
            "Hz",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    nominal_rate_hz: Annotated[
        float,
        setting("IMU rate to design for until the true one is measured.", "Hz", ge=1.0, le=2000.0),
    ] = 100.0


class SensorChain:
    """Calibrate and filter the samples of one aircraft; never raises on data.

    Parameters
    ----------
    settings : SensingSettings
        The filters.
    calibration : NodeCalibration
        The IMU node's errors and mounting.
    """

    def __init__(self, settings: SensingSettings, calibration: NodeCalibration) -> None:
        self._settings = settings
        cal = calibration
        self._accel = Correction(cal.mounting, cal.accel_matrix, cal.accel_bias_mps2)
        self._gyro = Correction(cal.mounting, IDENTITY3, cal.gyro_bias_radps)
        self._mag = Correction(cal.mag_mounting, cal.mag_soft_iron, cal.mag_hard_iron_ut)
        self._added_flags = cal.missing
        self.reset()

    def reset(self) -> None:
        """Clear the filters' state but keep the settings."""
        self._rate_hz = self._settings.nominal_rate_hz
        self._lowpass = VectorFilter(self._design_lowpass, self._rate_hz)
        self._highpass = VectorFilter(self._design_highpass, self._rate_hz)
        self._last_us: int | None = None
        self._window: tuple[int, int] = (0, 0)

    def snapshot(self) -> bytes:
        """Return the whole state as bytes."""
        memory = (self._rate_hz, self._lowpass.state, self._highpass.state)
        return msgspec.msgpack.encode((*memory, self._last_us, self._window))

    def restore(self, snapshot: bytes) -> None:
        """Restore a snapshot; raises ValueError if it is invalid."""
        rate_hz, lowpass, highpass, self._last_us, self._window = msgspec.msgpack.decode(
            snapshot, type=_Memory
        )
        self._rate_hz = rate_hz
        self._lowpass = VectorFilter(self._design_lowpass, rate_hz)
        self._highpass = VectorFilter(self._design_highpass, rate_hz)
        self._lowpass.state, self._highpass.state = lowpass, highpass

    @property
    def rate_hz(self) -> float:
        """Sample rate for which the filters are designed now."""
        return self._rate_hz

    def imu(self, raw: ImuRaw) -> ImuSample:
        """Turn one IMU payload into a sample in body FRD.

        Parameters
        ----------
        raw : ImuRaw
            Counts in sensor axes.

        Returns
        -------
        ImuSample
            Calibrated SI values, unfiltered and filtered; NaN where the sensor could not be read.
        """
        accel = gyro = UNKNOWN_VEC3
        if raw.accel_raw != BLANK:
            accel = self._accel.apply(accel_from_counts(raw.accel_raw, raw.accel_range_g))
            gyro = self._gyro.apply(gyro_from_counts(raw.gyro_raw, raw.gyro_range_dps))
        mag = None
        if raw.flags & ImuFlags.MAG_NEW and not raw.flags & ImuFlags.MAG_ABSENT:
            counts = mag_from_counts(raw.mag_raw, raw.mag_lsb_per_gauss)
            mag = None if counts is None else self._mag.apply(counts)
        return self.imu_si(
            raw.time_us,
            accel,
            gyro,
            mag,
            temperature_from_counts(raw.temperature_raw),
            _joined_flags(raw.flags, self._added_flags),
        )

    def imu_calibrated(self, imu: ImuCalibrated) -> ImuSample:
        """Filter a sample that is calibrated already; see `imu_si`."""
        return self.imu_si(
            imu.time_us,
            imu.accel_b_mps2,
            imu.gyro_b_radps,
            imu.mag_b_ut,
            imu.temperature_degc,
            imu.flags,
        )

    def imu_si(
        self,
        time_us: int,
        accel_b_mps2: Vec3,
        gyro_b_radps: Vec3,
        mag_b_ut: Vec3 | None,
        temperature_degc: float,
        flags: ImuFlags,
    ) -> ImuSample:
        """Filter a sample that is calibrated already, such as one of another program's log.

        Parameters
        ----------
        time_us : int
            Gateway clock.
        accel_b_mps2, gyro_b_radps : tuple of 3 floats
            Specific force and angular rate in body FRD; a value that is not finite stays so in
            the sample but does not enter the filters.
        mag_b_ut : tuple of 3 floats or None
            Magnetic field in body FRD, None unless new.
        temperature_degc : float
            NaN if not known.
        flags : ImuFlags
            What is filtered already.

        Returns
        -------
        ImuSample
            The same values, unfiltered and filtered.
        """
        self._track_rate(time_us)
        accel_lowpass, gyro_highpass = accel_b_mps2, gyro_b_radps
        if not flags & ImuFlags.ACCEL_FILTERED:
            accel_lowpass = _filtered(self._lowpass, accel_b_mps2)
        if not flags & ImuFlags.GYRO_FILTERED:
            gyro_highpass = _filtered(self._highpass, gyro_b_radps)
        return ImuSample(
            time_us=time_us,
            accel_b_mps2=accel_b_mps2,
            gyro_b_radps=gyro_b_radps,
            accel_lowpass_b_mps2=accel_lowpass,
            gyro_highpass_b_radps=gyro_highpass,
            mag_b_ut=mag_b_ut,
            temperature_degc=temperature_degc,
            flags=flags,
        )

    def calibrated(
        self, counts: FloatArray, flags: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
        """Calibrate many IMU payloads without filtering them.

        Parameters
        ----------
        counts : ndarray, shape (n, 13)
            Whole numbers: three of the accelerometer, of the gyroscope and of the magnetometer,
            the temperature, and the three ranges, as in `ImuRaw`.
        flags : ndarray of int, shape (n,)
            `ImuFlags`.

        Returns
        -------
        accel, gyro, mag : ndarray, shape (n, 3)
            In m/s2, rad/s and uT, body FRD; the field NaN unless it is new, the others NaN where
            the node could not read them.
        temperature_degc : ndarray, shape (n,)
        flags : ndarray of int, shape (n,)
            Those given, and what the calibration adds.
        """
        accel = vectors_from_counts(accel_from_counts, counts[:, 0:3], counts[:, 10])
        gyro = vectors_from_counts(gyro_from_counts, counts[:, 3:6], counts[:, 11])
        blank = (counts[:, 0:3] == BLANK).all(axis=1)
        accel[blank] = gyro[blank] = np.nan
        return (
            self._accel.apply_all(accel),
            self._gyro.apply_all(gyro),
            self._mag.apply_all(new_field_ut(counts, flags)),
            temperature_from_counts(counts[:, 9]),
            flags | int(self._added_flags),
        )

    def imu_si_log(
        self,
        time_us: IntArray,
        accel_b_mps2: FloatArray,
        gyro_b_radps: FloatArray,
        mag_b_ut: FloatArray,
        temperature_degc: FloatArray,
        flags: IntArray,
    ) -> ImuLog:
        """Filter many samples that are calibrated already; bit for bit what `imu_si` gives.

        Parameters
        ----------
        time_us : ndarray of int, shape (n,)
            Gateway clock.
        accel_b_mps2, gyro_b_radps, mag_b_ut : ndarray, shape (n, 3)
            As `calibrated` returns them.
        temperature_degc : ndarray, shape (n,)
        flags : ndarray of int, shape (n,)
            `ImuFlags`.
        """
        accel, gyro = self.filter_log(time_us, accel_b_mps2, gyro_b_radps, flags)
        return ImuLog(
            time_us, accel_b_mps2, gyro_b_radps, accel, gyro, mag_b_ut, temperature_degc, flags
        )

    def filter_log(
        self,
        time_us: IntArray,
        accel_b_mps2: FloatArray,
        gyro_b_radps: FloatArray,
        flags: IntArray | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Filter a whole log; bit for bit what `imu_si` gives for its samples.

        Parameters
        ----------
        time_us : ndarray of int, shape (n,)
            Gateway clock.
        accel_b_mps2, gyro_b_radps : ndarray, shape (n, 3)
            Specific force and angular rate in body FRD.
        flags : ndarray of int, shape (n,), optional
            Tell what is filtered already; by default nothing.

        Returns
        -------
        accel, gyro : ndarray, shape (n, 3)
            After the low-pass and the high-pass.
        """
        flags = np.zeros(len(time_us), np.int64) if flags is None else flags
        accel, gyro = accel_b_mps2.copy(), gyro_b_radps.copy()
        bare_accel = (flags & int(ImuFlags.ACCEL_FILTERED)) == 0
        bare_gyro = (flags & int(ImuFlags.GYRO_FILTERED)) == 0
        begin = 0
        for k, now_us in enumerate([*time_us.tolist(), None]):
            rate_hz = None if now_us is None else self._rate_to_restart_with(now_us)
            if now_us is not None and rate_hz is None:
                continue
            # The filters run without a break up to here.
            for chosen, values, vector_filter in (
                (bare_accel, accel, self._lowpass),
                (bare_gyro, gyro, self._highpass),
            ):
                part = begin + np.flatnonzero(chosen[begin:k])
                values[part] = _filtered_array(vector_filter, values[part])
            begin = k
            if rate_hz is not None:
                self._restart(rate_hz)
        return accel, gyro

    def baro(self, raw: BaroRaw) -> BaroSample:
        """Add the pressure altitude to a barometer payload.

        It is above the 1013.25 hPa level, m; NaN for no pressure.
        """
        return BaroSample(
            time_us=raw.time_us,
            pressure_pa=raw.pressure_pa,
            temperature_degc=raw.temperature_degc,
            alt_pressure_m=pressure_altitude_m(raw.pressure_pa),
        )

    def _design_lowpass(self, rate_hz: float) -> Coefficients:
        s = self._settings
        return design_lowpass(s.accel_filter, s.accel_cutoff_hz, rate_hz, s.chebyshev_ripple_db)

    def _design_highpass(self, rate_hz: float) -> Coefficients:
        return design_highpass(self._settings.gyro_highpass_hz, rate_hz)

    def _track_rate(self, time_us: int) -> None:
        """Measure the sample rate; reset the filters after a gap, redesign them if it changed."""
        rate_hz = self._rate_to_restart_with(time_us)
        if rate_hz is not None:
            self._restart(rate_hz)

    def _restart(self, rate_hz: float) -> None:
        """Redesign the filters for another rate, or reset them if it is the same."""
        if rate_hz == self._rate_hz:
            self._lowpass.reset()
            self._highpass.reset()
            return
        self._rate_hz = rate_hz
        self._lowpass.retune(rate_hz)
        self._highpass.retune(rate_hz)

    def _rate_to_restart_with(self, time_us: int) -> float | None:
        """Measure the rate, Hz; return it where it changed, the old one after a gap, else None."""
        last, self._last_us = self._last_us, time_us
        if last is None:
            return None
        dt_us = time_us - last
        if not 0 < dt_us <= GAP_US:
            self._window = (0, 0)
            return self._rate_hz if abs(dt_us) > GAP_US else None
        count, total_us = self._window[0] + 1, self._window[1] + dt_us
        if count == RATE_WINDOW:
            measured_hz = count * US_PER_S / total_us
            self._window = (0, 0)
            changed = abs(measured_hz - self._rate_hz) > RETUNE_RATIO * self._rate_hz
            return measured_hz if changed else None
        self._window = (count, total_us)
        return None


@cache
def _joined_flags(flags: ImuFlags, more: ImuFlags) -> ImuFlags:
    """Join two sets of flags; they are the same for many samples, and a lookup costs a tenth."""
    return flags | more


def _filtered(vector_filter: VectorFilter, v: Vec3) -> Vec3:
    """Filter a finite vector; repeat the last output for one that is not finite."""
    if math.isfinite(v[0]) and math.isfinite(v[1]) and math.isfinite(v[2]):
        return vector_filter.step(v)
    return v if vector_filter.state is None else vector_filter.state[1]


def _filtered_array(vector_filter: VectorFilter, values: FloatArray) -> FloatArray:
    """Do what `_filtered` does, for vectors of shape (n, 3)."""
    finite = np.isfinite(values).all(axis=1)
    if finite.all():
        return vector_filter.run(values)
    return np.array([_filtered(vector_filter, (v[0], v[1], v[2])) for v in values.tolist()])
