"""Faults of one client cost the others no frame."""

import asyncio
import errno
import logging
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx

from gateway.hub.hub import CONNECTIONS_IN_FULL
from gateway.hub.stats import WINDOW_US
from gateway.wire.mavlink_messages import CRC_EXTRA

pytestmark = pytest.mark.io


async def test_interface_outage_loses_no_frame_of_other_clients(
    rig: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    near, far = rig.station(), rig.station()
    hub = await rig.open(*(f"udp:127.0.0.1:{each.port}" for each in (near, far)))
    rig.publish(hub, sent := rig.vehicle.attitude())
    client = hub._clients[2]

    def unreachable(_: bytes) -> int:
        raise OSError(errno.ENETUNREACH, "Network is unreachable")

    frames = [sent]
    with monkeypatch.context() as down:
        down.setattr(client, "write", unreachable)
        down.setattr(type(client), "_connect", lambda _: None)
        for _ in range(100):
            frames.append(rig.vehicle.attitude())
            rig.publish(hub, frames[-1])
        assert (hub.clients()[1].state, hub.clients()[1].dropped) == ("unreachable", 100)
    rig.tick(hub, 1)
    await rig.until_open(hub)
    rig.publish(hub, last := rig.vehicle.attitude())
    assert [await near.receive() for _ in (*frames, last)] == [*frames, last]
    assert [await far.receive() for _ in range(2)] == [sent, last]


@pytest.mark.parametrize("kind", ["udp", "tcp"])
async def test_invalid_name_is_reported_as_unresolved(
    rig: Any, kind: str, monkeypatch: pytest.MonkeyPatch, loop_errors: list[Any]
) -> None:
    async def choke(*_: object, **__: object) -> None:
        raise UnicodeError("label empty or too long")

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", choke)
    hub = rig.hub(f"{kind}:no-such-place.invalid:14550")
    await rig.until(lambda: hub.clients()[0].reason != "")
    assert (hub.clients()[0].state, loop_errors) == ("resolving", [])


async def test_truncated_heartbeats_are_accepted_without_error(
    rig: Any, loop_errors: list[Any]
) -> None:
    hub = rig.hub("udp-listen:127.0.0.1:0?trusted=no")
    caller = rig.station(hub.listening_ports()[0])
    for length in range(10):
        payload = bytes((0, 0, 0, 0, 6, 8, 0, 4, 3))[:length]
        body = bytes((len(payload), 0, 0, length, 255, 190, 0, 0, 0)) + payload
        crc = mcrf4xx(CRC_EXTRA[0], mcrf4xx(body))
        caller.send(b"\xfd" + body + crc.to_bytes(2, "little"))
    await rig.until(lambda: len(rig.incoming) == 10)
    assert loop_errors == []


async def test_unlimited_new_clients_do_not_flood_the_log(
    rig: Any, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, logger="gateway")
    many = CONNECTIONS_IN_FULL + 10
    hub = rig.hub("udp-listen:127.0.0.1:0", max_clients=many, idle_timeout_s=3600)
    for _ in range(many):
        client = rig.station(hub.listening_ports()[0])
        client.send(client.sender.heartbeat())
    await rig.until(lambda: len(hub.clients()) == many)
    assert len(caplog.messages) == CONNECTIONS_IN_FULL
    hub.add("udp:127.0.0.1:9")
    assert caplog.messages[-1].endswith("127.0.0.1:9"), "a configured client is always named"
    rig.clock.now_us += WINDOW_US
    rig.tick(hub)
    assert "10 more connects and disconnects at listening ports" in caplog.messages
