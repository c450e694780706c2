"""What shows the iron that a compass carries along: strength and dip of the field.

A field that grows and shrinks as the aircraft turns has a part that turns along. With `B` the
Earth's strength and `b` that part, `|m|^2 - |m - b|^2 = b . (2 m - b)` makes the strength of the
raw field `|m| = B + b . d` with `d = (2 m - b) / (|m| + |m - b|)`, whatever the attitude is. `B`
goes out with the means of both sides. What of it points up or down, or along the field's level
part, also bends the dip.
"""

import math
from typing import Annotated, Final

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray, as_vec, fill
from gateway.geometry.quaternion import body_axes
from gateway.records import Quat, Vec3

MEAN_S: Final = 60.0
"""The strength of the field itself stays the same over this time."""
STRENGTH_NOISE: Final = 0.03
"""Share by which the field's strength varies with no iron to find: soft iron, scale, currents."""
MISFIT_S: Final = 20.0
"""A strength that has varied for so long beyond its noise is that of unknown iron; the heading's
error by it lasts as long, for it changes with the attitude alone."""
UNLIKELY_TIMES: Final = 2.0
"""No iron makes the Earth's field so many times as strong or as weak as it usually is."""
COMPASS_CORRELATION_S: Final = 1.0
"""The errors of soft iron and current change with the attitude, so in about this time: recorded
compasses were 3 to 5 deg off, for half a second to two."""


class IronState:
    """Means of what the strength of the field is compared with."""

    iron_norm: float
    """Mean strength of the field in flight, its iron in, uT."""
    iron_along: Annotated[FloatArray, (3,)]
    """Mean of how each axis of the iron adds to that."""
    iron_s: float
    """Over which time."""
    iron_misfit: float
    """Mean square by which the strength differs from what the known iron explains, uT2."""
    iron_doubted: int
    """1 once that was more than noise, with GPS."""


@compiled
def forget_strength(s: IronState) -> None:
    """Know nothing of how the strength of the field has varied."""
    s.iron_norm = s.iron_s = s.iron_misfit = 0.0
    s.iron_doubted = 0
    fill(s.iron_along, 0.0)


@compiled
def is_likely(norm: float, usual: float) -> bool:
    """Return whether a strength may be that of the Earth and of iron, and is no odd number."""
    return norm < UNLIKELY_TIMES * usual and usual < UNLIKELY_TIMES * norm


@compiled
def compare_strength(s: IronState, raw: Vec3, iron_b: Vec3, dt: float) -> tuple[float, Vec3]:
    """Compare the strength of a field with its mean.

    Parameters
    ----------
    s : IronState
        Its means are carried on.
    raw : tuple of 3 floats
        Field in body FRD with the iron still in, uT.
    iron_b : tuple of 3 floats
        The iron as far as it is known, in body FRD, uT.
    dt : float
        Time since the field before, s.

    Returns
    -------
    tuple of float and of 3 floats
        By how much the strength is more than its mean and the known iron explain, uT; and how
        each axis of the iron adds to that.
    """
    b = iron_b
    c0, c1, c2 = raw[0] - b[0], raw[1] - b[1], raw[2] - b[2]
    norm = math.sqrt(raw[0] * raw[0] + raw[1] * raw[1] + raw[2] * raw[2])
    total = norm + math.sqrt(c0 * c0 + c1 * c1 + c2 * c2)
    along = ((raw[0] + c0) / total, (raw[1] + c1) / total, (raw[2] + c2) / total)
    s.iron_s += dt
    share = dt / min(s.iron_s, MEAN_S)
    s.iron_norm += share * (norm - s.iron_norm)
    off = norm - s.iron_norm
    for k in range(3):
        s.iron_along[k] += share * (along[k] - s.iron_along[k])
        off -= (along[k] - s.iron_along[k]) * b[k]
    s.iron_misfit += dt / MISFIT_S * (off * off - s.iron_misfit)
    mean = as_vec(s.iron_along)
    return off, (along[0] - mean[0], along[1] - mean[1], along[2] - mean[2])


@compiled
def strength_noise_sq(s: IronState) -> float:
    """Return the variance of the field's strength with no iron to find, uT2."""
    return (STRENGTH_NOISE * s.iron_norm) ** 2


@compiled
def unexplained_iron_sq(s: IronState) -> float:
    """Return the variance, per axis, of what bends the field beyond the iron that is known, uT2."""
    return max(s.iron_misfit - strength_noise_sq(s), 0.0)


@compiled
def mean_strengthening(s: IronState, iron_b: Vec3) -> float:
    """Return by how much iron makes the mean field stronger, uT."""
    d = s.iron_along
    return float(d[0] * iron_b[0] + d[1] * iron_b[1] + d[2] * iron_b[2])


@compiled
def heading_by_iron(q_eb: Quat, field_e: Vec3) -> Vec3:
    """Return how iron along each body axis turns the heading that a field tells, rad/uT.

    Parameters
    ----------
    q_eb : tuple of 4 floats
        Attitude: body FRD to the level frame of the field.
    field_e : tuple of 3 floats
        The field in a level frame, the known iron out of it, uT.

    Returns
    -------
    tuple of 3 floats
        Derivatives.
    """
    x, y, z = body_axes(q_eb)
    return turned_heading(x, field_e), turned_heading(y, field_e), turned_heading(z, field_e)


@compiled
def turned_heading(axis_e: Vec3, field_e: Vec3) -> float:
    """Return how iron along one axis in the level frame turns the heading, rad/uT."""
    north, east, _ = field_e
    return (east * axis_e[0] - north * axis_e[1]) / (north * north + east * east)


@compiled
def dip_by_iron(q_eb: Quat, field_e: Vec3) -> Vec3:
    """Return how the dip that is told changes as iron along each body axis is taken out, rad/uT.

    Parameters and shape as those of `heading_by_iron`.
    """
    x, y, z = body_axes(q_eb)
    return bent_dip(x, field_e), bent_dip(y, field_e), bent_dip(z, field_e)


@compiled
def bent_dip(axis_e: Vec3, field_e: Vec3) -> float:
    """Return how the dip changes as iron along one axis in the level frame is taken out, rad/uT."""
    north, east, down = field_e
    level = math.hypot(north, east)
    along = (north * axis_e[0] + east * axis_e[1]) / level
    return (down * along - level * axis_e[2]) / (level * level + down * down)
