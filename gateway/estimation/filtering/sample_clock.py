"""The clock of a filter: its begin, its step from sample to sample, and silences."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.alignment.review import GAP_LOST_RAD, GAP_S
from gateway.estimation.filtering.filter_state import FilterState
from gateway.estimation.kernel_record import as_vec, write_vec
from gateway.estimation.magfield import begin_turn
from gateway.estimation.rest import begin_rest, is_usual_bias
from gateway.estimation.sensor_faults import (
    ACCEL_LIMIT_MPS2,
    GYRO_LIMIT_RADPS,
    UNKNOWN_HOLD_S,
    is_blank,
    is_hanging,
    is_sound,
)
from gateway.geometry.quaternion import rotate_inverse
from gateway.records import Quat, Vec3

LONGEST_SILENCE_S: Final = 60.0
"""What moved and turned for longer may be anywhere: more tells no more, but breaks a covariance."""
USUAL_STEP_SHARE: Final = 0.01
"""Of the newest step in the usual one: it is an average over a hundred samples."""
LOST_STEPS: Final = 1.5
"""Samples further apart than so many usual steps had others between them."""
RATE_TAU_S: Final = 0.3
"""An angular rate is another one after this time: between that of a hand, or of a multirotor in the
wind, and that of what flies on wings."""
TURNING_S: Final = 5.0
"""How much turns is averaged over this time."""
UNSEEN_MPS2: Final = 3.0
"""By so much a force may differ between two samples from what both tell."""
STEADY_S: Final = 1.0
"""What turned in a longer silence, both ends of it do not tell."""


@compiled
def begin_clock(s: FilterState, time_us: int, gyro: Vec3, accel: Vec3) -> None:
    """Begin at a sound sample: the time, and the averages over samples."""
    s.started, s.base_us, s.time_us, s.time_s = 1, time_us, time_us, 0.0
    begin_rest(s, gyro, accel)
    write_vec(s.force_first_i, accel)
    write_vec(s.force_mean_i, accel)
    write_vec(s.rate_b, gyro)
    write_vec(s.gyro_held, gyro)
    write_vec(s.accel_held, accel)
    s.usual_hold_s = UNKNOWN_HOLD_S


@compiled
def step_clock(s: FilterState, time_us: int) -> float:
    """Go on to a sample.

    Parameters
    ----------
    s : FilterState
        Changed in place.
    time_us : int
        Of the sample, on the gateway's clock.

    Returns
    -------
    float
        Time in s since the sample before. Not positive for one that is late, which is to be left
        out; below `-GAP_S` the clock is a new one, and begins here.
    """
    dt = (time_us - s.time_us) * 1e-6
    if dt <= 0.0:
        s.fault = 1
        if dt < -GAP_S:
            s.base_us, s.time_us, s.time_s, s.imu_s = time_us, time_us, 0.0, 0.0
        return dt
    s.time_us, s.time_s = time_us, (time_us - s.base_us) * 1e-6
    s.gap_s, s.imu_s = min(s.time_s - s.imu_s, LONGEST_SILENCE_S), s.time_s
    return dt


@compiled
def mean_over_step(
    s: FilterState, gyro_before: Vec3, accel_before: Vec3, gyro: Vec3, accel: Vec3, dt: float
) -> tuple[Vec3, Vec3, float]:
    """Return the mean rate and force since the sample before, where samples between were lost.

    A sample tells the usual step before it; over what is missing they changed evenly.

    Parameters
    ----------
    s : FilterState
        Follows the usual step, and how much turns.
    gyro_before, accel_before, gyro, accel : tuple of 3 floats
        The sample before and the newest one, in body FRD.
    dt : float
        Time between them, s.

    Returns
    -------
    tuple of 2 vectors and a float
        In rad/s and m/s2, and how long samples were lost, in s; 0 where none was.
    """
    if s.usual_step_s == 0.0:
        s.usual_step_s = dt
    s.usual_step_s += USUAL_STEP_SHARE * (min(dt, 2.0 * s.usual_step_s) - s.usual_step_s)
    newest_sq = (gyro[0] * gyro[0] + gyro[1] * gyro[1] + gyro[2] * gyro[2]) / 3.0
    s.turning_sq += min(dt / TURNING_S, 1.0) * (newest_sq - s.turning_sq)
    # After a silence, the sample before is not of the begin of this step.
    if dt < LOST_STEPS * s.usual_step_s or s.sound_s <= dt:
        return (gyro, accel, 0.0)
    unseen_s = dt - s.usual_step_s
    share = 0.5 * (unseen_s / dt)
    return (part_way(gyro, gyro_before, share), part_way(accel, accel_before, share), unseen_s)


@compiled
def part_way(newest: Vec3, before: Vec3, share: float) -> Vec3:
    """Return what lies a share of the way from one vector to another."""
    return (
        newest[0] + share * (before[0] - newest[0]),
        newest[1] + share * (before[1] - newest[1]),
        newest[2] + share * (before[2] - newest[2]),
    )


@compiled
def turning_variance(s: FilterState, before: Vec3, newest: Vec3, steady: Vec3) -> float:
    """Return the variance of a rate about a steady one, by what lies behind and by both ends.

    What turns is most often about one axis: that of the three together.
    """
    ends_sq = 0.0
    for k in range(3):
        ends_sq += 0.5 * ((before[k] - steady[k]) ** 2 + (newest[k] - steady[k]) ** 2)
    return max(s.turning_sq, ends_sq)


@compiled
def bridged_variance(unseen_s: float) -> float:
    """Return the variance of the integral over a time of which both ends are told, in s2.

    For an Ornstein-Uhlenbeck process of the variance 1 and the time constant `tau`, over the time
    `T`: `2 tau (T - 2 tau tanh(T / 2 tau))`.
    """
    return 2.0 * RATE_TAU_S * (unseen_s - 2.0 * told_by_an_end(unseen_s))


@compiled
def told_by_an_end(unseen_s: float) -> float:
    """Return for how much of such a time either end counts, in s: `tau tanh(T / 2 tau)`."""
    return RATE_TAU_S * math.tanh(0.5 * unseen_s / RATE_TAU_S)


@compiled
def unseen_variances(
    s: FilterState, before: Vec3, newest: Vec3, steady: Vec3, force: Vec3, unseen_s: float
) -> tuple[float, float]:
    """Return how far the mean of both ends may be off what was lost between them.

    Parameters
    ----------
    s : FilterState
        How much has turned before.
    before, newest, steady : tuple of 3 floats
        Rates at both ends and of a steady turn, rad/s.
    force : tuple of 3 floats
        Specific force, m/s2: it turns with what turned unseen.
    unseen_s : float
        How long samples were lost.

    Returns
    -------
    tuple of 2 floats
        Variances of the angle about one axis, rad2, and of the velocity along one, (m/s)2.
    """
    spread = bridged_variance(unseen_s)
    turned = turning_variance(s, before, newest, steady) * spread
    force_sq = force[0] * force[0] + force[1] * force[1] + force[2] * force[2]
    pulled = UNSEEN_MPS2 * UNSEEN_MPS2 * spread
    return (turned, pulled + 0.25 * unseen_s * unseen_s * turned * force_sq)


@compiled
def is_silent(s: FilterState, gyro: Vec3, accel: Vec3, moving: bool, dt: float) -> bool:
    """Return whether the IMU has told nothing new for too long; to be asked at each sample.

    Parameters
    ----------
    s : FilterState
        Changed in place: a silence may end, and sensors that hang are a fault.
    gyro, accel : tuple of 3 floats
        Newest sample in body FRD.
    moving : bool
        Whether the aircraft is known to move.
    dt : float
        Time since the sample before, s.
    """
    may_rest = is_usual_bias(s, gyro) and not moving
    # What fixes have lost in it, the sample at its end does not bring back.
    silent_s = dt if s.lost == 1 else s.gap_s
    hangs = silent_s <= GAP_S and is_hanging(s, gyro, accel, may_rest, dt)
    if silent_s > GAP_S or hangs:
        # Samples that are lost on their way are no fault of the sensors.
        s.fault = 1 if hangs else 0
        begin_turn(s, (0.0, 0.0, 0.0))
        return True
    s.silent_s, s.silent_rad, s.silent_turn_rad, s.silent_rest = 0.0, 0.0, 0.0, 0
    return False


@compiled
def silence_before(s: FilterState, valid_s: float) -> float:
    """Go on to a fix that was valid long after the newest sample, and tell how long; else 0."""
    ahead = valid_s - s.time_s
    if ahead <= GAP_S:
        return 0.0
    s.time_us += int(ahead * 1e6)
    s.time_s = (s.time_us - s.base_us) * 1e-6
    return ahead


@compiled
def is_rest_silent(s: FilterState) -> bool:
    """Return whether a silence began at rest, also one that fixes have come in."""
    s.silent_rest = 1 if s.at_rest == 1 or s.silent_rest == 1 else 0
    return s.silent_rest == 1


@compiled
def silent_rate(s: FilterState, bias_b: Vec3) -> Vec3:
    """Return the rate in body FRD at which a turn goes on in a silence, rad/s; none at rest."""
    if s.silent_rest == 1:
        return (0.0, 0.0, 0.0)
    return (s.gyro_lp[0] - bias_b[0], s.gyro_lp[1] - bias_b[1], s.gyro_lp[2] - bias_b[2])


@compiled
def silent_variance(s: FilterState, radps: float, dt: float) -> float:
    """Return what the next part of a silence adds to the attitude's variance, rad2.

    Whatever turns goes on turning: the angle grows with the time, however many parts it has.
    """
    before = s.silent_rad
    s.silent_rad += radps * dt
    return s.silent_rad * s.silent_rad - before * before


@compiled
def is_turn_lost(s: FilterState, still: bool) -> bool:
    """Return whether a silence of which no end is told has lost the attitude.

    One that is young may still be bridged by the sample at its end.
    """
    young = GAP_S < s.time_s - s.imu_s < STEADY_S
    return bool(s.silent_rad > GAP_LOST_RAD and not still and not young)


@compiled
def is_end_told(s: FilterState, gyro: Vec3, accel: Vec3) -> bool:
    """Return whether a sample ends a silence in motion, so that it tells where that ended."""
    sound = is_sound(gyro, GYRO_LIMIT_RADPS) and is_sound(accel, ACCEL_LIMIT_MPS2)
    moved = s.gap_s > GAP_S and not is_rest_silent(s)
    return bool(moved and sound and not is_blank(gyro, accel))


@compiled
def turn_of(q_nb: Quat, rate: Vec3) -> Vec3:
    """Return the part of a rate in body FRD that is a turn about down."""
    x, y, z = rotate_inverse(q_nb, (0.0, 0.0, 1.0))
    about = x * rate[0] + y * rate[1] + z * rate[2]
    return (x * about, y * about, z * about)


@compiled
def end_silence(
    s: FilterState, q_nb: Quat, bias_b: Vec3, gyro: Vec3, wander_radps: float
) -> tuple[Vec3, float]:
    """Tell the turn over a silence by both its ends, and how far that may be off.

    The rate wanders about the turn that it was in: an Ornstein-Uhlenbeck process of the variance
    `v` and the time constant `tau`. Over the time `T`, what either end differs from that turn by
    counts for `tau tanh(T / 2 tau)`; see `bridged_variance` for how far that may be off. In a long
    silence, another turn may have begun.

    Parameters
    ----------
    s : FilterState
        How long it was, and how much has turned before.
    q_nb : tuple of 4 floats
        Attitude; the turn that it was in is about down.
    bias_b : tuple of 3 floats
        Of the gyroscope, rad/s.
    gyro : tuple of 3 floats
        Newest sample in body FRD, rad/s, bias still in.
    wander_radps : float
        By how much it may turn beside the turn that it was in.

    Returns
    -------
    mean : tuple of 3 floats
        Rate over the whole silence, rad/s, bias still in.
    std : float
        Standard deviation of the angle about one axis, rad.
    """
    gap_s, before, rate = s.gap_s, as_vec(s.gyro_held), silent_rate(s, bias_b)
    turn = turn_of(q_nb, rate)
    steady = (bias_b[0] + turn[0], bias_b[1] + turn[1], bias_b[2] + turn[2])
    share = told_by_an_end(gap_s) / gap_s
    turned_sq = turning_variance(s, before, gyro, steady) * bridged_variance(gap_s)
    turning = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    begun = (wander_radps + turning) * max(gap_s - STEADY_S, 0.0)
    return (
        (
            steady[0] + share * (before[0] + gyro[0] - 2.0 * steady[0]),
            steady[1] + share * (before[1] + gyro[1] - 2.0 * steady[1]),
            steady[2] + share * (before[2] + gyro[2] - 2.0 * steady[2]),
        ),
        math.sqrt(turned_sq + begun * begun),
    )
