"""The paper's estimator: filters, then three complementary filters, with corrected equations.

Accelerometer and gyroscope give roll and pitch, the magnetometer corrects yaw, and the acceleration
is integrated twice and blended with GPS [1]_. Deviations from the printed equations:

- Eq. 1, 2, 7, 8: the course is counted from north, so its cosine is the north velocity and north
  velocity drives latitude; a metre east is `180 / (pi r_e cos(lat))` degrees. They are recursions:
  `V = alpha (V + a dt) + (1 - alpha) V_gps`. By default they blend once at each fix; blending at
  every sample against the held fix, as printed, drags the track back to the last fix.
- Eq. 1, 2: the acceleration is the specific force rotated to NED plus gravity.
- Eq. 3 to 6: the receiver's velocity replaces the bearing between two fixes, which is used only
  without a velocity. A fix is extrapolated over its latency by its velocity and the acceleration.
  The vertical axis, which the paper omits, is blended by the same equations.
- The gyroscope is integrated as a quaternion; Euler angles are only blended.
- A constant rate at rest is subtracted as bias. The high-pass of the rate would also remove the
  steady rate of a turn, so it is off by default.

References
----------
.. [1] A. A. Arfakhsyad et al., "Unmanned Aerial Vehicle (UAV) Data-Driven Modeling Software with
   Integrated 9-Axis IMU-GPS Sensor Fusion and Data Filtering Algorithm".
"""

import math
from typing import Annotated, Final, Literal

import msgspec
import numpy as np

from gateway.compiled import array_at, compiled, record_at
from gateway.compiled.entry_point import EntryPoint
from gateway.estimation import columns as col
from gateway.estimation.columns import FLAG, imu_vectors
from gateway.estimation.kernel import CompiledEstimator, Kernels
from gateway.estimation.record import (
    FloatArray,
    as_quat,
    as_vec,
    filled_record,
    layout,
    write_quat,
    write_vec,
)
from gateway.estimation.reference import EarthField, ReferenceSettings
from gateway.estimation.vector_filter import (
    Kind,
    design_highpass,
    discretise,
    filter_step,
    prototype_of,
)
from gateway.geometry import quaternion as quat
from gateway.geometry.angle import wrap_180, wrap_pi
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.records import NAN, Vec3
from gateway.settings import Settings, setting
from gateway.units import STANDARD_GRAVITY_MPS2, US_PER_S

GAP_S: Final = 2.5
"""Longest interval of the IMU that is integrated."""
GAIN_INTERVAL_S: Final = 0.01
"""Interval for which the attitude weights are given; for others the matching power is used."""
POSITION_HOLD_S: Final = 30.0
"""Longest dead reckoning with a valid position."""
MOST_GAINS: Final = 2000
"""Number of samples in the longest latency at 1000 a second."""
STALE_MAG_S: Final = 2.0
"""A compass without readings for longer is not in use."""
MIN_COS_PITCH: Final = 0.05
"""Cosine of the pitch below which the accelerometer does not give the roll."""
LIMITS: Final = (500.0, 50.0)
"""Largest force in m/s2 and rate in rad/s that a sensor of this kind can measure."""
NEVER_US: Final = -(1 << 62)
"""A time earlier than all others."""
REST: Final = (0.035, 0.5, 0.1, 0.7)
"""Maximum values at rest: deviation of rate and force from their means, rad/s and m/s2, mean rate,
rad/s, and GPS speed, m/s."""
REST_S: Final = 1.5
"""Time after which rest begins, and time constant of the means and the bias."""
FIRST_RATE_HZ: Final = 100.0
RATE_CHANGE: Final = 0.1
"""Relative change of the sample rate at which the filters are redesigned."""
FLOAT: Final = np.dtype(np.float64)
INT: Final = np.dtype(np.int64)


class PaperSettings(Settings, frozen=True):
    """Filters and weights of the paper's method."""

    accel_filter: Annotated[
        Kind, setting("Second-order low-pass of the acceleration: butterworth or chebyshev.")
    ] = "butterworth"
    accel_cutoff_hz: Annotated[
        float, setting("Cutoff of the low-pass.", "Hz", ge=0.1, le=500.0)
    ] = 10.0
    chebyshev_ripple_db: Annotated[
        float, setting("Ripple of the Chebyshev filter's pass band.", "dB", ge=0.01, le=6.0)
    ] = 1.0
    gyro_highpass_hz: Annotated[
        float,
        setting(
            "Cutoff of the first-order high-pass of the rate, which also removes the steady rate "
            "of a long turn; 0 for none.",
            "Hz",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    alpha_gyro: Annotated[
        float,
        setting(
            "Weight of the gyroscope in roll and pitch over 10 ms. Small: follows the noise of the "
            "accelerometer, and levels long turns. Large: drifts. Time constant: "
            "0.01 s * a / (1 - a).",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.9997
    alpha_yaw: Annotated[
        float, setting("The same for yaw, with the magnetometer.", ge=0.0, le=1.0)
    ] = 0.999
    alpha_accel: Annotated[
        float,
        setting(
            "Alpha: weight of the integrated acceleration in the velocity, relative to the GPS "
            "velocity. Small: smooth. Large: noisy, and drifts.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.1
    beta_velocity: Annotated[
        float,
        setting(
            "Beta: weight of the integrated velocity in the position, relative to the GPS "
            "position. Small: follows the fixes. Large: lags, and drifts.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.1
    blend: Annotated[
        Literal["at_fix", "every_sample"],
        setting("Times of blending velocity and position: at_fix, or every_sample (as printed)."),
    ] = "at_fix"


class PaperState:
    """State of the estimator; times in microseconds on the gateway clock."""

    started: int
    time_us: int
    q_nb: Annotated[FloatArray, (4,)]
    rate_b: Annotated[FloatArray, (3,)]
    """Angular rate without bias, rad/s."""
    rate_hz: float
    mean_step_s: float
    lowpass: Annotated[FloatArray, (5,)]
    highpass: Annotated[FloatArray, (5,)]
    """Coefficients at `rate_hz`."""
    delays: Annotated[FloatArray, (2, 6)]
    """Delays of the low-pass and the high-pass, see `filter_step`."""
    gyro_mean: Annotated[FloatArray, (3,)]
    accel_mean: Annotated[FloatArray, (3,)]
    rest_s: float
    bias_b: Annotated[FloatArray, (3,)]
    mag_us: int
    declination_rad: float
    location: Annotated[FloatArray, (3,)]
    """Latitude and longitude in deg, height in m."""
    vel_n: Annotated[FloatArray, (3,)]
    fix_us: int
    fix_from: Annotated[FloatArray, (3,)]
    fix_location: Annotated[FloatArray, (3,)]
    """The last fix: as received in `fix_from`, extrapolated by its latency here."""
    fix_vel: Annotated[FloatArray, (3,)]
    gains: Annotated[FloatArray, (MOST_GAINS, 4)]
    """Ring of the times of recent samples, us, and the integral of the acceleration, m/s."""
    first_gain: int
    gain_count: int


class PaperGains:
    """The settings for compiled code; see `PaperSettings`."""

    damping: float
    w0_sq: float
    """Prototype of the low-pass."""
    accel_cutoff_hz: float
    gyro_highpass_hz: float
    alpha_gyro: float
    alpha_yaw: float
    alpha_accel: float
    beta_velocity: float
    every_sample: int
    """1 if fixes are blended at every sample."""
    gps_latency_s: float
    declination_rad: float
    """NaN if it is looked up at the position of a fix."""


@compiled
def retune(s: PaperState, p: PaperGains, rate_hz: float) -> None:
    """Redesign the filters, which restart at the next sample."""
    s.rate_hz = rate_hz
    lowpass = discretise(p.damping, p.w0_sq, p.accel_cutoff_hz, rate_hz)
    highpass = design_highpass(p.gyro_highpass_hz, rate_hz)
    for k in range(5):
        s.lowpass[k], s.highpass[k] = lowpass[k], highpass[k]
    s.delays[:] = NAN


@compiled
def update_imu(s: PaperState, p: PaperGains, time_us: int, row: FloatArray) -> bool:
    """Advance by one IMU sample; return whether it is valid."""
    gyro, accel, mag = imu_vectors(row)
    sound = quat.is_below(accel, LIMITS[0]) and quat.is_below(gyro, LIMITS[1])
    if s.started == 0:
        if not sound:
            return False
        s.started, s.time_us = 1, time_us
        write_vec(s.gyro_mean, gyro)
        write_vec(s.accel_mean, accel)
        write_vec(s.rate_b, gyro)
        roll, pitch = quat.tilt(accel)
        write_quat(s.q_nb, quat.from_euler(roll, pitch, 0.0))
    dt_s = (time_us - s.time_us) / US_PER_S
    if abs(dt_s) > GAP_S:
        if dt_s < 0.0:
            s.fix_us = s.mag_us = NEVER_US
        retune(s, p, s.rate_hz)
        s.time_us, dt_s = time_us, 0.0
    if dt_s > 0.0:
        s.time_us = time_us
        if sound:
            follow_rate(s, p, dt_s)
            force, rate = accel, gyro
            if row[col.ACCEL_FILTERED] == 0.0:
                c = s.lowpass
                force = filter_step((c[0], c[1], c[2], c[3], c[4]), s.delays[0], accel)
            if row[col.GYRO_FILTERED] == 0.0:
                c = s.highpass
                rate = filter_step((c[0], c[1], c[2], c[3], c[4]), s.delays[1], gyro)
            follow_rest(s, accel, gyro, dt_s)
            advance(s, p, force, quat.difference(rate, as_vec(s.bias_b)), dt_s)
    if dt_s >= 0.0 and quat.norm_sq(mag) > 0.0 and quat.is_below(mag, math.inf):
        correct_yaw(s, p, mag)
    return sound


@compiled
def update_gps(s: PaperState, p: PaperGains, time_us: int, row: FloatArray) -> None:
    """Blend one fix, extrapolated by its latency: eq. 1 to 8."""
    if row[col.GPS_USABLE] == 0.0:
        return
    s.declination_rad = row[col.GPS_DECLINATION]
    lat, lon, alt = as_vec(row[col.GPS_LAT : col.GPS_LAT + 3])
    if not math.isfinite(alt):
        alt = s.fix_from[2] if math.isfinite(s.fix_from[2]) else 0.0
    vel = as_vec(row[col.GPS_VEL : col.GPS_VEL + 3])
    if not math.isfinite(vel[0] + vel[1] + vel[2]):
        vel = bearing_velocity(s, (lat, lon, alt), time_us)
    write_vec(s.fix_from, (lat, lon, alt))
    s.fix_us = time_us
    gained = gained_since(s, time_us - round(p.gps_latency_s * US_PER_S))
    mean = (vel[0] + 0.5 * gained[0], vel[1] + 0.5 * gained[1], vel[2] + 0.5 * gained[2])
    write_vec(s.fix_location, moved((lat, lon, alt), mean, p.gps_latency_s))
    write_vec(s.fix_vel, (vel[0] + gained[0], vel[1] + gained[1], vel[2] + gained[2]))
    if not math.isfinite(s.location[0]):
        write_vec(s.location, as_vec(s.fix_location))
        write_vec(s.vel_n, as_vec(s.fix_vel))
    blend_fix(s, p)


@compiled
def gained_since(s: PaperState, time_us: int) -> Vec3:
    """Return the change of velocity since a time, and discard older values."""
    if s.gain_count == 0:
        return (0.0, 0.0, 0.0)
    newest = s.gain_count - 1
    while s.first_gain < newest and s.gains[(s.first_gain + 1) % MOST_GAINS, 0] <= time_us:
        s.first_gain += 1
    first, last = s.gains[s.first_gain % MOST_GAINS], s.gains[newest % MOST_GAINS]
    return (last[1] - first[1], last[2] - first[2], last[3] - first[3])


@compiled
def bearing_velocity(s: PaperState, location: Vec3, time_us: int) -> Vec3:
    """Return the velocity from one fix to the next: eq. 3 to 6 for a short distance."""
    f, dt_s = s.fix_from, (time_us - s.fix_us) / US_PER_S
    if not 0.0 < dt_s < POSITION_HOLD_S:
        return (0.0, 0.0, 0.0)
    north, east = displacement_m(f[0], f[1], location[0], location[1], location[2])
    return (north / dt_s, east / dt_s, (f[2] - location[2]) / dt_s)


@compiled
def advance(s: PaperState, p: PaperGains, accel: Vec3, rate: Vec3, dt_s: float) -> None:
    """Advance attitude, velocity and position by a filtered sample."""
    step = quat.from_rotation_vector(quat.scaled(rate, dt_s))
    write_quat(s.q_nb, quat.normalise(quat.multiply(as_quat(s.q_nb), step)))
    write_vec(s.rate_b, rate)
    roll, pitch = quat.tilt(accel)
    if math.cos(pitch) >= MIN_COS_PITCH:
        weight = p.alpha_gyro ** (dt_s / GAIN_INTERVAL_S)
        own = quat.to_euler(as_quat(s.q_nb))
        roll, pitch = blend_angle(weight, own[0], roll), blend_angle(weight, own[1], pitch)
        write_quat(s.q_nb, quat.from_euler(roll, pitch, own[2]))
    a, v, newest = (
        quat.rotate(as_quat(s.q_nb), accel),
        s.vel_n,
        s.gains[(s.gain_count - 1) % MOST_GAINS],
    )
    gain = (a[0] * dt_s, a[1] * dt_s, (a[2] + STANDARD_GRAVITY_MPS2) * dt_s)
    row = s.gains[s.gain_count % MOST_GAINS]
    row[0] = s.time_us
    for k in range(3):
        v[k] += gain[k]
        row[1 + k] = newest[1 + k] + gain[k]
    s.gain_count += 1
    s.first_gain = max(s.first_gain, s.gain_count - MOST_GAINS)
    write_vec(s.location, moved(as_vec(s.location), as_vec(v), dt_s))
    if p.every_sample == 1:
        blend_fix(s, p)


@compiled
def follow_rate(s: PaperState, p: PaperGains, dt_s: float) -> None:
    """Measure the sample rate, and redesign the filters when it has changed."""
    s.mean_step_s += min(1.0, dt_s / REST_S) * (dt_s - s.mean_step_s)
    rate_hz = 1.0 / s.mean_step_s if s.mean_step_s > 0.0 else s.rate_hz
    if abs(rate_hz / s.rate_hz - 1.0) > RATE_CHANGE:
        retune(s, p, rate_hz)


@compiled
def follow_rest(s: PaperState, accel: Vec3, gyro: Vec3, dt_s: float) -> None:
    """Measure the gyroscope bias at rest."""
    share = min(1.0, dt_s / REST_S)
    write_vec(s.gyro_mean, quat.part_way(as_vec(s.gyro_mean), gyro, share))
    write_vec(s.accel_mean, quat.part_way(as_vec(s.accel_mean), accel, share))
    fresh = s.fix_us != NEVER_US and (s.time_us - s.fix_us) / US_PER_S < col.FRESH_GPS_S
    quiet = (
        math.sqrt(quat.norm_sq(quat.difference(gyro, as_vec(s.gyro_mean)))) < REST[0]
        and math.sqrt(quat.norm_sq(quat.difference(accel, as_vec(s.accel_mean)))) < REST[1]
        and math.sqrt(quat.norm_sq(as_vec(s.gyro_mean))) < REST[2]
        and not (fresh and math.sqrt(quat.norm_sq(as_vec(s.fix_vel))) > REST[3])
    )
    s.rest_s = s.rest_s + dt_s if quiet else 0.0
    if s.rest_s >= REST_S:
        write_vec(s.bias_b, quat.part_way(as_vec(s.bias_b), as_vec(s.gyro_mean), share))


@compiled
def correct_yaw(s: PaperState, p: PaperGains, mag_b: Vec3) -> None:
    """Blend yaw with the tilt-compensated compass: the second complementary filter."""
    roll, pitch, yaw = quat.to_euler(as_quat(s.q_nb))
    level = quat.rotate(quat.from_euler(roll, pitch, 0.0), mag_b)
    compass = math.atan2(-level[1], level[0])
    if math.isfinite(s.declination_rad):
        compass += s.declination_rad
    weight = 0.0
    if s.mag_us != NEVER_US:
        dt_s = max(s.time_us - s.mag_us, 0) / US_PER_S
        weight = p.alpha_yaw ** (dt_s / GAIN_INTERVAL_S)
    write_quat(s.q_nb, quat.from_euler(roll, pitch, blend_angle(weight, yaw, compass)))
    s.mag_us = s.time_us


@compiled
def blend_fix(s: PaperState, p: PaperGains) -> None:
    """Blend velocity and position with the fix: eq. 1, 2, 7 and 8 as recursions."""
    write_vec(s.vel_n, quat.part_way(as_vec(s.vel_n), as_vec(s.fix_vel), 1.0 - p.alpha_accel))
    # The longitude may wrap between the two positions.
    fix_lon = s.location[1] + wrap_180(s.fix_location[1] - s.location[1])
    fix = (s.fix_location[0], fix_lon, s.fix_location[2])
    lat, lon, alt = quat.part_way(as_vec(s.location), fix, 1.0 - p.beta_velocity)
    write_vec(s.location, (lat, wrap_180(lon), alt))


@compiled
def flags_of(s: PaperState, sound: bool) -> int:
    """Return the flags, see `NavFlags`."""
    flags: int = FLAG.ATTITUDE_VALID if s.started == 1 else 0
    if s.mag_us != NEVER_US and (s.time_us - s.mag_us) / US_PER_S < STALE_MAG_S:
        flags |= FLAG.USING_MAG
        if math.isfinite(s.declination_rad):
            flags |= FLAG.HEADING_VALID
    if s.fix_us != NEVER_US:
        age_s = (s.time_us - s.fix_us) / US_PER_S
        if age_s < POSITION_HOLD_S:
            flags |= FLAG.POSITION_VALID | FLAG.VELOCITY_VALID | FLAG.ALTITUDE_VALID
        fresh = age_s < col.FRESH_GPS_S
        flags |= FLAG.USING_GPS if fresh else FLAG.DEAD_RECKONING | FLAG.DEGRADED
    return flags if sound else flags | FLAG.SENSOR_FAULT | FLAG.DEGRADED


@compiled
def blend_angle(weight: float, own: float, measured: float) -> float:
    """Return the weighted mean of two angles, along the shorter arc."""
    return float(measured + weight * wrap_pi(own - measured))


@compiled
def moved(location: Vec3, vel: Vec3, dt_s: float) -> Vec3:
    """Move latitude, longitude and height by a velocity."""
    north_m, east_m = vel[0] * dt_s, vel[1] * dt_s
    lat, lon = offset_deg(location[0], location[1], location[2], north_m, east_m)
    return (lat, lon, location[2] - vel[2] * dt_s)


STATE_LAYOUT: Final = layout(PaperState)
GAINS_LAYOUT: Final = layout(PaperGains)


@EntryPoint
def begin_state(state: int, gains: int) -> None:
    """Initialise a state of zeros."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    s.q_nb[0], s.declination_rad = 1.0, p.declination_rad
    s.fix_us = s.mag_us = NEVER_US
    for k in range(3):
        s.rate_b[k] = s.location[k] = s.vel_n[k] = NAN
        s.fix_from[k] = s.fix_location[k] = s.fix_vel[k] = NAN
    retune(s, p, FIRST_RATE_HZ)


@EntryPoint
def imu_steps(state: int, gains: int, count: int, times: int, samples: int, outputs: int) -> None:
    """Advance by IMU samples, with an output row each; standard deviations are NaN."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    time_us = array_at(times, (count,), INT)
    rows = array_at(samples, (count, col.IMU_COLUMNS), FLOAT)
    out = array_at(outputs, (count, col.NAV_COLUMNS), FLOAT)
    for i in range(count):
        sound = update_imu(s, p, time_us[i], rows[i])
        out[i, :] = NAN
        write_quat(out[i, col.NAV_QUAT : col.NAV_QUAT + 4], as_quat(s.q_nb))
        write_vec(out[i, col.NAV_RATE : col.NAV_RATE + 3], as_vec(s.rate_b))
        write_vec(out[i, col.NAV_LAT : col.NAV_LAT + 3], as_vec(s.location))
        write_vec(out[i, col.NAV_VEL : col.NAV_VEL + 3], as_vec(s.vel_n))
        out[i, col.NAV_FLAGS] = float(flags_of(s, sound))


@EntryPoint
def gps_step(state: int, gains: int, arrival_us: int, fix: int) -> None:
    """Use one fix."""
    s, p = record_at(state, STATE_LAYOUT), record_at(gains, GAINS_LAYOUT)
    update_gps(s, p, arrival_us, array_at(fix, (col.GPS_COLUMNS,), FLOAT))


class PaperEstimator(CompiledEstimator):
    """The paper's fusion with the common interface of estimators; it does not use a barometer."""

    def __init__(self, settings: PaperSettings, reference: ReferenceSettings) -> None:
        damping, w0_sq = prototype_of(settings.accel_filter, settings.chebyshev_ripple_db)
        values = msgspec.structs.asdict(settings) | {
            "damping": damping,
            "w0_sq": w0_sq,
            "every_sample": int(settings.blend == "every_sample"),
            "gps_latency_s": reference.gps_latency_s,
            "declination_rad": EarthField(reference).declination_rad,
        }
        kernels = Kernels(PaperState, begin_state, imu_steps, gps_step)
        super().__init__(kernels, filled_record(PaperGains, values), reference)
