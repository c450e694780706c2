"""Settings of the filter, also as variances and densities in SI units."""

from typing import Annotated, Final

import msgspec

from gateway.estimation.record import filled_record
from gateway.estimation.reference import EarthField, ReferenceSettings
from gateway.settings import Settings, fields_of, setting
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

DYNAMIC_S: Final = 30.0
"""Correlation time of the barometer's error by dynamic pressure: wind and sideslip change."""


class EskfSettings(Settings, frozen=True):
    """Noise of the sensors and limits of the filter; standard deviations unless stated otherwise.

    A larger noise makes the filter follow the other sensors; a smaller one makes it follow this
    sensor and reject more of the others.
    """

    gyro_noise_degprs: Annotated[
        float, setting("Gyroscope noise, without vibration.", "deg/sqrt(s)", ge=1e-4, le=10.0)
    ] = 0.066
    gyro_vibration: Annotated[
        float,
        setting("Share of the measured noise of the rate that is white noise.", ge=0.0, le=10.0),
    ] = 1.4
    gyro_scale: Annotated[
        float, setting("Relative scale error of each gyroscope axis.", ge=0.0, le=0.1)
    ] = 0.03
    gyro_turn_deg: Annotated[
        float, setting("Attitude error by skewed axes, per rad of turn.", "deg", ge=0.0, le=10.0)
    ] = 0.25
    gyro_bias_degps: Annotated[
        float, setting("Initial gyroscope bias.", "deg/s", ge=0.01, le=20.0)
    ] = 0.6
    gyro_bias_uncalibrated_degps: Annotated[
        float, setting("Initial bias without calibration.", "deg/s", ge=0.01, le=20.0)
    ] = 3.0
    gyro_bias_walk_degpsprs: Annotated[
        float, setting("Random walk of the gyroscope bias.", "deg/s/sqrt(s)", ge=0.0, le=1.0)
    ] = 0.0055
    gyro_bias_change_degps: Annotated[
        float, setting("Change of the bias from rest to motion, by heat.", "deg/s", ge=0.0, le=5.0)
    ] = 0.15
    accel_noise_mpsprs: Annotated[
        float, setting("Accelerometer noise, without vibration.", "m/s/sqrt(s)", ge=1e-4, le=10.0)
    ] = 0.1
    accel_vibration: Annotated[
        float,
        setting("Share of the measured noise of the force that is white noise.", ge=0.0, le=10.0),
    ] = 0.46
    accel_scale: Annotated[
        float, setting("Relative error of the force beyond gravity.", ge=0.0, le=0.2)
    ] = 0.01
    accel_bias_mps2: Annotated[
        float, setting("Initial accelerometer bias.", "m/s2", ge=0.001, le=2.0)
    ] = 0.04
    accel_bias_uncalibrated_mps2: Annotated[
        float, setting("Initial bias without calibration.", "m/s2", ge=0.001, le=2.0)
    ] = 0.3
    accel_bias_walk_mps2prs: Annotated[
        float, setting("Random walk of the accelerometer bias.", "m/s2/sqrt(s)", ge=0.0, le=1.0)
    ] = 0.0018
    gravity_tau_s: Annotated[
        float,
        setting(
            "Time constant of each of two low-passes that determine gravity without GPS. Small: "
            "follows accelerations. Large: follows the drift of the gyroscope.",
            "s",
            ge=0.1,
            le=20.0,
        ),
    ] = 1.3
    gravity_noise_mps2: Annotated[
        float, setting("Acceleration in the low-pass filtered gravity.", "m/s2", ge=0.001, le=5.0)
    ] = 0.1
    gravity_motion: Annotated[
        float, setting("Share of the difference of the low-passes that is error.", ge=0.0, le=2.0)
    ] = 0.6
    gps_position_m: Annotated[
        float, setting("Noise of a fix, horizontal.", "m", ge=0.01, le=50.0)
    ] = 1.2
    gps_height_m: Annotated[
        float, setting("Noise of the height of a fix.", "m", ge=0.01, le=50.0)
    ] = 1.9
    gps_error_m: Annotated[
        float, setting("Slow error of the GPS position, horizontal.", "m", ge=0.01, le=50.0)
    ] = 0.7
    gps_height_error_m: Annotated[
        float, setting("Slow error of the GPS height.", "m", ge=0.01, le=50.0)
    ] = 2.5
    gps_error_s: Annotated[
        float, setting("Correlation time of the slow GPS errors.", "s", ge=1.0, le=3600.0)
    ] = 29.0
    gps_velocity_mps: Annotated[
        float, setting("Noise of the GPS velocity, horizontal.", "m/s", ge=0.01, le=10.0)
    ] = 0.4
    gps_climb_mps: Annotated[
        float, setting("Noise of the GPS velocity, vertical.", "m/s", ge=0.01, le=10.0)
    ] = 0.25
    gps_climb_error_mps: Annotated[
        float, setting("Slow error of the vertical GPS velocity.", "m/s", ge=0.0, le=10.0)
    ] = 0.3
    gps_climb_error_s: Annotated[
        float, setting("Correlation time of that error.", "s", ge=1.0, le=3600.0)
    ] = 50.0
    gps_correlation_s: Annotated[
        float, setting("Correlation time of the velocity noise.", "s", ge=0.0, le=10.0)
    ] = 0.4
    gps_jitter_s: Annotated[
        float, setting("Variation of the latency from fix to fix.", "s", ge=0.0, le=0.5)
    ] = 0.085
    mag_noise_deg: Annotated[
        float, setting("Compass noise, sample to sample.", "deg", ge=0.1, le=45.0)
    ] = 5.3
    mag_latency_s: Annotated[
        float, setting("Age of the magnetic field in a sample.", "s", ge=0.0, le=0.2)
    ] = 0.02
    mag_latency_std_s: Annotated[
        float, setting("Standard deviation of the age of the field.", "s", ge=0.0, le=0.2)
    ] = 0.03
    hard_iron_ut: Annotated[
        float, setting("Hard iron left by a calibration, per axis.", "uT", ge=0.001, le=50.0)
    ] = 1.5
    hard_iron_uncalibrated_ut: Annotated[
        float, setting("Hard iron without calibration, per axis.", "uT", ge=0.001, le=100.0)
    ] = 15.0
    hard_iron_walk_utprs: Annotated[
        float, setting("Random walk of the hard iron.", "uT/sqrt(s)", ge=0.0, le=10.0)
    ] = 0.005
    field_norm_tolerance: Annotated[
        float, setting("Largest relative difference of the field strength.", ge=0.01, le=1.0)
    ] = 0.1
    field_dip_tolerance_deg: Annotated[
        float, setting("Maximum difference from the usual dip.", "deg", ge=1.0, le=90.0)
    ] = 10.0
    baro_noise_m: Annotated[
        float, setting("Noise of the barometer's height.", "m", ge=0.01, le=20.0)
    ] = 0.26
    baro_walk_mprs: Annotated[
        float, setting("Random walk of the barometer's offset.", "m/sqrt(s)", ge=0.0, le=5.0)
    ] = 0.5
    baro_dynamic: Annotated[
        float, setting("Share of the dynamic pressure in the static one.", ge=0.0, le=1.0)
    ] = 0.2
    dead_reckoning_s: Annotated[
        float, setting("Longest dead reckoning without GPS.", "s", ge=1.0, le=600.0)
    ] = 60.0
    gate_sigma: Annotated[
        float, setting("Standard deviations at which weights fall.", ge=2.0, le=20.0)
    ] = 5.0
    gate_m: Annotated[
        float, setting("Distance below which a fix is never rejected.", "m", ge=0.0, le=100.0)
    ] = 10.0
    rest_gyro_degps: Annotated[
        float, setting("Maximum deviation of the rate at rest.", "deg/s", ge=0.01, le=10.0)
    ] = 2.0
    rest_accel_mps2: Annotated[
        float, setting("Maximum deviation of the force at rest.", "m/s2", ge=0.01, le=5.0)
    ] = 0.5
    rest_time_s: Annotated[
        float, setting("Time within both deviations after which it is rest.", "s", ge=0.2, le=30.0)
    ] = 1.5
    rest_speed_mps: Annotated[
        float, setting("Maximum GPS speed at rest.", "m/s", ge=0.05, le=10.0)
    ] = 0.7
    bias_limit_degps: Annotated[
        float, setting("Largest possible gyroscope bias.", "deg/s", ge=0.1, le=30.0)
    ] = 20.0


class Gains:
    """The settings as variances and densities in SI units; see `EskfSettings`."""

    gyro_noise_density: float
    """rad2/s."""
    gyro_vibration_sq: float
    gyro_scale_var: float
    gyro_turn_var: float
    """rad2 per rad."""
    gyro_bias_var: float
    gyro_bias_uncalibrated_var: float
    gyro_bias_walk_density: float
    gyro_bias_change_radps: float
    accel_noise_density: float
    """m2/s3."""
    accel_vibration_sq: float
    accel_scale_sq: float
    accel_bias_var: float
    accel_bias_uncalibrated_var: float
    accel_bias_walk_density: float
    gravity_tau_s: float
    gravity_noise_var: float
    gravity_motion_sq: float
    gps_position_var: float
    gps_height_var: float
    gps_error_var: float
    gps_height_error_var: float
    gps_error_s: float
    gps_velocity_var: float
    gps_climb_var: float
    gps_climb_error_var: float
    gps_climb_error_s: float
    gps_jitter_sq: float
    gps_correlation_s: float
    gps_latency_s: float
    gps_relock_s: float
    mag_noise_var: float
    mag_latency_s: float
    mag_latency_std_sq: float
    hard_iron_var: float
    hard_iron_uncalibrated_var: float
    hard_iron_walk_density: float
    field_norm_tolerance: float
    field_dip_tolerance_rad: float
    declination_rad: float
    """NaN if it is looked up at the position of a fix."""
    baro_noise_var: float
    baro_walk_density: float
    baro_dynamic_density: float
    dead_reckoning_s: float
    gate_sigma_sq: float
    gate_m: float
    rest_gyro_radps: float
    rest_accel_mps2: float
    rest_time_s: float
    rest_speed_mps: float
    bias_limit_radps: float


def make_gains(settings: EskfSettings, reference: ReferenceSettings) -> Gains:
    """Convert the settings to SI units; a gain has the name of its setting with another unit.

    A variance or density is the square of its setting.
    """
    values = msgspec.structs.asdict(reference) | msgspec.structs.asdict(settings)
    # Reversed, because of two settings that differ only in their units the first is squared.
    for field in reversed(fields_of(EskfSettings)):
        name = field.name.rpartition("_")[0] if field.unit else field.name
        value = values[field.name] * (RAD_PER_DEG if field.unit.startswith("deg") else 1.0)
        values |= dict.fromkeys((f"{name}_rad", f"{name}_radps"), value)
        values |= dict.fromkeys((f"{name}_var", f"{name}_sq", f"{name}_density"), value**2)
    values["declination_rad"] = EarthField(reference).declination_rad
    dynamic = settings.baro_dynamic * 0.5 / STANDARD_GRAVITY_MPS2
    values["baro_dynamic_density"] = 2.0 / DYNAMIC_S * dynamic**2
    return filled_record(Gains, values)
