"""How late the compass is: its samples tell an attitude that the gyroscope has left behind.

A magnetometer averages, and waits to be read. With `m` the field that it tells, `L` the lag and
`w` the angular rate, the field of now is `m - L w x m`, to first order. The gyroscope carries the
field from one sample to another, so what it leaves unexplained between two, less what it leaves of
`w x m`, is `L` times that: a regression that needs neither attitude nor GPS. Iron, scale and bias
err by the angle that is turned, the lag by how the rate changes: one does not pass for the other.
"""

from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec, write_vec
from gateway.geometry.quaternion import from_rotation_vector, rotate, rotate_inverse
from gateway.records import Vec3

USUAL_LAG_S: Final = 0.02
LAG_SPREAD_S: Final = 0.02
"""Lags are expected about here; recorded flights had 13 to 47 ms."""
LONGEST_LAG_S: Final = 0.2
LAG_PAIR_S: Final = 0.08
MAX_LAG_PAIR_S: Final = 0.5
"""Samples closer together tell little but their noise, those further apart much iron."""
CHANGE_RADPS: Final = 0.1
"""A rate that changed by less tells nothing of the lag."""
FIRST_PAIRS: Final = 10.0
FIELD_NOISE: Final = 0.03
"""Share of the field's strength by which a pair is off, until so many have shown it."""
ODD_FIELD: Final = 0.1
"""A pair off by more of the strength, beyond what the lag may explain, is a disturbance's."""
LAGS_KEPT: Final = 0.9995
"""What was compared fades within some two thousand pairs."""


class LagState:
    """The lag, and what it was learned from."""

    time_s: float
    rate_b: Annotated[FloatArray, (3,)]
    q_ib: Annotated[FloatArray, (4,)]
    compass_lag_s: float
    """How long before its sample's time the compass saw the field."""
    compass_lag_var: float
    """Variance of that, s2."""
    late_rate_b: Annotated[FloatArray, (3,)]
    """Mean angular rate over the lag, rad/s."""
    late_begin_s: float
    late_field_i: Annotated[FloatArray, (3,)]
    late_change_i: Annotated[FloatArray, (3,)]
    """When a pair of samples began, and its `m` and `w x m` in the gyroscope's frame."""
    late_pairs: float
    late_changes_ut2ps2: float
    late_product_ut2ps: float
    late_left_ut2: float
    """Sums over pairs: how many, and the squares and product of the regression."""


@compiled
def begin_lag(s: LagState) -> None:
    """Expect a usual lag."""
    s.compass_lag_s, s.compass_lag_var = USUAL_LAG_S, LAG_SPREAD_S * LAG_SPREAD_S


@compiled
def follow_rate(s: LagState, dt: float) -> None:
    """Average the rate over the lag; to be called at each sample of the IMU."""
    share = min(1.0, 2.0 * dt / (max(s.compass_lag_s, 0.0) + dt))
    for k in range(3):
        s.late_rate_b[k] += share * (s.rate_b[k] - s.late_rate_b[k])


@compiled
def present_field(s: LagState, mag_b: Vec3) -> Vec3:
    """Learn the lag from one more field, and return what that field has become by now.

    Parameters
    ----------
    s : LagState
        Changed in place.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT.

    Returns
    -------
    tuple of 3 floats
        The same turned on by the lag.
    """
    learn_lag(s, mag_b)
    w = s.late_rate_b
    turn = from_rotation_vector(
        (w[0] * s.compass_lag_s, w[1] * s.compass_lag_s, w[2] * s.compass_lag_s)
    )
    return rotate_inverse(turn, mag_b)


@compiled
def learn_lag(s: LagState, mag_b: Vec3) -> None:
    """Compare how the field changed since the pair began with how the gyroscope turned it."""
    since_s = s.time_s - s.late_begin_s
    if 0.0 <= since_s < LAG_PAIR_S:
        return
    m, w = mag_b, as_vec(s.late_rate_b)
    change_b = (
        w[1] * m[2] - w[2] * m[1],
        w[2] * m[0] - w[0] * m[2],
        w[0] * m[1] - w[1] * m[0],
    )
    field_i, change_i = rotate(as_quat(s.q_ib), m), rotate(as_quat(s.q_ib), change_b)
    if 0.0 <= since_s < MAX_LAG_PAIR_S:
        f, c = s.late_field_i, s.late_change_i
        left = (field_i[0] - f[0], field_i[1] - f[1], field_i[2] - f[2])
        change = (change_i[0] - c[0], change_i[1] - c[1], change_i[2] - c[2])
        take_lag_pair(s, left, change, m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    write_vec(s.late_field_i, field_i)
    write_vec(s.late_change_i, change_i)
    s.late_begin_s = s.time_s


@compiled
def take_lag_pair(s: LagState, left: Vec3, change: Vec3, norm_sq: float) -> None:
    """Add a pair to the regression of `left`, in uT, on `change`, in uT/s."""
    changed_sq = product = left_sq = 0.0
    for k in range(3):
        changed_sq += change[k] * change[k]
        product += change[k] * left[k]
        left_sq += left[k] * left[k]
    off_sq = (
        left_sq - 2.0 * s.compass_lag_s * product + s.compass_lag_s * s.compass_lag_s * changed_sq
    )
    most_sq = ODD_FIELD * ODD_FIELD * norm_sq + 9.0 * s.compass_lag_var * changed_sq
    # What is not finite compares false.
    if not (changed_sq > CHANGE_RADPS * CHANGE_RADPS * norm_sq and off_sq < most_sq):
        return
    s.late_pairs = LAGS_KEPT * s.late_pairs + 1.0
    s.late_changes_ut2ps2 = LAGS_KEPT * s.late_changes_ut2ps2 + changed_sq
    s.late_product_ut2ps = LAGS_KEPT * s.late_product_ut2ps + product
    s.late_left_ut2 = LAGS_KEPT * s.late_left_ut2 + left_sq
    off_sum = s.late_left_ut2 - 2.0 * s.compass_lag_s * s.late_product_ut2ps
    off_sum = max(off_sum + s.compass_lag_s * s.compass_lag_s * s.late_changes_ut2ps2, 0.0)
    first = FIRST_PAIRS * FIELD_NOISE * FIELD_NOISE * norm_sq
    noise_sq = (first + off_sum) / (3.0 * (FIRST_PAIRS + s.late_pairs))
    usual = noise_sq / (LAG_SPREAD_S * LAG_SPREAD_S)
    total = s.late_changes_ut2ps2 + usual
    lag_s = (s.late_product_ut2ps + usual * USUAL_LAG_S) / total
    s.compass_lag_s = min(max(lag_s, -LONGEST_LAG_S), LONGEST_LAG_S)
    s.compass_lag_var = noise_sq / total
