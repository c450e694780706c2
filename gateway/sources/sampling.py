"""Times and counts of samples that a source sends in SI units.

A calibration applies to counts in sensor axes, and recordings store counts, so that they can be
calibrated and fused again. SI values are therefore converted to counts of a fine fixed scale, a
tenth of the noise of usual sensors: 0.6 mm/s2, 0.008 deg/s and 0.01 uT.
"""

import math
from typing import Any, Final

from gateway.records import NAN, GpsFix, GpsFixType, ImuFlags, ImuRaw, Int3, NodeId, Vec3
from gateway.units import DEGE7_PER_DEG, US_PER_S
from gateway.wire.timesync import WRAP_MASK, ClockTracker

ACCEL_RANGE_G: Final = 2
GYRO_RANGE_DPS: Final = 250
MAG_LSB_PER_GAUSS: Final = 10_000
COUNTS_PER_MPS2: Final = 32768.0 / (ACCEL_RANGE_G * 9.80665)
COUNTS_PER_DPS: Final = 131.0
COUNTS_PER_UT: Final = MAG_LSB_PER_GAUSS / 100.0
MAX_COUNTS: Final = 1 << 30
"""Maximum number of counts, beyond the range of any sensor."""
OVERFLOW: Final = -4096
"""Value with which boards mark an overflow of the magnetometer; a real value is moved by one."""
ROOM_TEMPERATURE: Final = round((25.0 - 36.53) * 340.0)
"""Counts of the IMU's temperature (25 deg C) if none is measured."""
MAX_AHEAD_US: Final = 50_000
PACE_WEIGHT: Final = 8


def imu_raw(
    time_us: int,
    node: NodeId,
    accel_mps2: Vec3,
    gyro_dps: Vec3,
    mag_ut: Vec3 | None = None,
    temperature_degc: float = NAN,
) -> ImuRaw | None:
    """Convert a sample in SI and sensor axes to counts; None if a value is not finite or absurd."""
    accel, gyro = _counts(accel_mps2, COUNTS_PER_MPS2), _counts(gyro_dps, COUNTS_PER_DPS)
    mag = None if mag_ut is None else _counts(mag_ut, COUNTS_PER_UT)
    if accel is None or gyro is None:
        return None
    if mag is not None:
        x, y, z = (count + (count == OVERFLOW) for count in mag)
        mag = (x, y, z)
    known = math.isfinite(temperature_degc)
    return ImuRaw(
        time_us,
        node,
        time_us & WRAP_MASK,
        # All zero would mean a sensor that could not be read.
        accel if any(accel) else (0, 0, -1),
        gyro,
        mag or (0, 0, 0),
        round((temperature_degc - 36.53) * 340.0) if known else ROOM_TEMPERATURE,
        ACCEL_RANGE_G,
        GYRO_RANGE_DPS,
        MAG_LSB_PER_GAUSS,
        ImuFlags(0) if mag is None else ImuFlags.MAG_NEW,
    )


def _counts(values: Vec3, per_unit: float) -> Int3 | None:
    x, y, z = (value * per_unit for value in values)
    if not max(abs(x), abs(y), abs(z)) < MAX_COUNTS:
        return None
    return (round(x), round(y), round(z))


class SampleClock:
    """Strictly increasing times of a source's samples, from its own clock or from their arrival."""

    def __init__(self) -> None:
        self._tracker = ClockTracker()
        self._last_us = 0
        self._period_us = 0

    def own(self, stamp_us: int, arrival_us: int) -> int:
        """Return the time of a sample with a timestamp of the source's clock."""
        return self.after_last(self.local(stamp_us, arrival_us))

    def local(self, stamp_us: int, arrival_us: int) -> int:
        """Convert a timestamp of the source's clock to the gateway clock."""
        return self._tracker.observe(stamp_us & WRAP_MASK, arrival_us)

    def arrival(self, arrival_us: int) -> int:
        """Return the time of a sample without a timestamp.

        Several samples in one chunk are spaced by half of the usual interval.
        """
        gap_us = arrival_us - self._last_us
        if 0 < gap_us < US_PER_S:
            self._period_us += (gap_us - self._period_us) // PACE_WEIGHT
        return self.after_last(arrival_us, max(self._period_us // 2, 1))

    def after_last(self, time_us: int, step_us: int = 1) -> int:
        """Return the time if it is later than the last sample's, else one step after the last."""
        if self._last_us - time_us > MAX_AHEAD_US:
            step_us = 1
        self._last_us = max(time_us, self._last_us + step_us)
        return self._last_us


def fix_at(
    time_us: int,
    node: NodeId,
    lat_deg: float,
    lon_deg: float,
    alt_amsl_m: float = NAN,
    *,
    satellites: int = 0,
    fix_type: GpsFixType | None = None,
    **values: Any,
) -> GpsFix | None:
    """Make a fix from the values of a source, with others of its fields by their names.

    None if the coordinates are out of range.
    """
    if not (-90.0 <= lat_deg <= 90.0 and -180.0 <= lon_deg <= 180.0):
        return None
    if fix_type is None:
        fix_type = GpsFixType.FIX_3D if math.isfinite(alt_amsl_m) else GpsFixType.FIX_2D
    located = fix_type in (GpsFixType.FIX_2D, GpsFixType.FIX_3D)
    return GpsFix(
        time_us=time_us,
        node=node,
        node_time_us=time_us & WRAP_MASK,
        itow_ms=0,
        fix_type=fix_type,
        fix_ok=located,
        satellites=max(0, min(satellites, 255)),
        lat_dege7=round(lat_deg * DEGE7_PER_DEG),
        lon_dege7=round(lon_deg * DEGE7_PER_DEG),
        alt_amsl_m=alt_amsl_m,
        **values,
    )


def velocity(speed_mps: float, course_deg: float, climb_mps: float = NAN) -> Vec3:
    """Return the NED velocity for speed and course over ground, and climb."""
    course = math.radians(course_deg) if math.isfinite(course_deg) else NAN
    if speed_mps == 0.0 and math.isnan(course):
        course = 0.0
    return (speed_mps * math.cos(course), speed_mps * math.sin(course), -climb_mps)
