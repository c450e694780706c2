"""Which times of a recording are damaged: no checksum shows it, only those beside them."""

from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from gateway.units import US_PER_S

DAY_US: Final = 86_400 * US_PER_S
"""Records that lie further apart are of different days: nothing is said of what is between."""
ORDER_US: Final = 2 * US_PER_S
"""A time that is further before the record before, or behind the next one, is damaged."""

Times = TypeVar("Times", int, NDArray[np.int64])


def is_damaged(before_us: Times, time_us: Times, after_us: Times) -> bool | NDArray[np.bool_]:
    """Return whether a time is not between those beside it, which are in order.

    Parameters
    ----------
    before_us, time_us, after_us : int, or ndarray of shape (n,)
        Of the record before, of the record itself, and of the next one.

    Returns
    -------
    bool, or ndarray of shape (n,)
    """
    gap_us = after_us - before_us
    is_in_order = (gap_us >= -ORDER_US) & (gap_us <= DAY_US)
    is_outside = (time_us < before_us - ORDER_US) | (time_us > after_us + ORDER_US)
    return is_in_order & is_outside
