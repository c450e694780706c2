"""Our vehicles and the greeting of newcomers, on the manual clock."""

from pymavlink.dialects.v20 import common as dialect

from gateway.hub.own_vehicles import OWN_FRESH_US, OwnVehicles
from gateway.wire.mavlink_splitter import split_datagram


def heartbeat(system: int, sequence: int) -> bytes:
    link = dialect.MAVLink(None, system, 1)
    link.seq = sequence
    return bytes(dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(link))


def home(system: int, sequence: int) -> bytes:
    link = dialect.MAVLink(None, system, 1)
    link.seq = sequence
    message = dialect.MAVLink_home_position_message(1, 2, 3, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)
    return bytes(message.pack(link))


def test_ours_while_its_heart_beats() -> None:
    vehicles = OwnVehicles()
    vehicles.note(heartbeat(1, 0), 0, 0)
    assert vehicles.is_own((1, 1), OWN_FRESH_US)
    assert not vehicles.is_own((1, 1), OWN_FRESH_US + 1)
    assert not vehicles.is_own((1, 2), 0)
    assert vehicles.systems(0) == [1]
    assert vehicles.systems(OWN_FRESH_US + 1) == []


def test_greeting_leads_up_to_the_next_frame() -> None:
    vehicles = OwnVehicles()
    vehicles.note(home(1, 50), 242, 0)
    vehicles.note(heartbeat(1, 60), 0, 0)
    vehicles.note(heartbeat(2, 9), 0, 0)
    vehicles.await_greeting(7)
    assert vehicles.has_newcomers
    clients, frames = vehicles.greet(heartbeat(1, 1))
    assert clients == [7]
    assert [message_id for _, message_id in frames] == [0, 242]
    assert [frame[4] for frame, _ in frames] == [255, 0]
    assert all(split_datagram(frame) == [frame] for frame, _ in frames)
    assert vehicles.greet(heartbeat(1, 2)) == ([], [])
    assert vehicles.has_newcomers
    clients, frames = vehicles.greet(heartbeat(2, 10))
    assert (clients, [frame[4] for frame, _ in frames]) == ([7], [9])
    assert not vehicles.has_newcomers


def test_a_newcomer_that_left_is_not_waited_for() -> None:
    vehicles = OwnVehicles()
    vehicles.note(heartbeat(1, 0), 0, 0)
    vehicles.await_greeting(7)
    vehicles.await_greeting(8)
    vehicles.forget(7)
    assert vehicles.greet(heartbeat(1, 1))[0] == [8]
    vehicles.await_greeting(7)
    vehicles.forget(7)
    assert not vehicles.has_newcomers


def test_a_system_that_returns_starts_afresh() -> None:
    vehicles = OwnVehicles()
    vehicles.note(heartbeat(1, 0), 0, 0)
    vehicles.note(home(1, 1), 242, 0)
    assert vehicles.note(heartbeat(1, 2), 0, OWN_FRESH_US + 1)
    assert not vehicles.note(heartbeat(1, 3), 0, OWN_FRESH_US + 2)
    vehicles.await_greeting(7)
    assert [message_id for _, message_id in vehicles.greet(heartbeat(1, 4))[1]] == [0]


def test_nobody_waits_where_there_is_no_vehicle() -> None:
    vehicles = OwnVehicles()
    vehicles.await_greeting(7)
    assert not vehicles.has_newcomers
