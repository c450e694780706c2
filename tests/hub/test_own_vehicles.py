"""Our vehicles and the greeting of new clients, on the manual clock."""

from pymavlink.dialects.v20 import common as dialect

from gateway.hub.routing_table import OWN_FRESH_US, OwnVehicles
from gateway.wire.mavlink_splitter import MavFrame
from tests.kit.mavlink import numbered


def home(system: int, sequence: int) -> MavFrame:
    message = dialect.MAVLink_home_position_message(1, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    return numbered(system, sequence, message)


def test_system_is_own_until_its_heartbeat_stops() -> None:
    vehicles = OwnVehicles()
    vehicles.register(numbered(1, 0), 0)
    assert vehicles.is_own((1, 1), OWN_FRESH_US)
    assert not vehicles.is_own((1, 1), OWN_FRESH_US + 1)
    assert not vehicles.is_own((1, 2), 0)
    assert vehicles.systems(0) == [1]
    assert vehicles.systems(OWN_FRESH_US + 1) == []


def test_waiting_client_gets_heartbeat_and_home_of_each_vehicle() -> None:
    vehicles = OwnVehicles()
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


def test_removed_client_is_not_greeted() -> None:
    vehicles = OwnVehicles()
    vehicles.register(numbered(1, 0), 0)
    vehicles.await_greeting(7)
    vehicles.await_greeting(8)
    vehicles.remove(7)
    assert vehicles.greet((1, 1))[0] == [8]
    vehicles.await_greeting(7)
    vehicles.remove(7)
    assert not vehicles.waiting


def test_returning_system_greets_without_its_old_home() -> None:
    vehicles = OwnVehicles()
    vehicles.register(numbered(1, 0), 0)
    vehicles.register(home(1, 1), 0)
    assert vehicles.register(numbered(1, 2), OWN_FRESH_US + 1)
    assert not vehicles.register(numbered(1, 3), OWN_FRESH_US + 2)
    vehicles.await_greeting(7)
    assert [frame.message_id for frame in vehicles.greet((1, 1))[1]] == [0]


def test_no_client_waits_without_a_vehicle() -> None:
    vehicles = OwnVehicles()
    vehicles.await_greeting(7)
    assert not vehicles.waiting
