"""Scaling one state of a covariance: no correlation with the others changes."""

import math

from gateway.compiled import compiled
from gateway.estimation.kernel_record import FloatArray


@compiled
def scale_state(P: FloatArray, k: int, share: float) -> None:
    """Scale a row and a column.

    Parameters
    ----------
    P : ndarray, shape (n, n)
        Changed in place.
    k : int
        The state.
    share : float
        By which its standard deviation is multiplied.
    """
    for j in range(P.shape[0]):
        P[k, j] *= share
        P[j, k] *= share


@compiled
def limit_variance(P: FloatArray, k: int, most: float) -> None:
    """Scale a row and a column so that the variance is no larger: no correlation beyond one."""
    if P[k, k] > most:
        scale_state(P, k, math.sqrt(most / P[k, k]))
