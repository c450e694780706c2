"""A steady turn, which is as quiet as rest, and a bias that has jumped, which seems to be one."""

import math
from typing import Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import as_vec, fill, write_vec
from gateway.estimation.rest import LONGEST_TURN_S, USUAL_BIAS_RADPS, RestState
from gateway.records import Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2

SLOW_TURN_RADPS: Final = 0.5 * RAD_PER_DEG
"""A steady turn of less passes for a change of the bias, and turns little before it ends."""
TURN_SIGMA: Final = 4.0
LEAN_SQ: Final = 0.1
"""Square of how far, as a share, the axis of such a turn leans from the mean force."""
LEAN_RAD: Final = 2.0 * RAD_PER_DEG
"""So far the rate must seem to have turned the level before it is asked whether it has."""


@compiled
def turns_steadily(s: RestState, bias_b: Vec3, bias_std: float, dt: float) -> bool:
    """Return whether the mean rate is that of a turn, since the bias is known not to be so large.

    What turns slowly on a smooth road, on water or in calm air is as quiet as rest, and would teach
    the bias its own rate. But it turns about the vertical: about a level axis gravity would turn in
    the body, so a rate about that is a bias that has changed.

    Parameters
    ----------
    s : RestState
        Changed in place.
    bias_b : tuple of 3 floats
        The estimator's, rad/s.
    bias_std : float
        Its standard deviation along an axis, rad/s.
    dt : float
        Time step, s.
    """
    rate, force = as_vec(s.gyro_lp), as_vec(s.accel_lp)
    off = (rate[0] - bias_b[0], rate[1] - bias_b[1], rate[2] - bias_b[2])
    norm = math.sqrt(force[0] * force[0] + force[1] * force[1] + force[2] * force[2])
    if norm == 0.0:
        s.turn_s, s.bias_jumped = 0.0, 0
        return False
    up = (force[0] / norm, force[1] / norm, force[2] / norm)
    along = off[0] * up[0] + off[1] * up[1] + off[2] * up[2]
    lean = (off[0] - along * up[0], off[1] - along * up[1], off[2] - along * up[2])
    lean_sq, upright_sq = lean[0] * lean[0] + lean[1] * lean[1] + lean[2] * lean[2], along * along
    most_sq = (SLOW_TURN_RADPS + TURN_SIGMA * bias_std) ** 2
    leans = lean_sq > max(most_sq, LEAN_SQ * upright_sq)
    turns = s.bias_shown == 1 and upright_sq > most_sq and not leans
    s.turn_s = s.turn_s + dt if turns else 0.0
    leans = lean_sq > max(SLOW_TURN_RADPS**2, LEAN_SQ * upright_sq)
    known = s.bias_shown == 1 or lean_sq > USUAL_BIAS_RADPS**2
    leans = known and leans and not is_banked_turn(lean_sq, upright_sq, norm)
    watch_lean(s, lean, up, leans, dt)
    return bool(turns and s.turn_s < LONGEST_TURN_S and s.bias_jumped == 0)


@compiled
def is_banked_turn(lean_sq: float, upright_sq: float, force_mps2: float) -> bool:
    """Return whether the force is that of a turn with such a rate across it and along it, squared.

    In a turn that is flown the force stands still in the body, across which the axis of the turn
    leans by the bank; and it is as much stronger than gravity as that bank takes.
    """
    if upright_sq == 0.0:
        return False
    share = math.sqrt(1.0 + lean_sq / upright_sq)
    return force_mps2 > STANDARD_GRAVITY_MPS2 * (1.0 + 0.5 * (share - 1.0))


@compiled
def watch_lean(s: RestState, lean: Vec3, up: Vec3, leans: bool, dt: float) -> None:
    """Look whether what seems to turn about a level axis turns the force in the body.

    If not, the bias has jumped, and what now pulls is the level that it has turned.

    Parameters
    ----------
    s : RestState
        Changed in place.
    lean : tuple of 3 floats
        What of the mean rate in body FRD, the bias out of it, is across the force, rad/s.
    up : tuple of 3 floats
        Direction of the mean specific force in body FRD.
    leans : bool
        Whether that is more than a known bias explains, and is no banked turn.
    dt : float
        Time step, s.
    """
    if s.still == 0:
        s.bias_jumped = 0
        fill(s.lean_b, 0.0)
        return
    turned_sq, changed_sq = 0.0, 0.0
    for k in range(3):
        s.lean_b[k] += lean[k] * dt
        turned_sq += s.lean_b[k] ** 2
        changed_sq += (up[k] - s.lean_force_b[k]) ** 2
    if s.bias_jumped == 1:
        s.bias_jumped = 1 if changed_sq < LEAN_RAD * LEAN_RAD else 0
    elif leans and turned_sq > LEAN_RAD * LEAN_RAD:
        s.bias_jumped = 1 if changed_sq < 0.25 * turned_sq else 0
    elif leans:
        return
    if s.bias_jumped == 0:
        fill(s.lean_b, 0.0)
        write_vec(s.lean_force_b, up)
