"""Faults of one client cost the others no frame."""

import asyncio
import contextlib
import json
import logging
import os
import shutil
import socket
import subprocess
import sys
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx

from gateway.hub.hub import CONNECTIONS_IN_FULL
from gateway.hub.stats import WINDOW_US
from gateway.hub.transports.registry import LISTENERS
from gateway.wire.mavlink_messages import CRC_EXTRA
from tests.conftest import ROOT

pytestmark = pytest.mark.io


class Healthy:
    """Clients without a fault: two configured, and one of a listening port."""

    def __init__(self, rig: Any, *endpoints: str, **settings: object) -> None:
        self.rig = rig
        self.stations = [rig.station() for _ in range(2)]
        configured = [f"udp:127.0.0.1:{station.port}" for station in self.stations]
        self.hub = rig.hub("udp-listen:127.0.0.1:0", *configured, *endpoints, **settings)
        self.stations.append(rig.station(self.hub.listening_ports()[0]))
        self.sent: list[bytes] = []
        self.received: list[list[int]] = [[] for _ in self.stations]

    async def start(self) -> None:
        caller = self.stations[-1]
        caller.send(caller.sender.heartbeat())
        await self.rig.until(lambda: len(self.hub.clients()) >= 3)
        await self.rig.until(lambda: all(c.state == "open" for c in self.hub.clients()[:2]))

    async def fly(self, frames: int) -> None:
        """Publish frames, letting the loop and the clients run between them."""
        for _ in range(frames):
            frame = self.rig.vehicle.attitude()
            self.sent.append(frame)
            self.rig.publish(self.hub, frame)
            await asyncio.sleep(0)
            self.listen()

    def listen(self) -> bool:
        """Read the frames received by the clients; return whether those are all."""
        for station, received in zip(self.stations, self.received, strict=True):
            received += [frame[4] for frame in station.received()]
        return all(len(received) >= len(self.sent) for received in self.received)

    async def lost(self) -> int:
        """Count the clients that did not get every frame in order."""
        with contextlib.suppress(TimeoutError):
            await self.rig.until(self.listen)
        whole = [frame[4] for frame in self.sent]
        return sum(received != whole for received in self.received)


@pytest.mark.parametrize("garbage", [b"\xfd", b"\xfe", b"\xfd\xff\x02", bytes(range(256))])
async def test_garbage_of_a_tcp_client_costs_others_no_frame(rig: Any, garbage: bytes) -> None:
    flight = Healthy(rig, "tcp-listen:127.0.0.1:0")
    await flight.start()
    with socket.create_connection(("127.0.0.1", flight.hub.listening_ports()[1])) as rude:
        await rig.until(lambda: len(flight.hub.clients()) == 4)
        rude.setblocking(False)
        for _ in range(50):
            with contextlib.suppress(BlockingIOError):
                rude.send(garbage * (20_000 // len(garbage)))
            with contextlib.suppress(BlockingIOError):
                rude.recv(1 << 20)
            await flight.fly(20)
        assert await flight.lost() == 0
        client = flight.hub.clients()[-1]
        assert client.bytes_garbage > 100_000
        assert client.received == 0
        heartbeat = rig.sender(200, 190).heartbeat()
        while not flight.hub.clients()[-1].received:
            # What looks like the head of a frame swallows the first ones.
            with contextlib.suppress(BlockingIOError):
                rude.send(heartbeat)
            await flight.fly(1)


@pytest.mark.skipif(
    os.geteuid() != 0 or not all(map(shutil.which, ("unshare", "ip", "nsenter"))),
    reason="only root can make network namespaces, with iproute2 and util-linux",
)
@pytest.mark.slow
async def test_interface_outage_loses_no_frame_of_other_clients(tmp_path: Any) -> None:
    """Run in a network namespace of its own: see `interface_world.py`."""
    run = await asyncio.to_thread(
        subprocess.run,
        ["unshare", "--net", sys.executable, "-m", "tests.hub.interface_world"],
        capture_output=True,
        text=True,
        timeout=240,
        cwd=ROOT,
        check=False,
    )
    if "not permitted" in run.stderr:
        pytest.skip("this machine forbids network namespaces")
    assert run.returncode == 0, run.stderr
    seen = json.loads(run.stdout)
    assert seen["state while down"] == "unreachable"
    assert seen["loopback lost"] == 0
    before_and_after = seen["far end could hear"]
    assert before_and_after - 50 <= seen["far end received"] <= before_and_after
    assert seen["far end received"] >= seen["sent after"] - 5


class TestLinkThatRaises:
    """An unexpected error closes its own link for a second and affects no other."""

    async def test_link_that_raises_is_reported_and_retried_while_others_go_on(
        self, rig: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        gone = rig.station()
        gone.socket.close()
        ours, device = os.openpty()
        rig.closing += [lambda: os.close(ours), lambda: os.close(device)]

        def overflow(*_: object, **__: object) -> None:
            raise OverflowError("signed integer is greater than maximum")

        with monkeypatch.context() as patched:
            patched.setattr("serial.Serial", overflow)
            hub = rig.hub(f"serial:{os.ttyname(device)}:57600?name=radio")
            hub.add(f"udp:127.0.0.1:{gone.port}")
            await rig.until(lambda: hub.clients()[1].state == "open")
            rig.publish(hub, rig.vehicle.attitude(), rig.vehicle.attitude())
            assert hub.clients()[1].state == "refused"
            radio = hub.clients()[0]
            assert (radio.state, radio.reason[:14]) == ("unreachable", "signed integer")
            for _ in range(3):
                rig.tick(hub, 1)
            assert "radio is closed and opened again" in caplog.text
            assert hub.clients()[1].state == "open", "the other one is open again"
        rig.tick(hub, 1)
        assert hub.clients()[0].state == "open"

    @pytest.mark.parametrize("kind", ["udp", "tcp"])
    async def test_listening_port_that_raises_is_bound_again(
        self, rig: Any, kind: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        hub = rig.hub(f"{kind}-listen:127.0.0.1:0")
        with monkeypatch.context() as patched:
            patched.setattr(LISTENERS[f"{kind}-listen"], "tick", lambda *_: 1 // 0)
            rig.tick(hub)
            assert hub.listeners()[0].state == "closed"
        rig.tick(hub, 2)
        assert hub.listeners()[0].state == "open"

    @pytest.mark.parametrize("kind", ["udp", "tcp"])
    async def test_invalid_name_is_reported_as_unresolved(
        self, rig: Any, kind: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        errors: list[Any] = []
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(lambda _, context: errors.append(context))

        async def choke(*_: object, **__: object) -> None:
            raise UnicodeError("label empty or too long")

        monkeypatch.setattr(loop, "getaddrinfo", choke)
        hub = rig.hub(f"{kind}:no-such-place.invalid:14550")
        await rig.until(lambda: hub.clients()[0].reason != "")
        assert (hub.clients()[0].state, errors) == ("resolving", [])


async def test_truncated_heartbeats_are_accepted_without_error(rig: Any) -> None:
    errors: list[Any] = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
    hub = rig.hub("udp-listen:127.0.0.1:0?trusted=no")
    caller = rig.station(hub.listening_ports()[0])
    for length in range(10):
        payload = bytes((0, 0, 0, 0, 6, 8, 0, 4, 3))[:length]
        body = bytes((len(payload), 0, 0, length, 255, 190, 0, 0, 0)) + payload
        crc = mcrf4xx(CRC_EXTRA[0], mcrf4xx(body))
        caller.send(b"\xfd" + body + crc.to_bytes(2, "little"))
    await rig.until(lambda: len(rig.incoming) == 10)
    assert errors == []


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
