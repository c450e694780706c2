"""No client fills the disk, and none uses the quota of another in the recording."""

import pytest

from gateway.live.part import BURST_S, TRUSTED_RATE, UNTRUSTED_RATE, RecordingBudget

SECOND_US = 1_000_000


def taken(budget: RecordingBudget, clients: list[int], seconds: int, size: int = 100) -> int:
    """Let clients send 2 MB/s each; return the bytes that are recorded."""
    total = 0
    for step in range(seconds * 100):
        for client_id in clients:
            for _ in range(20_000 // size):
                total += size * budget.takes(client_id, size, step * SECOND_US // 100)
    return total


@pytest.mark.parametrize("clients", [[1], [1, 2, 3]])
def test_untrusted_clients_share_one_small_budget(clients: list[int]) -> None:
    budget = RecordingBudget()
    for client_id in clients:
        budget.note(client_id, 0, trusted=False)
    assert taken(budget, clients, 10) <= UNTRUSTED_RATE * (BURST_S + 10)


def test_budget_of_a_trusted_client_is_independent_of_untrusted_ones() -> None:
    budget = RecordingBudget()
    budget.note(7, 0, trusted=True)
    taken(budget, [1], 5)
    assert TRUSTED_RATE * BURST_S <= taken(budget, [7], 5) <= TRUSTED_RATE * (BURST_S + 5)


def test_ground_station_at_its_usual_rate_is_recorded_completely() -> None:
    budget = RecordingBudget()
    budget.note(1, 0, trusted=True)
    assert all(budget.takes(1, 280, n * SECOND_US // 200) for n in range(20_000))


def test_client_that_loses_trust_or_leaves_loses_its_own_budget() -> None:
    budget = RecordingBudget()
    budget.note(1, 0, trusted=True)
    budget.note(1, 0, trusted=False)
    assert taken(budget, [1], 1) <= UNTRUSTED_RATE * (BURST_S + 1)
    budget.note(2, 0, trusted=True)
    budget.remove_client(2)
    assert not budget.takes(2, 60_000, SECOND_US)
