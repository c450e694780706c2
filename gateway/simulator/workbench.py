"""An aircraft on a workbench: it lies level until it is turned by hand about all its axes.

For `mavgate setup --simulated`, which waits for a person between its steps: the turning begins when
it is asked for, not at a time.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import (
    Truth,
    body_rates,
    euler_quaternions,
    rotate_inverse,
)
from gateway.units import STANDARD_GRAVITY_MPS2

FloatArray = NDArray[np.float64]

ROLL_RADPS: Final = 1.1
YAW_RADPS: Final = 0.8
PITCH_RAD: Final = 1.3
PITCH_RADPS: Final = 0.47
"""Rates without a common period: within a minute every side of the aircraft points everywhere."""


class Workbench:
    """The motion of an aircraft that a person holds.

    Parameters
    ----------
    settings : SimulatorSettings
        Home, where it stays.
    """

    def __init__(self, settings: SimulatorSettings) -> None:
        self._settings = settings
        self._turned_from_s = np.inf
        self._sampled_s = 0.0

    def turn(self) -> None:
        """Begin to turn it, from the last sampled time on."""
        self._turned_from_s = min(self._turned_from_s, self._sampled_s)

    def truth_at(self, time_s: FloatArray) -> Truth:
        """Return the true state at any times, as `Trajectory.truth_at` does."""
        t = np.asarray(time_s, dtype=np.float64)
        self._sampled_s = max(self._sampled_s, float(t.max(initial=0.0)))
        angles, rates = self._angles(t)
        q_nb = euler_quaternions(angles)
        home, still = self._settings, np.zeros((len(t), 3))
        return Truth(
            time_s=t,
            lat_deg=np.full(len(t), home.home_lat_deg),
            lon_deg=np.full(len(t), home.home_lon_deg),
            alt_amsl_m=np.full(len(t), home.home_alt_m),
            pos_n_m=still,
            vel_n_mps=still,
            accel_n_mps2=still,
            q_nb=q_nb,
            rate_b_radps=body_rates(angles, rates),
            accel_b_mps2=rotate_inverse(q_nb, np.array([0.0, 0.0, -STANDARD_GRAVITY_MPS2])),
            airspeed_mps=np.zeros(len(t)),
        )

    def attitude_at(self, time_s: FloatArray) -> FloatArray:
        """Return `q_nb` alone, shape (N, 4)."""
        return euler_quaternions(self._angles(time_s)[0])

    def _angles(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return roll, pitch and yaw and their rates, shape (N, 3)."""
        since_s = np.maximum(time_s - self._turned_from_s, 0.0)
        # It gathers speed within some seconds: s' = 1 - exp(-t).
        s, s_rate = since_s + np.expm1(-since_s), -np.expm1(-since_s)
        pitch = PITCH_RAD * np.sin(PITCH_RADPS * s)
        pitch_rate = PITCH_RAD * PITCH_RADPS * np.cos(PITCH_RADPS * s)
        angles = np.column_stack([ROLL_RADPS * s, pitch, YAW_RADPS * s])
        ones = np.ones_like(s)
        rates = np.column_stack([ROLL_RADPS * ones, pitch_rate, YAW_RADPS * ones])
        return angles, rates * s_rate[:, np.newaxis]
