"""An attitude that is lost, and one that the alignment has found."""

import math

from gateway.compiled import compiled
from gateway.estimation.alignment.review import (
    GRAVITY_PAIR_S,
    find,
    is_to_be_taken,
    lose,
    tells_heading,
)
from gateway.estimation.alignment.wahba import align_by_gravity, heading_difference
from gateway.estimation.complementary.complementary_state import (
    ComplementaryGains,
    ComplementaryState,
)
from gateway.estimation.complementary.errors.drift import (
    begin_state,
    doubt_sensors,
    end_level,
    forget_heading,
    heading_variance,
    start_heading,
    start_level,
)
from gateway.estimation.complementary.tilt import LEVEL_STD_RAD, hold_level, refresh
from gateway.estimation.filtering.hidden_pull import forget_level
from gateway.estimation.kernel_record import as_quat, as_vec, write_quat
from gateway.estimation.local_position import NEVER_S
from gateway.estimation.magfield import begin_turn
from gateway.estimation.rest_bias import BIAS_CHANGE_RADPS
from gateway.geometry.quaternion import multiply, normalise


@compiled
def lose_attitude(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Give the attitude up; the place follows the fixes until the alignment has found another."""
    lose(s)
    forget_level(s)
    if s.level_by_gps == 1:
        end_level(s, p)
    begin_level(s)
    forget_heading(s, p)


@compiled
def take_rest_bias(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Begin anew with the bias that a rest has shown: the one before has turned the attitude."""
    lose_attitude(s, p)
    doubt_sensors(s, p)
    for k in range(3):
        s.bias_b[k] = s.gyro_rest[k]
        begin_state(s, k, BIAS_CHANGE_RADPS * BIAS_CHANGE_RADPS)
    begin_turn(s, (0.0, 0.0, 0.0))


@compiled
def begin_level(s: ComplementaryState) -> None:
    """Let the low-pass of gravity begin anew, with a plain mean."""
    s.force_lp_s = s.rest_s = s.epoch_s = 0.0
    s.at_rest = s.ring_count = 0
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0
    s.fix_valid_s = NEVER_S


@compiled
def watch_gravity(s: ComplementaryState, p: ComplementaryGains) -> None:
    """Look at gravity where there is no GPS velocity."""
    dt = align_by_gravity(s, s.time_s, as_vec(s.integrals), GRAVITY_PAIR_S)
    if dt > 0.0:
        review_attitude(s, p, dt)


@compiled
def find_by_gravity(s: ComplementaryState) -> None:
    """Believe the level that gravity's low-pass has found meanwhile, as far as the pairs do."""
    s.lost, s.doubt_s = 0, 0.0
    s.unaided_level_sq = s.level_std * s.level_std
    hold_level(s)


@compiled
def review_attitude(s: ComplementaryState, p: ComplementaryGains, dt: float) -> None:
    """Compare the attitude with the alignment after a new pair of `dt` seconds."""
    q = as_quat(s.q_nb)
    heading_told = math.sqrt(heading_variance(s))
    lost = s.lost == 1
    taken = is_to_be_taken(s, q, LEVEL_STD_RAD, heading_told, 0.0, dt)
    if lost and s.by_gps == 0:
        if taken or s.force_lp_s > p.tau_accel_s:
            find_by_gravity(s)
        return
    if not taken:
        if tells_heading(s):
            forget_heading(s, p)
            turn_rad = heading_difference(as_quat(s.found_q_nb), q)
            start_heading(s, p, s.heading_rad + turn_rad, s.heading_std**2)
            s.heading_known = s.heading_true = 1
            refresh(s)
        return
    found = find(s, q)
    if not lost:
        doubt_sensors(s, p)
    forget_heading(s, p)
    if s.heading_known == 1:
        s.heading_true = 1
        start_heading(s, p, s.heading_rad, s.heading_std**2)
    begin_level(s)
    # The level frame is NED turned about down by the heading; the gyroscope's frame stays.
    half = -0.5 * s.heading_rad
    level = multiply((math.cos(half), 0.0, 0.0, math.sin(half)), found)
    q_ib = as_quat(s.q_ib)
    write_quat(s.q_ei, normalise(multiply(level, (q_ib[0], -q_ib[1], -q_ib[2], -q_ib[3]))))
    s.unaided_level_sq = s.level_std * s.level_std
    hold_level(s)
    if s.by_gps == 1 and s.heading_known == 1:
        start_level(s, p, s.level_std)
    refresh(s)
