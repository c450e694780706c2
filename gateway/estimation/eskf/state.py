"""State of the filter: the nominal state, the error covariance, and the state of each part.

The true state is the nominal one plus the error; the true attitude is `q(att) * q_nb`.

The error state, in the order of the covariance's rows:

| rows | error | frame, unit |
| --- | --- | --- |
| ATT | rotation from the estimated to the true attitude | NED, rad |
| VEL | velocity | NED, m/s |
| POS | position | NED, m |
| GYRO_BIAS | gyroscope bias | body, rad/s |
| ACCEL_BIAS | accelerometer bias | body, m/s2 |
| GPS_ERROR | slow (Gauss-Markov) error of the GPS position | NED, m |
| HARD_IRON | hard iron left by the calibration | body, uT |
| GYRO_SCALE | relative scale error of each gyroscope axis | body |
| BARO_OFFSET | offset added to the barometer's depth | m |
| MAG_LATENCY | age of the field in a magnetometer sample | s |
| GPS_CLIMB | slow (Gauss-Markov) error of the vertical GPS velocity | down, m/s |
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.record import FloatArray

ATT: Final = 0
VEL: Final = 3
POS: Final = 6
GYRO_BIAS: Final = 9
ACCEL_BIAS: Final = 12
GPS_ERROR: Final = 15
HARD_IRON: Final = 18
GYRO_SCALE: Final = 21
BARO_OFFSET: Final = 24
MAG_LATENCY: Final = 25
GPS_CLIMB: Final = 26
STATES: Final = 27
WATCHED: Final = 7
"""Number of states whose corrections are tested: both biases, and the barometer's offset."""
MOVING_STATES: Final = 9
"""Attitude, velocity and position: the states that the transition changes."""

GAINED: Final = 3
MOVED: Final = 6
INTEGRALS: Final = 9
"""Number of integrals over time: of the force in the gyroscope frame, of the acceleration in NED
(`GAINED`), and of that integral (`MOVED`), three numbers each."""
HISTORY_LENGTH: Final = 512
"""Number of stored past integrals: 2.5 s at `predict.HISTORY_INTERVAL_S`, above any latency."""
LATENCIES: Final = 13
"""Number of latencies that are compared, see `latency`."""
MOMENTS: Final = 8
"""Rows: reference acceleration, measured force (three each), 1 and time; see `alignment`."""

NEVER_S: Final = -1e9
"""A time earlier than all others."""


class State:
    """State of the filter between samples."""

    # Nominal state.
    q_nb: Annotated[FloatArray, (4,)]
    vel_n: Annotated[FloatArray, (3,)]
    pos_n: Annotated[FloatArray, (3,)]
    """Metres from the origin; the third is minus the height above mean sea level."""
    gyro_bias_b: Annotated[FloatArray, (3,)]
    accel_bias_b: Annotated[FloatArray, (3,)]
    gps_error_n: Annotated[FloatArray, (3,)]
    hard_iron_b: Annotated[FloatArray, (3,)]
    gyro_scale_b: Annotated[FloatArray, (3,)]
    baro_offset_m: float
    mag_latency_s: float
    gps_climb_error_mps: float
    P: Annotated[FloatArray, (STATES, STATES)]

    # Working memory of a measurement update.
    h: Annotated[FloatArray, (STATES,)]
    """Row of the measurement matrix."""
    Ph: Annotated[FloatArray, (STATES,)]
    considered: Annotated[FloatArray, (STATES,)]
    """1 for states that the measurement must not change."""
    dx: Annotated[FloatArray, (STATES,)]
    """Error estimated so far by one group of scalar updates."""

    # Time on the gateway clock, s since `base_us` unless another unit is given.
    started: int
    base_us: int
    time_us: int
    time_s: float
    imu_s: float
    """Newest IMU sample that was used."""
    means: int
    """1 if the samples are means over their intervals."""
    usual_step_s: float
    """Average interval of IMU samples; 0 before the second."""
    sound_s: float
    """Time since the last IMU fault or gap."""

    # Integrals since the last propagation of the covariance.
    pending_s: float
    pending_force_n: Annotated[FloatArray, (3,)]
    """Specific force."""
    pending_rotation: Annotated[FloatArray, (3, 3)]
    """`R_nb`."""
    pending_rotation_gyro: Annotated[FloatArray, (3, 3)]
    """`R_nb diag(rate)`."""
    pending_noise: Annotated[FloatArray, (2,)]
    """Variances of angle and velocity beyond the sensors' noise densities."""

    # Angular rate and gyroscope frame.
    rate_b: Annotated[FloatArray, (3,)]
    """Angular rate without bias and scale error, rad/s."""
    q_ib: Annotated[FloatArray, (4,)]
    """Rotation from the body to the gyroscope frame, the integral of the angular rate."""
    imu_before: Annotated[FloatArray, (6,)]
    """Rate and force of the previous sample."""
    imu_change: Annotated[FloatArray, (6,)]
    """Change of rate and force up to the previous sample, for the vibration noise."""

    # Gravity: specific force in the gyroscope frame.
    force_lp_i: Annotated[FloatArray, (2, 3)]
    """First and second low-pass, m/s2."""
    force_dev_sq: float
    """Mean square of the force about the second low-pass, m2/s4."""
    force_lp_s: float
    """Time since the reset of the low-pass."""
    level_s: float
    """Time of the last measurement of gravity or rest."""

    # Past integrals for late fixes, see `fixes`.
    integrals: Annotated[FloatArray, (INTEGRALS,)]
    then: Annotated[FloatArray, (INTEGRALS,)]
    """Working memory: the integrals at the time of a fix."""
    history: Annotated[FloatArray, (HISTORY_LENGTH, 1 + INTEGRALS)]
    history_count: int

    # GPS.
    origin: Annotated[FloatArray, (2,)]
    """Latitude and longitude of the origin of `pos_n`, deg."""
    blend_n: Annotated[FloatArray, (2,)]
    """Offset of the output position, north and east, while a correction after a gap is blended
    in."""
    has_origin: int
    aided: int
    """1 while velocity and position are estimated: from a fix until dead reckoning ends."""
    was_aided: int
    """1 once `aided` has been 1."""
    has_height: int
    """1 once a fix has had a height above sea level."""
    fix_s: float
    """Arrival of the last accepted fix."""
    update_s: float
    """Arrival of the last fix that was fused or rejected."""
    fix_vel: Annotated[FloatArray, (3,)]
    newest_lat_deg: float
    newest_lon_deg: float
    newest_vel: Annotated[FloatArray, (3,)]
    newest_s: float
    """Newest fix, to detect repetitions, and the arrival of the first one with these values."""
    track_s: float
    track_pos_n: Annotated[FloatArray, (3,)]
    """Time and position from which a velocity is derived if fixes have none."""
    zero_s: float
    zero_pos_n: Annotated[FloatArray, (3,)]
    """The same for velocities of exactly zero."""
    zero_velocity_wrong: int
    """1 while positions contradict a velocity of exactly zero."""
    gps_error_var: Annotated[FloatArray, (3,)]
    gps_climb_error_var: float
    pos_density: Annotated[FloatArray, (3,)]
    """Position noise due to slow errors of GPS velocities, m2/s."""
    reject_s: float
    """Time for which fixes have been rejected and agreed with one another."""
    rejected_s: float
    rejected_pos_n: Annotated[FloatArray, (2,)]
    """Last rejected fix."""
    glitch_var: Annotated[FloatArray, (2,)]
    """Variance of velocity and position due to a present glitch, m2/s2 and m2."""
    hard_accel_sq: float
    """Square of the largest recent acceleration, m2/s4."""
    fix_excess: float
    """Noise of GPS velocities in units of the assumed variance, see `alignment`."""

    # Barometer.
    baro_s: float
    baro_down_m: float

    # Alignment by GPS velocities, see `alignment`.
    moments: Annotated[FloatArray, (MOMENTS, MOMENTS)]
    pairs: float
    pairs_s: float
    """Total time of the pairs, faded like them."""
    pair_s: float
    pair_vel: Annotated[FloatArray, (3,)]
    pair_force: Annotated[FloatArray, (3,)]
    work: Annotated[FloatArray, (2, 4, 4)]
    """Working memory for the eigenvector."""
    aligned_q_nb: Annotated[FloatArray, (4,)]
    aligned_std: Annotated[FloatArray, (2,)]
    """Standard deviations of its level and heading, rad."""

    # Integrity of the attitude.
    lost: int
    """1 while the attitude is unknown."""
    lost_s: float
    mismatch_s: float
    """Time for which the alignment has contradicted the attitude."""
    heading_known: int
    heading_true: int
    """1 if the heading refers to true north, 0 to magnetic north."""

    # Rest.
    imu_mean: Annotated[FloatArray, (6,)]
    """Low-pass of rate and force."""
    gyro_mean: Annotated[FloatArray, (3,)]
    """Second low-pass of the rate."""
    rest_from: Annotated[FloatArray, (6,)]
    """Mean rate and force at the begin of a rest."""
    rest_s: float
    at_rest: int
    rest_bias_b: Annotated[FloatArray, (3,)]
    """Bias measured at the last rest, rad/s; zero before the first."""
    rest_seen: int
    """1 once a rest has measured the bias, 2 once the aircraft has moved since."""
    rest_turn_rad: float
    """Angle of an apparent turn about the vertical at rest, without a turn of the compass."""

    # Magnetometer.
    declination_rad: float
    earth_dip_rad: float
    earth_norm_ut: float
    """The Earth's field at the last fix; NaN before the first."""
    mag_s: float
    """Time of the newest field that was compared with the usual one."""
    mag_used_s: float
    mag_ref: Annotated[FloatArray, (2,)]
    """Norm in uT and dip in rad of the usual field; zero while unknown."""
    mag_new: Annotated[FloatArray, (2,)]
    """The same for a candidate field."""
    mag_usual_s: float
    mag_rejected_s: float
    mag_candidate_s: float
    """Times for which the field has been usual, has been rejected, and has agreed with the
    candidate."""
    mag_disturbed: int
    mag_last: Annotated[FloatArray, (3,)]
    mag_turned: Annotated[FloatArray, (3,)]
    """Rotation since the readings last changed, rad."""
    mag_from_b: Annotated[FloatArray, (3,)]
    mag_from_i: Annotated[FloatArray, (3,)]
    """Field at the begin of a turn, in the body and in the gyroscope frame; zero for none."""
    mag_squares: Annotated[FloatArray, (3,)]
    """Sums over turns of the squared change of the field, of its part that the gyroscope does not
    explain, and of the change of the norm, uT2."""
    mag_misplaced: int
    """1 while the rotation of the field contradicts that of the aircraft."""
    mag_mean: Annotated[FloatArray, (4,)]
    """Low-pass of the field in the body and of its square, uT and uT2."""
    mag_mean_s: float
    """Time since its reset."""
    field_n: Annotated[FloatArray, (3,)]
    """Field of the last heading update, uT."""

    # GPS latency, see `latency`.
    gps_latency_s: float
    """Latency in use."""
    window_from: Annotated[FloatArray, (5,)]
    """Arrival and velocity of the begin of the next pair, and the begin of the window."""
    window_misfit: Annotated[FloatArray, (LATENCIES,)]
    """Working memory: the misfits of one window."""
    window_force: Annotated[FloatArray, (LATENCIES, 3)]
    """Integrated force at the begin of the next pair, for every latency."""
    window_sums: Annotated[FloatArray, (5,)]
    """Number of pairs; sums of their acceleration (three) and of its square."""
    window_products: Annotated[FloatArray, (LATENCIES, 10)]
    """Sums of the products of both changes of velocity, and of their squares."""
    latency_misfit: Annotated[FloatArray, (LATENCIES,)]
    """Twice the negative log-likelihood of each latency over all windows."""
    latency_found: Annotated[FloatArray, (2,)]
    """The best latency in s and its inverse variance in 1/s2."""

    # Sensor faults.
    fault: int
    imu_last: Annotated[FloatArray, (6,)]
    imu_held: Annotated[FloatArray, (6,)]
    """Newest valid values of rate and force."""
    usual_change: Annotated[FloatArray, (2,)]
    """Average change of rate and force from sample to sample, rad/s and m/s2."""
    usual_rate_sq: float
    """Mean square of the rate, (rad/s)2."""
    stuck_s: Annotated[FloatArray, (2,)]
    missing_s: Annotated[FloatArray, (2,)]
    repeat_s: float
    usual_repeat_s: float
    """Time for which both sensors have repeated a sample, and its average."""
    uncalibrated: int
    """Bits of uncalibrated sensors: 1 gyroscope, 2 accelerometer, 4 magnetometer."""

    # Bias steps, see `integrity`.
    bias_sum: Annotated[FloatArray, (WATCHED,)]
    bias_sum_var: Annotated[FloatArray, (WATCHED,)]
    """Sums of recent corrections of the watched states, and their expected variances."""
    bias_watch_s: float

    # For the smoother: discontinuities of the covariance since the start.
    resets: Annotated[FloatArray, (STATES,)]
    """Number of resets of each state."""
    raised: Annotated[FloatArray, (STATES,)]
    """Variance added to each state outside the process model."""


@compiled
def watched_state(k: int) -> int:
    """Return the state of one of the watched numbers."""
    return GYRO_BIAS + k if k < WATCHED - 1 else BARO_OFFSET


@compiled
def level_variance(s: State) -> float:
    """Return the variance of roll and pitch together, rad2."""
    return float(s.P[ATT, ATT] + s.P[ATT + 1, ATT + 1])


@compiled
def reset_state(s: State, k: int, variance: float) -> None:
    """Set a new variance of one state, uncorrelated with the others."""
    s.resets[k] += 1.0
    s.P[k, :] = 0.0
    s.P[:, k] = 0.0
    s.P[k, k] = variance


@compiled
def reset_states(s: State, first: int, variance: float) -> None:
    """Set a new variance of the three states of a vector, uncorrelated with the others."""
    for k in range(3):
        reset_state(s, first + k, variance)


@compiled
def raise_variance(s: State, k: int, more: float) -> None:
    """Increase the variance of one state outside the process model."""
    s.P[k, k] += more
    s.raised[k] += more


@compiled
def scale_state(P: FloatArray, k: int, share: float) -> None:
    """Scale a row and a column of a covariance, without changing correlations."""
    for j in range(STATES):
        P[k, j] *= share
        P[j, k] *= share


@compiled
def limit_variance(P: FloatArray, k: int, most: float) -> None:
    """Limit the variance of one state, without changing correlations."""
    if P[k, k] > most:
        scale_state(P, k, math.sqrt(most / P[k, k]))
