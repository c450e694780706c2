"""Which client gets which frame, at which rate and with which sequence number."""

import itertools
from random import Random

import pytest

from gateway.hub.fanout import Fanout
from gateway.hub.forwarding import Forwarding
from gateway.hub.forwarding_step import HAND_OVER, RUN_SENT, ClientState, _route_of
from gateway.hub.route import Route
from gateway.hub.routing_table import SystemPath
from gateway.records import ClientInterval
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame, frame_of
from tests.kit.hub import KeepingClient
from tests.kit.mavlink import Sender, signer

ATTITUDE_ID = 30


class Peer(KeepingClient):
    """A client of a fan-out."""

    def __init__(
        self, fanout: Fanout, client_id: int, options: str = "", *, direct: bool = False
    ) -> None:
        super().__init__(client_id, f"udp:h:1{options}", direct=direct)
        fanout.add(self)

    @property
    def message_ids(self) -> list[int]:
        return [frame.message_id for _, frame in self.sent]

    def sequences(self) -> list[int]:
        return [frame.sequence for _, frame in self.sent]


def publish(fanout: Fanout, data: bytes, now_us: int = 0) -> None:
    frame = frame_of(data)
    fanout.publish(frame, frame.sequence, now_us)


def answer(fanout: Fanout, data: bytes, client_ids: list[int]) -> None:
    frame = frame_of(data)
    fanout.answer(frame, frame.sequence, client_ids, 0)


def forward(fanout: Fanout, data: bytes, source: KeepingClient, now_us: int = 0) -> None:
    frame = frame_of(data)
    if frame.key not in source.routes:
        path = SystemPath(0)
        source.routes[frame.key] = fanout.make_route(frame, source, path, None)
    source.routes[frame.key].forward(frame, now_us)


@pytest.fixture
def fanout() -> Fanout:
    return Fanout(FrameSigner())


@pytest.fixture
def vehicle() -> Sender:
    return Sender()


def test_clients_with_the_same_number_share_one_signed_copy(vehicle: Sender) -> None:
    fanout = Fanout(signer())
    peers = [Peer(fanout, client_id, "?deny=0") for client_id in range(1, 4)]
    publish(fanout, vehicle.heartbeat())
    publish(fanout, vehicle.attitude())
    assert [peer.sequences() for peer in peers] == [[0]] * 3
    assert len({id(peer.sent[0][1]) for peer in peers}) == 1
    assert peers[0].sent[0][1].signed


def test_client_may_leave_while_a_frame_is_sent_to_it(fanout: Fanout, vehicle: Sender) -> None:
    class Leaving(Peer):
        def transmit(self, frame: MavFrame) -> None:
            super().transmit(frame)
            fanout.remove(self.client_id)

    for send in (publish, lambda fanout, frame: answer(fanout, frame, [1])):
        leaving, other = Leaving(fanout, 1), Peer(fanout, 2)
        send(fanout, vehicle.attitude())
        publish(fanout, vehicle.attitude())
        assert other.sent
        assert len(leaving.sent) == 1
        fanout.remove(2)


def test_denied_messages_leave_no_gap_in_the_sequence(fanout: Fanout, vehicle: Sender) -> None:
    picky, plain = Peer(fanout, 1, "?deny=ATTITUDE"), Peer(fanout, 2)
    for _ in range(300):
        publish(fanout, vehicle.attitude(), 0)
        publish(fanout, vehicle.heartbeat(), 0)
    assert set(picky.message_ids) == {0}
    assert picky.sequences() == [1 + n - 1 & 255 for n in range(300)]
    assert plain.sequences() == [n & 255 for n in range(600)]


def test_answer_to_one_client_leaves_no_gap_at_others(fanout: Fanout, vehicle: Sender) -> None:
    asker, other = Peer(fanout, 1, "?deny=HEARTBEAT"), Peer(fanout, 2)
    publish(fanout, vehicle.attitude(), 0)
    answer(fanout, vehicle.heartbeat(), [1])
    publish(fanout, vehicle.attitude(), 0)
    assert asker.message_ids == [ATTITUDE_ID, 0, ATTITUDE_ID]
    assert asker.sequences() == [0, 1, 2]
    assert other.sequences() == [0, 1]


def test_systems_are_numbered_separately(fanout: Fanout) -> None:
    one, two = Sender(1), Sender(2)
    peer = Peer(fanout, 1)
    answer(fanout, one.heartbeat(), [99])
    publish(fanout, one.attitude(), 0)
    publish(fanout, two.attitude(), 0)
    assert peer.sequences() == [0, 0]


class TestRates:
    @pytest.mark.parametrize(
        ("rate_hz", "times_us", "passed"),
        [
            pytest.param(25, [n * 20_000 + n % 3 * 4_000 for n in range(100)], 50, id="jitter"),
            pytest.param(50, [n * 20_000 + n % 3 * 2_000 for n in range(100)], 100, id="equal"),
            pytest.param(10, [0, *range(60_000_000, 60_000_010)], 2, id="no burst after a pause"),
        ],
    )
    def test_rate_limit_passes_frames_at_its_rate(
        self, fanout: Fanout, vehicle: Sender, rate_hz: int, times_us: list[int], passed: int
    ) -> None:
        peer = Peer(fanout, 1, f"?rate=ATTITUDE:{rate_hz}")
        for now_us in times_us:
            publish(fanout, vehicle.attitude(), now_us)
        assert peer.sequences() == list(range(passed))

    def test_requested_interval_slows_and_stops(self, fanout: Fanout, vehicle: Sender) -> None:
        asker, other = Peer(fanout, 1), Peer(fanout, 2)

        def sent_in_a_second(interval_us: int) -> int:
            fanout.set_interval(ClientInterval(1, 1, ATTITUDE_ID, interval_us))
            before = len(asker.frames)
            for n in range(49):
                publish(fanout, vehicle.attitude(), n * 20_000)
            return len(asker.frames) - before

        assert [sent_in_a_second(us) for us in (100_000, -1, 0)] == [10, 0, 49]
        assert len(other.frames) == 147

    def test_settings_bound_a_requested_interval(self, fanout: Fanout, vehicle: Sender) -> None:
        denied = Peer(fanout, 1, "?deny=ATTITUDE")
        limited = Peer(fanout, 2, "?rate=ATTITUDE:1")
        for client_id in (1, 2):
            fanout.set_interval(ClientInterval(client_id, 1, ATTITUDE_ID, 20_000))
        for n in range(25):
            publish(fanout, vehicle.attitude(), n * 20_000)
        assert (len(denied.frames), len(limited.frames)) == (0, 1)

    def test_requested_interval_applies_to_one_system(self, fanout: Fanout) -> None:
        peer = Peer(fanout, 1)
        fanout.set_interval(ClientInterval(1, 1, ATTITUDE_ID, -1))
        publish(fanout, Sender(1).attitude(), 0)
        publish(fanout, Sender(2).attitude(), 0)
        assert [frame[5] for frame in peer.frames] == [2]


def test_monitor_gets_every_frame_without_a_gap(fanout: Fanout, vehicle: Sender) -> None:
    monitor, other = Peer(fanout, 1, "?monitor=yes&deny=ATTITUDE"), Peer(fanout, 2)
    publish(fanout, vehicle.attitude())
    answer(fanout, vehicle.heartbeat(), [2])
    publish(fanout, vehicle.attitude())
    command = Sender(255, 190).command(9, 1)
    fanout.deliver(frame_of(command), [1, 2], 7)
    fanout.deliver(frame_of(command), [2], 1)
    assert monitor.frames == [*other.frames[:3], command]
    assert monitor.sequences() == [0, 1, 2, 0]


def keep(fanout: Fanout, data: bytes, source: KeepingClient) -> None:
    """Forward a frame by a route of its own, which is kept."""
    frame = frame_of(data)
    route = fanout.make_route(frame, source, SystemPath(0), None)
    fanout.keep_route(route, source, frame.key)
    route.forward(frame, 0)


def test_kinds_beyond_the_bound_replace_the_oldest_route_only(
    fanout: Fanout, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gateway.hub.fanout.MAX_ROUTES", 1000)
    limited = Peer(fanout, 1, "?rate=HEARTBEAT:1")
    source, other = Peer(fanout, 99), Peer(fanout, 98)
    keep(fanout, Sender(99, 1).heartbeat(), other)
    keys = []
    for system, component in itertools.product(range(1, 41), range(1, 31)):
        keep(fanout, Sender(system, component).heartbeat(), source)
        keys.append(bytes((system, component, 0, 0, 0)))
    assert [*source.routes] == keys[-1000:]
    assert len(other.routes) == 1
    assert len(fanout._targets) == len(fanout._targets_at) == 1001, "one of each limit"
    fanout.settle()
    assert (fanout.forwarded, len(limited.frames)) == (1201, 1201)


@pytest.mark.parametrize("seed", range(3))
def test_compiled_step_finds_the_routes_that_have_not_left(seed: int) -> None:
    random, forwarding = Random(seed), Forwarding()
    known: dict[tuple[int, bytes], int] = {}
    kinds = [(client, bytes((1, 1, m, m, 0))) for client in (1, 2) for m in range(200)]
    for client_id, key in random.choices(kinds, k=1500):
        if (client_id, key) in known:
            forwarding.leave(client_id, key, known.pop((client_id, key)))
        else:
            row = forwarding.enter(client_id, key, 0, 0, 0, 0)
            assert row is not None
            known[client_id, key] = row
    assert sorted(known.values()) == sorted(set(known.values()))
    for client_id, key in kinds:
        state, data = ClientState(), bytes(5) + key
        state.id = client_id
        found = _route_of(forwarding.work, state, data, 0)
        row = known.get((client_id, key))
        first, size = forwarding.work.routes_at, forwarding._routes.itemsize
        assert found == (0 if row is None else first + row * size)


def test_plan_of_a_bandwidth_changes_limits_and_no_routes(fanout: Fanout, vehicle: Sender) -> None:
    radio, station = Peer(fanout, 1, "?budget=300"), Peer(fanout, 2)
    source, other, routes = Peer(fanout, 3), Sender(2), set[Route]()
    for step in range(400):
        now_us = radio.now_us = step * 50_000
        fanout.thin(now_us)
        publish(fanout, vehicle.attitude(), now_us)
        forward(fanout, other.attitude(), source, now_us)
        routes |= {*source.routes.values()}
    assert (len(routes), len(station.frames)) == (1, 800)
    flow = len(b"".join(radio.since(10 * US_PER_S))) / 10
    assert 150 < flow <= 1.1 * 300


def test_frames_of_the_compiled_step_are_counted_when_their_route_is_settled(
    fanout: Fanout, vehicle: Sender
) -> None:
    peer, source = (Peer(fanout, number, direct=True) for number in (1, 2))
    path, forwarding = SystemPath(0), fanout.forwarding
    frames = [vehicle.attitude() for _ in range(3)]
    route = fanout.make_route(frame_of(frames[0]), source, path, None)
    fanout.keep_route(route, source, frame_of(frames[0]).key)
    source.memory.is_forwardable = 1
    step = forwarding.step(source.memory, reads=False)
    for now_us, frame in enumerate(frames, start=70):
        forwarding.load(frame, now_us)
        step()
        assert forwarding.work.status == RUN_SENT
        fanout.finish_run(now_us)
    forwarding.load(frames[0][:-1] + b"?", 99)
    step()
    assert forwarding.work.status & HAND_OVER
    assert peer.frames == frames
    assert route.settle(forwarding) == (3, sum(map(len, frames)))
    assert route.settle(forwarding) == (0, 0)
    fanout.settle()
    assert fanout.forwarded == 3
    assert (peer.counters.sent, source.counters.received) == (3, 3)
    stream = path.stream
    assert (path.heard_us, stream.count, stream.newest_us, stream.leader) == (72, 3, 72, 2)
    assert stream.sent_us[:3] == [70, 71, 72]
