"""Disturbances that occur in the field, added to the log of a flight."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from msgspec.structs import replace as replace_struct

from gateway.estimation.columns import (
    ACCEL,
    ACCEL_UNCALIBRATED,
    GPS_ALT,
    GPS_LAT,
    GPS_VEL,
    GYRO,
    GYRO_UNCALIBRATED,
    MAG,
)
from gateway.geometry.geodesy import SEMI_MAJOR_M
from tools.flights import IMU_NAMES, Flight

IMU_GAP_S = 4.0
HANG_S = 1.5
RECOVERY_S = 20.0
"""Time after a disturbance in which an estimator must recover."""
GYRO_OFF_RADPS = math.radians(1.0)
UNCALIBRATED_RADPS = np.radians([9.0, -8.0, 12.0])
UNCALIBRATED_MPS2 = (0.4, -0.35, 0.5)
BIAS_STEP_RADPS = np.radians([1.2, -1.2, 1.0])
BLOW_S = 0.5
BLOW_RADPS = (1.5, -1.0, 2.0)
GLITCH_S = 5.0
GLITCH_M = 60.0
GLITCH_MPS = 5.0
CURRENT_S = 20.0
CURRENT_UT = (20.0, 20.0, -10.0)
LATENCY_S = 0.25
ZERO_ROWS = 3
ODD_SHARE = 0.003
BLANK_SHARE = 0.01
ODD_RADPS = 35.0
ODD_MPS2 = 160.0
ODD_SEED = 5
"""Random seed of the samples that a bus error replaces by any values of the sensors' range."""


@dataclass(frozen=True)
class Spoilt:
    """A flight with a disturbance."""

    flight: Flight
    ends_s: float
    """End of the disturbance; for a lasting one, the begin of the actual flight."""


def first_fix_s(flight: Flight) -> float:
    """Return the time of the first fix, or of the first sample without GPS."""
    times = flight.log.gps_time_us if len(flight.log.gps) else flight.log.imu_time_us
    return float(times[0]) * 1e-6


def middle_s(flight: Flight) -> float:
    """Return the middle of the scored samples."""
    counted = flight.log.imu_time_us[flight.counts] * 1e-6
    return float(counted[len(counted) // 2])


def turn_s(flight: Flight) -> float:
    """Return the begin of the `IMU_GAP_S` with the largest turn, with time to recover after it."""
    time_s, log = flight.log.imu_time_us * 1e-6, flight.log
    dt = np.diff(time_s, prepend=time_s[0]).clip(0.0, 0.1)
    turned = np.cumsum(np.abs(np.linalg.norm(log.imu[:, GYRO : GYRO + 3], axis=1)) * dt)
    span = np.interp(time_s + IMU_GAP_S, time_s, turned) - turned
    counted = time_s[flight.counts]
    usable = (time_s > counted[0] + 30.0) & (time_s < counted[-1] - 3.0 * RECOVERY_S)
    return float(time_s[np.argmax(np.where(usable, span, -1.0))])


def with_imu(flight: Flight, imu: np.ndarray, ends_s: float) -> Spoilt:
    """Replace the samples of the IMU."""
    return Spoilt(replace(flight, log=replace(flight.log, imu=imu)), ends_s)


def zero_rows(flight: Flight) -> Spoilt:
    """Send all-zero samples first, as an MPU6050 may after waking up."""
    imu = flight.log.imu.copy()
    imu[:ZERO_ROWS, : len(IMU_NAMES)] = 0.0
    spoilt = replace(flight, log=replace(flight.log, imu=imu))
    return Spoilt(spoilt, float(flight.log.imu_time_us[ZERO_ROWS]) * 1e-6)


def late_gps(flight: Flight) -> Spoilt:
    """Start GPS in the middle of the flight."""
    keep = flight.log.gps_time_us * 1e-6 > middle_s(flight)
    spoilt = flight.with_gps(keep)
    return Spoilt(spoilt, first_fix_s(spoilt))


def without(flight: Flight, columns: slice) -> Spoilt:
    """Remove columns from the fixes."""
    gps = flight.log.gps.copy()
    gps[:, columns] = math.nan
    return Spoilt(replace(flight, log=replace(flight.log, gps=gps)), first_fix_s(flight))


def no_velocity(flight: Flight) -> Spoilt:
    """Remove the velocity from the fixes."""
    return without(flight, slice(GPS_VEL, GPS_VEL + 3))


def no_height(flight: Flight) -> Spoilt:
    """Remove the height from the fixes."""
    return without(flight, slice(GPS_ALT, GPS_ALT + 1))


def no_mag(flight: Flight) -> Spoilt:
    """Remove the magnetometer."""
    imu = flight.log.imu.copy()
    imu[:, MAG : MAG + 3] = math.nan
    return with_imu(flight, imu, first_fix_s(flight))


def no_baro(flight: Flight) -> Spoilt:
    """Remove the barometer."""
    log = replace(flight.log, baro_time_us=np.empty(0, np.int64), baro_alt_m=np.empty(0))
    return Spoilt(replace(flight, log=log), first_fix_s(flight))


def cut(flight: Flight, keep: np.ndarray) -> Flight:
    """Keep some of the IMU's samples, and their references."""
    log = replace(flight.log, imu_time_us=flight.log.imu_time_us[keep], imu=flight.log.imu[keep])
    return replace(
        flight,
        log=log,
        q_nb=flight.q_nb[keep],
        pos_ne_m=flight.pos_ne_m[keep],
        alt_m=flight.alt_m[keep],
        counts=flight.counts[keep],
    )


def imu_gap(flight: Flight) -> Spoilt:
    """Lose the IMU's samples in the sharpest turn; GPS and barometer continue."""
    time_s, begin_s = flight.log.imu_time_us * 1e-6, turn_s(flight)
    spoilt = cut(flight, (time_s <= begin_s) | (time_s > begin_s + IMU_GAP_S))
    return Spoilt(spoilt, begin_s + IMU_GAP_S)


def mid_air(flight: Flight) -> Spoilt:
    """Begin in the middle of the flight, like a restarted gateway."""
    begin_s = middle_s(flight)
    spoilt = cut(flight, flight.log.imu_time_us * 1e-6 > begin_s)
    log, baro = spoilt.log, flight.log.baro_time_us * 1e-6 > begin_s
    log = replace(log, baro_time_us=log.baro_time_us[baro], baro_alt_m=log.baro_alt_m[baro])
    spoilt = replace(spoilt, log=log).with_gps(log.gps_time_us * 1e-6 > begin_s)
    return Spoilt(spoilt, begin_s)


def gyro_off(flight: Flight) -> Spoilt:
    """Add a constant bias to every axis of the gyroscope."""
    imu = flight.log.imu.copy()
    imu[:, GYRO : GYRO + 3] += GYRO_OFF_RADPS
    return with_imu(flight, imu, first_fix_s(flight))


def uncalibrated(flight: Flight) -> Spoilt:
    """Add the errors of an uncalibrated MPU6050 to the inertial sensors."""
    imu = flight.log.imu.copy()
    imu[:, GYRO : GYRO + 3] += UNCALIBRATED_RADPS
    imu[:, ACCEL : ACCEL + 3] += UNCALIBRATED_MPS2
    imu[:, [GYRO_UNCALIBRATED, ACCEL_UNCALIBRATED]] = 1.0
    return with_imu(flight, imu, first_fix_s(flight))


def half_rate(flight: Flight) -> Spoilt:
    """Lose every other IMU sample; new values in it are sent with the next one."""
    imu, odd = flight.log.imu.copy(), np.arange(len(flight.log.imu)) % 2 == 1
    known = np.isfinite(imu[:, MAG])
    late = np.flatnonzero(odd & known & ~np.roll(known, -1))
    late = late[late + 1 < len(imu)]
    imu[late + 1, MAG : MAG + 3] = imu[late, MAG : MAG + 3]
    spoilt = cut(replace(flight, log=replace(flight.log, imu=imu)), ~odd)
    return Spoilt(spoilt, first_fix_s(flight))


def odd_samples(flight: Flight) -> Spoilt:
    """Replace single samples by noise of the sensor bus, or by zeros."""
    rng, imu = np.random.default_rng(ODD_SEED), flight.log.imu.copy()
    luck = rng.random(len(imu))
    odd, blank = luck < ODD_SHARE, luck > 1.0 - BLANK_SHARE
    imu[odd, GYRO : GYRO + 3] = rng.uniform(-ODD_RADPS, ODD_RADPS, (odd.sum(), 3))
    imu[odd, ACCEL : ACCEL + 3] = rng.uniform(-ODD_MPS2, ODD_MPS2, (odd.sum(), 3))
    imu[blank, : len(IMU_NAMES)] = 0.0
    return with_imu(flight, imu, first_fix_s(flight))


def imu_hangs(flight: Flight) -> Spoilt:
    """Repeat one sample of gyroscope and accelerometer in the sharpest turn."""
    imu, time_s, begin_s = flight.log.imu.copy(), flight.log.imu_time_us * 1e-6, turn_s(flight)
    hung = np.flatnonzero((time_s > begin_s) & (time_s <= begin_s + HANG_S))
    imu[hung, : GYRO + 3] = imu[hung[0], : GYRO + 3]
    return with_imu(flight, imu, begin_s + HANG_S)


def mag_hangs(flight: Flight) -> Spoilt:
    """Repeat one field of the magnetometer from the middle of the flight on."""
    imu, begin_s = flight.log.imu.copy(), middle_s(flight)
    hung = np.flatnonzero((flight.log.imu_time_us * 1e-6 > begin_s) & np.isfinite(imu[:, MAG]))
    imu[hung, MAG : MAG + 3] = imu[hung[0], MAG : MAG + 3]
    return with_imu(flight, imu, begin_s)


def bias_step(flight: Flight) -> Spoilt:
    """Change the bias of the gyroscope abruptly in the middle of the flight."""
    imu, begin_s = flight.log.imu.copy(), middle_s(flight)
    imu[flight.log.imu_time_us * 1e-6 > begin_s, GYRO : GYRO + 3] += BIAS_STEP_RADPS
    return with_imu(flight, imu, begin_s + RECOVERY_S)


def blow(flight: Flight) -> Spoilt:
    """Add a false turn of 80 degrees to the gyroscope, as by a shock."""
    imu, begin_s = flight.log.imu.copy(), middle_s(flight)
    time_s = flight.log.imu_time_us * 1e-6
    imu[(time_s > begin_s) & (time_s <= begin_s + BLOW_S), GYRO : GYRO + 3] += BLOW_RADPS
    return with_imu(flight, imu, begin_s + BLOW_S)


def field_jump(flight: Flight) -> Spoilt:
    """Change the field for a while in the middle of the flight, like a current."""
    imu, begin_s = flight.log.imu.copy(), middle_s(flight)
    time_s = flight.log.imu_time_us * 1e-6
    imu[(time_s > begin_s) & (time_s <= begin_s + CURRENT_S), MAG : MAG + 3] += CURRENT_UT
    return with_imu(flight, imu, begin_s + CURRENT_S)


def gps_jump(flight: Flight, begin_s: float | None = None) -> Spoilt:
    """Shift position and velocity of the fixes of some seconds, by default in the middle."""
    gps = flight.log.gps.copy()
    begin_s = middle_s(flight) if begin_s is None else begin_s
    time_s = flight.log.gps_time_us * 1e-6
    wrong = (time_s > begin_s) & (time_s <= begin_s + GLITCH_S)
    gps[wrong, GPS_LAT] += math.degrees(GLITCH_M / SEMI_MAJOR_M)
    gps[wrong, GPS_VEL : GPS_VEL + 3] += GLITCH_MPS
    return Spoilt(replace(flight, log=replace(flight.log, gps=gps)), begin_s + GLITCH_S)


def wrong_latency(flight: Flight, known_s: float | None = None) -> Spoilt:
    """Set too long a latency of the fixes, which manoeuvres (by default up to the middle) show."""
    latency_s = flight.reference.gps_latency_s + LATENCY_S
    spoilt = replace(flight, reference=replace_struct(flight.reference, gps_latency_s=latency_s))
    return Spoilt(spoilt, middle_s(flight) if known_s is None else known_s)


SPOILS: dict[str, Callable[[Flight], Spoilt]] = {
    spoil.__name__: spoil
    for spoil in (
        *(zero_rows, late_gps, no_velocity, no_height, no_mag, no_baro, imu_gap, mid_air),
        *(gyro_off, uncalibrated, half_rate, odd_samples, imu_hangs, mag_hangs, bias_step, blow),
        *(field_jump, gps_jump, wrong_latency),
    )
}
GPS_SPOILS = ("late_gps", "no_velocity", "no_height", "gps_jump", "wrong_latency")
MAG_SPOILS = ("no_mag", "mag_hangs", "field_jump")


def applies(how: str, flight: Flight) -> bool:
    """Return whether a flight has the sensor that a disturbance changes."""
    log = flight.log
    if how in GPS_SPOILS:
        return len(log.gps) > 0
    if how in MAG_SPOILS:
        return bool(np.isfinite(log.imu[:, MAG]).any())
    return how != "no_baro" or len(log.baro_alt_m) > 0
