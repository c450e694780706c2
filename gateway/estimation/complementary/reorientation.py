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
from gateway.estimation.complementary.complementary_state import ComplementaryState
from gateway.estimation.complementary.heading import UNKNOWN_VAR
from gateway.estimation.complementary.tilt import refresh
from gateway.estimation.kernel_record import as_quat, as_vec, write_quat, write_vec
from gateway.estimation.local_position import NEVER_S
from gateway.geometry.quaternion import multiply, normalise, rotate_inverse, wrap_pi
from gateway.units import STANDARD_GRAVITY_MPS2

LEVEL_STD_RAD = 0.05
"""What the level of this estimator may be off in a manoeuvre."""


@compiled
def lose_attitude(s: ComplementaryState) -> None:
    """Give the attitude up; the place follows the fixes until the alignment has found another."""
    lose(s)
    begin_level(s)
    forget_heading(s)


@compiled
def begin_level(s: ComplementaryState) -> None:
    """Let the low-pass of gravity begin anew, with a plain mean."""
    s.force_lp_s = s.rest_s = s.epoch_s = 0.0
    s.at_rest = s.ring_count = 0
    s.tilt_sum[0] = s.tilt_sum[1] = 0.0
    s.fix_valid_s = NEVER_S


@compiled
def forget_heading(s: ComplementaryState) -> None:
    """Know nothing of the heading."""
    s.heading_var = UNKNOWN_VAR
    for k in range(3):
        s.heading_cov[k] = s.down_turn[k] = 0.0


@compiled
def watch_gravity(s: ComplementaryState) -> None:
    """Look at gravity where GPS tells no velocity."""
    dt = align_by_gravity(s, s.time_s, as_vec(s.integrals), GRAVITY_PAIR_S)
    if dt > 0.0:
        review_attitude(s, dt)


@compiled
def review_attitude(s: ComplementaryState, dt: float) -> None:
    """Compare the attitude with the alignment after a new pair of `dt` seconds."""
    q = as_quat(s.q_nb)
    if not is_to_be_taken(s, q, LEVEL_STD_RAD, math.sqrt(s.heading_var), dt):
        if tells_heading(s):
            forget_heading(s)
            s.heading_rad = wrap_pi(s.heading_rad + heading_difference(as_quat(s.found_q_nb), q))
            s.heading_var = s.heading_std * s.heading_std
            s.heading_known = s.heading_true = 1
            refresh(s)
        return
    found = find(s, q)
    forget_heading(s)
    if s.heading_known == 1:
        s.heading_true = 1
        s.heading_var = s.heading_std * s.heading_std
    begin_level(s)
    # The level frame is NED turned about down by the heading; the gyroscope's frame stays.
    half = -0.5 * s.heading_rad
    level = multiply((math.cos(half), 0.0, 0.0, math.sin(half)), found)
    q_ib = as_quat(s.q_ib)
    write_quat(s.q_ei, normalise(multiply(level, (q_ib[0], -q_ib[1], -q_ib[2], -q_ib[3]))))
    gravity = rotate_inverse(as_quat(s.q_ei), (0.0, 0.0, -STANDARD_GRAVITY_MPS2))
    write_vec(s.force_lp_i, gravity)
    refresh(s)
