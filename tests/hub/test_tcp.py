"""TCP both ways and serial ports: broken and stalled peers, and the order of frames."""

import asyncio
import contextlib
import fcntl
import os
import pty
import socket
import sys
import tty
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.hub.transports.stream import UNSENT_BYTES
from gateway.wire.mavlink_splitter import MavlinkSplitter, message_id_of
from tests.conftest import LoopTime
from tests.kit.mavlink import frames_of
from tests.ports import free_port

pytestmark = pytest.mark.io

ATTITUDE, COMMAND_ACK = 30, 77
SIOCOUTQNSD = 0x894B
"""Bytes that the kernel has not sent, not even once."""


class TestTcpListen:
    async def narrow_client(self, rig: Any, hub: Any) -> socket.socket:
        """Connect with the smallest buffer that the kernel gives."""
        client = await rig.connect(hub.listening_ports()[0], room_bytes=1)
        await rig.until(lambda: len(hub.clients()) == 1)
        return client

    async def test_kernel_holds_few_unsent_bytes_of_joined_writes(self, rig: Any) -> None:
        """With a wide window it may join 40 kB: 20 s of a link of 2 kB/s."""
        hub = rig.hub("tcp-listen:127.0.0.1:0")
        await rig.connect(hub.listening_ports()[0])
        await rig.until(lambda: len(hub.clients()) == 1)
        (client,) = hub._clients.values()
        while not client.queued:
            rig.publish(hub, rig.vehicle.raw_imu())
        unsent = fcntl.ioctl(client._socket, SIOCOUTQNSD, bytes(4))
        assert int.from_bytes(unsent, sys.byteorder) < 2 * UNSENT_BYTES

    async def test_slow_client_gets_fresh_telemetry_and_answers_first(self, rig: Any) -> None:
        """It takes 2 kB a second of 10."""
        hub = rig.hub("tcp-listen:127.0.0.1:0")
        slow = await self.narrow_client(rig, hub)
        splitter, received = MavlinkSplitter(), list[tuple[int, bytes]]()
        for now_ms in range(0, 12_000, 20):
            rig.clock.now_us += 20_000
            message = dialect.MAVLink_attitude_message(now_ms, 0, 0, 0, 0, 0, 1.0)
            rig.publish(hub, *(rig.vehicle.pack(message) for _ in range(5)))
            if now_ms == 8000:
                rig.publish(hub, rig.vehicle.ack())
            await asyncio.sleep(0)
            with contextlib.suppress(BlockingIOError):
                received += [(now_ms, frame) for frame in frames_of(splitter.feed(slow.recv(40)))]
        late_ms = [
            now_ms - int.from_bytes(frame[10:14], "little")
            for now_ms, frame in received
            if message_id_of(frame) == ATTITUDE
        ]
        (answered_ms,) = [now_ms for now_ms, f in received if message_id_of(f) == COMMAND_ACK]
        assert len(late_ms) > 400
        assert max(late_ms[200:]) < 3500
        assert answered_ms < 10_000


class TestTcpOut:
    async def test_connection_to_itself_counts_as_refused(
        self, rig: Any, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The kernel may draw the wanted port, where nobody listens, as our own."""
        loop = asyncio.get_running_loop()
        connect = loop.sock_connect

        async def from_there(sock: socket.socket, address: tuple[str, int]) -> None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            sock.bind(address)
            await connect(sock, address)

        port = free_port()
        monkeypatch.setattr(loop, "sock_connect", from_there)
        hub = rig.hub(f"tcp:127.0.0.1:{port}")
        await rig.until(lambda: hub.clients()[0].state in ("refused", "open"))
        assert hub.clients()[0].state == "refused"


class TestSerial:
    @pytest.fixture
    def line(self, rig: Any) -> tuple[int, str]:
        near, far = pty.openpty()
        rig.closing += [lambda: os.close(near), lambda: os.close(far)]
        os.set_blocking(near, False)
        tty.setraw(far)
        return near, os.ttyname(far)

    async def test_radio_that_reports_a_full_buffer_is_sent_less(
        self, rig: Any, line: tuple[int, str]
    ) -> None:
        near, device = line
        hub = rig.hub(f"serial:{device}:57600")
        reports: list[tuple[int, int]] = []
        hub.update_buffer = lambda *report: reports.append(report)
        radio = rig.sender(51, 68)
        for free in (100, 10):
            report = dialect.MAVLink_radio_status_message(200, 200, free, 30, 30, 0, 0)
            os.write(near, radio.pack(report))
        await rig.until(lambda: hub.clients()[0].received == 2)
        assert reports == [(1, 100), (1, 10)]

    async def test_missing_device_is_reported_and_opened_when_it_appears(
        self, rig: Any, line: tuple[int, str], tmp_path: Path
    ) -> None:
        hub = rig.hub(f"serial:{tmp_path / 'radio'}:57600")
        assert hub.clients()[0].state == "unreachable"
        assert "No such file" in hub.clients()[0].reason
        (tmp_path / "radio").symlink_to(line[1])
        rig.tick(hub, 1)
        assert hub.clients()[0].state == "open"

    async def test_attitude_overtakes_and_sequence_numbers_stay_in_order(
        self, rig: Any, line: tuple[int, str], loop_time: LoopTime
    ) -> None:
        near, device = line
        hub = rig.hub(f"serial:{device}:9600")
        rig.publish(hub, rig.vehicle.heartbeat())
        rig.publish(hub, *(rig.vehicle.raw_imu() for _ in range(15)), rig.vehicle.attitude())
        waiting = hub.clients()[0].queued
        assert waiting > 10
        splitter, frames = MavlinkSplitter(), []
        while len(frames) < 17:
            rig.clock.now_us += 1_000
            loop_time.ahead_s += 0.001
            await asyncio.sleep(0)
            try:
                frames += frames_of(splitter.feed(os.read(near, 4096)))
            except BlockingIOError:
                continue
        ids = [message_id_of(frame) for frame in frames]
        assert ids.index(30) <= 17 - waiting + 1
        assert [frame[4] for frame in frames] == list(range(17))
