"""Clients that send without end: others are served, and untrusted ones are read slowly."""

import asyncio
import contextlib
import itertools
import socket
from typing import Any

import pytest

from gateway.hub.forwarding_step import MAX_DATAGRAM
from gateway.hub.transports.base import READ_BYTES, UNTRUSTED_READ_BURST, UNTRUSTED_READ_RATE
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

KINDS = {"udp-listen": socket.SOCK_DGRAM, "tcp-listen": socket.SOCK_STREAM}
NOISE = bytes(1024)


async def caller(rig: Any, kind: str, port: int) -> socket.socket:
    """Open a connection that has sent one heartbeat."""
    sock: socket.socket = await rig.connect(port, KINDS[kind])
    sock.send(rig.sender(255, 190).heartbeat())
    return sock


def send(sock: socket.socket) -> None:
    with contextlib.suppress(BlockingIOError):
        sock.send(NOISE)


@pytest.mark.parametrize("kind", KINDS)
async def test_one_wake_up_reads_a_bounded_part_of_a_flood(rig: Any, kind: str) -> None:
    hub = rig.hub(f"{kind}:127.0.0.1:0")
    sock = await caller(rig, kind, hub.listening_ports()[0])
    await rig.until(lambda: bool(rig.incoming))
    (client,) = hub._clients.values()
    taken = [client.counters.bytes_received]
    all_of_it = taken[0] + 20 * len(NOISE)
    for _ in range(20):
        send(sock)
    async with asyncio.timeout(START_LIMIT_S):
        while taken[-1] < all_of_it:
            await asyncio.sleep(0)
            taken.append(client.counters.bytes_received)
    assert max(after - before for before, after in itertools.pairwise(taken)) <= READ_BYTES


@pytest.mark.parametrize("kind", KINDS)
async def test_untrusted_clients_share_one_read_rate(rig: Any, kind: str) -> None:
    (other,) = KINDS.keys() - {kind}
    hub = rig.hub(f"{kind}:127.0.0.1:0?trusted=no", f"{other}:127.0.0.1:0?trusted=yes")
    port, quiet_port = hub.listening_ports()
    floods = [await caller(rig, kind, port) for _ in range(2)]

    def taken() -> int:
        return sum(client.bytes_received for client in hub.clients() if not client.trusted)

    async def flood_until(most: int) -> None:
        while taken() < most:
            for sock in floods:
                send(sock)
            await asyncio.sleep(0)

    async with asyncio.timeout(START_LIMIT_S):
        await flood_until(UNTRUSTED_READ_BURST)
        for _ in range(20):
            for sock in floods:
                send(sock)
        rig.incoming.clear()
        await caller(rig, other, quiet_port)
        await rig.until(lambda: any(incoming.trusted for incoming in rig.incoming))
        # Each of the two may have been reading when the last was spent.
        limit = UNTRUSTED_READ_BURST + len(floods) * (READ_BYTES + MAX_DATAGRAM)
        assert UNTRUSTED_READ_BURST <= taken() < limit
        rig.clock.now_us += 2_000_000
        await flood_until(UNTRUSTED_READ_BURST + UNTRUSTED_READ_RATE)
        assert taken() < limit + 2 * UNTRUSTED_READ_RATE


async def test_client_that_becomes_trusted_is_read_at_once(rig: Any) -> None:
    hub = rig.hub("tcp-listen:127.0.0.1:0?trusted=no")
    sock = await caller(rig, "tcp-listen", hub.listening_ports()[0])
    await rig.until(lambda: bool(rig.incoming))
    (client,) = hub._clients.values()
    hub.untrusted_reads.level = -1.0
    send(sock)
    await rig.until(lambda: client.counters.bytes_received > len(NOISE))
    client.trusted = True
    before = client.counters.bytes_received
    send(sock)
    await rig.until(lambda: client.counters.bytes_received == before + len(NOISE))


async def test_untrusted_client_that_leaves_while_it_waits_is_not_read_again(rig: Any) -> None:
    hub = rig.hub("tcp-listen:127.0.0.1:0?trusted=no")
    sock = await caller(rig, "tcp-listen", hub.listening_ports()[0])
    await rig.until(lambda: bool(rig.incoming))
    (client,) = hub._clients.values()
    paused = client._socket
    hub.untrusted_reads.level = -1.0
    send(sock)
    await rig.until(lambda: client.counters.bytes_received > len(NOISE))
    hub.vanish(client)
    client._read_later(paused, client._read)
    assert not hub.clients()
