"""A field that changes by itself: iron comes near, or a current is switched on.

In the gyroscope's own frame the Earth's field stands still, whatever the attitude is. Iron that the
aircraft carries turns there, but only as it turns. What a field differs by from that of half a
second before, beyond noise and beyond what the turn may have done, has come just now: the heading
that was known before has none of it.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.alignment.wahba import AlignmentState
from gateway.estimation.filtering.iron_evidence import is_likely
from gateway.estimation.kernel_record import FloatArray, as_quat, as_vec, write_vec
from gateway.geometry.quaternion import rotate, rotate_inverse
from gateway.records import Vec3

WINDOW_S: Final = 0.5
STALE_S: Final = 1.5
"""A field that is older says nothing of the newest."""
JUMP_SQ: Final = 16.0
"""A change whose square is so many times that of the noise is a jump."""
LEAST_NOISE_UT: Final = 1.5
USUAL_NOISE_UT: Final = 4.0
USUAL_S: Final = 2.0
"""The noisiest compasses are expected until so much time has shown as much of the true noise."""
NOISE_TAU_S: Final = 20.0
CARRIED_SHARE: Final = 0.7
"""Iron that is carried along turns as well: it may be this share of the field."""


class FieldJumpState(AlignmentState):
    """The field that the newest one is compared with."""

    time_s: float
    sound_s: float
    """For how long the IMU has been sound: what it did not see turns the frame."""
    jump_from_s: float
    jump_from_b: Annotated[FloatArray, (3,)]
    """As it was in body FRD, uT; all zeros before the first."""
    jump_from_i: Annotated[FloatArray, (3,)]
    """The same in the gyroscope's frame."""
    jump_noise_sq: float
    """Mean square of how a field differs from the one before, uT2."""
    jump_noise_s: float
    """Over which time."""
    jump_seen: int
    """1 where the newest field differs by a jump; one alone may be an odd number."""
    jump_b: Annotated[FloatArray, (3,)]
    """By how much a field has jumped, in body FRD, uT."""


@compiled
def has_jumped(s: FieldJumpState, mag_b: Vec3) -> bool:
    """Return whether the field has jumped; to be asked at each sample that tells one.

    Parameters
    ----------
    s : FieldJumpState
        Changed in place; `jump_b` then tells by how much.
    mag_b : tuple of 3 floats
        Calibrated field in body FRD, uT.
    """
    since_s, b, f = s.time_s - s.jump_from_s, s.jump_from_b, as_vec(s.jump_from_i)
    known = bool(b[0] or b[1] or b[2])
    if not known or not 0.0 <= since_s <= min(STALE_S, s.sound_s):
        compare_from(s, mag_b)
        return False
    carried = rotate_inverse(as_quat(s.q_ib), f)
    off_sq = turned_sq = norm_sq = from_sq = 0.0
    for k in range(3):
        off_sq += (mag_b[k] - carried[k]) ** 2
        turned_sq += (carried[k] - b[k]) ** 2
        norm_sq += mag_b[k] * mag_b[k]
        from_sq += b[k] * b[k]
    if not is_likely(math.sqrt(norm_sq), math.sqrt(from_sq)):
        return False
    if off_sq > JUMP_SQ * field_noise_sq(s) + CARRIED_SHARE * CARRIED_SHARE * turned_sq:
        if s.jump_seen == 0:
            s.jump_seen = 1
            return False
        for k in range(3):
            s.jump_b[k] = mag_b[k] - carried[k]
        compare_from(s, mag_b)
        return True
    s.jump_seen = 0
    if since_s >= WINDOW_S:
        s.jump_noise_s = min(s.jump_noise_s + since_s, NOISE_TAU_S)
        s.jump_noise_sq += since_s / s.jump_noise_s * (off_sq - s.jump_noise_sq)
        compare_from(s, mag_b)
    return False


@compiled
def field_noise_sq(s: FieldJumpState) -> float:
    """Return the mean square by which a field differs from the one before by noise, uT2."""
    known = s.jump_noise_s / (s.jump_noise_s + USUAL_S)
    noise_sq = USUAL_NOISE_UT**2 + known * (s.jump_noise_sq - USUAL_NOISE_UT**2)
    return max(noise_sq, LEAST_NOISE_UT * LEAST_NOISE_UT)


@compiled
def compare_from(s: FieldJumpState, mag_b: Vec3) -> None:
    """Compare the fields that follow with this one."""
    s.jump_seen, s.jump_from_s = 0, s.time_s
    write_vec(s.jump_from_b, mag_b)
    write_vec(s.jump_from_i, rotate(as_quat(s.q_ib), mag_b))
