"""Who gets which frame, at which rate and with which sequence number."""

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.endpoint import parse_endpoint
from gateway.hub.fanout import MAX_PLANS, Fanout
from gateway.records import ClientInterval
from gateway.wire.mavlink_splitter import restamp, split_datagram

ATTITUDE_ID = 30


class Vehicle:
    """Encodes frames with a running sequence number."""

    def __init__(self, system: int = 1) -> None:
        self.link = dialect.MAVLink(None, system, 1)

    def _pack(self, message: dialect.MAVLink_message) -> bytes:
        frame = bytes(message.pack(self.link))
        self.link.seq = (self.link.seq + 1) % 256
        return frame

    def attitude(self) -> bytes:
        return self._pack(dialect.MAVLink_attitude_message(0, 0, 0, 0, 0, 0, 0))

    def heartbeat(self) -> bytes:
        return self._pack(dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))


class Outlet:
    def __init__(self, fanout: Fanout, client_id: int, options: str = "") -> None:
        self.frames: list[bytes] = []
        self.message_ids: list[int] = []
        fanout.add(client_id, self._take, parse_endpoint(f"udp:h:1{options}"))

    def _take(self, frame: bytes, message_id: int) -> None:
        assert split_datagram(frame) == [frame]
        self.frames.append(frame)
        self.message_ids.append(message_id)

    def sequences(self) -> list[int]:
        return [frame[4] for frame in self.frames]


@pytest.fixture
def fanout() -> Fanout:
    return Fanout()


@pytest.fixture
def vehicle() -> Vehicle:
    return Vehicle()


def test_everybody_gets_the_same_bytes(fanout: Fanout, vehicle: Vehicle) -> None:
    outlets = [Outlet(fanout, client_id) for client_id in range(3)]
    frame = vehicle.attitude()
    fanout.publish(frame, 0)
    assert all(outlet.frames[0] is frame for outlet in outlets)
    assert outlets[0].message_ids == [ATTITUDE_ID]


def test_late_and_early_leavers(fanout: Fanout, vehicle: Vehicle) -> None:
    first = Outlet(fanout, 1)
    fanout.publish(vehicle.attitude(), 0)
    second = Outlet(fanout, 2)
    fanout.publish(vehicle.attitude(), 0)
    fanout.remove(1)
    fanout.remove(99)
    fanout.publish(vehicle.attitude(), 0)
    assert (len(first.frames), len(second.frames)) == (2, 2)


def test_a_frame_is_sealed_once_for_all_that_get_the_same(vehicle: Vehicle) -> None:
    sealed: list[int] = []

    def seal(frame: bytes, sequence: int) -> bytes:
        sealed.append(sequence)
        return restamp(frame, sequence)

    fanout = Fanout(seal)
    fanout.publish(vehicle.attitude(), 0)
    assert sealed == [], "nobody gets it"
    outlets = [Outlet(fanout, client_id, "?deny=0") for client_id in range(3)]
    fanout.publish(vehicle.heartbeat(), 0)
    fanout.publish(vehicle.attitude(), 0)
    assert [outlet.sequences() for outlet in outlets] == [[1]] * 3
    assert sealed == [1]


def test_an_outlet_may_leave_while_it_is_sent_to(fanout: Fanout, vehicle: Vehicle) -> None:
    frames: list[bytes] = []

    def leave(frame: bytes, message_id: int) -> None:
        frames.append(frame)
        fanout.remove(1)

    for send in (lambda f: fanout.publish(f, 0), lambda f: fanout.answer(f, [1])):
        fanout.add(1, leave, parse_endpoint("tcp:h:1"))
        other = Outlet(fanout, 2)
        send(vehicle.attitude())
        fanout.publish(vehicle.attitude(), 0)
        assert other.frames
        fanout.remove(2)
    assert len(frames) == 2


def test_denied_messages_leave_no_gap_in_the_sequence(fanout: Fanout, vehicle: Vehicle) -> None:
    picky, plain = Outlet(fanout, 1, "?deny=ATTITUDE"), Outlet(fanout, 2)
    for _ in range(300):
        fanout.publish(vehicle.attitude(), 0)
        fanout.publish(vehicle.heartbeat(), 0)
    assert set(picky.message_ids) == {0}
    assert picky.sequences() == [1 + n - 1 & 255 for n in range(300)]
    assert plain.sequences() == [n & 255 for n in range(600)]


def test_an_answer_goes_to_one_and_leaves_no_gap_elsewhere(
    fanout: Fanout, vehicle: Vehicle
) -> None:
    asker, other = Outlet(fanout, 1, "?deny=HEARTBEAT"), Outlet(fanout, 2)
    fanout.publish(vehicle.attitude(), 0)
    fanout.answer(vehicle.heartbeat(), [1])
    fanout.publish(vehicle.attitude(), 0)
    assert asker.message_ids == [ATTITUDE_ID, 0, ATTITUDE_ID]
    assert asker.sequences() == [0, 1, 2]
    assert other.sequences() == [0, 1]


def test_systems_are_numbered_apart(fanout: Fanout) -> None:
    one, two = Vehicle(1), Vehicle(2)
    outlet = Outlet(fanout, 1)
    fanout.answer(one.heartbeat(), [99])
    fanout.publish(one.attitude(), 0)
    fanout.publish(two.attitude(), 0)
    assert outlet.sequences() == [0, 0]


class TestRates:
    def test_a_limit_halves_the_stream_and_jitter_does_not(
        self, fanout: Fanout, vehicle: Vehicle
    ) -> None:
        outlet = Outlet(fanout, 1, "?rate=ATTITUDE:25")
        for n in range(100):
            fanout.publish(vehicle.attitude(), n * 20_000 + (n % 3) * 4_000)
        assert len(outlet.frames) == 50
        assert outlet.sequences() == list(range(50))

    def test_a_limit_at_the_stream_rate_passes_all(self, fanout: Fanout, vehicle: Vehicle) -> None:
        outlet = Outlet(fanout, 1, "?rate=ATTITUDE:50")
        for n in range(100):
            fanout.publish(vehicle.attitude(), n * 20_000 + (n % 3) * 2_000)
        assert len(outlet.frames) == 100

    def test_after_a_pause_no_burst_makes_up(self, fanout: Fanout, vehicle: Vehicle) -> None:
        outlet = Outlet(fanout, 1, "?rate=ATTITUDE:10")
        fanout.publish(vehicle.attitude(), 0)
        for n in range(10):
            fanout.publish(vehicle.attitude(), 60_000_000 + n)
        assert len(outlet.frames) == 2

    def test_a_wish_slows_stops_and_restores(self, fanout: Fanout, vehicle: Vehicle) -> None:
        wisher, other = Outlet(fanout, 1), Outlet(fanout, 2)

        def sent_in_a_second(interval_us: int) -> int:
            fanout.set_interval(ClientInterval(1, 1, ATTITUDE_ID, interval_us))
            before = len(wisher.frames)
            for n in range(49):
                fanout.publish(vehicle.attitude(), n * 20_000)
            return len(wisher.frames) - before

        assert [sent_in_a_second(us) for us in (100_000, -1, 0)] == [10, 0, 49]
        assert len(other.frames) == 147

    def test_a_wish_cannot_pass_the_settings(self, fanout: Fanout, vehicle: Vehicle) -> None:
        denied = Outlet(fanout, 1, "?deny=ATTITUDE")
        limited = Outlet(fanout, 2, "?rate=ATTITUDE:1")
        for client_id in (1, 2):
            fanout.set_interval(ClientInterval(client_id, 1, ATTITUDE_ID, 20_000))
        for n in range(25):
            fanout.publish(vehicle.attitude(), n * 20_000)
        assert (len(denied.frames), len(limited.frames)) == (0, 1)

    def test_a_wish_for_one_system_leaves_the_other(self, fanout: Fanout) -> None:
        outlet = Outlet(fanout, 1)
        fanout.set_interval(ClientInterval(1, 1, ATTITUDE_ID, -1))
        fanout.publish(Vehicle(1).attitude(), 0)
        fanout.publish(Vehicle(2).attitude(), 0)
        assert [frame[5] for frame in outlet.frames] == [2]

    def test_a_wish_of_nobody_is_ignored(self, fanout: Fanout) -> None:
        fanout.set_interval(ClientInterval(5, 1, ATTITUDE_ID, -1))


class TestForeignFrames:
    def test_forwarded_to_all_but_the_source_and_never_restamped(self, fanout: Fanout) -> None:
        source, plain = Outlet(fanout, 1), Outlet(fanout, 2)
        picky = Outlet(fanout, 3, "?deny=HEARTBEAT&rate=ATTITUDE:1")
        foreign = Vehicle(9)
        frames = [foreign.heartbeat(), foreign.attitude(), foreign.attitude()]
        for frame in frames:
            fanout.forward(frame, 1, 0)
        assert source.frames == []
        assert plain.frames == frames
        assert picky.frames == [frames[1]]

    def test_delivered_to_the_named_only(self, fanout: Fanout, vehicle: Vehicle) -> None:
        outlets = [Outlet(fanout, client_id) for client_id in range(3)]
        fanout.deliver(vehicle.attitude(), [0, 2, 99])
        assert [len(outlet.frames) for outlet in outlets] == [1, 0, 1]


def test_forged_headers_do_not_fill_the_memory(fanout: Fanout) -> None:
    Outlet(fanout, 1)
    for system in range(1, 200):
        for component in range(1, 60):
            frame = bytes(
                dialect.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(
                    dialect.MAVLink(None, system, component)
                )
            )
            fanout.forward(frame, 99, 0)
    assert len(fanout._plans) <= MAX_PLANS
