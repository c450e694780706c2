import numpy as np
import pytest

from gateway.estimation.history import SLOTS, SPACING_S, recall, remember


def filled(count: int, step_s: float = 0.01) -> tuple[np.ndarray, int]:
    ring, n = np.zeros((SLOTS, 3)), 0
    for k in range(count):
        t = k * step_s
        n = remember(ring, n, t, np.array([2.0 * t, -t]))
    return ring, n


@pytest.mark.parametrize("count", [10, SLOTS, 3 * SLOTS + 7])
@pytest.mark.parametrize("back_s", [0.0, 0.005, 0.0312, 0.09])
def test_recalls_between_the_slots(count: int, back_s: float) -> None:
    ring, n = filled(count)
    now_s = (count - 1) * 0.01
    out = np.empty(2)
    found_s = recall(ring, n, now_s - back_s, now_s, np.array([2.0 * now_s, -now_s]), out)
    assert found_s == pytest.approx(now_s - back_s)
    np.testing.assert_allclose(out, [2.0 * found_s, -found_s], atol=1e-12)


def test_holds_what_is_older_than_it_remembers() -> None:
    ring, n = filled(3 * SLOTS)
    out = np.empty(2)
    now_s = (3 * SLOTS - 1) * 0.01
    oldest_s = recall(ring, n, 0.0, now_s, np.zeros(2), out)
    assert oldest_s == pytest.approx((2 * SLOTS) * 0.01)
    assert out[0] == pytest.approx(2.0 * oldest_s)


def test_the_future_and_an_empty_ring_give_the_present() -> None:
    out = np.empty(2)
    assert recall(np.zeros((SLOTS, 3)), 0, 1.0, 5.0, np.array([7.0, 8.0]), out) == 5.0
    np.testing.assert_array_equal(out, [7.0, 8.0])


def test_samples_that_come_fast_share_a_slot() -> None:
    _, n = filled(100, SPACING_S / 5.0)
    assert n == pytest.approx(20, abs=1)
