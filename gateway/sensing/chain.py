"""The sensing stage of one aircraft: raw records in, calibrated samples out."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.records import (
    UNKNOWN_VEC3,
    BaroRaw,
    BaroSample,
    ImuCalibrated,
    ImuFlags,
    ImuRaw,
    ImuSample,
)
from gateway.sensing.calibration import (
    IDENTITY3,
    Correction,
    NodeCalibration,
    accel_scale,
    gyro_scale,
    mag_from_counts,
    new_field_ut,
    temperature_from_counts,
    vectors_from_counts,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BLANK: Final = (0, 0, 0)
"""The accelerometer's counts after a reset of the MPU6050, when its gyroscope is off as well."""
NEW_FIELD: Final = int(ImuFlags.MAG_NEW)
FIELD_FLAGS: Final = NEW_FIELD | int(ImuFlags.MAG_ABSENT)
ALL_FLAGS: Final = sum(map(int, ImuFlags))
"""All flags as an int: testing one costs a sixth, and hashing an enumeration calls Python."""


@dataclass(frozen=True, slots=True)
class ImuLog:
    """`ImuSample` as columns; vectors have the shape (n, 3)."""

    time_us: IntArray
    accel_b_mps2: FloatArray
    gyro_b_radps: FloatArray
    mag_b_ut: FloatArray
    """NaN unless newly sampled."""
    temperature_degc: FloatArray
    flags: IntArray
    """`ImuFlags`."""

    def __len__(self) -> int:
        return len(self.time_us)

    def samples(self) -> list[ImuSample]:
        """Return the single samples."""
        has_mag = ~np.isnan(self.mag_b_ut[:, 0])
        return [
            ImuSample(time_us, accel, gyro, mag if new else None, degc, flags)
            for time_us, accel, gyro, mag, new, degc, flags in zip(
                self.time_us.tolist(),
                map(tuple, self.accel_b_mps2.tolist()),
                map(tuple, self.gyro_b_radps.tolist()),
                map(tuple, self.mag_b_ut.tolist()),
                has_mag.tolist(),
                self.temperature_degc.tolist(),
                map(ImuFlags, self.flags.tolist()),
                strict=True,
            )
        ]


class SensorChain:
    """Calibrate the samples of one aircraft; never raises on data."""

    def __init__(self, calibration: NodeCalibration) -> None:
        cal = calibration
        self._accel = Correction(cal.mounting, cal.accel_matrix, cal.accel_bias_mps2)
        self._gyro = Correction(cal.mounting, IDENTITY3, cal.gyro_bias_radps)
        self._mag = Correction(cal.mag_mounting, cal.mag_soft_iron, cal.mag_hard_iron_ut)
        self._added_flags = cal.missing | ImuFlags.MEANS
        self._flags: dict[int, ImuFlags] = {}

    def imu(self, raw: ImuRaw) -> ImuSample:
        """Turn one IMU payload into a sample in body FRD."""
        accel = gyro = UNKNOWN_VEC3
        if raw.accel_raw != BLANK:
            accel = self._accel.apply(raw.accel_raw, accel_scale(raw.accel_range_g))
            gyro = self._gyro.apply(raw.gyro_raw, gyro_scale(raw.gyro_range_dps))
        flags, mag = raw.flags, None
        if flags & FIELD_FLAGS == NEW_FIELD:
            field = mag_from_counts(raw.mag_raw, raw.mag_lsb_per_gauss)
            mag = None if field is None else self._mag.apply(field)
        return ImuSample(
            raw.time_us,
            accel,
            gyro,
            mag,
            temperature_from_counts(raw.temperature_raw),
            self._flags.get(flags & ALL_FLAGS) or self._join(flags),
        )

    def _join(self, flags: ImuFlags) -> ImuFlags:
        """Add the calibration's flags; cached, since they are the same for many samples."""
        joined = self._flags[flags & ALL_FLAGS] = flags | self._added_flags
        return joined

    def imu_calibrated(self, imu: ImuCalibrated) -> ImuSample:
        """Return a sample that is already calibrated, such as one of another program's log."""
        vectors = (imu.accel_b_mps2, imu.gyro_b_radps, imu.mag_b_ut)
        return ImuSample(imu.time_us, *vectors, imu.temperature_degc, imu.flags)

    def calibrated(
        self, counts: FloatArray, flags: IntArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
        """Calibrate many IMU payloads.

        Parameters
        ----------
        counts : ndarray, shape (n, 13)
            Integers: three of the accelerometer, of the gyroscope and of the magnetometer, the
            temperature, and the three ranges, as in `ImuRaw`.
        flags : ndarray of int, shape (n,)
            `ImuFlags`.

        Returns
        -------
        accel, gyro, mag : ndarray, shape (n, 3)
            In m/s2, rad/s and uT, body FRD; the field NaN unless it is new, the others NaN where
            the node could not read them.
        temperature_degc : ndarray, shape (n,)
        flags : ndarray of int, shape (n,)
            The given flags and those that the calibration adds.
        """
        accel = vectors_from_counts(accel_scale, counts[:, 0:3], counts[:, 10])
        gyro = vectors_from_counts(gyro_scale, counts[:, 3:6], counts[:, 11])
        blank = (counts[:, 0:3] == BLANK).all(axis=1)
        accel[blank] = gyro[blank] = np.nan
        return (
            self._accel.apply_all(accel),
            self._gyro.apply_all(gyro),
            self._mag.apply_all(new_field_ut(counts, flags)),
            temperature_from_counts(counts[:, 9]),
            flags | int(self._added_flags),
        )

    def baro(self, raw: BaroRaw) -> BaroSample:
        """Add the pressure altitude to a barometer payload.

        It is the height above the 1013.25 hPa level, m; NaN without a pressure.
        """
        alt_m = pressure_altitude_m(raw.pressure_pa)
        return BaroSample(raw.time_us, raw.pressure_pa, raw.temperature_degc, alt_m)
