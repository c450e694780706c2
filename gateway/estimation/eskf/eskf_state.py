"""EskfState of the error-state Kalman filter: nominal values and the covariance of their errors."""

from typing import Annotated, Final

from gateway.estimation.filtering.filter_state import FilterState
from gateway.estimation.kernel_record import FloatArray

TILT: Final = 0
"""Attitude error: the rotation in NED that takes the estimate to the truth, rad."""
VEL: Final = 3
POS: Final = 6
GYRO_BIAS: Final = 9
ACCEL_BIAS: Final = 12
WANDER: Final = 15
"""Slow error of the GPS position in NED, m."""
MAG_BIAS: Final = 18
"""Iron that the calibration left, in body FRD, uT."""
GYRO_SCALE: Final = 21
"""Share by which each axis of the gyroscope tells too much."""
BARO_BIAS: Final = 24
"""What is added to the barometer's depth, m."""
STATES: Final = 25


class EskfState(FilterState):
    """All that the filter remembers."""

    q_nb: Annotated[FloatArray, (4,)]
    gyro_bias_b: Annotated[FloatArray, (3,)]
    accel_bias_b: Annotated[FloatArray, (3,)]
    gyro_scale_b: Annotated[FloatArray, (3,)]
    wander_n: Annotated[FloatArray, (3,)]
    mag_bias_b: Annotated[FloatArray, (3,)]
    baro_bias_m: float
    P: Annotated[FloatArray, (STATES, STATES)]

    h: Annotated[FloatArray, (STATES,)]
    """Scratch: one row of the measurement matrix."""
    Ph: Annotated[FloatArray, (STATES,)]
    considered: Annotated[FloatArray, (STATES,)]
    """Scratch: 1 for the states that a measurement must not change."""
    dx: Annotated[FloatArray, (STATES,)]
    """Scratch: error found so far in one group of measurements."""

    pending_s: float
    """Time over which the covariance has still to be propagated."""
    pending_force_n: Annotated[FloatArray, (3,)]
    pending_rad: float
    """How far the aircraft turned in that time."""
    unseen_rad2: float
    unseen_m2ps2: float
    """Variances of angle and velocity by what has not been seen since: samples that were lost, and
    what lies beyond the range of a sensor."""
    pending_accel_sq: float
    """Integral of the squared acceleration over that time."""
    pending_turn: Annotated[FloatArray, (3, 3)]
    """Integral of `R_nb` over that time."""
    pending_scaled: Annotated[FloatArray, (3, 3)]
    """Integral of `R_nb diag(gyro)` over that time; without GPS the last row alone, for the
    heading: the level then rests on gravity."""

    aided: int
    """1 while position and velocity are those of GPS, 0 while they only keep the attitude level."""
    mag_used_s: float
    mag_unlike: float
    """Mean of `field_unlikeness` over the last `field_memory_s`."""
    field_n: Annotated[FloatArray, (3,)]
    """The field that the compass was last used with, NED, uT; all zero before."""
    field_held_s: float
    """Time in motion for which the usual field has held; what was learned at rest is a place's."""
    left_iron_ut: float
    """Standard deviation per axis of what bends the field: iron that the calibration left, and more
    where the field in motion is not that of the place where the heading was read."""
    compass_share: float
    """How much of what the compass is off on its board the heading is off: 1 while only it tells
    the heading, less the more GPS does."""
    scale_known: int
    """1 where the gyroscope's scale is known beforehand, to a smoother: it is only considered."""
    iron_search_started: int
    """1 once the iron that the calibration left is looked for."""
    aided_before: int
    """1 once GPS has told the velocity: it tells the accelerometer's bias from tilt."""
    pseudo_s: float
    """Last time of a measurement that stands in for a sensor: no motion, or little."""
    hand_sq: float
    """Variance of a level velocity that began unknown in a hand, per axis, m2/s2; it fades."""
    unaided_sq: float
    """Mean square of the speed that has shown itself where no GPS tells it, per axis, m2/s2."""
    assumed: Annotated[FloatArray, (6,)]
    """What the speed of about zero has lately corrected: attitude in rad, velocity in m/s."""
    assumed_bias: Annotated[FloatArray, (3,)]
    """The same of the gyroscope's bias, rad/s."""
    assumed_scale: Annotated[FloatArray, (3,)]
    """And of its scale."""
    flies: int
    """1 while the way without GPS is that of a flight."""
    rest_unsure: int
    """1 after a silence that began at rest, until a sample shows whether it still holds."""
    hold_s: float
    """How long position is dead-reckoned."""
    baro_down_m: float
    """Newest barometer height, positive down."""
    fix_vel: Annotated[FloatArray, (3,)]
    wander_var: Annotated[FloatArray, (3,)]
    """Of the slow error of the GPS position, by the receiver's own word where it gives one, m2."""
    place_density: Annotated[FloatArray, (3,)]
    """Density of the noise by which the place runs away: slow errors of GPS velocities, m2/s."""
    force_turn_var: float
    """Variance of the attitude about an axis by what force does to a gyroscope, rad2: it is told
    beside `P`, and fades as that is reduced."""
    bias_raised: Annotated[FloatArray, (3,)]
    """Sum of what doubt has added to the variance of the gyroscope's bias, rad2/s2."""
    iron_raised: Annotated[FloatArray, (3,)]
    """The same of the iron, uT2."""
    renewals: Annotated[FloatArray, (STATES,)]
    """How often each state began anew: what it was before says nothing of what it is since."""
    off_last_m: float
    """By how much the last fix contradicted the filter's place, horizontal; 0 if it did not."""
    contradiction_m: float
    """By how much the last two fixes did; the true place may be either."""
    contradiction_mps: float
    """By how much the velocities of fixes did of late, along an axis."""
    height_off_s: float
    """For how long the heights of the fixes have contradicted the filter's."""
    height_held_s: float
    """For how long they have agreed with it while there was a barometer."""
    weighed_s: float
    """Arrival of the last fix that was weighed, accepted or not."""
    doubt_vel_sq: float
    doubt_pos_sq: float
    """Variance by which fixes are off of late beyond what is expected, per axis, m2/s2 and m2."""
    manoeuvre_mps2: float
    """Hardest acceleration of late."""
