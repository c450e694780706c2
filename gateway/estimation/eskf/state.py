"""State of the error-state Kalman filter: nominal values and the covariance of their errors."""

from typing import Annotated, Final

from gateway.estimation.alignment import MatchState
from gateway.estimation.health import HealthState
from gateway.estimation.magfield import FieldState
from gateway.estimation.place import PlaceState
from gateway.estimation.record import FloatArray
from gateway.estimation.rest import RestState

TILT: Final = 0
"""Attitude error: the rotation in NED that takes the estimate to the truth, rad."""
VEL: Final = 3
POS: Final = 6
GYRO_BIAS: Final = 9
ACCEL_BIAS: Final = 12
WANDER: Final = 15
"""Slow error of the GPS position in NED, m."""
MAG_BIAS: Final = 18
"""Slow error of the compass, rad."""
BARO_BIAS: Final = 19
"""What is added to the barometer's depth, m."""
STATES: Final = 20


class State(HealthState, RestState, FieldState, PlaceState, MatchState):
    """All that the filter remembers."""

    started: int
    base_us: int
    time_us: int
    q_nb: Annotated[FloatArray, (4,)]
    gyro_bias_b: Annotated[FloatArray, (3,)]
    accel_bias_b: Annotated[FloatArray, (3,)]
    wander_n: Annotated[FloatArray, (3,)]
    mag_bias_rad: float
    baro_bias_m: float
    P: Annotated[FloatArray, (STATES, STATES)]

    h: Annotated[FloatArray, (STATES,)]
    """Scratch: one row of the measurement matrix."""
    Ph: Annotated[FloatArray, (STATES,)]
    held: Annotated[FloatArray, (STATES,)]
    """Scratch: 1 for the states that a measurement must not change."""
    dx: Annotated[FloatArray, (STATES,)]
    """Scratch: error found so far in one group of measurements."""

    pending_s: float
    """Time over which the covariance has still to be propagated."""
    pending_force_n: Annotated[FloatArray, (3,)]
    pending_rate_sq: float
    """Integral of the squared angular rate over that time."""
    rough_gyro: float
    """Variance of the angle over that time if the changes of the rate were white noise."""
    rough_accel: float
    """The same of the velocity."""
    pending_accel_sq: float
    """The same of the acceleration."""
    pending_turn: Annotated[FloatArray, (3, 3)]
    """Integral of `R_nb` over that time."""

    aided: int
    """1 while position and velocity are those of GPS, 0 while they only keep the attitude level."""
    heading_known: int
    heading_true: int
    declination_rad: float
    mag_s: float
    mag_used_s: float
    pseudo_s: float
    """Last time of a measurement that stands in for a sensor: no motion, or little."""
    hold_s: float
    """How long position is dead-reckoned."""
    baro_s: float
    baro_known: int
    baro_down_m: float
    """Newest barometer height, positive down."""
    has_height: int
    """1 once a fix has told the height above the sea."""
    fix_s: float
    fix_valid_s: float
    fix_vel: Annotated[FloatArray, (3,)]
    fix_force: Annotated[FloatArray, (3,)]
