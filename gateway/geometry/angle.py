"""Wrapping of angles, single ones in kernels or whole columns."""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from gateway.compiled import compiled

Angle = TypeVar("Angle", float, NDArray[np.float64])


@compiled
def wrap_pi(angle_rad: Angle) -> Angle:
    """Wrap an angle, or an array of them, to [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


@compiled
def wrap_180(angle_deg: Angle) -> Angle:
    """Wrap an angle, or an array of them, to [-180, 180): a longitude, or a difference of two."""
    return (angle_deg + 180.0) % 360.0 - 180.0
