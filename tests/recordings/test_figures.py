"""Figures of a flight that several commands show."""

import numpy as np
import pytest

from gateway.recordings.figures import NODE_WRAP_US, gps_outages_us, lost_share
from gateway.units import US_PER_S

TEN = [*range(0, 100, 10)]


@pytest.mark.parametrize(
    ("times", "share"),
    [
        (TEN, 0.0),
        ([0, 10, 20, 50, 60], 2 / 7),
        ([*TEN, 5, 15, 25], 0.0),
        ([NODE_WRAP_US - 20, NODE_WRAP_US - 10, 0, 20, 30], 1 / 6),
        ([0, 10, 20, 20 + 70 * US_PER_S, 30 + 70 * US_PER_S], 0.0),
        ([0, 0, 10, 20, 40], 1 / 6),
    ],
    ids=["steady", "gap", "restart", "wrap", "switched off", "same time twice"],
)
def test_lost_samples_are_gaps_of_the_usual_interval(times: list[int], share: float) -> None:
    assert lost_share(np.array(times)) == pytest.approx(share)


def test_loss_of_a_single_sample_is_unknown() -> None:
    assert lost_share(np.array([1])) is None


def outages(seconds: list[float], without: tuple[int, ...] = (), end_s: float = 0.0) -> object:
    times = np.array([round(s * US_PER_S) for s in seconds])
    fixed = np.array([k not in without for k in range(len(seconds))], bool)
    found = gps_outages_us(times, fixed, round(end_s * US_PER_S))
    return found and [(begin / US_PER_S, end / US_PER_S) for begin, end in found]


def test_outage_is_a_long_gap_between_fixes() -> None:
    assert outages([0, 0.2, 0.4, 0.6]) == []
    assert outages([0, 0.2, 2.0, 2.2]) == [(0.2, 2.0)]
    assert outages([0, 0.5, 1.0, 1.5, 2.0], without=(1, 2, 3)) == [(0.0, 2.0)]
    assert outages([0, 0.2, 0.4], end_s=5.0) == [(0.4, 5.0)]
    assert outages([0, 0.2, 0.4], without=(0, 1, 2)) is None


def test_slow_rate_of_fixes_and_jump_of_the_clock_are_no_outage() -> None:
    assert outages([0, 5, 10, 15, 30, 35]) == [(15.0, 30.0)]
    assert outages([0, 1, 2, 200_000, 200_001]) == []
