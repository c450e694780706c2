"""A compass beside which iron comes, or a current is switched on, in flight."""

import numpy as np
import pytest

from gateway.estimation.filtering.field_jump import FieldJumpState, has_jumped
from gateway.geometry.quaternion import from_rotation_vector, rotate_inverse
from gateway.records import Vec3
from tests.estimation.test_compass_errors import errors_beside_iron
from tests.estimation.test_receiver_noise import FIELD_N_UT

STRONG_UT = np.array([25.0, -20.0, 10.0])
WEAK_UT = np.array([9.0, -9.0, 6.0])
COMES_S, GOES_S = 80.0, 100.0


def passes(time_s: np.ndarray) -> np.ndarray:
    """Pass strong iron."""
    near = (time_s > COMES_S) & (time_s < GOES_S)
    return np.outer(near, STRONG_UT)


def stays(time_s: np.ndarray) -> np.ndarray:
    """Switch a current on, for good."""
    return np.outer(time_s > COMES_S, WEAK_UT)


@pytest.mark.parametrize(("name", "passes_deg"), [("complementary", 3.5), ("eskf", 1.5)])
def test_a_heading_is_kept_where_the_field_jumps(name: str, passes_deg: float) -> None:
    for added, most_deg in ((passes, passes_deg), (stays, 1.6)):
        errors, std = errors_beside_iron(name, 0.0, added=added, since_s=COMES_S)
        assert np.degrees(np.sqrt(np.mean(errors**2))) < most_deg
        assert np.mean(errors < 2.0 * std) > 0.95


def told_jumps(
    fields: list[np.ndarray], iron_b: Vec3 = (0.0, 0.0, 0.0), unseen_s: float = 0.0
) -> list[int]:
    """Tell at which of ten fields a second one has jumped, in turns and beside iron.

    The IMU is silent up to `unseen_s`.
    """
    s, found = FieldJumpState(), []
    s.jump_from_b, s.jump_from_i, s.jump_b = np.zeros(3), np.zeros(3), np.zeros(3)
    s.jump_from_s = s.jump_noise_sq = s.jump_noise_s = 0.0
    s.jump_seen = 0
    for k, field_i in enumerate(fields):
        s.time_s = 0.1 * (k + 1)
        s.sound_s = max(s.time_s - unseen_s, 0.0)
        turn = from_rotation_vector((0.0, 0.0, 0.5 * s.time_s))
        s.q_ib = np.array(turn)
        x, y, z = rotate_inverse(turn, (field_i[0], field_i[1], field_i[2]))
        if has_jumped(s, (x + iron_b[0], y + iron_b[1], z + iron_b[2])):
            found.append(k)
            assert abs(np.linalg.norm(s.jump_b) - np.linalg.norm(WEAK_UT)) < 3.0
    return found


def noisy(count: int, rng: np.random.Generator) -> list[np.ndarray]:
    return [np.array(FIELD_N_UT) + rng.normal(0.0, 0.7, 3) for _ in range(count)]


def test_a_jump_is_told_once_at_its_second_field(rng: np.random.Generator) -> None:
    fields = noisy(300, rng)
    for k in range(203, 300):
        fields[k] += WEAK_UT
    assert told_jumps(fields) == [204]


def test_what_changes_while_the_imu_is_silent_is_no_jump(rng: np.random.Generator) -> None:
    fields = noisy(300, rng)
    for k in range(203, 300):
        fields[k] += WEAK_UT
    assert told_jumps(fields, unseen_s=20.39) == []


def test_noise_and_one_odd_field_are_no_jump(rng: np.random.Generator) -> None:
    fields = noisy(300, rng)
    fields[200] += WEAK_UT
    fields[250] *= 1e30
    assert told_jumps(fields) == []


def test_iron_that_turns_along_is_no_jump(rng: np.random.Generator) -> None:
    assert told_jumps(noisy(300, rng), (12.0, -14.0, 9.0)) == []


def test_a_noisy_compass_has_to_jump_further(rng: np.random.Generator) -> None:
    fields = [field + rng.normal(0.0, 3.0, 3) for field in noisy(300, rng)]
    for k in range(203, 300):
        fields[k] += WEAK_UT
    assert told_jumps(fields) == []
