"""Arrangements of a running gateway, a receiver or a machine for the transcripts, by name."""

import asyncio
import dataclasses
import grp
import os
import select
import socket
import subprocess
import sys
import threading
import tty
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, nullcontext
from getpass import getuser
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest

from gateway.aircraft import Aircraft, AircraftSettings
from gateway.cli.live import calibrate, doctor, first_start
from gateway.clock import GatewayClock
from gateway.compiled.entry_point import LibraryError
from gateway.config import GatewaySettings
from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live.control_socket import ControlError, ControlServer, Verbs, socket_path
from gateway.live.control_verbs import introduction_verb, recorder_verbs
from gateway.live.pty_port import PtyPort
from gateway.live.serial_port import Port, SerialPort
from gateway.records import LinkReport, LoggedRequest, NodeId, NodeLink, NodeStatus
from gateway.sensing.calibrating import CalibrationStep, NodeSamples
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.status import AircraftStatus, RelativeLocation, Snapshot
from tests.client_stats import TABLET
from tests.conftest import ManualClock
from tests.kit.recorder import RecorderBench
from tests.kit.recordings import make_frames
from tests.kit.records import NOTHING
from tests.ports import free_port

CLIENT = dataclasses.replace(
    TABLET, endpoint="udp:10.0.0.7:14550?name=tablet", systems=((255, 190),), sent=5000, dropped=2,
    received=10, queued=3, heard_us=1_000_000, round_trip_us=1500,
)  # fmt: skip
RADIO = dataclasses.replace(
    CLIENT, endpoint="udp:10.0.0.8:14550", name="radio", state="unreachable",
    reason="No such device", systems=tuple((n, 1) for n in range(1, 250)),
)  # fmt: skip
OPEN = ListenerStats("udp-listen:0.0.0.0:14551", "", "open", "", 14551, 1, 0)
CLOSED = ListenerStats(
    "observers", "tcp-listen:[::]:5760?name=observers", "closed", "Address already in use", 0, 0, 8
)
NODE = NodeLink(NodeId(1, 2), 0, 100, 7, 0, 0, 1, 60.0, 0, 0.0)
BOARD = NodeStatus(0, NodeId(1, 2), 0, (1, 4), 1, 7, 0, 12, 3, 450, 900, 100, 3290)
HOME = RelativeLocation(47.0, 8.0, 500.0, 1234.4, 271.2)
REFUSED = "COMMAND_LONG REQUEST_MESSAGE 62", "UNSUPPORTED", 3, 3_720_000_000
SNAPSHOT = Snapshot(
    time_us=3_723_000_000,
    report=LinkReport(0, True, "/dev/ttyUSB0", 0, 103, 4, (), (NODE,), None),
    states=((1, msgspec.structs.replace(NOTHING, lat_deg=47.5)),),
    clients=(CLIENT, RADIO),
    sent=((30, 9),),
    hub=HubCounters(published=9, looped=1),
    aircraft=(
        AircraftStatus(1, None, HOME, RelativeLocation(47.0, 8.0, 1.0, None, None), (BOARD,)),
    ),
    listeners=(OPEN, CLOSED),
    refused=3,
    requests=(LoggedRequest(1, 255, 190, *REFUSED),),
)


def clients() -> Verbs:
    """Return verbs with canned answers."""

    def add(url: str) -> None:
        if url not in (CLIENT.endpoint, CLOSED.endpoint):
            raise ControlError(f"no such endpoint: {url}")

    def mark(
        lat_deg: float | None, lon_deg: float | None, alt_amsl_m: float | None,
        vehicle_id: int | None,
    ) -> str:  # fmt: skip
        return f"marked {lat_deg} {lon_deg} {alt_amsl_m} {vehicle_id}"

    def remove(name: str) -> None:
        raise ControlError(f"no endpoint is called {name!r}")

    return {
        "status": lambda: SNAPSHOT,
        "clients.list": lambda: SNAPSHOT.clients,
        "clients.add": add,
        "clients.remove": remove,
        "reload": lambda: "settings of the hub applied",
        "mark": mark,
        **introduction_verb({1: INTRODUCTION}.__getitem__),
    }


INTRODUCTION = [sent.frame for sent in Aircraft(1, AircraftSettings()).vehicle.introduction()]


@asynccontextmanager
async def recorder(folder: Path, mode: str) -> AsyncIterator[Verbs]:
    """Yield the verbs of a recorder, which cannot write to its folder if it is blocked."""
    clock, below = ManualClock(), folder.parent / "elsewhere"
    if mode == "blocked":
        below.write_text("a file in its place")
    bench = RecorderBench(below, clock, mode="armed" if mode == "armed" else "manual")
    verbs = recorder_verbs(bench.recorder)
    start, rename = verbs["record.start"], verbs["record.rename"]

    async def start_with_frames() -> object:
        found = await start()
        bench.send(make_frames(9))
        return found

    async def rename_on_disk(name: str) -> object:
        found = await rename(name)
        await bench.recorder.settle()
        return found

    if mode == "armed":
        await bench.turn()
        clock.advance(21.0)
    else:
        bench.recorder.start()
    yield {**verbs, "record.start": start_with_frames, "record.rename": rename_on_disk}
    bench.recorder.close()


@contextmanager
def gateway(folder: Path, mode: str = "") -> Iterator[None]:
    """Serve the control socket of a gateway in a thread: with clients, or with a recorder."""
    loop, ended = asyncio.new_event_loop(), asyncio.Event()
    begun = threading.Event()

    async def serve() -> None:
        async with recorder(folder, mode) if mode else nullcontext(clients()) as verbs:
            server = ControlServer(socket_path("run"), verbs)
            await server.start()
            begun.set()
            await ended.wait()
            server.close()
            await asyncio.sleep(0)

    thread = threading.Thread(target=lambda: loop.run_until_complete(serve()))
    thread.start()
    assert begun.wait(60.0)
    try:
        yield
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join()
        loop.close()


G = 9.80665
SIDES = G * np.array([[0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0.0]])
BIAS = np.array([0.2, -0.1, 0.3])
AIRCRAFT = 'aircraft_folder = "."\n'


def link(folder: Path, kind: str = "", *, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a node lie on another side in each capture, first level; or move, or be interrupted."""
    captures = 0

    def capture(seconds: float, turned: bool) -> NodeSamples:
        nonlocal captures
        rng, side = np.random.default_rng(captures), SIDES[captures % 6]
        captures += 1
        if kind == "interrupted" and captures > 4:
            raise KeyboardInterrupt
        n = round(seconds * 100)
        times_s, moves = np.arange(n) / 100, 5.0 if kind == "moving" else 0.0
        field = rng.normal(size=(n, 3)) if turned else np.tile([0.3, 0.1, 0.9], (n, 1))
        return NodeSamples(
            time_s=times_s,
            accel=side + BIAS + rng.normal(0, 0.02 + moves, (n, 3)),
            gyro=0.05 + rng.normal(0, 0.002 + moves, (n, 3)),
            mag_time_s=times_s,
            mag=45.0 * field / np.linalg.norm(field, axis=1)[:, None] + 10.0,
            moving=np.zeros(n, np.bool_),
        )

    monkeypatch.setattr(calibrate, "capture_from", lambda serial, vehicle: capture)
    (folder / "g.toml").write_text(AIRCRAFT)


SPEED = 8.0
"""The simulated receiver and the gateway clock run so many times faster than true time."""


class FastClock(GatewayClock):
    def __call__(self) -> int:
        return round(SPEED * super().__call__())


def fast_port(frames: Iterator[TimedFrame]) -> PtyPort:
    return PtyPort(TimedFrame(frame.time_s / SPEED, frame.data) for frame in frames)


@contextmanager
def receiver(folder: Path, kind: str = "", *, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Simulate fast receivers; of some kind, run one of aircraft 3 at the port `port`."""
    monkeypatch.setattr(calibrate, "GatewayClock", FastClock)
    monkeypatch.setattr(calibrate, "PtyPort", fast_port)
    monkeypatch.setattr(first_start, "GPS_WAIT_S", 0.5)
    monkeypatch.setattr(first_start, "_own_address", lambda: "192.168.1.20")
    (folder / "g.toml").write_text(AIRCRAFT)
    if not kind:
        yield
        return
    if kind == "failing":
        monkeypatch.setattr(first_start, "calibrate_each", lambda *_: None)
    else:
        monkeypatch.setattr(first_start, "STEPS", (CalibrationStep.GYRO,))
    with calibrate.simulated_receiver(SimulatorSettings(vehicle_id=3)) as (path, _):
        (folder / "port").symlink_to(path)
        yield


@contextmanager
def line(folder: Path, sent: str = "", *, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Open a terminal `port` that sends some bytes when it is opened."""
    master, slave = os.openpty()
    tty.setraw(slave)
    (folder / "port").symlink_to(os.ttyname(slave))
    before, data = SerialPort.start, sent.encode() * 9

    def start(port: SerialPort) -> None:
        before(port)
        os.write(master, data)
        if data:
            assert select.select([port._port], [], [], 60.0)[0], "there before the look begins"

    monkeypatch.setattr(first_start, "LOOK_S", 0.3)
    monkeypatch.setattr(SerialPort, "start", start)
    try:
        yield
    finally:
        os.close(master)
        os.close(slave)


NAMELESS = 3_999_999_999
"""A user id without a name."""
SETTINGS = """\
aircraft_folder = "aircraft"
recording.folder = "recordings"
serial.port = "{port}"
hub.endpoints = ["{endpoint}"]
hub.tls_certificate = "{tls}"
panel.certificate = "{certificate}"
panel.certificate_key = "{key}"
"""


@contextmanager
def machine(folder: Path, *facts: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Make settings, and a machine with some facts: each a word and a value."""
    given = {"port": f"{folder}/ttyUSB7", "endpoint": "udp:127.0.0.1:14550"}
    given |= dict.fromkeys(("tls", "certificate", "key"), "")
    found = dict(fact.partition(" ")[::2] for fact in facts)
    given |= {name: found[name] for name in given.keys() & found}
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.setattr(doctor, "TTY", folder / "tty")
    if days := found.get("days"):
        given |= {"certificate": "panel.pem", "key": "key.pem"}
        make_certificate(folder, days)
    endpoint = ("127.0.0.1", free_port())
    given["endpoint"] = given["endpoint"].replace("FREE", str(endpoint[1]))
    (folder / "g.toml").write_text(SETTINGS.format(**given))
    ports = [
        Port(f"/dev/none{n}", f"1a86:{n}523", "A5" * n, "CH340", known=n < 2) for n in range(3)
    ]
    ports = ports if "adapters" in found else []
    monkeypatch.setattr(doctor, "list_serial_ports", lambda: ports)
    if user := found.get("user"):
        members = [getuser()] if user == "member" else []
        uid = NAMELESS if user == "nameless" else os.getuid()
        dialout = SimpleNamespace(gr_name="dialout", gr_mem=members)
        monkeypatch.setattr(os, "access", lambda _, mode: not mode & os.W_OK)
        monkeypatch.setattr(grp, "getgrgid", lambda _: dialout)
        monkeypatch.setattr(os, "getuid", lambda: uid)
    if room_mb := found.get("room"):
        free = (GatewaySettings().recording.free_floor_mb + int(room_mb)) * 1e6
        monkeypatch.setattr(doctor, "free_bytes_near", lambda _: free)
    if said := found.get("clock"):
        (folder / "timedatectl").write_text(f"#!/bin/sh\necho {said}\n")
        (folder / "timedatectl").chmod(0o755)
    if "kernels" in found:
        error = LibraryError(Path("kernels.so"), "is missing")
        monkeypatch.setattr(doctor, "load_entry_points", Mock(side_effect=error))
    if module := found.get("lacks"):
        monkeypatch.setitem(sys.modules, module, None)
    if kind := found.get("taken"):
        with socket.socket(socket.AF_INET, getattr(socket, kind)) as other:
            other.bind(endpoint)
            if kind == "SOCK_STREAM":
                other.listen()
            yield
        return
    yield


def make_certificate(folder: Path, days: str) -> None:
    key, request, file = (folder / name for name in ("key.pem", "request.pem", "panel.pem"))
    curve = ("ec", "-pkeyopt", "ec_paramgen_curve:P-256")
    made = ("openssl", "req", "-new", "-newkey", *curve, "-nodes", "-subj", "/CN=mavgate")
    signed = ("openssl", "x509", "-req", "-in", request, "-signkey", key, "-days", days)
    for words in ((*made, "-keyout", key, "-out", request), (*signed, "-out", file)):
        subprocess.run(words, check=True, capture_output=True, env={"PATH": "/usr/bin:/bin"})
