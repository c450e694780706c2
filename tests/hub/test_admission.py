"""The clients of a listening port on the manual clock."""

from gateway.hub.limits import SILENT_AFTER_US, ClientTable

S = 1_000_000
GCS = (255, 190)


def table_of(*ports: int, max_clients: int = 3) -> ClientTable:
    table = ClientTable(max_clients, 30 * S)
    for client_id, port in enumerate(ports):
        presence, _ = table.admit(("10.0.0.1", port), client_id, 0)
        assert presence is not None
        presence.identity = GCS
    return table


def test_found_by_address() -> None:
    table = table_of(1000)
    found = table.find(("10.0.0.1", 1000))
    assert found is not None
    assert found.client_id == 0
    assert table.find(("10.0.0.2", 1000)) is None


def test_timeout_ends_it() -> None:
    table = table_of(1000)
    assert table.expire(30 * S - 1) == []
    assert [presence.client_id for presence in table.expire(30 * S)] == [0]
    assert len(table) == 0


def test_full_table_refuses_while_all_are_alive() -> None:
    table = table_of(1, 2, 3)
    assert not table.is_full(0)
    assert table.admit(("10.0.0.9", 9), 9, SILENT_AFTER_US - 1) == (None, None)
    assert table.is_full(SILENT_AFTER_US - 1)
    assert not table.is_full(SILENT_AFTER_US)
    table.remove(table.presences()[0])
    assert not table.is_full(SILENT_AFTER_US - 1)


def test_full_table_gives_the_place_of_the_most_silent() -> None:
    table = table_of(1, 2, 3)
    for port in (1, 3):
        presence = table.find(("10.0.0.1", port))
        assert presence is not None
        presence.heard_us = S
    newcomer, leaver = table.admit(("10.0.0.9", 9), 9, SILENT_AFTER_US)
    assert newcomer is not None
    assert leaver is not None
    assert leaver.client_id == 1
    assert len(table) == 3


def test_back_on_a_new_port_replaces_itself() -> None:
    table = table_of(1000)
    back, _ = table.admit(("10.0.0.1", 2000), 7, 1 * S)
    assert back is not None
    back.identity = GCS
    back.heard_us = SILENT_AFTER_US
    assert [presence.client_id for presence in table.expire(SILENT_AFTER_US)] == [0]
    assert table.find(("10.0.0.1", 2000)) is back


def test_two_living_stations_on_one_machine_both_stay() -> None:
    table = table_of(1000, 2000)
    for n in range(1, 20):
        for port in (1000, 2000):
            presence = table.find(("10.0.0.1", port))
            assert presence is not None
            presence.heard_us = n * S
        assert table.expire(n * S + S) == []


def test_a_silent_neighbour_of_another_identity_stays() -> None:
    table = table_of(1000)
    other, _ = table.admit(("10.0.0.1", 2000), 7, 5 * S)
    assert other is not None
    other.identity = (254, 190)
    assert table.expire(6 * S) == []


class TestShares:
    """One machine may hold every place only as long as nobody else wants one."""

    def full(self, hosts: list[str]) -> ClientTable:
        table = ClientTable(len(hosts), 30 * S)
        for client_id, host in enumerate(hosts):
            assert table.admit((host, client_id), client_id, 0)[0]
        return table

    def test_a_machine_with_all_places_makes_room_for_others(self) -> None:
        table = self.full(["10.0.0.6"] * 32)
        for n in range(100):
            table.admit(("10.0.0.6", 5000 + n), 100 + n, 1)
        others = [table.admit((f"10.0.1.{n}", 9), 900 + n, 2)[0] for n in range(30)]
        assert [presence is not None for presence in others] == [True] * 24 + [False] * 6
        assert table.find(("10.0.0.6", 0)), "who came first stays"

    def test_client_within_the_share_of_its_host_is_not_removed_for_a_new_one(self) -> None:
        table = self.full(["10.0.0.1", "10.0.0.1", *(f"10.0.2.{n}" for n in range(6))])
        assert table.admit(("10.0.9.9", 9), 99, 1) == (None, None)
        assert table.is_full(1)

    def test_the_crowd_that_knocks_shuts_nobody_else_out(self) -> None:
        table = self.full(["10.0.0.6"] * 8)
        assert table.admit(("10.0.0.6", 99), 99, 1) == (None, None)
        assert not table.is_full(1)
        assert table.admit(("10.0.0.7", 99), 99, 1)[0]
