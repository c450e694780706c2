"""Rest detection: quiet sensors, a small rate, and no GPS speed; never in flight."""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray
from gateway.records import Vec3
from gateway.settings import Settings, setting

REST_TAU_S: Final = 0.5
"""Time constant of the averages that rest is judged by."""


class RestSettings(Settings, frozen=True):
    """What is taken for rest, where the gyroscope shows its bias; the same for all estimators."""

    gyro_degps: Annotated[
        float,
        setting(
            "At rest the angular rate stays this close to its average.", "deg/s", ge=0.01, le=10.0
        ),
    ] = 2.0
    accel_mps2: Annotated[
        float,
        setting(
            "At rest the specific force stays this close to its average.", "m/s2", ge=0.01, le=5.0
        ),
    ] = 0.5
    time_s: Annotated[
        float, setting("How long that must hold to be called rest.", "s", ge=0.2, le=30.0)
    ] = 1.5
    speed_mps: Annotated[
        float, setting("GPS speed above which nothing is at rest.", "m/s", ge=0.05, le=10.0)
    ] = 0.7
    bias_limit_degps: Annotated[
        float, setting("No gyroscope bias is larger than this.", "deg/s", ge=0.1, le=30.0)
    ] = 6.0


class RestGains:
    """The same in SI units."""

    bias_limit_radps: float
    rest_gyro_radps: float
    rest_accel_mps2: float
    rest_time_s: float
    rest_speed_mps: float


def rest_gains(settings: RestSettings) -> dict[str, float]:
    """Tell the fields of `RestGains`."""
    return {
        "bias_limit_radps": math.radians(settings.bias_limit_degps),
        "rest_gyro_radps": math.radians(settings.gyro_degps),
        "rest_accel_mps2": settings.accel_mps2,
        "rest_time_s": settings.time_s,
        "rest_speed_mps": settings.speed_mps,
    }


class RestState:
    """What rest is judged by."""

    rest_s: float
    at_rest: int
    gyro_lp: Annotated[FloatArray, (3,)]
    gyro_rest: Annotated[FloatArray, (3,)]
    """Behind `gyro_lp`: still the bias when a slow start of motion is noticed."""
    accel_lp: Annotated[FloatArray, (3,)]


@compiled
def watch_rest(
    s: RestState, p: RestGains, gyro: Vec3, accel: Vec3, moving: bool, dt: float
) -> None:
    """Judge whether the aircraft stands: quiet sensors, small rate, no GPS speed.

    Parameters
    ----------
    s : RestState
        Changed in place.
    p : RestGains
        Constants.
    gyro, accel : tuple of 3 floats
        Newest sample in body FRD, bias still in.
    moving : bool
        What the GPS says.
    dt : float
        Time step, s.
    """
    share = min(1.0, dt / REST_TAU_S)
    gyro_sq, accel_sq, largest = 0.0, 0.0, 0.0
    for k in range(3):
        s.gyro_lp[k] += share * (gyro[k] - s.gyro_lp[k])
        s.gyro_rest[k] += share * (s.gyro_lp[k] - s.gyro_rest[k])
        s.accel_lp[k] += share * (accel[k] - s.accel_lp[k])
        gyro_sq += (gyro[k] - s.gyro_lp[k]) ** 2
        accel_sq += (accel[k] - s.accel_lp[k]) ** 2
        largest = max(largest, abs(s.gyro_lp[k]))
    quiet = (
        gyro_sq < p.rest_gyro_radps**2
        and accel_sq < p.rest_accel_mps2**2
        and largest < p.bias_limit_radps
        and not moving
    )
    s.rest_s = s.rest_s + dt if quiet else 0.0
    s.at_rest = 1 if s.rest_s >= p.rest_time_s else 0
