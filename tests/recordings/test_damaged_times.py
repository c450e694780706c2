"""One rule for all formats: a time is damaged that is not between those beside it."""

import numpy as np
import pytest

from gateway.recordings.tlog import DAY_US, ORDER_US, is_damaged


@pytest.mark.parametrize(
    ("before", "time", "after", "is_odd"),
    [
        (0, 5, 10, False),
        (0, -ORDER_US, 10, False),
        (0, -ORDER_US - 1, 10, True),
        (0, 10 + ORDER_US, 10, False),
        (0, 11 + ORDER_US, 10, True),
        (0, 11 + ORDER_US, -ORDER_US - 1, False),
        (0, -DAY_US, DAY_US, True),
        (0, -DAY_US, DAY_US + 1, False),
    ],
)
def test_numbers_and_arrays_are_judged_alike(
    before: int, time: int, after: int, is_odd: bool
) -> None:
    assert is_damaged(before, time, after) is is_odd
    columns = [np.array([value, 0]) for value in (before, time, after)]
    assert is_damaged(*columns).tolist() == [is_odd, False]
