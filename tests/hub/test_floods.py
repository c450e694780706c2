"""Clients that send without end: others are served, and untrusted ones are read slowly."""

import asyncio
import contextlib
import socket
from typing import Any

import msgspec
import pytest

from gateway.hub.forwarding_step import MAX_DATAGRAM
from gateway.hub.hub import Hub
from gateway.hub.transports.base import READ_BYTES, UNTRUSTED_READ_BURST, UNTRUSTED_READ_RATE
from tests.conftest import LoopTime
from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

KINDS = {"udp-listen": socket.SOCK_DGRAM, "tcp-listen": socket.SOCK_STREAM}
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
    hub = rig.hub(f"{kind}:127.0.0.1:0?trusted=no", f"{other}:127.0.0.1:0?trusted=yes")
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
    sock = await caller(rig, "tcp-listen", hub.listening_ports()[0])
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
