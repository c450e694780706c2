"""Attack a gateway and a panel that this program starts on loopback; print held or fell.

    .venv/bin/python -m tools.attack                 # two minutes; --only WORD for some

Each attack is possible for untrusted clients, local programs or hostile files. The gateway holds if
it still serves the operator, and sends, stores and computes no more than its limits allow.
"""

import argparse
import asyncio
import contextlib
import gzip
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http.client import HTTPConnection
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

import websockets
from pymavlink.dialects.v20 import common as mavlink

from gateway.hub.systems import HARMLESS
from gateway.live.control_socket import ControlError, request
from gateway.panel.logins import hash_password
from gateway.wire.mavlink_messages import HEARTBEAT_ID
from gateway.wire.mavlink_splitter import MavFrame, split_datagram
from gateway.wire.vehicle_inputs import acts
from tests.kit.mavlink import STATION, every_message, packed, sent_by
from tests.kit.process import Process
from tests.ports import free_port

OPERATOR, VIEWER = "operator's", "viewer's"
DEMO: Final = 1
"""System id of the demo's aircraft."""
COMMAND_S: Final = 30.0
"""Timeout of a command that must refuse a hostile file; its start takes some seconds."""
CONFIG = """
[recording]
folder = "{folder}/recordings"
[hub]
endpoints = ["udp-listen:127.0.0.1:{port}", "udp-listen:127.0.0.1:{selecting}?systems=2"]
[panel]
port = 0
map_styles = []
password = "{operator}"
viewer_password = "{viewer}"
"""


@dataclass
class Target:
    """A demo and a panel for it."""

    folder: Path
    port: int
    """Its listening UDP port."""
    selecting_port: int = 0
    """Another one, behind which only system 2 passes."""
    link: str = ""
    """Address of the panel."""

    def connection(self) -> HTTPConnection:
        """Connect to the panel."""
        return HTTPConnection(urlsplit(self.link).netloc, timeout=COMMAND_S)

    def log_in(self, password: str) -> str:
        """Open a session and return its cookie."""
        connection = self.connection()
        kind = {"content-type": "application/x-www-form-urlencoded"}
        connection.request("POST", "/login", f"password={password}", kind)
        cookie = connection.getresponse().headers["set-cookie"].partition(";")[0]
        connection.close()
        return str(cookie)

    def status_of(self, cookie: str, method: str = "GET", body: bytes | None = None) -> int:
        """Request the page, or post to the REST API; return the status of the answer."""
        connection = self.connection()
        path = "/v1/mavlink" if method == "POST" else "/"
        connection.request(method, path, body, {"cookie": cookie})
        status = connection.getresponse().status
        connection.close()
        return status


def past_a_selection(target: Target) -> bool:
    """Send every message behind `systems=2` to a vehicle with another id; only harmless ones pass.

    The vehicle has sent a heartbeat and no telemetry; the sender uses ids of all three.
    """
    vehicle_id, selected_id = 3, 2
    address = ("127.0.0.1", target.port)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as station,
    ):
        vehicle.setblocking(False)
        beat = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3)
        vehicle.sendto(beat.pack(mavlink.MAVLink(None, vehicle_id, 1)), address)
        station.connect(("127.0.0.1", target.selecting_port))
        passed = set()
        for sender in ((255, STATION), (selected_id, 1), (vehicle_id, STATION)):
            station.send(packed(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), *sender))
            for frame in every_message(0, vehicle_id):
                station.send(sent_by(frame, *sender).data)
                if frame.message_id % 16 == 0:
                    passed |= _received(vehicle)
        passed |= _received(vehicle)
    return HEARTBEAT_ID in passed and {number for number in passed if acts(number)} <= HARMLESS


def _received(sock: socket.socket) -> set[int]:
    """Return the ids of the messages of others than the demo that have arrived."""
    found = set()
    time.sleep(0.02)
    with contextlib.suppress(BlockingIOError):
        while True:
            for event in split_datagram(sock.recv(65535)):
                if isinstance(event, MavFrame) and event.origin[0] != DEMO:
                    found.add(event.message_id)
    return found


def idle_control_connections(target: Target) -> bool:
    """Open connections to the control socket that send no request."""
    path = target.folder / "mavgate" / "run.sock"
    with contextlib.ExitStack() as opened:
        for _ in range(64):
            idle = opened.enter_context(socket.socket(socket.AF_UNIX))
            idle.connect(str(path))
        return isinstance(request(path, "verbs"), list)


def devices_as_clients(target: Target) -> bool:
    """Request the gateway to open devices that are not serial ports."""
    path = target.folder / "mavgate" / "run.sock"
    for device in ("/dev/null", "/dev/ptmx", "/dev/zero"):
        try:
            request(path, "clients.add", {"url": f"serial:{device}:57600"})
        except ControlError:
            continue
        return False
    return True


def viewer_sessions(target: Target) -> bool:
    """Log in as a viewer until no slot is left, and load pages without their scripts."""
    operator = target.log_in(OPERATOR)
    viewers = [target.log_in(VIEWER) for _ in range(70)]
    pages = [target.status_of(viewers[-1]) for _ in range(40)]
    return target.status_of(operator) == 200 and set(pages) == {200}


def viewer_websockets(target: Target) -> bool:
    """Open WebSockets as a viewer until no connection is left."""
    operator, viewer = target.log_in(OPERATOR), target.log_in(VIEWER)

    async def open_all() -> bool:
        url = f"ws://{urlsplit(target.link).netloc}/v1/ws/mavlink"
        async with contextlib.AsyncExitStack() as opened:
            connected = 0
            for _ in range(260):
                with contextlib.suppress(websockets.WebSocketException, OSError):
                    connect = websockets.connect(
                        url, additional_headers={"cookie": viewer}, close_timeout=0.2
                    )
                    await opened.enter_async_context(connect)
                    connected += 1
            assert connected > 200
            return await asyncio.to_thread(target.status_of, operator) == 200

    return asyncio.run(open_all())


def large_bodies(target: Target) -> bool:
    """Post bodies of up to a megabyte; the next request is answered."""
    operator = target.log_in(OPERATOR)
    bodies = (b"[" * 300_000, b'{"a":' * 150_000, bytes(900_000), b'"' + b"\\" * 700_000)
    answered = {target.status_of(operator, "POST", body) for body in bodies}
    return answered <= {400, 404, 413} and target.status_of(operator) == 200


def hostile_settings(target: Target) -> bool:
    """Check settings files that take long to parse, or never end."""
    texts = {
        "keys.toml": ".".join(["a"] * 50_000) + " = 1",
        "unknown.toml": "\n".join(f"unknown{n} = 1" for n in range(30_000)),
        "lists.toml": "x = " + "[" * 100_000,
    }
    for name, text in texts.items():
        (target.folder / name).write_text(text)
    pipe = target.folder / "pipe.toml"
    os.mkfifo(pipe)
    files = [*(target.folder / name for name in texts), pipe, Path("/dev/zero")]
    return all(_refuses("doctor", str(file)) for file in files)


def packed_comments(target: Target) -> bool:
    """Read a small file that unpacks to hundreds of millions of lines."""
    bomb = target.folder / "bomb.csv.gz"
    with gzip.open(bomb, "wb", compresslevel=9) as file:
        for _ in range(200):
            file.write(b"#\n" * (1 << 20))
    return _refuses("info", str(bomb))


def _refuses(*arguments: str) -> bool:
    command = [sys.executable, "-m", "gateway.cli", *arguments]
    try:
        done = subprocess.run(command, capture_output=True, timeout=COMMAND_S, check=False)
    except subprocess.TimeoutExpired:
        return False
    return done.returncode in (1, 2) and b"Traceback" not in done.stderr


Attacks = Mapping[str, Callable[[Target], bool]]
"""Attacks by name; each returns whether the target held."""
OF_FILES: Final = {
    "hostile settings files": hostile_settings,
    "comment lines packed to a thousandth": packed_comments,
}
OF_GATEWAY: Final = {
    "every message past a selection of systems": past_a_selection,
    "idle control connections": idle_control_connections,
    "devices as serial clients": devices_as_clients,
}
OF_PANEL: Final = {
    "70 sessions and 40 pages of a viewer": viewer_sessions,
    "260 WebSockets of a viewer": viewer_websockets,
    "bodies of up to a megabyte": large_bodies,
}


@contextlib.contextmanager
def started(folder: Path, *, panel: bool) -> Iterator[Target]:
    """Start a demo, with a panel if `panel`."""
    (folder / "recordings").mkdir()
    target = Target(folder, free_port(), free_port())
    hashes = {"operator": hash_password(OPERATOR), "viewer": hash_password(VIEWER)}
    config = CONFIG.format(
        folder=folder, port=target.port, selecting=target.selecting_port, **hashes
    )
    with contextlib.ExitStack() as opened:
        demo = opened.enter_context(Process(folder, "demo", "--plain", "--no-panel", config=config))
        socket_path = folder / "mavgate" / "run.sock"
        while not socket_path.exists():
            assert demo.process.poll() is None, demo.log.read_text()
            time.sleep(0.1)
        if panel:
            target.link = opened.enter_context(Process(folder, "panel", config=config)).link()
        yield target


def run(attacks: Attacks, target: Target) -> bool:
    """Run attacks and print their outcome; return whether all held."""
    held = True
    for name, attack in attacks.items():
        begin_s = time.monotonic()
        try:
            outcome = attack(target)
        except (OSError, AssertionError, ControlError) as error:
            print(f"{name}: {error!r}")
            outcome = False
        held = held and outcome
        print(f"{'held' if outcome else 'FELL'}  {time.monotonic() - begin_s:5.1f} s  {name}")
    return held


def main() -> None:
    """Run all attacks, or those with a word in their name."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", metavar="WORD", default="", help="attacks with this word")
    only = parser.parse_args().only

    def chosen(attacks: Attacks) -> Attacks:
        return {name: attack for name, attack in attacks.items() if only in name}

    with tempfile.TemporaryDirectory() as name:
        held = run(chosen(OF_FILES), Target(Path(name), 0))
        of_gateway, of_panel = chosen(OF_GATEWAY), chosen(OF_PANEL)
        if of_gateway or of_panel:
            with started(Path(name), panel=bool(of_panel)) as target:
                held = run({**of_gateway, **of_panel}, target) and held
    sys.exit(0 if held else 1)


if __name__ == "__main__":
    main()
