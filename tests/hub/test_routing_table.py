"""Ways to systems, and copies of frames, on the manual clock."""

import pytest

from gateway.hub.routing_table import (
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


def test_a_system_is_shared_by_paths_that_are_alive(table: RoutingTable) -> None:
    table.hear(4, (20, 1), 0)
    assert table.is_shared((20, 1), ROUTE_FRESH_US)
    table.hear(4, (20, 1), ROUTE_FRESH_US + 1)
    assert not table.is_shared((20, 1), ROUTE_FRESH_US + 1)
    assert not table.is_shared((10, 1), 0)


def test_a_client_that_left_is_no_way(table: RoutingTable) -> None:
    table.forget(1)
    table.forget(1)
    assert table.ways_to((10, 1), 9, 0) == [2]
    assert table.origins(1) == ()


def test_stations_are_distinguished_from_vehicles(table: RoutingTable) -> None:
    table.hear(4, (255, 190), 0)
    table.note_kind(4, (255, 190), is_station=True)
    assert table.is_station((255, 190))
    assert table.ways_to_vehicles(1) == [2, 3]
    table.note_kind(4, (255, 190), is_station=False)
    assert table.ways_to_vehicles(1) == [2, 3, 4]


def test_a_way_is_as_old_as_its_last_long_silence(table: RoutingTable) -> None:
    later_us = ROUTE_FRESH_US
    table.hear(8, (10, 1), 0)
    assert not table.hear(1, (10, 1), later_us)
    assert table.since_us(1, (10, 1)) == 0
    assert table.hear(1, (10, 1), 2 * later_us + 1)
    assert table.since_us(1, (10, 1)) == 2 * later_us + 1
    assert table.since_us(9, (10, 1)) == 0


class TestBounds:
    def test_every_system_there_can_be_is_reached(self) -> None:
        table = RoutingTable()
        for system in range(1, 256):
            assert not table.hear(1, (system, 1), system)
        assert all(table.ways_to((system, 1), 9, 255) == [1] for system in range(1, 256))

    def test_the_stalest_makes_room(self) -> None:
        table = RoutingTable(max_origins=3)
        for system, us in ((1, 5), (2, 0), (3, 9)):
            table.hear(1, (system, 1), us)
        assert not table.hear(1, (4, 1), ROUTE_FRESH_US + 1)
        assert table.origins(1) == ((1, 1), (3, 1), (4, 1))
        assert table.ways_to((2, 1), 9, 0) == []

    def test_while_all_are_alive_a_newcomer_is_not_kept_and_is_no_news(self) -> None:
        table = RoutingTable(max_origins=3)
        for system in range(1, 4):
            table.hear(1, (system, 1), 0)
            table.hear(2, (system, 1), 0)
        for system in range(4, 250):
            assert not table.hear(1, (system, 1), 1)
        assert table.origins(1) == ((1, 1), (2, 1), (3, 1))

    def test_only_a_further_way_is_news(self) -> None:
        table = RoutingTable()
        assert not table.hear(1, (10, 1), 0)
        assert table.hear(2, (10, 1), 0)
        assert not table.hear(2, (10, 1), 1)
        assert not table.hear(2, (11, 1), 1)

    def test_stations_without_number_leave_nothing_behind(self) -> None:
        table = RoutingTable()
        for client in range(400):
            table.hear(client, (client % 255, 190), 0)
            table.note_kind(client, (client % 255, 190), is_station=True)
            table.forget(client)
        assert (table._to, table._of_client, table._components) == ({}, {}, {})
        table.hear(1, (255, 190), 0)
        table.note_kind(1, (255, 190), is_station=True)
        assert table.is_station((255, 190))


def is_new(guard: LoopGuard, frame: bytes, since_us: int, now_us: int) -> bool:
    return guard.first_way(frame, (9, 1), 5, since_us, now_us) is None


class TestLoopGuard:
    def test_a_copy_is_known_wherever_it_comes_from(self) -> None:
        guard = LoopGuard()
        assert guard.first_way(b"frame", (9, 1), 5, 0, 0) is None
        assert guard.first_way(b"frame", (9, 1), 6, 0, 10) == 5
        assert guard.first_way(b"frame", (9, 1), 5, 0, 20) == 5
        assert guard.first_way(b"other", (9, 1), 6, 0, 20) is None

    def test_a_newcomer_repeats_nothing(self) -> None:
        guard = LoopGuard()
        assert is_new(guard, b"frame", 0, 10)
        assert is_new(guard, b"frame", 11, 11)
        assert not is_new(guard, b"frame", 0, 12)
        assert not is_new(guard, b"frame", 11, 12)

    def test_across_the_turn_of_generations_and_forgotten_after_two(self) -> None:
        guard = LoopGuard()
        is_new(guard, b"frame", 0, MEMORY_US)
        is_new(guard, b"other", 0, 2 * MEMORY_US)
        assert not is_new(guard, b"frame", 0, 2 * MEMORY_US + 1)
        is_new(guard, b"third", 0, 3 * MEMORY_US)
        assert is_new(guard, b"frame", 0, 3 * MEMORY_US)

    def test_the_same_content_under_the_same_number_is_new_when_the_numbers_are_used_up(
        self,
    ) -> None:
        guard = LoopGuard()
        for n in range(3 * 256):
            frame = bytes((n % 256,))
            assert guard.first_way(frame, (9, 1), 5, 0, n) is None
            assert guard.first_way(frame, (9, 1), 6, 0, n) == 5

    def test_memory_is_bounded(self) -> None:
        guard = LoopGuard()
        for n in range(5 * MEMORY_FRAMES):
            is_new(guard, n.to_bytes(4, "little"), 0, 1)
        assert len(guard._memory._recent) + len(guard._memory._older) <= 2 * MEMORY_FRAMES
