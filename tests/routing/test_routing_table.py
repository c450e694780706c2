"""Ways to systems, and copies of frames, on the manual clock."""

import pytest

from gateway.routing.routing_table import (
    MAX_ORIGINS,
    MEMORY_FRAMES,
    MEMORY_US,
    ROUTE_FRESH_US,
    LoopGuard,
    RoutingTable,
)


@pytest.fixture
def table() -> RoutingTable:
    table = RoutingTable()
    table.hear(1, (10, 1), 0)
    table.hear(2, (10, 100), 0)
    table.hear(3, (20, 1), 0)
    return table


@pytest.mark.parametrize(
    ("target", "source", "ways"),
    [
        ((10, 1), 9, [1]),
        ((10, 100), 9, [2]),
        ((10, 0), 9, [1, 2]),
        ((10, 7), 9, [1, 2]),
        ((10, 0), 1, [2]),
        ((20, 1), 3, []),
        ((99, 1), 9, []),
    ],
)
def test_ways(table: RoutingTable, target: tuple[int, int], source: int, ways: list[int]) -> None:
    assert table.ways_to(target, source, 0) == ways


def test_a_living_way_is_preferred_to_a_silent_one(table: RoutingTable) -> None:
    table.hear(4, (20, 1), ROUTE_FRESH_US + 1)
    assert table.ways_to((20, 1), 9, ROUTE_FRESH_US + 1) == [4]
    assert table.ways_to((20, 1), 4, ROUTE_FRESH_US + 1) == [3]


def test_a_client_that_left_is_no_way(table: RoutingTable) -> None:
    table.forget(1)
    table.forget(1)
    assert table.ways_to((10, 1), 9, 0) == [2]
    assert table.origins(1) == ()


def test_forged_origins_are_bounded(table: RoutingTable) -> None:
    for system in range(255):
        table.hear(1, (system, 1), 1)
    assert len(table.origins(1)) == MAX_ORIGINS
    assert table.origins(1)[0] == (10, 1)


def test_stations_are_told_from_vehicles(table: RoutingTable) -> None:
    table.hear(4, (255, 190), 0)
    table.note_kind((255, 190), is_station=True)
    assert table.is_station((255, 190))
    assert table.ways_to_vehicles(1) == [2, 3]
    table.note_kind((255, 190), is_station=False)
    assert table.ways_to_vehicles(1) == [2, 3, 4]


def test_a_way_is_as_old_as_its_last_long_silence(table: RoutingTable) -> None:
    later_us = ROUTE_FRESH_US
    assert not table.hear(1, (10, 1), later_us)
    assert table.since_us(1, (10, 1)) == 0
    assert table.hear(1, (10, 1), 2 * later_us + 1)
    assert table.since_us(1, (10, 1)) == 2 * later_us + 1
    assert table.since_us(9, (10, 1)) == 0


class TestLoopGuard:
    def test_a_copy_is_known_wherever_it_comes_from(self) -> None:
        guard = LoopGuard()
        assert not guard.is_copy(b"frame", 0, 0)
        assert guard.is_copy(b"frame", 0, 10)
        assert guard.is_copy(b"frame", 0, 20)
        assert not guard.is_copy(b"other", 0, 20)

    def test_a_newcomer_repeats_nothing(self) -> None:
        guard = LoopGuard()
        assert not guard.is_copy(b"frame", 0, 10)
        assert not guard.is_copy(b"frame", 11, 11)
        assert guard.is_copy(b"frame", 0, 12)
        assert guard.is_copy(b"frame", 11, 12)

    def test_across_the_turn_of_generations_and_forgotten_after_two(self) -> None:
        guard = LoopGuard()
        guard.is_copy(b"frame", 0, MEMORY_US)
        guard.is_copy(b"other", 0, 2 * MEMORY_US)
        assert guard.is_copy(b"frame", 0, 2 * MEMORY_US + 1)
        guard.is_copy(b"third", 0, 3 * MEMORY_US)
        assert not guard.is_copy(b"frame", 0, 3 * MEMORY_US)

    def test_memory_is_bounded(self) -> None:
        guard = LoopGuard()
        for n in range(5 * MEMORY_FRAMES):
            guard.is_copy(n.to_bytes(4, "little"), 0, 1)
        assert len(guard._recent) + len(guard._older) <= 2 * MEMORY_FRAMES
