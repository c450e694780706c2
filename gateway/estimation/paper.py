"""The paper's estimator: three complementary filters, its equations corrected.

Accelerometer and gyroscope give roll and pitch, the magnetometer corrects yaw, and the
acceleration is integrated twice and blended with GPS [1]_. Deviations from the print:

- Eq. 1, 2, 7, 8: the course is counted from north, so its cosine is the north velocity and north
  velocity drives latitude; a metre east is `180 / (pi r_e cos(lat))` degrees.
- Eq. 1, 2, 7, 8 are read as recursions: `V = alpha (V + a dt) + (1 - alpha) V_gps`. By default they
  blend once at each fix and run on inertial data between fixes; blending at every sample against
  the held fix, as printed, drags the track back to the last fix.
- Eq. 1, 2: the acceleration is the specific force turned into NED, gravity added; body axes cannot
  be integrated.
- Eq. 3 to 6: the receiver's own course over ground takes the place of the bearing between two
  fixes, which is used where a receiver tells no velocity.
- The vertical axis, which the paper leaves out, is blended by the same equations.
- The gyroscope is integrated as a quaternion, so that the angles are only blended, not integrated:
  Euler rates are singular at +-90 deg of pitch.

References
----------
.. [1] A. A. Arfakhsyad et al., "Unmanned Aerial Vehicle (UAV) Data-Driven Modeling Software with
   Integrated 9-Axis IMU-GPS Sensor Fusion and Data Filtering Algorithm".
"""

import math
from dataclasses import dataclass, replace
from typing import Annotated, Final, Literal

from gateway.estimation.reference import EarthField, ReferenceSettings, is_usable
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.geometry.quaternion import (
    IDENTITY,
    from_euler,
    from_rotation_vector,
    multiply,
    normalise,
    rotate,
    to_euler,
    wrap_pi,
)
from gateway.records import (
    NAN,
    UNKNOWN_VEC3,
    BaroSample,
    GpsFix,
    ImuSample,
    NavFlags,
    NavState,
    Quat,
    Vec3,
)
from gateway.settings import Settings, setting
from gateway.units import DEG_PER_DEGE7, STANDARD_GRAVITY_MPS2, US_PER_S

GAP_US: Final = 500_000
"""A longer silence is not integrated over."""
GAIN_INTERVAL_S: Final = 0.01
"""The attitude gains are given for this interval; other intervals take the matching power."""
STALE_GPS_US: Final = 1_500_000
POSITION_HOLD_US: Final = 30_000_000
"""Dead reckoning longer than this is no position any more."""
STALE_MAG_US: Final = 2_000_000
MIN_COS_PITCH: Final = 0.05
"""Nose up or down, the accelerometer does not tell the roll."""


class PaperSettings(Settings, frozen=True):
    """Weights of the paper's three complementary filters."""

    alpha_gyro: Annotated[
        float,
        setting(
            "Weight of the gyroscope in roll and pitch over 10 ms. Small follows the "
            "accelerometer's noise and manoeuvres, large drifts; time constant "
            "0.01 s * a / (1 - a).",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.995
    alpha_yaw: Annotated[
        float,
        setting(
            "Weight of the gyroscope in yaw over 10 ms, against the magnetometer.", ge=0.0, le=1.0
        ),
    ] = 0.99
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


@dataclass(slots=True)
class PaperState:
    """Everything the estimator remembers."""

    time_us: int | None = None
    q_nb: Quat = IDENTITY
    rate_b_radps: Vec3 = UNKNOWN_VEC3
    mag_time_us: int | None = None
    lat_deg: float = NAN
    lon_deg: float = NAN
    alt_m: float = NAN
    vel_n_mps: Vec3 = UNKNOWN_VEC3
    fix_time_us: int | None = None
    fix_lat_deg: float = NAN
    fix_lon_deg: float = NAN
    fix_alt_m: float = NAN
    fix_vel_n_mps: Vec3 = UNKNOWN_VEC3


def _finite(v: Vec3) -> bool:
    return math.isfinite(v[0]) and math.isfinite(v[1]) and math.isfinite(v[2])


def _blend(weight: float, predicted: Vec3, measured: Vec3) -> Vec3:
    """Weigh the predicted path against the measured one; weight 0 and 1 are exact."""
    w, v = weight, 1.0 - weight
    return (
        w * predicted[0] + v * measured[0],
        w * predicted[1] + v * measured[1],
        w * predicted[2] + v * measured[2],
    )


def _blend_angle(weight: float, predicted_rad: float, measured_rad: float) -> float:
    """Weigh two angles the shortest way round."""
    return measured_rad + weight * wrap_pi(predicted_rad - measured_rad)


class PaperEstimator:
    """The paper's fusion behind the estimators' common interface.

    Parameters
    ----------
    settings : PaperSettings
        Weights.
    reference : ReferenceSettings
        GPS latency and declination.
    """

    def __init__(self, settings: PaperSettings, reference: ReferenceSettings) -> None:
        self._settings = settings
        self._reference = reference
        self._earth = EarthField(reference)
        self._s = PaperState()

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._earth.reset()
        self._s = PaperState()

    @property
    def state(self) -> PaperState:
        """A copy of all that is remembered but the declination; may be set back."""
        return replace(self._s)

    @state.setter
    def state(self, state: PaperState) -> None:
        self._s = replace(state)

    def update_baro(self, sample: BaroSample) -> None:
        """Ignore the barometer: the paper does not use it."""

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample.

        Parameters
        ----------
        sample : ImuSample
            The filtered twins are used: the paper filters before it fuses.

        Returns
        -------
        NavState
            State at the newest time seen; standard deviations are NaN.
        """
        s = self._s
        accel, gyro = sample.accel_lowpass_b_mps2, sample.gyro_highpass_b_radps
        sound = _finite(sample.accel_b_mps2) and _finite(sample.gyro_b_radps)
        sound = sound and _finite(accel) and _finite(gyro)
        if s.time_us is None:
            if not sound:
                return self._nav(sample.time_us, sound)
            s.time_us = sample.time_us
            self._update_attitude(accel, gyro, None)
        dt_us = sample.time_us - s.time_us
        if abs(dt_us) > GAP_US:
            if dt_us < 0:
                # The clock began anew: the ages of fix and compass mean nothing any more.
                s.fix_time_us = s.mag_time_us = None
            s.time_us, dt_us = sample.time_us, 0
        if dt_us > 0:
            s.time_us = sample.time_us
            if sound:
                dt_s = dt_us / US_PER_S
                self._update_attitude(accel, gyro, dt_s)
                self._update_position(accel, dt_s)
        if sample.mag_b_ut is not None and dt_us >= 0 and _finite(sample.mag_b_ut):
            self._update_yaw(sample.mag_b_ut)
        return self._nav(s.time_us, sound)

    def update_gps(self, fix: GpsFix) -> None:
        """Take in one fix: eq. 1 to 8 at the fix.

        Parameters
        ----------
        fix : GpsFix
            Moved forward by its latency and its own velocity before it is blended.
        """
        if not is_usable(fix, self._reference):
            return
        s = self._s
        lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
        self._earth.update(lat_deg, lon_deg, fix.alt_amsl_m, fix.utc_us)
        vel = fix.vel_n_mps if _finite(fix.vel_n_mps) else self._bearing_velocity(fix)
        latency_s = self._reference.gps_latency_s
        s.fix_lat_deg, s.fix_lon_deg = offset_deg(
            lat_deg, lon_deg, fix.alt_amsl_m, vel[0] * latency_s, vel[1] * latency_s
        )
        s.fix_alt_m = fix.alt_amsl_m - vel[2] * latency_s
        s.fix_vel_n_mps = vel
        if s.fix_time_us is None or not math.isfinite(s.lat_deg):
            s.lat_deg, s.lon_deg, s.alt_m = s.fix_lat_deg, s.fix_lon_deg, s.fix_alt_m
            s.vel_n_mps = vel
        s.fix_time_us = fix.time_us
        self._blend_fix()

    def _bearing_velocity(self, fix: GpsFix) -> Vec3:
        """Speed and bearing from the last fix to this one: eq. 3 to 6 over a short way."""
        s = self._s
        dt_s = 0.0 if s.fix_time_us is None else (fix.time_us - s.fix_time_us) / US_PER_S
        if not 0.0 < dt_s < POSITION_HOLD_US / US_PER_S:
            return (0.0, 0.0, 0.0)
        latency_s, old = self._reference.gps_latency_s, s.fix_vel_n_mps
        north_m, east_m = displacement_m(
            s.fix_lat_deg,
            s.fix_lon_deg,
            fix.lat_dege7 * DEG_PER_DEGE7,
            fix.lon_dege7 * DEG_PER_DEGE7,
            fix.alt_amsl_m,
        )
        return (
            north_m / dt_s + old[0] * latency_s / dt_s,
            east_m / dt_s + old[1] * latency_s / dt_s,
            (s.fix_alt_m - fix.alt_amsl_m + old[2] * latency_s) / dt_s,
        )

    def _update_attitude(self, accel: Vec3, gyro: Vec3, dt_s: float | None) -> None:
        """First complementary filter: gyroscope against the accelerometer's tilt."""
        s = self._s
        roll_rad = math.atan2(-accel[1], -accel[2])
        pitch_rad = math.atan2(accel[0], math.hypot(accel[1], accel[2]))
        s.rate_b_radps = gyro
        if dt_s is None:
            s.q_nb = from_euler(roll_rad, pitch_rad, 0.0)
            return
        turn = from_rotation_vector((gyro[0] * dt_s, gyro[1] * dt_s, gyro[2] * dt_s))
        s.q_nb = normalise(multiply(s.q_nb, turn))
        if math.cos(pitch_rad) < MIN_COS_PITCH:
            return
        weight = self._settings.alpha_gyro ** (dt_s / GAIN_INTERVAL_S)
        roll, pitch, yaw = to_euler(s.q_nb)
        s.q_nb = from_euler(
            _blend_angle(weight, roll, roll_rad), _blend_angle(weight, pitch, pitch_rad), yaw
        )

    def _update_yaw(self, mag_b_ut: Vec3) -> None:
        """Second complementary filter: yaw against the tilt-compensated compass."""
        s = self._s
        roll, pitch, yaw = to_euler(s.q_nb)
        level = rotate(from_euler(roll, pitch, 0.0), mag_b_ut)
        declination = self._earth.declination_rad
        compass = math.atan2(-level[1], level[0])
        if math.isfinite(declination):
            compass += declination
        weight = 0.0
        if s.mag_time_us is not None and s.time_us is not None:
            dt_s = max(s.time_us - s.mag_time_us, 0) / US_PER_S
            weight = self._settings.alpha_yaw ** (dt_s / GAIN_INTERVAL_S)
        s.mag_time_us = s.time_us
        s.q_nb = from_euler(roll, pitch, _blend_angle(weight, yaw, compass))

    def _update_position(self, accel: Vec3, dt_s: float) -> None:
        """Third complementary filter, its inertial path: integrate twice."""
        s = self._s
        if not math.isfinite(s.lat_deg):
            return
        a = rotate(s.q_nb, accel)
        v = s.vel_n_mps
        s.vel_n_mps = (
            v[0] + a[0] * dt_s,
            v[1] + a[1] * dt_s,
            v[2] + (a[2] + STANDARD_GRAVITY_MPS2) * dt_s,
        )
        v = s.vel_n_mps
        s.lat_deg, s.lon_deg = offset_deg(s.lat_deg, s.lon_deg, s.alt_m, v[0] * dt_s, v[1] * dt_s)
        s.alt_m -= v[2] * dt_s
        if self._settings.blend == "every_sample":
            self._blend_fix()

    def _blend_fix(self) -> None:
        """Third complementary filter, its blend: eq. 1, 2, 7 and 8 as recursions."""
        s = self._s
        s.vel_n_mps = _blend(self._settings.alpha_accel, s.vel_n_mps, s.fix_vel_n_mps)
        predicted = (s.lat_deg, s.lon_deg, s.alt_m)
        # The longitude may wrap between the two; blend the shortest way round.
        lon_deg = s.lon_deg + (s.fix_lon_deg - s.lon_deg + 180.0) % 360.0 - 180.0
        fix = (s.fix_lat_deg, lon_deg, s.fix_alt_m)
        s.lat_deg, lon, s.alt_m = _blend(self._settings.beta_velocity, predicted, fix)
        s.lon_deg = (lon + 180.0) % 360.0 - 180.0

    def _nav(self, time_us: int, sound: bool) -> NavState:
        s = self._s
        return NavState(
            time_us=time_us,
            q_nb=s.q_nb,
            rate_b_radps=s.rate_b_radps,
            lat_deg=s.lat_deg,
            lon_deg=s.lon_deg,
            alt_amsl_m=s.alt_m,
            vel_n_mps=s.vel_n_mps,
            attitude_std_rad=UNKNOWN_VEC3,
            vel_std_mps=UNKNOWN_VEC3,
            pos_std_m=UNKNOWN_VEC3,
            flags=self._flags(time_us, sound),
        )

    def _flags(self, time_us: int, sound: bool) -> NavFlags:
        s = self._s
        flags = NavFlags(0)
        if s.time_us is not None:
            flags |= NavFlags.ATTITUDE_VALID
        if s.mag_time_us is not None and time_us - s.mag_time_us < STALE_MAG_US:
            flags |= NavFlags.USING_MAG
            if math.isfinite(self._earth.declination_rad):
                flags |= NavFlags.HEADING_VALID
        if s.fix_time_us is not None:
            age_us = time_us - s.fix_time_us
            valid = NavFlags.POSITION_VALID | NavFlags.VELOCITY_VALID | NavFlags.ALTITUDE_VALID
            if age_us < POSITION_HOLD_US:
                flags |= valid
            fresh = age_us < STALE_GPS_US
            flags |= NavFlags.USING_GPS if fresh else NavFlags.DEAD_RECKONING | NavFlags.DEGRADED
        if not sound:
            flags |= NavFlags.SENSOR_FAULT | NavFlags.DEGRADED
        return flags
