"""Broadcast and multicast on the loopback interface."""

import asyncio
import socket
import struct
from typing import Any

import pytest

from tests.kit.process import START_LIMIT_S

pytestmark = pytest.mark.io

GROUP = "239.255.145.50"


def member(rig: Any) -> socket.socket:
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    rig.closing.append(sock.close)
    sock.setblocking(False)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.bind((GROUP, 0))
    sock.setsockopt(
        socket.IPPROTO_IP,
        socket.IP_ADD_MEMBERSHIP,
        struct.pack("=4s4s", socket.inet_aton(GROUP), socket.inet_aton(source_address())),
    )
    return sock


def source_address() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((GROUP, 1))
        except OSError:
            pytest.skip("this machine has no route to multicast groups")
        return str(probe.getsockname()[0])


async def test_multicast_is_sent_and_received_without_own_frames(rig: Any) -> None:
    listener = member(rig)
    port = listener.getsockname()[1]
    hub = await rig.open(f"udp-multicast:{GROUP}:{port}")
    frame = rig.vehicle.attitude()
    rig.publish(hub, frame)
    async with asyncio.timeout(START_LIMIT_S):
        data, sender = await asyncio.get_running_loop().sock_recvfrom(listener, 4096)
    assert data == frame
    answer, sent = rig.sender(255, 190), []
    for target in ((GROUP, port), sender):
        sent.append(answer.heartbeat())
        listener.sendto(sent[-1], target)
    await rig.until(lambda: len(rig.incoming) == 2)
    assert [incoming.frame for incoming in rig.incoming] == sent
    (client,) = hub.clients()
    assert (client.received, client.trusted) == (2, False)
