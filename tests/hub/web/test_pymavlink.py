"""pymavlink's own WebSockets as the other end, both ways."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

pytestmark = pytest.mark.io


async def receive(link: Any, kind: str) -> Any:
    """Wait in a thread of its own, since pymavlink blocks."""
    return await asyncio.to_thread(link.recv_match, type=kind, blocking=True, timeout=START_LIMIT_S)


@pytest.mark.parametrize("kind", ["ws", "wss"])
async def test_pymavlink_connects_to_the_hub(
    rig: Rig, certificate: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    hub = rig.hub(f"{kind}-listen:127.0.0.1:0", tls_certificate=str(certificate))
    rig.publish(hub, rig.vehicle.heartbeat())
    url = f"{kind}:127.0.0.1:{hub.listening_ports()[0]}"
    link = await asyncio.to_thread(mavutil.mavlink_connection, url, source_system=255)
    try:
        rig.publish(hub, rig.vehicle.raw_imu())
        assert (await receive(link, "HEARTBEAT")).get_srcSystem() == 1
        assert (await receive(link, "RAW_IMU")).zmag == 9
        link.mav.command_long_send(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0)
        await rig.until(lambda: bool(rig.incoming))
        assert rig.incoming[0].trusted
        rig.publish(hub, *(rig.vehicle.attitude() for _ in range(200)))
        got = [await receive(link, "ATTITUDE") for _ in range(200)]
        assert [message.get_seq() for message in got] == list(range(2, 202))
        assert link.mav.total_receive_errors == 0
    finally:
        link.close()


async def test_hub_connects_to_pymavlink(rig: Rig) -> None:
    port = free_port()
    server = mavutil.mavlink_connection(f"wsserver:127.0.0.1:{port}", source_system=9)
    try:
        hub = rig.hub(f"ws:127.0.0.1:{port}")
        await until_read(rig, server, lambda: hub.clients()[0].state == "open")
        rig.publish(hub, rig.vehicle.attitude())
        got: list[Any] = []

        def has_come() -> bool:
            if message := server.recv_match(type="ATTITUDE"):
                got.append(message)
            return bool(got)

        await rig.until(has_come)
        assert got[0].get_srcSystem() == 1
        server.mav.heartbeat_send(6, 8, 0, 0, 0)
        await rig.until(lambda: hub.clients()[0].systems == ((9, 0),))
    finally:
        server.close()


async def until_read(rig: Rig, server: Any, condition: Callable[[], bool]) -> None:
    """Let pymavlink answer the handshake, which it does as it reads."""

    def step() -> bool:
        server.recv_msg()
        return condition()

    await rig.until(step)
