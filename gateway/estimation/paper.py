"""The paper's estimator: filters, then three complementary filters, its equations corrected.

Accelerometer and gyroscope give roll and pitch, the magnetometer corrects yaw, and the acceleration
is integrated twice and blended with GPS [1]_. Deviations from the print:

- Eq. 1, 2, 7, 8: the course is counted from north, so its cosine is the north velocity and north
  velocity drives latitude; a metre east is `180 / (pi r_e cos(lat))` degrees. They are recursions:
  `V = alpha (V + a dt) + (1 - alpha) V_gps`. By default they blend once at each fix; blending at
  every sample against the held fix, as printed, drags the track back to the last fix.
- Eq. 1, 2: the acceleration is the specific force rotated to NED, gravity added.
- Eq. 3 to 6: the receiver's velocity replaces the bearing between two fixes, which is used where
  there is none. A fix is moved on over its latency by its velocity and by the acceleration since.
  The vertical axis, which the paper leaves out, is blended by the same equations.
- The gyroscope is integrated as a quaternion; Euler angles are only blended.
- A rate that is constant at rest is subtracted as bias. The high-pass of the rate would also remove
  the steady rate of a turn, so it is off unless it is set.

References
----------
.. [1] A. A. Arfakhsyad et al., "Unmanned Aerial Vehicle (UAV) Data-Driven Modeling Software with
   Integrated 9-Axis IMU-GPS Sensor Fusion and Data Filtering Algorithm".
"""

import math
from typing import Annotated, Final, Literal

import msgspec

from gateway.estimation.columns import FRESH_GPS_S
from gateway.estimation.reference import EarthField, EarthLocation, ReferenceSettings, is_usable
from gateway.estimation.vector_filter import Kind, VectorFilter, design_highpass, design_lowpass
from gateway.geometry.angle import wrap_180, wrap_pi
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.geometry.quaternion import (
    IDENTITY,
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    to_euler,
)
from gateway.records import (
    UNKNOWN_VEC3,
    BaroSample,
    GpsFix,
    ImuFlags,
    ImuSample,
    NavFlags,
    NavState,
    Quat,
    Vec3,
)
from gateway.settings import Settings, setting
from gateway.units import DEG_PER_DEGE7, STANDARD_GRAVITY_MPS2, US_PER_S

GAP_S: Final = 2.5
"""A longer interval of the IMU is not integrated."""
GAIN_INTERVAL_S: Final = 0.01
"""The attitude weights hold for this interval; other intervals take the matching power."""
POSITION_HOLD_S: Final = 30.0
"""A position is not valid after a longer time of dead reckoning."""
MOST_GAINS: Final = 2000
"""Samples of the longest latency at 1000 a second."""
STALE_MAG_S: Final = 2.0
"""A compass without readings for longer is not in use."""
MIN_COS_PITCH: Final = 0.05
"""Near the vertical the accelerometer does not give the roll."""
LIMITS: Final = (500.0, 50.0)
"""Largest force in m/s2 and rate in rad/s that a sensor of this kind can measure."""
REST: Final = (0.035, 0.5, 0.1, 0.7)
"""At rest rate and force are this close to their means, rad/s and m/s2; the mean rate is no larger,
rad/s, nor the GPS speed, m/s."""
REST_S: Final = 1.5
"""Rest begins after this time; the means and the bias follow with it as time constant."""
RATE_CHANGE: Final = 0.1
"""The filters are redesigned when the sample rate changes by this share."""


class PaperSettings(Settings, frozen=True):
    """Filters and weights of the paper's method."""

    accel_filter: Annotated[
        Kind, setting("Second-order low-pass of the acceleration: butterworth or chebyshev.")
    ] = "butterworth"
    accel_cutoff_hz: Annotated[float, setting("Its cutoff.", "Hz", ge=0.1, le=500.0)] = 10.0
    chebyshev_ripple_db: Annotated[
        float, setting("Ripple of the Chebyshev filter's pass band.", "dB", ge=0.01, le=6.0)
    ] = 1.0
    gyro_highpass_hz: Annotated[
        float,
        setting(
            "Cutoff of the rate's first-order high-pass; 0 for none. It also removes the steady "
            "rate of a long turn.",
            "Hz",
            ge=0.0,
            le=10.0,
        ),
    ] = 0.0
    alpha_gyro: Annotated[
        float,
        setting(
            "Weight of the gyroscope in roll and pitch over 10 ms. Small follows the "
            "accelerometer's noise and levels long turns, large drifts; time constant "
            "0.01 s * a / (1 - a).",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.9997
    alpha_yaw: Annotated[
        float, setting("The same in yaw, against the magnetometer.", ge=0.0, le=1.0)
    ] = 0.999
    alpha_accel: Annotated[
        float,
        setting(
            "Alpha: weight of the integrated acceleration in the velocity, against the GPS "
            "velocity. Small is smooth, large is spiky and drifts.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.1
    beta_velocity: Annotated[
        float,
        setting(
            "Beta: weight of the integrated velocity in the position, against the GPS position. "
            "Small follows the fixes, large lags and drifts.",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.1
    blend: Annotated[
        Literal["at_fix", "every_sample"],
        setting("When velocity and position are blended: at_fix or every_sample (as printed)."),
    ] = "at_fix"


class PaperState(msgspec.Struct):
    """All that the estimator keeps; times in microseconds on the gateway clock."""

    time_us: int | None = None
    q_nb: Quat = IDENTITY
    rate_b_radps: Vec3 = UNKNOWN_VEC3
    rate_hz: float = 100.0
    mean_step_s: float = 0.0
    filters: tuple[list[float] | None, list[float] | None] = (None, None)
    gyro_mean: Vec3 = (0.0, 0.0, 0.0)
    accel_mean: Vec3 = (0.0, 0.0, 0.0)
    rest_s: float = 0.0
    bias_b: Vec3 = (0.0, 0.0, 0.0)
    mag_time_us: int | None = None
    location: Vec3 = UNKNOWN_VEC3
    """Latitude and longitude in deg, height in m."""
    vel_n_mps: Vec3 = UNKNOWN_VEC3
    fix_time_us: int | None = None
    fix_from: Vec3 = UNKNOWN_VEC3
    fix_location: Vec3 = UNKNOWN_VEC3
    """The last fix, as received above, moved on by its latency here."""
    fix_vel_n_mps: Vec3 = UNKNOWN_VEC3
    gains: list[tuple[int, Vec3]] = []
    """Times of recent samples, and the integral of the acceleration there, m/s."""


class PaperEstimator:
    """The paper's fusion behind the interface of all estimators."""

    def __init__(self, settings: PaperSettings, reference: ReferenceSettings) -> None:
        self._settings, self._reference = settings, reference
        self._earth = EarthField(reference)
        s = settings
        self._lowpass = VectorFilter(
            lambda hz: design_lowpass(s.accel_filter, s.accel_cutoff_hz, hz, s.chebyshev_ripple_db)
        )
        self._highpass = VectorFilter(lambda hz: design_highpass(s.gyro_highpass_hz, hz))
        self.reset()

    def reset(self) -> None:
        """Discard everything except the settings."""
        self._earth.reset()
        self._use(PaperState())

    def _use(self, state: PaperState) -> None:
        self._s = state
        self._retune(state.rate_hz)
        self._lowpass.state, self._highpass.state = state.filters

    def _retune(self, rate_hz: float) -> None:
        self._s.rate_hz = rate_hz
        self._lowpass.retune(rate_hz)
        self._highpass.retune(rate_hz)

    def snapshot(self) -> bytes:
        """Return the whole state."""
        self._s.filters = (self._lowpass.state, self._highpass.state)
        return msgspec.msgpack.encode((self._s, self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Continue from a snapshot; raises ValueError for another estimator's."""
        kind = tuple[PaperState, EarthLocation | None]
        state, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._use(state)

    def update_baro(self, sample: BaroSample) -> None:
        """Ignore the barometer: the paper does not use it."""

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample; the standard deviations of the state are NaN."""
        s, accel, gyro = self._s, sample.accel_b_mps2, sample.gyro_b_radps
        sound = _is_below(accel, LIMITS[0]) and _is_below(gyro, LIMITS[1])
        if s.time_us is None:
            if not sound:
                return self._nav(sample.time_us, sound)
            s.time_us, s.gyro_mean, s.accel_mean = sample.time_us, gyro, accel
            s.q_nb, s.rate_b_radps = from_euler(*_tilt(accel), 0.0), gyro
        dt_s = (sample.time_us - s.time_us) / US_PER_S
        if abs(dt_s) > GAP_S:
            if dt_s < 0.0:
                s.fix_time_us = s.mag_time_us = None
            self._retune(s.rate_hz)
            s.time_us, dt_s = sample.time_us, 0.0
        if dt_s > 0.0:
            s.time_us = sample.time_us
            if sound:
                self._advance(accel, gyro, sample.flags, dt_s)
        mag = sample.mag_b_ut
        if mag is not None and dt_s >= 0.0 and any(mag) and _is_below(mag, math.inf):
            self._correct_yaw(mag)
        return self._nav(s.time_us, sound)

    def update_gps(self, fix: GpsFix) -> None:
        """Blend one fix: eq. 1 to 8, moved on by its latency."""
        if not is_usable(fix, self._reference):
            return
        s = self._s
        alt_m = next(filter(math.isfinite, (fix.alt_amsl_m, s.fix_from[2])), 0.0)
        location = (fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7, alt_m)
        self._earth.update(*location, fix.utc_us)
        known = all(map(math.isfinite, fix.vel_n_mps))
        vel = fix.vel_n_mps if known else self._bearing_velocity(location, fix.time_us)
        s.fix_from, s.fix_time_us = location, fix.time_us
        latency_s = self._reference.gps_latency_s
        gained = self._gained_since(fix.time_us - round(latency_s * US_PER_S))
        mean = (vel[0] + 0.5 * gained[0], vel[1] + 0.5 * gained[1], vel[2] + 0.5 * gained[2])
        s.fix_location = _moved(location, mean, latency_s)
        s.fix_vel_n_mps = (vel[0] + gained[0], vel[1] + gained[1], vel[2] + gained[2])
        if not math.isfinite(s.location[0]):
            s.location, s.vel_n_mps = s.fix_location, s.fix_vel_n_mps
        self._blend_fix()

    def _gained_since(self, time_us: int) -> Vec3:
        """Return the change of velocity since a time, and discard older values."""
        gains = self._s.gains
        while len(gains) > 1 and gains[1][0] <= time_us:
            del gains[0]
        return _difference(gains[-1][1], gains[0][1]) if gains else (0.0, 0.0, 0.0)

    def _bearing_velocity(self, location: Vec3, time_us: int) -> Vec3:
        """Return speed and bearing from one fix to the next: eq. 3 to 6 over a short way."""
        s = self._s
        dt_s = 0.0 if s.fix_time_us is None else (time_us - s.fix_time_us) / US_PER_S
        if not 0.0 < dt_s < POSITION_HOLD_S:
            return (0.0, 0.0, 0.0)
        north, east = displacement_m(*s.fix_from[:2], *location[:2], location[2])
        return (north / dt_s, east / dt_s, (s.fix_from[2] - location[2]) / dt_s)

    def _advance(self, accel: Vec3, gyro: Vec3, flags: ImuFlags, dt_s: float) -> None:
        """Filter a sample, then advance attitude, velocity and position."""
        s = self._s
        self._follow_rate(dt_s)
        accel_lowpass = accel if flags & ImuFlags.ACCEL_FILTERED else self._lowpass.step(accel)
        gyro_highpass = gyro if flags & ImuFlags.GYRO_FILTERED else self._highpass.step(gyro)
        self._follow_rest(accel, gyro, dt_s)
        rate = _difference(gyro_highpass, s.bias_b)
        step = from_rotation_vector((rate[0] * dt_s, rate[1] * dt_s, rate[2] * dt_s))
        s.q_nb, s.rate_b_radps = normalise(multiply(s.q_nb, step)), rate
        roll, pitch = _tilt(accel_lowpass)
        if math.cos(pitch) >= MIN_COS_PITCH:
            weight = self._settings.alpha_gyro ** (dt_s / GAIN_INTERVAL_S)
            own = to_euler(s.q_nb)
            s.q_nb = from_euler(
                _blend_angle(weight, own[0], roll), _blend_angle(weight, own[1], pitch), own[2]
            )
        a, v = rotate(s.q_nb, accel_lowpass), s.vel_n_mps
        gain = (a[0] * dt_s, a[1] * dt_s, (a[2] + STANDARD_GRAVITY_MPS2) * dt_s)
        s.vel_n_mps = (v[0] + gain[0], v[1] + gain[1], v[2] + gain[2])
        last = s.gains[-1][1] if s.gains else (0.0, 0.0, 0.0)
        total = (last[0] + gain[0], last[1] + gain[1], last[2] + gain[2])
        s.gains.append((s.time_us or 0, total))
        del s.gains[:-MOST_GAINS]
        s.location = _moved(s.location, s.vel_n_mps, dt_s)
        if self._settings.blend == "every_sample":
            self._blend_fix()

    def _follow_rate(self, dt_s: float) -> None:
        """Measure the sample rate, and redesign the filters when it has changed."""
        s = self._s
        s.mean_step_s += min(1.0, dt_s / REST_S) * (dt_s - s.mean_step_s)
        rate_hz = 1.0 / s.mean_step_s if s.mean_step_s > 0.0 else s.rate_hz
        if abs(rate_hz / s.rate_hz - 1.0) > RATE_CHANGE:
            self._retune(rate_hz)

    def _follow_rest(self, accel: Vec3, gyro: Vec3, dt_s: float) -> None:
        """Measure the gyroscope bias at rest."""
        s, share = self._s, min(1.0, dt_s / REST_S)
        s.gyro_mean, s.accel_mean = _mix(share, s.gyro_mean, gyro), _mix(share, s.accel_mean, accel)
        fixed_us, now_us = s.fix_time_us, s.time_us or 0
        age_s = math.inf if fixed_us is None else (now_us - fixed_us) / US_PER_S
        quiet = (
            math.dist(gyro, s.gyro_mean) < REST[0]
            and math.dist(accel, s.accel_mean) < REST[1]
            and math.hypot(*s.gyro_mean) < REST[2]
            and not (age_s < FRESH_GPS_S and math.hypot(*s.fix_vel_n_mps) > REST[3])
        )
        s.rest_s = s.rest_s + dt_s if quiet else 0.0
        if s.rest_s >= REST_S:
            s.bias_b = _mix(share, s.bias_b, s.gyro_mean)

    def _correct_yaw(self, mag_b_ut: Vec3) -> None:
        """Blend yaw with the tilt-compensated compass: the second complementary filter."""
        s = self._s
        roll, pitch, yaw = to_euler(s.q_nb)
        level = rotate(from_euler(roll, pitch, 0.0), mag_b_ut)
        compass = math.atan2(-level[1], level[0])
        if math.isfinite(self._earth.declination_rad):
            compass += self._earth.declination_rad
        weight = 0.0
        if s.mag_time_us is not None and s.time_us is not None:
            dt_s = max(s.time_us - s.mag_time_us, 0) / US_PER_S
            weight = self._settings.alpha_yaw ** (dt_s / GAIN_INTERVAL_S)
        s.q_nb = from_euler(roll, pitch, _blend_angle(weight, yaw, compass))
        s.mag_time_us = s.time_us

    def _blend_fix(self) -> None:
        """Blend velocity and position with the fix: eq. 1, 2, 7 and 8 as recursions."""
        s, settings = self._s, self._settings
        s.vel_n_mps = _mix(1.0 - settings.alpha_accel, s.vel_n_mps, s.fix_vel_n_mps)
        # The longitude may wrap between the two.
        fix_lon = s.location[1] + wrap_180(s.fix_location[1] - s.location[1])
        fix = (s.fix_location[0], fix_lon, s.fix_location[2])
        lat, lon, alt = _mix(1.0 - settings.beta_velocity, s.location, fix)
        s.location = (lat, wrap_180(lon), alt)

    def _nav(self, time_us: int, sound: bool) -> NavState:
        s = self._s
        return NavState(
            time_us=time_us,
            q_nb=s.q_nb,
            rate_b_radps=s.rate_b_radps,
            lat_deg=s.location[0],
            lon_deg=s.location[1],
            alt_amsl_m=s.location[2],
            vel_n_mps=s.vel_n_mps,
            attitude_std_rad=UNKNOWN_VEC3,
            vel_std_mps=UNKNOWN_VEC3,
            pos_std_m=UNKNOWN_VEC3,
            flags=self._flags(time_us, sound),
        )

    def _flags(self, time_us: int, sound: bool) -> NavFlags:
        s = self._s
        flags = NavFlags(0) if s.time_us is None else NavFlags.ATTITUDE_VALID
        if s.mag_time_us is not None and time_us - s.mag_time_us < STALE_MAG_S * US_PER_S:
            flags |= NavFlags.USING_MAG
            if math.isfinite(self._earth.declination_rad):
                flags |= NavFlags.HEADING_VALID
        if s.fix_time_us is not None:
            age_s = (time_us - s.fix_time_us) / US_PER_S
            if age_s < POSITION_HOLD_S:
                flags |= NavFlags.POSITION_VALID | NavFlags.VELOCITY_VALID | NavFlags.ALTITUDE_VALID
            fresh = age_s < FRESH_GPS_S
            flags |= NavFlags.USING_GPS if fresh else NavFlags.DEAD_RECKONING | NavFlags.DEGRADED
        return flags if sound else flags | NavFlags.SENSOR_FAULT | NavFlags.DEGRADED


def _is_below(v: Vec3, limit: float) -> bool:
    return all(abs(x) < limit for x in v)


def _difference(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _mix(share: float, a: Vec3, b: Vec3) -> Vec3:
    """Return a vector a share of the way from one to another; exact at 0 and 1."""
    kept = 1.0 - share
    return (kept * a[0] + share * b[0], kept * a[1] + share * b[1], kept * a[2] + share * b[2])


def _blend_angle(weight: float, own: float, measured: float) -> float:
    return measured + weight * wrap_pi(own - measured)


def _tilt(accel: Vec3) -> tuple[float, float]:
    """Return roll and pitch of a specific force that is gravity alone."""
    return (math.atan2(-accel[1], -accel[2]), math.atan2(accel[0], math.hypot(*accel[1:])))


def _moved(location: Vec3, vel: Vec3, dt_s: float) -> Vec3:
    """Move latitude, longitude and height by a velocity."""
    lat, lon = offset_deg(*location, vel[0] * dt_s, vel[1] * dt_s)
    return (lat, lon, location[2] - vel[2] * dt_s)
