"""A stretch of calibrated IMU samples as arrays."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gateway.records import ImuFlags, ImuSample

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ImuLog:
    """The columns of as many `ImuSample`; vectors have the shape (n, 3)."""

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
        """Return them one by one."""
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
