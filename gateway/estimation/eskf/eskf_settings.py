"""Settings and gains of the error-state Kalman filter."""

import math
from typing import Annotated, Final

from gateway.estimation.filtering.filter_state import FilterGains, filter_gains
from gateway.estimation.kernel_record import filled_record
from gateway.estimation.magfield import CompassSettings
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.rest import RestSettings
from gateway.settings import Settings, setting
from gateway.units import RAD_PER_DEG

VELOCITY_CORRELATION_S: Final = 0.25
LASTING_RAD: Final = 0.005
"""Axes and scales of the sensors are off by about this for a whole flight."""


class EskfSettings(Settings, frozen=True):
    """What the filter believes of its sensors; each is a standard deviation unless it says else."""

    gyro_noise_degprs: Annotated[
        float,
        setting("Noise of the gyroscope, vibration included.", "deg/sqrt(s)", ge=1e-4, le=10.0),
    ] = 0.066
    gyro_roughness: Annotated[
        float,
        setting(
            "How much of what is uneven in the angular rate from sample to sample is taken for "
            "noise, vibration and what the sampling misses; 1 if all of it, were it white.",
            ge=0.0,
            le=10.0,
        ),
    ] = 1.5
    gyro_scale: Annotated[
        float,
        setting(
            "Share by which each axis of the gyroscope may be off scale; flying in circles tells.",
            ge=0.0,
            le=0.1,
        ),
    ] = 0.088
    accel_noise_mpsprs: Annotated[
        float,
        setting("Noise of the accelerometer, vibration included.", "m/s/sqrt(s)", ge=1e-4, le=10.0),
    ] = 0.14
    accel_roughness: Annotated[
        float, setting("The same of the specific force.", ge=0.0, le=10.0)
    ] = 0.46
    accel_scale: Annotated[
        float,
        setting("Share by which the specific force beyond gravity is wrong.", ge=0.0, le=0.2),
    ] = 0.0055
    gyro_bias_walk_degpsprs: Annotated[
        float, setting("Random walk of the gyroscope bias.", "deg/s/sqrt(s)", ge=0.0, le=1.0)
    ] = 0.0045
    accel_bias_walk_mps2prs: Annotated[
        float, setting("Random walk of the accelerometer bias.", "m/s2/sqrt(s)", ge=0.0, le=1.0)
    ] = 0.0018
    gyro_bias_degps: Annotated[
        float, setting("Gyroscope bias at the start.", "deg/s", ge=0.01, le=20.0)
    ] = 0.6
    accel_bias_mps2: Annotated[
        float,
        setting(
            "Accelerometer bias while nothing but gravity tells the level; at the first fix it is "
            "taken to be 0.04 at least.",
            "m/s2",
            ge=0.001,
            le=2.0,
        ),
    ] = 0.0195
    gps_position_m: Annotated[
        float, setting("Noise of a fix from one to the next, horizontal.", "m", ge=0.01, le=50.0)
    ] = 1.2
    gps_height_m: Annotated[float, setting("The same of its height.", "m", ge=0.01, le=50.0)] = 1.9
    gps_wander_m: Annotated[
        float, setting("Slow error of the GPS position, horizontal.", "m", ge=0.01, le=50.0)
    ] = 0.92
    gps_height_wander_m: Annotated[
        float, setting("Slow error of the GPS height.", "m", ge=0.01, le=50.0)
    ] = 2.5
    gps_wander_s: Annotated[
        float, setting("Correlation time of these slow errors.", "s", ge=1.0, le=3600.0)
    ] = 29.0
    gps_velocity_mps: Annotated[
        float, setting("Noise of the GPS velocity, horizontal.", "m/s", ge=0.01, le=10.0)
    ] = 0.4
    gps_climb_mps: Annotated[
        float, setting("The same of its vertical velocity.", "m/s", ge=0.01, le=10.0)
    ] = 0.25
    gps_jitter_s: Annotated[
        float,
        setting(
            "How much the latency of a fix varies. At speed and in turns this is the larger part "
            "of its error.",
            "s",
            ge=0.0,
            le=0.5,
        ),
    ] = 0.065
    mag_noise_deg: Annotated[
        float, setting("Noise of the compass, sample to sample.", "deg", ge=0.1, le=45.0)
    ] = 4.7
    mag_bias_ut: Annotated[
        float, setting("Iron that the calibration has left, per axis.", "uT", ge=0.001, le=50.0)
    ] = 1.5
    mag_bias_walk_utprs: Annotated[
        float, setting("Random walk of it.", "uT/sqrt(s)", ge=0.0, le=10.0)
    ] = 0.005
    baro_noise_m: Annotated[
        float, setting("Noise of the barometer's height.", "m", ge=0.01, le=20.0)
    ] = 0.26
    baro_walk_mprs: Annotated[
        float, setting("Random walk of the barometer's offset.", "m/sqrt(s)", ge=0.0, le=5.0)
    ] = 1.2
    unaided_velocity_mps: Annotated[
        float,
        setting(
            "Speed to be expected where no GPS tells it. Small levels fast and is fooled by "
            "acceleration, large trusts the gyroscope.",
            "m/s",
            ge=0.01,
            le=100.0,
        ),
    ] = 0.14
    dead_reckoning_s: Annotated[
        float,
        setting("How long position and velocity are carried without GPS.", "s", ge=1.0, le=600.0),
    ] = 60.0
    gate_sigma: Annotated[
        float,
        setting(
            "Innovations beyond this many standard deviations are not believed.", ge=2.0, le=20.0
        ),
    ] = 5.0
    gate_m: Annotated[
        float,
        setting(
            "A fix that is off by less than this is never rejected, only trusted less.",
            "m",
            ge=0.0,
            le=100.0,
        ),
    ] = 10.0


class EskfGains(FilterGains):
    """The settings as variances and densities in SI units."""

    gyro_density: float
    """rad2/s."""
    gyro_roughness_sq: float
    accel_roughness_sq: float
    gyro_scale_var: float
    gyro_turn_var: float
    """Variance of the attitude after a turn of 1 rad, by scale and axes of the gyroscope, rad2."""
    accel_density: float
    """m2/s3."""
    accel_scale_sq: float
    gyro_bias_density: float
    accel_bias_density: float
    gyro_bias_var: float
    accel_bias_var: float
    gps_position_var: float
    gps_height_var: float
    gps_wander_var: float
    gps_height_wander_var: float
    gps_wander_s: float
    gps_velocity_var: float
    velocity_correlation_s: float
    """Errors of GPS velocities are alike for about this time: faster fixes tell no more."""
    gps_climb_var: float
    gps_jitter_sq: float
    mag_var: float
    field_memory_s: float
    """A field that was unlike the usual one is doubted for about this time."""
    mag_bias_var: float
    mag_bias_density: float
    baro_var: float
    baro_density: float
    unaided_var: float
    dead_reckoning_s: float
    gate_sq: float
    gate_m: float


def make_gains(
    settings: EskfSettings,
    reference: ReferenceSettings,
    rest: RestSettings,
    compass: CompassSettings,
) -> EskfGains:
    """Turn the settings into a record of variances.

    Parameters
    ----------
    settings : EskfSettings
        Standard deviations.
    reference : ReferenceSettings
        GPS latency.
    rest : RestSettings
        What is taken for rest.
    compass : CompassSettings
        When the compass is taken for disturbed.

    Returns
    -------
    EskfGains
        For the kernels.
    """
    s = settings
    values = {
        "gyro_density": (s.gyro_noise_degprs * RAD_PER_DEG) ** 2,
        "gyro_roughness_sq": s.gyro_roughness**2,
        "accel_roughness_sq": s.accel_roughness**2,
        "gyro_scale_var": s.gyro_scale**2,
        # What is off by a lasting angle errs by no more than twice that in a turn, and not at all
        # after a circle; on average over the circle, such a walk errs as much.
        "gyro_turn_var": LASTING_RAD**2 / math.pi,
        "accel_density": s.accel_noise_mpsprs**2,
        "accel_scale_sq": s.accel_scale**2,
        "gyro_bias_density": (s.gyro_bias_walk_degpsprs * RAD_PER_DEG) ** 2,
        "accel_bias_density": s.accel_bias_walk_mps2prs**2,
        "gyro_bias_var": (s.gyro_bias_degps * RAD_PER_DEG) ** 2,
        "accel_bias_var": s.accel_bias_mps2**2,
        "gps_position_var": s.gps_position_m**2,
        "gps_height_var": s.gps_height_m**2,
        "gps_wander_var": s.gps_wander_m**2,
        "gps_height_wander_var": s.gps_height_wander_m**2,
        "gps_wander_s": s.gps_wander_s,
        "velocity_correlation_s": VELOCITY_CORRELATION_S,
        "field_memory_s": 0.0,
        "gps_velocity_var": s.gps_velocity_mps**2,
        "gps_climb_var": s.gps_climb_mps**2,
        "gps_jitter_sq": s.gps_jitter_s**2,
        "mag_var": (s.mag_noise_deg * RAD_PER_DEG) ** 2,
        "mag_bias_var": s.mag_bias_ut**2,
        "mag_bias_density": s.mag_bias_walk_utprs**2,
        "baro_var": s.baro_noise_m**2,
        "baro_density": s.baro_walk_mprs**2,
        "unaided_var": s.unaided_velocity_mps**2,
        "dead_reckoning_s": s.dead_reckoning_s,
        "gate_m": s.gate_m,
        "gate_sq": s.gate_sigma**2,
    }
    return filled_record(EskfGains, values | filter_gains(reference, rest, compass))
