"""A fixed-wing flight whose position, velocity, attitude and rates are exactly consistent.

Theory of operation. A plan of legs commands heading, horizontal airspeed and height over time as
straight lines between corners. Three moving averages round the corners, so every command is three
times differentiable. Wind and gusts are added to the motion through the air to give the velocity
over ground. The bank is that of a coordinated turn; the pitch is that of the climb plus the angle
of attack for the load factor.

Velocity and Euler angles on a 50 Hz grid are interpolated by quintic splines. Position is the
integral of the velocity spline and acceleration its derivative; the body rate follows from the
derivatives of the angles. So the truth is closed form at any time: integrating one quantity gives
the other to machine precision.

The lengths of seven straight legs are solved for, so that in any wind the aircraft comes to rest
where it started, after exactly `FLIGHT_S`, and the flight can be repeated without a jump. The earth
does not rotate in this model, and is flat around home (a few centimetres of error at 1 km).

`Workbench` is the other motion: an aircraft that a person puts down or turns by hand.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import uniform_filter1d
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from gateway.geometry.geodesy import radii_m
from gateway.geometry.quaternion import from_euler_array
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import STANDARD_GRAVITY_MPS2

FloatArray = NDArray[np.float64]

FLIGHT_S: Final = 218.0
GRID_HZ: Final = 50
CRUISE_MPS: Final = 15.0
CRUISE_HEIGHT_M: Final = 80.0
SPLINE_DEGREE: Final = 5

RUNWAY_OFF_WIND_DEG: Final = 15.0
"""Angle between runway and wind: take-off and landing are into the wind, but not exactly."""

HEADING_ROUNDING_S: Final = 2.4
SPEED_ROUNDING_S: Final = 3.0
HEIGHT_ROUNDING_S: Final = 3.6
WIND_ROUNDING_S: Final = 6.0
"""Duration of the rounded wind gradient near the ground, to keep its acceleration below 1 m/s2."""

ATTACK_RAD: Final = math.radians(4.0)
"""Angle of attack at which the lift equals the weight at cruise."""
ATTITUDE_UNREST_RAD: Final = (math.radians(1.5), math.radians(0.8), math.radians(0.8))
"""Standard deviation of roll, pitch and yaw about the coordinated attitude, in flight."""
GUST_BANDWIDTH_HZ: Final = 0.5
UNREST_BANDWIDTH_HZ: Final = 1.0

MIN_LEG_S: Final = 3.0
CLOSURE_M: Final = 1e-6
MAX_ITERATIONS: Final = 30
STEP_WEIGHT: Final = 1e-2
"""Weight of a change by 1 s relative to a gap of 1 m: enough to prefer the least changes."""
LIFT_OFF: Final = 2
ROLL_RADPS: Final = 1.1
YAW_RADPS: Final = 0.8
PITCH_RAD: Final = 1.3
PITCH_RADPS: Final = 0.47
"""Rates without a common period, so that within a minute all sides point in all directions."""


class Leg(NamedTuple):
    """One part of the plan; speed and height are the values at its end."""

    duration_s: float
    turn_deg: float
    speed_mps: float
    height_m: float
    free: bool = False
    """Whether its duration can be changed to end the flight at home."""


PLAN: Final = (
    Leg(12.9, 0, 0, 0),
    Leg(6.5, 0, 14, 0),
    Leg(12, 0, 15, 30, free=True),
    Leg(6, -90, 15, 44),
    Leg(6, 0, 15, 48, free=True),
    Leg(6, -90, 15, 62),
    Leg(7, 0, 15, 68, free=True),
    Leg(15, -360, 15, CRUISE_HEIGHT_M),
    Leg(15, 360, 15, CRUISE_HEIGHT_M),
    Leg(4, 0, 15, 86),
    Leg(10.5, -180, 16, 95),
    Leg(17, 0, 16, 95, free=True),
    Leg(10.5, 360, 15, 85),
    Leg(6, 0, 15, 78),
    Leg(9, -180, 15, 62),
    Leg(7, 0, 15, 58, free=True),
    Leg(6, -90, 15, 48),
    Leg(18, 0, 14, 40, free=True),
    Leg(6, -90, 13, 30),
    Leg(18, 0, 12, 0, free=True),
    Leg(8, 0, 0, 0),
    Leg(11.6, 0, 0, 0),
)
"""Rest, take-off roll, climb, left-hand circuit with a figure of eight, a steep full circle,
descent, landing, roll-out, rest."""
TOUCH_DOWN: Final = len(PLAN) - 2
"""Indices of the legs at whose start the aircraft leaves and touches the ground."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The aircraft's true state at N times, as arrays of float64."""

    time_s: FloatArray
    """Shape (N,), time since the start of the simulation."""
    lat_deg: FloatArray
    lon_deg: FloatArray
    alt_amsl_m: FloatArray
    pos_n_m: FloatArray
    """Shape (N, 3), NED from home."""
    vel_n_mps: FloatArray
    """Shape (N, 3), velocity over ground."""
    q_nb: FloatArray
    """Shape (N, 4), scalar first, unit norm, continuous within one flight."""
    rate_b_radps: FloatArray
    """Shape (N, 3), body relative to NED, in body FRD: the reading of an ideal gyroscope."""
    accel_b_mps2: FloatArray
    """Shape (N, 3), specific force in body FRD: the reading of an ideal accelerometer."""
    airspeed_mps: FloatArray
    """Shape (N,), mean airspeed, without gusts."""


class SensorMotion(Protocol):
    """Motion that the simulated sensors measure."""

    def truth_at(self, time_s: FloatArray) -> Truth:
        """Return the true state at any times."""

    def attitude_at(self, time_s: FloatArray) -> FloatArray:
        """Return `q_nb` alone, shape (N, 4)."""


class Trajectory:
    """One planned flight, repeated endlessly; ValueError if no plan ends at home in this wind."""

    def __init__(self, settings: SimulatorSettings, rng: np.random.Generator) -> None:
        self._settings = settings
        self._grid_s = np.arange(round(FLIGHT_S * GRID_HZ) + 1) / GRID_HZ
        gusts = _coloured(rng, len(self._grid_s), GUST_BANDWIDTH_HZ) * settings.gust_mps
        unrest = _coloured(rng, len(self._grid_s), UNREST_BANDWIDTH_HZ) * ATTITUDE_UNREST_RAD
        durations_s = self._close(gusts)
        commands = _Commands.of(durations_s, self._grid_s, _runway_deg(settings))
        self._vel = self._velocity(commands, gusts)
        self._pos = self._vel.antiderivative()
        self._accel = self._vel.derivative()
        self._angles = _spline(self._grid_s, _attitude(commands) + commands.aloft * unrest)
        self._angle_rates = self._angles.derivative()
        airspeed = np.hypot(commands.speed_mps, commands.climb_mps)
        self._airspeed = _spline(self._grid_s, airspeed)

    def truth_at(self, time_s: FloatArray) -> Truth:
        """Return the true state at times from the start, (N,); beyond `FLIGHT_S` it repeats."""
        t = np.asarray(time_s, dtype=np.float64)
        phase = t % FLIGHT_S
        motion = (self._pos(phase), self._vel(phase), self._accel(phase))
        turning = (self._angles(phase), self._angle_rates(phase))
        return _truth(self._settings, t, motion, turning, self._airspeed(phase))

    def attitude_at(self, time_s: FloatArray) -> FloatArray:
        """Return `q_nb` alone, shape (N, 4), at times as in `truth_at`."""
        return from_euler_array(self._angles(time_s % FLIGHT_S))

    def _close(self, gusts: FloatArray) -> FloatArray:
        """Solve for leg durations that end the flight at home and in time, by Gauss-Newton steps.

        One second more on a straight leg moves the end by its ground velocity; of all steps that
        close the gap, the one with the least change of durations is taken.
        """
        durations_s = np.array([leg.duration_s for leg in PLAN])
        free = np.array([leg.free for leg in PLAN])
        for _ in range(MAX_ITERATIONS):
            commands = _Commands.of(durations_s, self._grid_s, _runway_deg(self._settings))
            vel = self._velocity(commands, gusts)
            end_m = vel.integrate(0.0, FLIGHT_S)[:2]
            late_s = durations_s.sum() - FLIGHT_S
            if np.hypot(*end_m) < CLOSURE_M and abs(late_s) < CLOSURE_M:
                return durations_s
            middle_s = (np.cumsum(durations_s) - 0.5 * durations_s)[free]
            jacobian = np.vstack([vel(middle_s)[:, :2].T, np.ones(free.sum())])
            gap = np.array([*end_m, late_s, *np.zeros(free.sum())])
            least = np.vstack([jacobian, np.eye(free.sum()) * STEP_WEIGHT])
            bounds = (MIN_LEG_S - 1e-9 - durations_s[free], np.inf)
            durations_s[free] += lsq_linear(least, -gap, bounds).x
        raise ValueError(f"no flight ends at home in a wind of {self._settings.wind_mps} m/s")

    def _velocity(self, commands: "_Commands", gusts: FloatArray) -> BSpline:
        s = self._settings
        blows_to_rad = math.radians(s.wind_from_deg) + math.pi
        wind = np.array([math.cos(blows_to_rad), math.sin(blows_to_rad), 0.0]) * s.wind_mps
        aloft = commands.aloft
        gusts = gusts * aloft
        # Vertical gusts cancel over the flight, which must end at the height of the runway.
        gusts[:, 2] -= aloft[:, 0] * gusts[:, 2].sum() / aloft.sum()
        through_air = np.column_stack(
            [
                commands.speed_mps * np.cos(commands.heading_rad),
                commands.speed_mps * np.sin(commands.heading_rad),
                -commands.climb_mps,
            ]
        )
        return _spline(self._grid_s, through_air + aloft * wind + gusts)


@dataclass(frozen=True, slots=True)
class _Commands:
    """Planned values at each time of the grid; arrays of shape (N,)."""

    heading_rad: FloatArray
    turn_radps: FloatArray
    speed_mps: FloatArray
    climb_mps: FloatArray
    airborne: FloatArray
    """0 on the ground, 1 in the air, with a smooth transition."""
    aloft: FloatArray
    """Shape (N, 1): share of the full wind at this height."""

    @staticmethod
    def of(durations_s: FloatArray, grid_s: FloatArray, runway_deg: float) -> "_Commands":
        ends_s = np.concatenate([[0.0], np.cumsum(durations_s)])
        turned_deg = np.cumsum([leg.turn_deg for leg in PLAN])
        lift_off_s, touch_down_s = ends_s[LIFT_OFF], ends_s[TOUCH_DOWN]

        def rounded(values: FloatArray, width_s: float) -> FloatArray:
            corners = np.concatenate([values[:1], values])
            return _round(np.interp(grid_s, ends_s, corners), width_s)

        def step(start_s: float, end_s: float, width_s: float) -> FloatArray:
            # Edges of a whole grid step make the result a smooth function of the durations.
            edges_s = np.array([start_s, start_s + 1 / GRID_HZ, end_s, end_s + 1 / GRID_HZ])
            return _round(np.interp(grid_s, edges_s, [0.0, 1.0, 1.0, 0.0]), width_s)

        heading = math.radians(runway_deg) + np.radians(rounded(turned_deg, HEADING_ROUNDING_S))
        height = rounded(np.array([leg.height_m for leg in PLAN]), HEIGHT_ROUNDING_S)
        half_wind_s = 0.5 * WIND_ROUNDING_S
        aloft = step(lift_off_s + half_wind_s, touch_down_s - half_wind_s, WIND_ROUNDING_S)
        return _Commands(
            heading_rad=heading,
            turn_radps=_spline(grid_s, heading).derivative()(grid_s),
            speed_mps=rounded(np.array([leg.speed_mps for leg in PLAN]), SPEED_ROUNDING_S),
            climb_mps=_spline(grid_s, height).derivative()(grid_s),
            airborne=step(lift_off_s, touch_down_s, SPEED_ROUNDING_S),
            aloft=aloft[:, np.newaxis],
        )


def _truth(
    home: SimulatorSettings,
    time_s: FloatArray,
    motion: tuple[FloatArray, FloatArray, FloatArray],
    turning: tuple[FloatArray, FloatArray],
    airspeed_mps: FloatArray,
) -> Truth:
    """Return the state from position, velocity and acceleration, and from the angles and rates."""
    pos, vel, accel = motion
    q_nb = from_euler_array(turning[0])
    ellipsoid_m = home.home_alt_m + home.geoid_separation_m
    meridian_m, parallel_m = radii_m(home.home_lat_deg, ellipsoid_m)
    return Truth(
        time_s=time_s,
        lat_deg=home.home_lat_deg + np.degrees(pos[:, 0] / meridian_m),
        lon_deg=home.home_lon_deg + np.degrees(pos[:, 1] / parallel_m),
        alt_amsl_m=home.home_alt_m - pos[:, 2],
        pos_n_m=pos,
        vel_n_mps=vel,
        q_nb=q_nb,
        rate_b_radps=body_rates(*turning),
        accel_b_mps2=rotate_inverse(q_nb, accel - (0.0, 0.0, STANDARD_GRAVITY_MPS2)),
        airspeed_mps=airspeed_mps,
    )


def rotate_inverse(q_nb: FloatArray, v_n: FloatArray) -> FloatArray:
    """Rotate vectors from NED, (N, 3) or (3,), to the body frame of attitudes, shape (N, 4)."""
    return np.asarray(Rotation.from_quat(q_nb, scalar_first=True).apply(v_n, inverse=True))


def _runway_deg(settings: SimulatorSettings) -> float:
    return settings.wind_from_deg - RUNWAY_OFF_WIND_DEG


def _attitude(commands: _Commands) -> FloatArray:
    """Return roll, pitch and continuous yaw of coordinated flight, shape (N, 3)."""
    speed = commands.speed_mps
    sideways = speed * commands.turn_radps
    bank = np.arctan2(sideways, STANDARD_GRAVITY_MPS2)
    climb_angle = np.arctan2(commands.climb_mps, np.maximum(speed, 1.0))
    load = np.hypot(sideways, STANDARD_GRAVITY_MPS2) / STANDARD_GRAVITY_MPS2
    # The constant added to the speed keeps the quotient smooth on the ground, without lift.
    carrying = (CRUISE_MPS**2 + 25.0) / (speed**2 + 25.0)
    attack = ATTACK_RAD * load * carrying * commands.airborne
    path = Rotation.from_euler("ZYX", np.column_stack([commands.heading_rad, climb_angle, bank]))
    yaw_pitch_roll = (path * Rotation.from_euler("Y", attack[:, np.newaxis])).as_euler("ZYX")
    yaw = np.unwrap(yaw_pitch_roll[:, 0])
    return np.column_stack([yaw_pitch_roll[:, 2], yaw_pitch_roll[:, 1], yaw])


def body_rates(angles: FloatArray, rates: FloatArray) -> FloatArray:
    """Convert Euler angle rates to the body rate: the exact derivative of the quaternion."""
    roll, pitch, _ = angles.T
    roll_rate, pitch_rate, yaw_rate = rates.T
    return np.column_stack(
        [
            roll_rate - yaw_rate * np.sin(pitch),
            pitch_rate * np.cos(roll) + yaw_rate * np.sin(roll) * np.cos(pitch),
            yaw_rate * np.cos(roll) * np.cos(pitch) - pitch_rate * np.sin(roll),
        ]
    )


def _spline(grid_s: FloatArray, values: FloatArray) -> BSpline:
    return make_interp_spline(grid_s, values, k=SPLINE_DEGREE)


def _round(values: FloatArray, width_s: float) -> FloatArray:
    """Round corners by three moving averages of `width_s` in total; the ends are unchanged."""
    size = 2 * round(width_s * GRID_HZ / 6.0) + 1
    for _ in range(3):
        values = uniform_filter1d(values, size, mode="nearest")
    return values


def _coloured(rng: np.random.Generator, size: int, bandwidth_hz: float) -> FloatArray:
    """Draw smooth noise of unit variance on three axes, shape (size, 3)."""
    settled = round(5.0 * GRID_HZ / bandwidth_hz)
    white = rng.standard_normal((settled + size, 3))
    # Third-order Butterworth by the bilinear transform; its wrap-around has decayed by then.
    half_rad = np.pi * np.fft.rfftfreq(len(white))
    s = 1j * np.tan(half_rad)[:, np.newaxis] / math.tan(math.pi * bandwidth_hz / GRID_HZ)
    gain = 1.0 / ((1.0 + s) * (1.0 + s + s**2))
    noise = np.fft.irfft(gain * np.fft.rfft(white, axis=0), len(white), axis=0)[settled:]
    # A third-order Butterworth passes pi / 3 of its bandwidth's noise power.
    return np.asarray(noise / math.sqrt(bandwidth_hz * math.pi / 3.0 / (0.5 * GRID_HZ)))


class Workbench:
    """The motion of an aircraft that a person handles."""

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = settings
        self._turned_from_s = np.inf
        self._sampled_s = 0.0
        self._lies_rad = np.zeros(3)

    def lay(self, roll_rad: float, pitch_rad: float) -> None:
        """Put the aircraft down in this attitude, from the next sampled time on."""
        self._turned_from_s = np.inf
        self._lies_rad = np.array([roll_rad, pitch_rad, 0.0])

    def turn(self) -> None:
        """Start turning the aircraft, from the last sampled time on."""
        self._turned_from_s = min(self._turned_from_s, self._sampled_s)

    def truth_at(self, time_s: FloatArray) -> Truth:
        """Return the true state at any times, as `Trajectory.truth_at`."""
        t = np.asarray(time_s, dtype=np.float64)
        self._sampled_s = max(self._sampled_s, float(t.max(initial=0.0)))
        still = np.zeros((len(t), 3))
        return _truth(self._settings, t, (still, still, still), self._angles(t), still[:, 0])

    def attitude_at(self, time_s: FloatArray) -> FloatArray:
        """Return `q_nb` alone, shape (N, 4)."""
        return from_euler_array(self._angles(time_s)[0])

    def _angles(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        since_s = np.maximum(time_s - self._turned_from_s, 0.0)
        # The rate increases gradually over some seconds: s' = 1 - exp(-t).
        s, s_rate = since_s + np.expm1(-since_s), -np.expm1(-since_s)
        pitch = PITCH_RAD * np.sin(PITCH_RADPS * s)
        pitch_rate = PITCH_RAD * PITCH_RADPS * np.cos(PITCH_RADPS * s)
        angles = self._lies_rad + np.column_stack([ROLL_RADPS * s, pitch, YAW_RADPS * s])
        ones = np.ones_like(s)
        rates = np.column_stack([ROLL_RADPS * ones, pitch_rate, YAW_RADPS * ones])
        return angles, rates * s_rate[:, np.newaxis]
