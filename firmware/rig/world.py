"""The quantities that the sensors measure, as a function of time."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

Vec3 = tuple[float, float, float]

EARTH_FIELD_UT: Final = (22.0, 1.5, 42.0)
SEA_LEVEL_PA: Final = 101_325.0


@dataclass(frozen=True, slots=True)
class Moment:
    """The world at one time, in the axes printed on the sensor board (FRD or not: as mounted)."""

    accel_mps2: Vec3 = (0.0, 0.0, 9.80665)
    """Specific force on the axes of the MPU6050: +1 g on z where it lies flat, face up."""
    gyro_radps: Vec3 = (0.0, 0.0, 0.0)
    mag_ut: Vec3 = EARTH_FIELD_UT
    temperature_degc: float = 25.0
    pressure_pa: float = SEA_LEVEL_PA


@dataclass(frozen=True, slots=True)
class Solution:
    """Solution of a GPS receiver."""

    lat_deg: float = -7.7123456
    lon_deg: float = 110.3654321
    alt_amsl_m: float = 153.25
    geoid_separation_m: float = 23.45
    vel_n_mps: Vec3 = (12.34, -5.67, -0.89)
    h_acc_m: float = 1.8
    v_acc_m: float = 3.1
    speed_acc_mps: float = 0.42
    course_acc_deg: float = 2.75
    pdop: float = 1.61
    fix_type: int = 3
    fix_ok: bool = True
    satellites: int = 14
    time_valid: bool = True


START_UNIX_US: Final = 1_795_046_400_000_000
"""19 November 2026, 00:00 UTC."""


@dataclass(frozen=True)
class World:
    """Functions of the time in seconds since the bench started."""

    moment: Callable[[float], Moment] = lambda _time_s: Moment()
    solution: Callable[[float], Solution] = lambda _time_s: Solution()
    start_unix_us: int = START_UNIX_US
