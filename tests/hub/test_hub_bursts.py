"""Bursts and floods: what one turn of the loop reads and sends, in which order, and for whom."""

import asyncio
import contextlib
import gc
import itertools
import logging
import socket
import sys
from typing import Any

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.hub.forwarding_step import MAX_DATAGRAM
from gateway.hub.hub import LEAST_READ_BYTES, MAX_WAITING, SENDS_AT_ONCE, Hub
from gateway.hub.limits import CLIENT_BURST, REQUEST_COST
from gateway.hub.transports.base import READ_BYTES, UNTRUSTED_READ_BURST, UNTRUSTED_READ_RATE
from gateway.records import Incoming, Outgoing
from gateway.wire.mavlink_splitter import frame_of
from tests.conftest import LoopTime
from tests.kit.hub import FlyingHub
from tests.kit.mavlink import STATION, Sender
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

STATIONS = 4
KINDS = {"udp": socket.SOCK_DGRAM, "tcp": socket.SOCK_STREAM}
FRAMES_A_TURN = SENDS_AT_ONCE // STATIONS


@pytest.fixture
async def crowd(rig: Any) -> Any:
    """Some stations that hear every frame."""
    rig.stations = [rig.station() for _ in range(STATIONS)]
    urls = (f"udp:127.0.0.1:{station.port}" for station in rig.stations)
    # A round trip that the real timer starts would have sequence numbers of its own.
    options = {"ping_interval_s": 0.0, "on_frame": lambda incoming: rig.serve(incoming)}
    rig.world = await rig.open(*urls, **options)
    return rig


def burst(rig: Any, count: int) -> list[bytes]:
    return [rig.vehicle.attitude() for _ in range(count)]


async def test_burst_is_sent_in_order_a_few_frames_a_turn(crowd: Any) -> None:
    hub, frames = crowd.world, burst(crowd, 3 * FRAMES_A_TURN + 1)
    sent = []
    hub.send_all(map(crowd.out, frames))
    while not sent or sent[-1] < len(frames):
        sent.append(hub.counters().published)
        await asyncio.sleep(0)
    assert sent == [FRAMES_A_TURN, 2 * FRAMES_A_TURN, 3 * FRAMES_A_TURN, len(frames)]
    for station in crowd.stations:
        assert [await station.receive() for _ in frames] == frames


async def test_answers_to_one_client_are_counted_once(crowd: Any) -> None:
    hub, asker = crowd.world, crowd.world.clients()[0].client_id
    hub.send_all(crowd.out(frame, asker) for frame in burst(crowd, SENDS_AT_ONCE + 1))
    assert hub.counters().published == SENDS_AT_ONCE
    await asyncio.sleep(0)
    assert hub.counters().published == SENDS_AT_ONCE + 1


async def test_telemetry_after_a_burst_does_not_overtake_it(crowd: Any) -> None:
    hub, frames = crowd.world, burst(crowd, 2 * FRAMES_A_TURN)
    hub.send_all(map(crowd.out, frames[:-1]))
    hub.send_all([crowd.out(frames[-1])])
    for station in crowd.stations:
        assert [await station.receive() for _ in frames] == frames


async def test_frames_beyond_the_bound_are_sent_at_once(crowd: Any) -> None:
    hub = crowd.world
    hub.send_all(map(crowd.out, burst(crowd, 2 * MAX_WAITING)))
    assert hub.counters().published == MAX_WAITING


async def test_burst_is_sent_before_the_hub_closes(crowd: Any) -> None:
    hub, frames = crowd.world, burst(crowd, 2 * FRAMES_A_TURN)
    hub.send_all(map(crowd.out, frames))
    hub.close()
    for station in crowd.stations:
        assert [await station.receive() for _ in frames] == frames


async def test_burst_is_charged_to_the_client_that_caused_it(crowd: Any) -> None:
    """Also where its frames are for all and are sent long after its request was served."""
    hub, asker = crowd.world, crowd.stations[0]
    await crowd.check_passes(hub, *crowd.stations)
    frames, served = [crowd.vehicle.raw_imu() for _ in range(100)], []

    def serve(incoming: Incoming) -> None:
        served.append(incoming)
        hub.send_all(map(crowd.out, frames))

    crowd.serve = serve
    asker.send(*(asker.sender.command(1, 1) for _ in range(40)))
    crowd.publish(hub, crowd.vehicle.heartbeat())
    await crowd.until(lambda: hub.clients()[0].received == 40)
    await crowd.quiet()
    assert len(served) == CLIENT_BURST // (REQUEST_COST + STATIONS * sum(map(len, frames))) + 1


@pytest.mark.parametrize("kind", KINDS)
async def test_simultaneous_clients_are_admitted_one_a_turn(rig: Any, kind: str) -> None:
    hub = rig.hub(f"{kind}-listen:127.0.0.1:0")
    for _ in range(STATIONS):
        sock = await rig.connect(hub.listening_ports()[0], KINDS[kind])
        sock.send(rig.sender(255, 190).heartbeat())
    seen = [hub.listeners()[0].clients]

    def are_all_in() -> bool:
        seen.append(hub.listeners()[0].clients)
        return seen[-1] == STATIONS

    await rig.until(are_all_in)
    assert all(after - before <= 1 for before, after in itertools.pairwise(seen))


@pytest.mark.parametrize(("stations", "most"), [(1, READ_BYTES), (15, 768), (80, LEAST_READ_BYTES)])
@pytest.mark.parametrize("kind", KINDS)
async def test_flood_is_forwarded_over_many_turns(
    rig: Any, kind: str, stations: int, most: int
) -> None:
    takers = [rig.station() for _ in range(stations)]
    hub = await rig.open(f"{kind}-listen:127.0.0.1:0", *(f"udp:127.0.0.1:{t.port}" for t in takers))
    source = await rig.connect(hub.listening_ports()[0], KINDS[kind])
    vehicle = rig.sender(7)
    source.send(vehicle.attitude())
    await rig.until(lambda: hub.counters().forwarded == 1)
    frames = [vehicle.attitude() for _ in range(200)]
    for frame in frames:
        source.send(frame)
    passed = [1]

    def are_all_through() -> bool:
        passed.append(hub.counters().forwarded)
        return passed[-1] == 1 + len(frames)

    await rig.until(are_all_through)
    in_a_turn = most // len(frames[0]) + 1
    assert all(after - before <= in_a_turn for before, after in itertools.pairwise(passed))
    assert rig.foreign[1:] == frames


TURN_US = 40_000
"""A turn of the loop at a load of 40."""


async def test_slow_loop_answers_within_0_3_s_and_sheds_telemetry(crowd: Any) -> None:
    """A client uploads a mission item by item while each turn of the loop takes 40 ms."""
    hub, station = crowd.world, crowd.stations[0]
    crowd.publish(hub, crowd.vehicle.heartbeat())
    await station.receive()
    crowd.serve = lambda incoming: hub.send_all(
        [crowd.out(crowd.vehicle.ack(), incoming.client_id)]
    )
    asked_us, latencies_us, numbers = None, [], []
    for _ in range(500):
        crowd.clock.now_us += TURN_US
        hub.send_all(map(crowd.out, burst(crowd, 20)))
        if asked_us is None:
            asked_us = crowd.clock.now_us
            station.send(station.sender.command(1, 1))
        await asyncio.sleep(0)
        for frame in map(frame_of, station.received()):
            numbers.append(frame.sequence)
            if frame.message_id == 77:
                latencies_us.append(crowd.clock.now_us - asked_us)
                asked_us = None
    assert len(latencies_us) > 50
    assert max(latencies_us) < 300_000
    counters = hub.counters()
    assert counters.shed > 1000
    assert len(numbers) > 500, "telemetry goes on"
    steps = {(after - before) % 256 for before, after in itertools.pairwise(numbers)}
    assert steps == {1}, "shed frames leave no gap in the numbers"


NOISE = bytes(1024)


async def caller(rig: Any, kind: str, port: int) -> socket.socket:
    """Open a connection that has sent one heartbeat, which is received."""
    sock: socket.socket = await rig.connect(port, KINDS[kind])
    before = rig.received
    sock.send(rig.sender(255, 190).heartbeat())
    await rig.until(lambda: rig.received > before)
    return sock


def send(sock: socket.socket) -> None:
    with contextlib.suppress(BlockingIOError):
        sock.send(NOISE)


def taken(hub: Hub) -> int:
    """Return the bytes that were read from untrusted clients, or from all."""
    clients = hub.clients()
    return sum(each.bytes_received for each in [c for c in clients if not c.trusted] or clients)


@pytest.mark.parametrize("kind", KINDS)
async def test_untrusted_clients_share_one_read_rate(rig: Any, kind: str) -> None:
    (other,) = KINDS.keys() - {kind}
    hub = rig.hub(
        f"{kind}-listen:127.0.0.1:0?trusted=no", f"{other}-listen:127.0.0.1:0?trusted=yes"
    )
    port, quiet_port = hub.listening_ports()
    floods = [await caller(rig, kind, port) for _ in range(2)]

    async def flood_until(most: int) -> None:
        while taken(hub) < most:
            for sock in floods:
                send(sock)
            await asyncio.sleep(0)

    async with asyncio.timeout(START_LIMIT_S):
        await flood_until(UNTRUSTED_READ_BURST)
        for _ in range(20):
            for sock in floods:
                send(sock)
        await caller(rig, other, quiet_port)
        assert rig.incoming[-1].trusted
        # Each of the two may have been reading when the last was spent.
        limit = UNTRUSTED_READ_BURST + len(floods) * (READ_BYTES + MAX_DATAGRAM)
        assert UNTRUSTED_READ_BURST <= taken(hub) < limit
        rig.clock.now_us += 2_000_000
        await flood_until(UNTRUSTED_READ_BURST + UNTRUSTED_READ_RATE)
        assert taken(hub) < limit + 2 * UNTRUSTED_READ_RATE


@pytest.fixture
async def paused(rig: Any) -> tuple[Hub, socket.socket]:
    """A hub that no longer reads its untrusted client, and the client."""
    hub = rig.hub("tcp-listen:127.0.0.1:0?trusted=no")
    sock = await caller(rig, "tcp", hub.listening_ports()[0])
    hub.untrusted_reads.level = -1.0
    send(sock)
    await rig.until(lambda: taken(hub) > len(NOISE))
    return hub, sock


async def test_client_that_becomes_trusted_is_read_at_once(
    rig: Any, paused: tuple[Hub, socket.socket]
) -> None:
    hub, sock = paused
    endpoints = ("tcp-listen:127.0.0.1:0?trusted=yes",)
    hub.apply(msgspec.structs.replace(hub.settings, endpoints=endpoints))
    before = taken(hub)
    send(sock)
    await rig.until(lambda: taken(hub) == before + len(NOISE))


async def test_untrusted_client_that_leaves_while_it_waits_is_not_read_again(
    rig: Any, paused: tuple[Hub, socket.socket], loop_time: LoopTime, loop_errors: list[Any]
) -> None:
    hub, _ = paused
    hub.remove("tcp-listen:127.0.0.1:0")
    assert not hub.clients()
    # The pause is over.
    rig.clock.now_us += 10_000_000
    loop_time.ahead_s = 3600.0
    await rig.quiet()
    assert loop_errors == []


CLIENTS, MAX_CLIENTS = 2000, 16
GROWTH_LIMIT_BLOCKS = CLIENTS // 8
"""Half a block for each of a quarter: a client that is kept takes one or more."""


@pytest.mark.slow
async def test_thousands_of_unknown_addresses_cost_no_frame_and_no_memory(
    rig: Any, rng: np.random.Generator, caplog: pytest.LogCaptureFixture
) -> None:
    # The lines that pytest keeps would be counted.
    caplog.set_level(logging.CRITICAL, logger="gateway")
    steady, forged = rig.station(), Sender(255, STATION)
    endpoints = (f"udp:127.0.0.1:{steady.port}", "udp-listen:127.0.0.1:0?trusted=no")
    gateway = FlyingHub(rig, 1, *endpoints, max_clients=MAX_CLIENTS, idle_timeout_s=5.0)
    await rig.until_open(gateway.hub)
    target, sent, numbers = ("127.0.0.1", gateway.hub.listening_ports()[0]), 0, bytearray()
    change = forged.pack(mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    datagrams = [forged.heartbeat(), change, Sender(1, 1).heartbeat(), rng.bytes(3000), b"", change]

    def listen() -> None:
        numbers.extend(frame[4] for frame in steady.received() if frame[5:7] == b"\x01\x01")

    async def assail(first: int, last: int) -> None:
        nonlocal sent
        for number in range(first, last):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.bind((f"127.1.{number // 250}.{1 + number % 250}", 0))
                client.sendto(datagrams[number % len(datagrams)], target)
            if number % 5 == 0:
                rig.clock.now_us += 1_000_000
                sent += sum(isinstance(each, Outgoing) for each in gateway.fly())
                await asyncio.sleep(0)
                listen()
                assert len(gateway.hub.clients()) <= 1 + MAX_CLIENTS
        gc.collect()

    blocks = []
    for first, last in itertools.pairwise((0, CLIENTS // 2, 3 * CLIENTS // 4, CLIENTS)):
        await assail(first, last)
        blocks.append(sys.getallocatedblocks())
    # Other objects may come once; kept clients would come in both quarters.
    assert min(np.diff(blocks)) < GROWTH_LIMIT_BLOCKS
    await rig.until(lambda: bool(listen()) or len(numbers) >= sent)
    steps = {(after - before) % 256 for before, after in itertools.pairwise(numbers)}
    assert steps == {1}, "nothing lost, and no gap from what others were answered"
    assert gateway.vehicle.refusals > CLIENTS // 20
