"""The gateway as its users start it: a process of its own, and a bare client of it."""

import asyncio
import fcntl
import math
import os
import re
import select
import socket
import subprocess
import sys
import termios
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path

from mavsdk.asyncio import ComponentType, Configuration, Mavsdk, System
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.telemetry.telemetry import Position
from pymavlink.dialects.v20 import common as mavlink

from gateway.simulator.simulator_settings import SimulatorSettings
from tests.kit.process import START_LIMIT_S, Process
from tests.ports import free_ports

HOME = SimulatorSettings()
NEAR_DEG = 0.004
"""The whole simulated flight; how much of it has been flown by then depends on the machine."""
STEEPEST_DEG = 50.0
"""Of the simulated flight."""
EXPECTED = {
    "HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "ATTITUDE_QUATERNION", "ATTITUDE",
    "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT", "HIGHRES_IMU", "SCALED_PRESSURE",
    "HOME_POSITION", "STATUSTEXT",
}  # fmt: skip
"""Messages of the simulated flight."""
SO_RCVBUFFORCE = 33
"""Of Linux, for root alone: beyond the limit that others have."""
RECEIVE_BYTES = 16 << 20
"""Ten thousand datagrams: a minute of telemetry."""

CONFIG = """
[hub]
endpoints = ["udp:127.0.0.1:{port}", "udp-listen:127.0.0.1:{listen}"]

[simulator]
gps_first_fix_s = 0.5
"""


class Gateway(Process):
    """A gateway with ports to clients, in a session of its own on a terminal if there is one."""

    def __init__(
        self,
        folder: Path,
        command: str,
        *options: str,
        config: str = CONFIG,
        terminal: int | None = None,
    ) -> None:
        self.port, self.listen_port = free_ports(2)
        self.socket = folder / "mavgate" / "run.sock"
        if command == "demo" and "--panel" not in options:
            options = ("--no-panel", *options)
        super().__init__(
            *(folder, command, "--plain", *options),
            config=config.format(port=self.port, listen=self.listen_port),
            stdin=subprocess.DEVNULL if terminal is None else terminal,
            start_new_session=terminal is not None,
            preexec_fn=None if terminal is None else _take_terminal,
        )


def _take_terminal() -> None:
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)


def make_room(sock: socket.socket) -> None:
    """Let the kernel keep what comes while a test is busy or does not run: as much as it allows."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, SO_RCVBUFFORCE, RECEIVE_BYTES)
    except PermissionError:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)


class Client:
    """A bare MAVLink client, decoding with pymavlink alone."""

    def __init__(self, port: int = 0) -> None:
        self.sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.sock.bind(("127.0.0.1", port))
        self.sock.settimeout(START_LIMIT_S)
        make_room(self.sock)
        self.mavlink = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)

    def receive(self) -> list[mavlink.MAVLink_message]:
        """Wait for a datagram and decode it."""
        return self.mavlink.parse_buffer(self.sock.recv(65_536)) or []

    def until(
        self, wanted: Callable[[dict[str, mavlink.MAVLink_message]], bool], limit: int = 20_000
    ) -> dict[str, mavlink.MAVLink_message]:
        """Receive until what was seen, newest by name, satisfies a condition."""
        seen: dict[str, mavlink.MAVLink_message] = {}
        for _ in range(limit):
            for message in self.receive():
                seen[message.get_type()] = message
            if wanted(seen):
                return seen
        raise AssertionError(f"not in {limit} datagrams; seen: {sorted(seen)}")

    def send(self, message: mavlink.MAVLink_message, port: int) -> None:
        self.sock.sendto(message.pack(self.mavlink), ("127.0.0.1", port))

    def introduce(self, port: int) -> None:
        """Show a listening port that this client receives: request something of what it sent."""
        request = mavlink.MAVLink_command_long_message(
            1, 1, mavlink.MAV_CMD_REQUEST_MESSAGE, 0, mavlink.MAVLINK_MSG_ID_HEARTBEAT, *[0] * 6
        )
        for _ in range(2):
            self.send(request, port)
            self.receive()


class MavProxy:
    """MAVProxy without its windows, driven as by keyboard."""

    def __init__(self, port: int, folder: Path) -> None:
        self.output = ""
        self.process = subprocess.Popen(
            [
                sys.executable,
                str(Path(sys.executable).parent / "mavproxy.py"),
                f"--master=udpin:127.0.0.1:{port}",
                f"--state-basedir={folder}",
            ],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            cwd=folder,
        )

    def type(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{command}\n".encode())
        self.process.stdin.flush()

    def until(self, pattern: str, asking: str = "") -> re.Match[str]:
        """Read until the output holds a pattern; ask for it by a command every second."""
        assert self.process.stdout is not None
        deadline = time.monotonic() + START_LIMIT_S
        while (found := re.search(pattern, self.output)) is None:
            assert time.monotonic() < deadline, f"no {pattern!r} in:\n{self.output}"
            if asking:
                self.type(asking)
            ready, _, _ = select.select([self.process.stdout], [], [], 1.0)
            if ready:
                self.output += os.read(self.process.stdout.fileno(), 65_536).decode()
        return found


@asynccontextmanager
async def mavsdk_system(
    port: int, kind: ComponentType = ComponentType.GROUND_STATION
) -> AsyncIterator[System]:
    """Connect MAVSDK to a port; yield the first vehicle, to be used within the time limit.

    A test must keep a reference to each plugin: otherwise a worker thread frees it, possibly while
    MAVSDK itself is freed, which aborts Python.
    """
    configuration = Configuration.create_with_component_type(kind)
    async with Mavsdk(configuration) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        system = await mavsdk.first_autopilot(timeout_s=START_LIMIT_S)
        async with asyncio.timeout(START_LIMIT_S):
            yield system


async def first_position(telemetry: TelemetryAsync) -> Position:
    """Return the first position that the vehicle has."""
    async for position in telemetry.subscribe_position():
        if math.isfinite(position.latitude_deg):
            return position
    raise AssertionError("no position")
