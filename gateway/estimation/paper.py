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
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import msgspec
import numpy as np

from gateway.estimation import paper_kernels as kernels
from gateway.estimation.paper_kernels import is_finite
from gateway.estimation.record import FloatArray, IntArray
from gateway.estimation.reference import EarthField, EarthPlace, ReferenceSettings, is_usable
from gateway.geometry.geodesy import displacement_m, offset_deg
from gateway.geometry.quaternion import (
    IDENTITY,
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
from gateway.units import DEG_PER_DEGE7, US_PER_S


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

    def snapshot(self) -> bytes:
        """Write down all that is remembered, the declination included."""
        return msgspec.msgpack.encode((self._s, self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot; raises ValueError if it is none of this estimator."""
        kind = tuple[PaperState, EarthPlace | None]
        self._s, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)

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
        sound = is_finite(sample.accel_b_mps2) and is_finite(sample.gyro_b_radps)
        sound = sound and is_finite(accel) and is_finite(gyro)
        if s.time_us is None:
            if not sound:
                return self._nav(sample.time_us, sound)
            s.time_us = sample.time_us
            self._update_attitude(accel, gyro, None)
        dt_us = sample.time_us - s.time_us
        if abs(dt_us) > kernels.GAP_US:
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
        if sample.mag_b_ut is not None and dt_us >= 0 and is_finite(sample.mag_b_ut):
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
        self._carry_forward(fix)
        if s.fix_time_us is None or not math.isfinite(s.lat_deg):
            s.lat_deg, s.lon_deg, s.alt_m = s.fix_lat_deg, s.fix_lon_deg, s.fix_alt_m
            s.vel_n_mps = s.fix_vel_n_mps
        s.fix_time_us = fix.time_us
        self._blend_fix()

    def run(self, time_us: IntArray, samples: FloatArray, fixes: Iterable[GpsFix]) -> FloatArray:
        """Fuse a whole log from the start; bit for bit what its samples give one at a time.

        Parameters
        ----------
        time_us : ndarray of int, shape (n,)
            Times of the IMU samples.
        samples : ndarray, shape (n, paper_kernels.SAMPLE_COLUMNS)
            See there.
        fixes : iterable of GpsFix
            In the order of their arrival.

        Returns
        -------
        ndarray, shape (n, paper_kernels.OUT_COLUMNS)
            One row an IMU sample. The estimator itself is reset.

        Raises
        ------
        ValueError
            If a time goes back: only a live clock begins anew.
        """
        self.reset()
        declination_rad = self._earth.declination_rad
        rows = []
        for fix in fixes:
            if is_usable(fix, self._reference):
                rows.append((fix.time_us, *self._carry_forward(fix), self._earth.declination_rad))
                self._s.fix_time_us = fix.time_us
        self.reset()
        table = np.array(rows, np.float64).reshape(-1, 1 + kernels.FIX_COLUMNS)
        fix_time_us = np.array([row[0] for row in rows], np.int64)
        if np.any(np.diff(time_us) < 0) or np.any(np.diff(fix_time_us) < 0):
            raise ValueError("the times of a log must not go back")
        gains = self._settings
        return kernels.run(
            (gains.alpha_gyro, gains.alpha_yaw, gains.alpha_accel, gains.beta_velocity),
            gains.blend == "at_fix",
            declination_rad,
            time_us,
            samples,
            fix_time_us,
            np.ascontiguousarray(table[:, 1:]),
        )

    def _carry_forward(self, fix: GpsFix) -> tuple[float, ...]:
        """Move a fix forward by its latency, and keep it; tells place and velocity."""
        s = self._s
        lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
        self._earth.update(lat_deg, lon_deg, fix.alt_amsl_m, fix.utc_us)
        vel = fix.vel_n_mps if is_finite(fix.vel_n_mps) else self._bearing_velocity(fix)
        latency_s = self._reference.gps_latency_s
        s.fix_lat_deg, s.fix_lon_deg = offset_deg(
            lat_deg, lon_deg, fix.alt_amsl_m, vel[0] * latency_s, vel[1] * latency_s
        )
        s.fix_alt_m = fix.alt_amsl_m - vel[2] * latency_s
        s.fix_vel_n_mps = vel
        return (s.fix_lat_deg, s.fix_lon_deg, s.fix_alt_m, *vel)

    def _bearing_velocity(self, fix: GpsFix) -> Vec3:
        """Speed and bearing from the last fix to this one: eq. 3 to 6 over a short way."""
        s = self._s
        dt_s = 0.0 if s.fix_time_us is None else (fix.time_us - s.fix_time_us) / US_PER_S
        if not 0.0 < dt_s < kernels.POSITION_HOLD_US / US_PER_S:
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
        s = self._s
        s.rate_b_radps = gyro
        if dt_s is None:
            s.q_nb = kernels.level_start(accel)
        else:
            s.q_nb = kernels.turn(s.q_nb, accel, gyro, dt_s, self._settings.alpha_gyro)

    def _update_yaw(self, mag_b_ut: Vec3) -> None:
        s = self._s
        s.q_nb = kernels.turn_to_compass(
            s.q_nb,
            mag_b_ut,
            self._earth.declination_rad,
            _known(s.time_us),
            _known(s.mag_time_us),
            self._settings.alpha_yaw,
        )
        s.mag_time_us = s.time_us

    def _update_position(self, accel: Vec3, dt_s: float) -> None:
        s = self._s
        if not math.isfinite(s.lat_deg):
            return
        place = (s.lat_deg, s.lon_deg, s.alt_m)
        place, s.vel_n_mps = kernels.advance(s.q_nb, accel, dt_s, place, s.vel_n_mps)
        s.lat_deg, s.lon_deg, s.alt_m = place
        if self._settings.blend == "every_sample":
            self._blend_fix()

    def _blend_fix(self) -> None:
        s = self._s
        place, s.vel_n_mps = kernels.blend_fix(
            self._settings.alpha_accel,
            self._settings.beta_velocity,
            (s.lat_deg, s.lon_deg, s.alt_m),
            s.vel_n_mps,
            (s.fix_lat_deg, s.fix_lon_deg, s.fix_alt_m),
            s.fix_vel_n_mps,
        )
        s.lat_deg, s.lon_deg, s.alt_m = place

    def _nav(self, time_us: int, sound: bool) -> NavState:
        s = self._s
        flags = kernels.flags_of(
            time_us,
            s.time_us is not None,
            _known(s.mag_time_us),
            self._earth.declination_rad,
            _known(s.fix_time_us),
            sound,
        )
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
            flags=NavFlags(flags),
        )


def _known(time_us: int | None) -> int:
    return kernels.NEVER if time_us is None else time_us
