"""No client fills the disk, and none costs another its place in the recording."""

import pytest

from gateway.live.part import BURST_S, STRANGERS_BPS, TRUSTED_BPS, RecordingBudget

SECOND_US = 1_000_000


def taken(budget: RecordingBudget, clients: list[int], seconds: int, size: int = 100) -> int:
    """Let clients say 2 MB/s each; give the bytes that are recorded."""
    total = 0
    for step in range(seconds * 100):
        for client_id in clients:
            for _ in range(20_000 // size):
                total += size * budget.takes(client_id, size, step * SECOND_US // 100)
    return total


@pytest.mark.parametrize("clients", [[1], [1, 2, 3]])
def test_strangers_together_have_one_small_budget(clients: list[int]) -> None:
    budget = RecordingBudget()
    for client_id in clients:
        budget.note(client_id, 0, trusted=False)
    assert taken(budget, clients, 10) <= STRANGERS_BPS * (BURST_S + 10)


def test_a_trusted_client_has_its_own_whatever_strangers_do() -> None:
    budget = RecordingBudget()
    budget.note(7, 0, trusted=True)
    taken(budget, [1], 5)
    assert TRUSTED_BPS * BURST_S <= taken(budget, [7], 5) <= TRUSTED_BPS * (BURST_S + 5)


def test_a_ground_station_at_its_usual_rate_is_recorded_whole() -> None:
    budget = RecordingBudget()
    budget.note(1, 0, trusted=True)
    assert all(budget.takes(1, 280, n * SECOND_US // 200) for n in range(20_000))


def test_one_that_is_trusted_no_longer_is_a_stranger() -> None:
    budget = RecordingBudget()
    budget.note(1, 0, trusted=True)
    budget.note(1, 0, trusted=False)
    assert taken(budget, [1], 1) <= STRANGERS_BPS * (BURST_S + 1)
    budget.note(2, 0, trusted=True)
    budget.remove_client(2)
    assert not budget.takes(2, 60_000, SECOND_US)
