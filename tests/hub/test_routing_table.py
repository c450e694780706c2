"""Paths to systems, duplicates, late copies, redundant links and greetings, on the manual clock."""

import random

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.duplicates import (
    LATE,
    LINKED_US,
    MEMORY_FRAMES,
    NEW,
    DuplicateFilter,
    RedundantLinks,
)
from gateway.hub.frame_stream import FrameStream
from gateway.hub.own_vehicles import OWN_FRESH_US, OwnVehicles
from gateway.hub.routing_table import MEMORY_US, ROUTE_FRESH_US, RoutingTable, SystemPath
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.kit.mavlink import numbered, packed
from tests.kit.messages import beat

FAST, SLOW = 1, 2
"""Two links to one vehicle."""
LIMIT_US = US_PER_S


@pytest.fixture
def table() -> RoutingTable:
    table = RoutingTable()
    table.register(1, (10, 1), 0)
    table.register(2, (10, 100), 0)
    table.register(3, (20, 1), 0)
    return table


@pytest.mark.parametrize(
    ("target", "source", "clients"),
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
def test_target_selects_the_clients_that_lead_to_it(
    table: RoutingTable, target: tuple[int, int], source: int, clients: list[int]
) -> None:
    assert table.clients_to(target, source, 0) == clients


def test_fresh_path_is_preferred_to_a_stale_one(table: RoutingTable) -> None:
    table.register(4, (20, 1), ROUTE_FRESH_US + 1)
    assert table.clients_to((20, 1), 9, ROUTE_FRESH_US + 1) == [4]
    assert table.clients_to((20, 1), 4, ROUTE_FRESH_US + 1) == [3]


def test_system_is_shared_by_paths_that_are_alive(table: RoutingTable) -> None:
    table.register(4, (20, 1), 0)
    assert table.is_shared((20, 1), ROUTE_FRESH_US)
    table.register(4, (20, 1), ROUTE_FRESH_US + 1)
    assert not table.is_shared((20, 1), ROUTE_FRESH_US + 1)
    assert not table.is_shared((10, 1), 0)


def test_removed_client_has_no_paths(table: RoutingTable) -> None:
    table.remove(1)
    table.remove(1)
    assert table.clients_to((10, 1), 9, 0) == [2]
    assert table.origins(1) == ()


def test_stations_are_distinguished_from_vehicles(table: RoutingTable) -> None:
    path = table.register(4, (255, 190), 0)
    gcs, plane = (frame_of(packed(beat(kind), 255, 190)) for kind in (6, 1))
    table.read_heartbeat(4, path, gcs, 0)
    assert table.is_station(4, (255, 190))
    assert table.clients_with_vehicles(1) == [2, 3]
    table.read_heartbeat(4, path, plane, 1)
    # Another program with its id: each of its heartbeats must not change the routes.
    table.read_heartbeat(4, path, gcs, 2)
    assert table.clients_with_vehicles(1) == [2, 3, 4]
    table.read_heartbeat(4, path, gcs, 1 + ROUTE_FRESH_US)
    assert table.clients_with_vehicles(1) == [2, 3]


def test_path_begins_again_after_a_timeout(table: RoutingTable) -> None:
    later_us = ROUTE_FRESH_US
    table.register(8, (10, 1), 0)
    assert table.register(1, (10, 1), later_us).since_us == 0
    assert table.register(1, (10, 1), 2 * later_us + 1).since_us == 2 * later_us + 1


class TestBounds:
    def test_all_255_systems_behind_one_client_are_reached(self) -> None:
        table = RoutingTable()
        for system in range(1, 256):
            assert table.register(1, (system, 1), system)
        assert all(table.clients_to((system, 1), 9, 255) == [1] for system in range(1, 256))

    def test_stalest_origin_is_replaced(self) -> None:
        table = RoutingTable(max_origins=3)
        for system, us in ((1, 5), (2, 0), (3, 9)):
            table.register(1, (system, 1), us)
        assert table.register(1, (4, 1), ROUTE_FRESH_US + 1)
        assert table.origins(1) == ((1, 1), (3, 1), (4, 1))
        assert table.clients_to((2, 1), 9, 0) == []

    def test_new_origin_is_ignored_while_all_are_fresh(self) -> None:
        changes: list[int] = []
        table = RoutingTable(lambda: changes.append(1), max_origins=3)
        for system in range(1, 4):
            table.register(1, (system, 1), 0)
            table.register(2, (system, 1), 0)
        changes.clear()
        for system in range(4, 250):
            assert not table.register(1, (system, 1), 1)
        assert table.origins(1) == ((1, 1), (2, 1), (3, 1))
        assert changes == []

    def test_another_system_its_kind_and_a_removal_change_routes(self) -> None:
        changes: list[int] = []
        table = RoutingTable(lambda: changes.append(1))
        for client_id, component, expected in ((1, 1, 1), (2, 1, 2), (2, 1, 2), (2, 2, 2)):
            path = table.register(client_id, (10, component), 0)
            assert len(changes) == expected
        for _ in range(2):
            table.read_heartbeat(2, path, frame_of(packed(beat(6))), 0)
            assert len(changes) == 3
        table.remove(2)
        assert len(changes) == 4


def frame(number: int, content: bytes | None = None) -> MavFrame:
    """Return the n-th frame of a vehicle; by default no two have the same content."""
    data = bytes((number % 256,)) + (number.to_bytes(4, "little") if content is None else content)
    return MavFrame(data, b"", 30, (9, 1), (0, 0), number % 256, False)


class Links:
    """Two links from one vehicle, the second slower."""

    def __init__(self) -> None:
        self.filter = DuplicateFilter()
        stream = FrameStream()
        self.paths = {FAST: SystemPath(0, stream), SLOW: SystemPath(0, stream)}

    def check(self, client_id: int, number: int, now_us: int, content: bytes | None = None) -> int:
        return self.filter.check(
            frame(number, content), client_id, self.paths[client_id], now_us, LIMIT_US
        )


@pytest.fixture
def links() -> Links:
    return Links()


class TestDuplicates:
    def test_copy_is_dropped_on_every_path(self, links: Links) -> None:
        assert links.check(FAST, 1, 0) == NEW
        assert links.check(SLOW, 1, 10) == FAST
        assert links.check(FAST, 1, 20) == FAST
        assert links.check(SLOW, 2, 20) == NEW

    def test_frame_from_before_its_path_existed_passes(self, links: Links) -> None:
        links.check(FAST, 1, 10)
        links.paths[FAST].since_us = 11
        assert links.check(FAST, 1, 11) == NEW
        assert links.check(FAST, 1, 12) == FAST

    def test_copies_are_recognised_for_thirty_seconds(self, links: Links) -> None:
        for number in range(200):
            links.check(FAST, number, number * 200_000)
        assert links.check(SLOW, 50, 199 * 200_000) == FAST
        assert MEMORY_US >= 29 * US_PER_S

    def test_repeated_content_is_new_when_the_numbers_are_used_up(self, links: Links) -> None:
        for number in range(3 * 256):
            assert links.check(FAST, number, number * 5000, b"") == NEW
            assert links.check(SLOW, number, number * 5000 + 10, b"") == FAST

    def test_memory_is_bounded(self, links: Links) -> None:
        now_us, count = 10 * US_PER_S, 2 * MEMORY_FRAMES + 1
        assert {links.check(FAST, number, now_us) for number in range(count)} == {NEW}
        assert links.check(SLOW, 0, now_us) == NEW, "no longer known"
        assert links.check(SLOW, count - 1, now_us) == FAST


class TestLateFrames:
    """The fast link loses every tenth frame, the slow one brings all of them seconds later."""

    @pytest.mark.parametrize("rate_hz", [10, 50, 100, 400])
    @pytest.mark.parametrize("delay_s", [1.5, 3.0, 10.0])
    def test_no_frame_moves_the_aircraft_back(
        self, links: Links, rate_hz: int, delay_s: float
    ) -> None:
        interval_us, count = US_PER_S // rate_hz, round(20 * rate_hz)
        arrivals = [(n * interval_us, FAST, n) for n in range(count) if n % 10 != 5]
        delay_us = round(delay_s * US_PER_S)
        arrivals += [(n * interval_us + delay_us, SLOW, n) for n in range(count)]
        newest = -1
        for now_us, client_id, number in sorted(arrivals):
            if links.check(client_id, number, now_us) == NEW:
                assert number >= newest - rate_hz
                newest = max(newest, number)

    def test_frame_within_the_limit_fills_a_gap(self, links: Links) -> None:
        for number in range(100):
            if number % 10:
                assert links.check(FAST, number, number * 20_000) == NEW
            if number >= 20 and (number - 20) % 10 == 0:
                assert links.check(SLOW, number - 20, number * 20_000 + 1) == NEW

    def test_slow_link_takes_over_when_the_fast_one_fails(self, links: Links) -> None:
        for number in range(500):
            now_us = number * 20_000
            if number < 250:
                links.check(FAST, number, now_us)
            if number >= 150:
                verdict = links.check(SLOW, number - 150, now_us + 1)
                assert (verdict == NEW) == (number - 150 >= 250)

    def test_restarted_vehicle_loses_nothing_on_the_leading_link(self, links: Links) -> None:
        for number in range(200):
            links.check(FAST, number, number * 20_000)
            links.check(SLOW, number, number * 20_000 + 5000)
        for number in range(1, 200):
            again = links.check(FAST, number, (number + 200) * 20_000, b"restarted%d" % number)
            assert again == NEW

    @pytest.mark.parametrize("seed", range(5))
    def test_prompt_links_with_jitter_drop_copies_only(self, links: Links, seed: int) -> None:
        rng = random.Random(seed)
        arrivals = sorted(
            (n * 20_000 + rng.randrange(300_000), client_id, n)
            for n in range(1000)
            for client_id in (FAST, SLOW)
            if rng.random() < 0.9
        )
        verdicts: dict[int, list[int]] = {}
        for now_us, client_id, number in arrivals:
            verdicts.setdefault(number, []).append(links.check(client_id, number, now_us))
        assert all(found[0] == NEW and LATE not in found for found in verdicts.values())


@pytest.fixture
def redundant() -> RedundantLinks:
    """Links 1 to 4 of one vehicle, joined in pairs at 0, 10 and 20 µs."""
    links = RedundantLinks()
    assert [links.register(*pair, us) for pair, us in PAIRS.items()] == [True] * 3
    return links


PAIRS = {(1, 2): 0, (3, 4): 10, (2, 3): 20}


def test_pairs_that_share_a_client_are_one_group(redundant: RedundantLinks) -> None:
    assert {redundant.group(n) for n in range(1, 5)} == {(1, 2, 3, 4)}
    assert redundant.group(5) == (5,)
    assert not redundant.register(2, 1, 5), "not another pair"


def test_links_without_copies_are_separated(redundant: RedundantLinks) -> None:
    redundant.expire(LINKED_US)
    assert redundant.group(1) == (1, 2, 3, 4)
    redundant.expire(LINKED_US + 1)
    assert [redundant.group(n) for n in (1, 2)] == [(1,), (2, 3, 4)]


def test_removed_client_is_in_no_group(redundant: RedundantLinks) -> None:
    redundant.remove(2)
    assert [redundant.group(n) for n in (1, 2, 3)] == [(1,), (2,), (3, 4)]


@pytest.fixture
def vehicles() -> OwnVehicles:
    """A vehicle 1 that has sent its heartbeat."""
    vehicles = OwnVehicles()
    vehicles.register(numbered(1, 0), 0)
    return vehicles


def home(system: int, sequence: int) -> MavFrame:
    message = dialect.MAVLink_home_position_message(1, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    return numbered(system, sequence, message)


def test_system_is_own_until_its_heartbeat_stops(vehicles: OwnVehicles) -> None:
    assert vehicles.is_own((1, 1), OWN_FRESH_US)
    assert not vehicles.is_own((1, 1), OWN_FRESH_US + 1)
    assert not vehicles.is_own((1, 2), 0)
    assert vehicles.systems(0) == [1]
    assert vehicles.systems(OWN_FRESH_US + 1) == []


def test_waiting_client_gets_heartbeat_and_home_of_each_vehicle(vehicles: OwnVehicles) -> None:
    frames = [home(1, 50), numbered(1, 60), numbered(2, 9)]
    for frame in frames:
        vehicles.register(frame, 0)
    vehicles.await_greeting(7)
    assert vehicles.waiting
    assert vehicles.greet((1, 1)) == ([7], [frames[1], frames[0]])
    assert vehicles.greet((1, 1))[0] == []
    assert vehicles.waiting
    assert vehicles.greet((2, 1)) == ([7], [frames[2]])
    assert not vehicles.waiting


def test_removed_client_is_not_greeted(vehicles: OwnVehicles) -> None:
    vehicles.await_greeting(7)
    vehicles.await_greeting(8)
    vehicles.remove(7)
    assert vehicles.greet((1, 1))[0] == [8]
    vehicles.await_greeting(7)
    vehicles.remove(7)
    assert not vehicles.waiting


def test_returning_system_greets_without_its_old_home(vehicles: OwnVehicles) -> None:
    vehicles.register(home(1, 1), 0)
    assert vehicles.register(numbered(1, 2), OWN_FRESH_US + 1)
    assert not vehicles.register(numbered(1, 3), OWN_FRESH_US + 2)
    vehicles.await_greeting(7)
    assert [frame.message_id for frame in vehicles.greet((1, 1))[1]] == [0]


def test_no_client_waits_without_a_vehicle() -> None:
    vehicles = OwnVehicles()
    vehicles.await_greeting(7)
    assert not vehicles.waiting
