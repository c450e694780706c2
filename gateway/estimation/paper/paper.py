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
- Eq. 1, 2, 7, 8: a fix is old when it arrives. What the inertial sensors saw since it was valid is
  added to its velocity, and its place moves on by both.
- Eq. 3 to 6: the receiver's own course over ground takes the place of the bearing between two
  fixes, which is used where a receiver tells no velocity.
- The vertical axis, which the paper leaves out, is blended by the same equations.
- The gyroscope is integrated as a quaternion, so that the angles are only blended, not integrated:
  Euler rates are singular at +-90 deg of pitch.
- The gyroscope's high-pass acts at rest only: what the gyroscope shows there is its bias. One that
  acts always takes the steady rate of a long turn for bias too, and the attitude with it; so that
  of the filter chain is off unless it is asked for.
- The gyroscope's weights, of which the paper tells nothing, give 33 s in tilt and 10 s in yaw. In a
  turn of rate w at bank b the accelerometer says level, and pulls the tilt off by b / (w T): 3 deg
  at a bank of 30 deg and 20 m/s. A gyroscope that is 0.1 deg/s off makes as much. The compass errs
  by the tilt that levels it times the tangent of the dip, so yaw has to be slow as well.

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

from gateway.compiled import address_of
from gateway.estimation.kernel_record import (
    FloatArray,
    IntArray,
    Packed,
    copy_record,
    filled_record,
    new_record,
    pack_record,
    unpack_record,
)
from gateway.estimation.paper import paper_kernels as kernels
from gateway.estimation.paper.paper_entry import MOTION_COLUMNS, step_live
from gateway.estimation.paper.paper_kernels import is_finite
from gateway.estimation.reference import EarthField, EarthPlace, ReferenceSettings, is_usable
from gateway.estimation.rest import RestGains, RestSettings, rest_gains
from gateway.geometry.geodesy import displacement_m
from gateway.geometry.quaternion import IDENTITY
from gateway.records import (
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
            "accelerometer's noise and levels long turns, large drifts; time constant "
            "0.01 s * a / (1 - a).",
            ge=0.0,
            le=1.0,
        ),
    ] = 0.9997
    alpha_yaw: Annotated[
        float,
        setting(
            "Weight of the gyroscope in yaw over 10 ms, against the magnetometer. Small swings "
            "with the compass in turns, large drifts; time constant as above.",
            ge=0.0,
            le=1.0,
        ),
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


@dataclass(slots=True)
class PaperState:
    """What the estimator remembers, but for `paper_kernels.Memory`."""

    time_us: int | None = None
    q_nb: Quat = IDENTITY
    rate_b_radps: Vec3 = UNKNOWN_VEC3
    mag_time_us: int | None = None
    place: kernels.Place = UNKNOWN_VEC3
    vel_n_mps: Vec3 = UNKNOWN_VEC3
    fix_time_us: int | None = None
    last_fix: kernels.Place = UNKNOWN_VEC3
    """As it came."""
    fix_place: kernels.Place = UNKNOWN_VEC3
    """Carried forward by its latency, as is its velocity."""
    fix_vel_n_mps: Vec3 = UNKNOWN_VEC3


class PaperEstimator:
    """The paper's fusion behind the estimators' common interface.

    Parameters
    ----------
    settings : PaperSettings
        Weights.
    reference : ReferenceSettings
        GPS latency and declination.
    rest : RestSettings
        What is taken for rest.
    """

    def __init__(
        self,
        settings: PaperSettings,
        reference: ReferenceSettings,
        rest: RestSettings,
    ) -> None:
        # Before a sample waits for it.
        step_live.load()
        self._settings = settings
        self._reference = reference
        self._rest = filled_record(RestGains, rest_gains(rest))
        self._earth = EarthField(reference)
        self._s = PaperState()
        self._memory = new_record(kernels.Memory)
        self._motion = np.zeros(MOTION_COLUMNS)

    def reset(self) -> None:
        """Forget everything but the settings."""
        self._earth.reset()
        self._s = PaperState()
        self._memory = new_record(kernels.Memory)

    @property
    def state(self) -> tuple[PaperState, kernels.Memory]:
        """A copy of all that is remembered but the declination; may be set back."""
        return replace(self._s), copy_record(self._memory)

    @state.setter
    def state(self, state: tuple[PaperState, kernels.Memory]) -> None:
        self._s, self._memory = replace(state[0]), copy_record(state[1])

    def snapshot(self) -> bytes:
        """Write down all that is remembered, the declination included."""
        return msgspec.msgpack.encode((self._s, pack_record(self._memory), self._earth.state))

    def restore(self, snapshot: bytes) -> None:
        """Go on from a snapshot; raises ValueError if it is none of this estimator."""
        kind = tuple[PaperState, Packed, EarthPlace | None]
        self._s, packed, self._earth.state = msgspec.msgpack.decode(snapshot, type=kind)
        self._memory = unpack_record(kernels.Memory, packed)

    def update_baro(self, sample: BaroSample) -> None:
        """Ignore the barometer: the paper does not use it."""

    def update_imu(self, sample: ImuSample) -> NavState:
        """Advance by one IMU sample.

        Parameters
        ----------
        sample : ImuSample
            Its filtered values are used: the paper filters before it fuses.

        Returns
        -------
        NavState
            State at the newest time seen; standard deviations are NaN.
        """
        s = self._s
        accel, gyro = sample.accel_lowpass_b_mps2, sample.gyro_highpass_b_radps
        sound = is_finite(sample.accel_b_mps2) and is_finite(sample.gyro_b_radps)
        sound = sound and kernels.is_sound(accel, gyro)
        if s.time_us is None:
            if not sound:
                return self._nav(sample.time_us, sound)
            s.time_us = sample.time_us
            s.rate_b_radps, s.q_nb = gyro, kernels.level_start(self._memory, accel, gyro)
        dt_us = sample.time_us - s.time_us
        if abs(dt_us) > kernels.GAP_US:
            if dt_us < 0:
                # The clock began anew: the ages of fix and compass mean nothing any more.
                s.fix_time_us = s.mag_time_us = None
                self._memory.ring_count = 0
            s.time_us, dt_us = sample.time_us, 0
        if dt_us > 0:
            s.time_us = sample.time_us
            if sound:
                self._advance(accel, gyro, dt_us / US_PER_S)
        if sample.mag_b_ut is not None and dt_us >= 0 and kernels.is_field(sample.mag_b_ut):
            self._update_yaw(sample.mag_b_ut)
        return self._nav(s.time_us, sound)

    def update_gps(self, fix: GpsFix) -> None:
        """Take in one fix: eq. 1 to 8 at the fix.

        Parameters
        ----------
        fix : GpsFix
            Moved forward by its latency before it is blended.
        """
        if not is_usable(fix, self._reference):
            return
        s = self._s
        place, vel = self._read(fix)
        place, vel = kernels.carry_forward(
            self._memory,
            place,
            vel,
            fix.time_us,
            _known(s.time_us),
            self._reference.gps_latency_s,
        )
        # They come from numpy's numbers, which a snapshot does not take.
        s.fix_place = (float(place[0]), float(place[1]), float(place[2]))
        s.fix_vel_n_mps = (float(vel[0]), float(vel[1]), float(vel[2]))
        if not math.isfinite(s.place[0]):
            s.place, s.vel_n_mps = s.fix_place, s.fix_vel_n_mps
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
                place, vel = self._read(fix)
                rows.append((fix.time_us, *place, *vel, self._earth.declination_rad))
        self.reset()
        table = np.array(rows, np.float64).reshape(-1, 1 + kernels.FIX_COLUMNS)
        fix_time_us = np.array([row[0] for row in rows], np.int64)
        if np.any(np.diff(time_us) < 0) or np.any(np.diff(fix_time_us) < 0):
            raise ValueError("the times of a log must not go back")
        gains, latency_s = self._settings, self._reference.gps_latency_s
        return kernels.run(
            (gains.alpha_gyro, gains.alpha_yaw, gains.alpha_accel, gains.beta_velocity, latency_s),
            self._rest,
            new_record(kernels.Memory),
            gains.blend == "at_fix",
            declination_rad,
            time_us,
            samples,
            fix_time_us,
            np.ascontiguousarray(table[:, 1:]),
        )

    def _read(self, fix: GpsFix) -> tuple[kernels.Place, Vec3]:
        """Return the place and velocity of a fix, and keep it for the next one's bearing."""
        s = self._s
        # Without a height of its own a fix lies as high as the one before.
        last_m = s.last_fix[2] if math.isfinite(s.last_fix[2]) else 0.0
        alt_m = fix.alt_amsl_m if math.isfinite(fix.alt_amsl_m) else last_m
        place = (fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7, alt_m)
        self._earth.update(*place, fix.utc_us)
        vel = fix.vel_n_mps
        if not is_finite(vel):
            dt_s = 0.0 if s.fix_time_us is None else (fix.time_us - s.fix_time_us) / US_PER_S
            vel = _bearing_velocity(s.last_fix, place, dt_s)
        s.last_fix, s.fix_time_us = place, fix.time_us
        return place, vel

    def _advance(self, accel: Vec3, gyro: Vec3, dt_s: float) -> None:
        s, now_us, motion = self._s, _known(self._s.time_us), self._motion
        motion[:] = (*s.q_nb, *gyro, *s.place, *s.vel_n_mps, *accel, *s.fix_vel_n_mps)
        step_live(
            address_of(self._memory),
            address_of(self._rest),
            self._settings.alpha_gyro,
            address_of(motion),
            now_us - _known(s.fix_time_us),
            now_us,
            dt_s,
        )
        m = motion.tolist()
        s.q_nb, s.rate_b_radps = (m[0], m[1], m[2], m[3]), (m[4], m[5], m[6])
        s.place, s.vel_n_mps = (m[7], m[8], m[9]), (m[10], m[11], m[12])
        if self._settings.blend == "every_sample":
            self._blend_fix()

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

    def _blend_fix(self) -> None:
        s = self._s
        s.place, s.vel_n_mps = kernels.blend_fix(
            self._settings.alpha_accel,
            self._settings.beta_velocity,
            s.place,
            s.vel_n_mps,
            s.fix_place,
            s.fix_vel_n_mps,
        )

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
            lat_deg=s.place[0],
            lon_deg=s.place[1],
            alt_amsl_m=s.place[2],
            vel_n_mps=s.vel_n_mps,
            attitude_std_rad=UNKNOWN_VEC3,
            vel_std_mps=UNKNOWN_VEC3,
            pos_std_m=UNKNOWN_VEC3,
            flags=NavFlags(flags),
        )


def _known(time_us: int | None) -> int:
    return kernels.NEVER if time_us is None else time_us


def _bearing_velocity(old: kernels.Place, new: kernels.Place, dt_s: float) -> Vec3:
    """Speed and bearing from one fix to the next: eq. 3 to 6 over a short way."""
    if not 0.0 < dt_s < kernels.POSITION_HOLD_US / US_PER_S:
        return (0.0, 0.0, 0.0)
    north_m, east_m = displacement_m(*old[:2], *new)
    return (north_m / dt_s, east_m / dt_s, (old[2] - new[2]) / dt_s)
