"""Measure a fleet: many simulated sites, one router, one `mavgate fleet`, one ground station.

For each number of sites: frames lost, latency from the load generator's clock before it publishes
to this process's clock when the ground station reads (p50 and p99), CPU of router and fleet in per
cent of a core, their memory. The sites are load generators, several in each of a few processes:
they publish ATTITUDE frames that contain the time, without a gateway. `--plain` measures one site
that connects to a plain hub over TCP, without Zenoh, as the baseline. `--fleets 2` splits the sites
between two fleets on one router.
"""

import contextlib
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import common as mavlink

from gateway.hub.transports.zenoh.session import open_session, session_config, site_key
from gateway.live.control_socket import request
from gateway.wire.mavlink_splitter import MavFrame, MavlinkSplitter
from tests.ports import free_port
from tools.bench_hub import hub_command
from tools.harness import (
    MAVGATE,
    PYTHON,
    arguments,
    cpu_s,
    memory_mb,
    port_of,
    running,
    show,
    udp_socket,
    write_json,
)

SITES = (1, 10, 50, 200)
RATE_HZ = 60
GENERATORS = 2
START_S = 60.0
MOST = 0.98
"""Share of the sent frames after which, at a timeout, the rest counts as lost."""
SETTLE_S = 3.0
CRC_EXTRA = bytes((mavlink.MAVLink_attitude_message.crc_extra,))
HEADS = ("sites", "way", "sent", "lost", "lost before the fleet", "shed", "p50 µs", "p99 µs",
         "router CPU %", "router MB", "fleet CPU %", "fleet MB")  # fmt: skip
ROUTER = """
import sys
from gateway.hub.transports.zenoh.session import open_session, session_config
session = open_session(session_config(sys.argv[1], "", "router"))
print("open", flush=True)
sys.stdin.read()
"""
Send = Callable[[bytes], Any]
Started = Sequence["subprocess.Popen[str]"]


@dataclass
class Station:
    """A ground station that notes the time in each frame of one message, and when it was read."""

    message_id: int
    clock: Callable[[], int] = time.monotonic_ns
    sock: socket.socket = field(default_factory=udp_socket)
    splitter: MavlinkSplitter = field(default_factory=MavlinkSplitter)
    got: list[tuple[int, int]] = field(default_factory=list)
    """The time in the first four bytes of each frame's payload, and the clock at reading, ns."""

    def read(self, wait_s: float = 0.0) -> bool:
        """Read all received datagrams; return whether any arrived within a time."""
        if not select.select([self.sock], [], [], wait_s)[0]:
            return False
        with contextlib.suppress(BlockingIOError):
            while data := self.sock.recv(65536):
                now_ns = self.clock()
                for frame in self.splitter.feed(data):
                    if isinstance(frame, MavFrame) and frame.message_id == self.message_id:
                        self.got.append((int.from_bytes(frame.payload[:4], "little"), now_ns))
        return True


class Servers(contextlib.ExitStack):
    """Router, fleets, hub and load generators, which end together."""

    def start(self, *words: str, home: Path | None = None) -> "subprocess.Popen[str]":
        """Start a Python process whose lines can be read."""
        env = os.environ | ({"HOME": str(home), "XDG_RUNTIME_DIR": str(home)} if home else {})
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return self.enter_context(running(PYTHON, *words, env=env, text=True, **pipes))

    def router(self, locator: str) -> "subprocess.Popen[str]":
        """Start a Zenoh router, and wait until it is open."""
        router = self.start("-c", ROUTER, locator)
        assert router.stdout is not None
        router.stdout.readline()
        return router

    def fleet(self, home: Path, locator: str, sites: str, url: str) -> "subprocess.Popen[str]":
        """Start a fleet, and wait until it answers requests."""
        words = ("--connect", locator, "--site", sites, "--endpoint", url)
        fleet = self.start(*MAVGATE[1:], "fleet", *words, home=home)
        wait_for(socket_in(home))
        return fleet


def socket_in(home: Path) -> Path:
    """Return the path of a fleet's control socket."""
    return home / "mavgate" / "fleet.sock"


def free_locator() -> str:
    """Return a Zenoh locator of a free local TCP port."""
    return f"tcp/127.0.0.1:{free_port()}"


def wait_for(file: Path) -> None:
    """Wait until there is a file."""
    limit_s = time.monotonic() + START_S
    while not file.exists():
        if time.monotonic() > limit_s:
            raise RuntimeError(f"there is no {file}")
        time.sleep(0.1)


def publish(locator: str, names: str, rate_hz: str, seconds: str) -> None:
    """Send as the vehicles of some sites over Zenoh."""
    import zenoh

    session, drop = open_session(session_config(locator, "")), zenoh.CongestionControl.DROP
    tokens, sends = [], list[Send]()
    for name in names.split(","):
        publisher = session.declare_publisher(site_key(name, 1, "out"), congestion_control=drop)
        tokens.append(session.liveliness().declare_token(site_key(name, "site", session.zid())))
        sends.append(publisher.put)
    load(sends, int(rate_hz), float(seconds))


def connect(port: str, rate_hz: str, seconds: str) -> None:
    """Send as one vehicle over TCP."""
    with socket.create_connection(("127.0.0.1", int(port))) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        load([link.sendall], int(rate_hz), float(seconds))


def load(sends: Sequence[Send], rate_hz: int, seconds: float) -> None:
    """Send numbered frames that contain the time, evenly at a rate for each vehicle."""
    mav = mavlink.MAVLink(None, 1, 1)
    for send in sends:
        send(bytes(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(mav)))
    frame = bytearray(mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 1).pack(mav))
    time.sleep(2)
    begin_s = time.monotonic()
    for number in range(round(rate_hz * seconds) * len(sends)):
        wait_s = begin_s + number / (rate_hz * len(sends)) - time.monotonic()
        # What is due within half a millisecond leaves together: to sleep costs more than to send.
        if wait_s > 0.0005:
            time.sleep(wait_s)
        frame[4] = (1 + number // len(sends)) % 256
        frame[10:14] = (time.time_ns() // 1000 % (1 << 32)).to_bytes(4, "little")
        crc = mcrf4xx(CRC_EXTRA, mcrf4xx(bytes(frame[1:-2])))
        frame[-2:] = crc.to_bytes(2, "little")
        sends[number % len(sends)](bytes(frame))
    time.sleep(2)


def run(sites: int, fleets: int, rate_hz: int, seconds: float) -> dict[str, Any]:
    """Measure one number of sites."""
    locator, station = free_locator(), Station(mavlink.MAVLINK_MSG_ID_ATTITUDE, time.time_ns)
    with tempfile.TemporaryDirectory() as folder, station.sock, Servers() as servers:
        homes = [Path(folder, str(number)) for number in range(fleets)]
        watched = [servers.router(locator)]
        for number, home in enumerate(homes):
            home.mkdir()
            url = f"udp:127.0.0.1:{port_of(station.sock)}"
            watched.append(servers.fleet(home, locator, f"{number}-*", url))
        time.sleep(SETTLE_S)
        names = [f"{number % fleets}-{number}" for number in range(sites)]
        shares = [names[n::GENERATORS] for n in range(min(GENERATORS, sites))]
        words = ("-m", "tools.bench_fleet", "--serve", "publish", locator)
        loads = [servers.start(*words, ",".join(s), str(rate_hz), str(seconds)) for s in shares]
        found = measure(station, watched, loads, sites * rate_hz * seconds)
        counts = [lost_in(socket_in(home)) for home in homes]
    missed, shed = map(sum, zip(*counts, strict=True))
    way = "Zenoh" if fleets == 1 else f"Zenoh, {fleets} fleets"
    return {"sites": sites, "way": way, **found, "before": missed, "shed": shed}


def run_plain(rate_hz: int, seconds: float) -> dict[str, Any]:
    """Measure one site that connects to a plain hub over TCP."""
    station = Station(mavlink.MAVLINK_MSG_ID_ATTITUDE, time.time_ns)
    _, *words = hub_command("tcp-listen:127.0.0.1:0", f"udp:127.0.0.1:{port_of(station.sock)}")
    with station.sock, Servers() as servers:
        hub = servers.start(*words)
        assert hub.stdout is not None
        port = hub.stdout.readline().strip()
        generator = ("-m", "tools.bench_fleet", "--serve", "connect", port)
        loads = [servers.start(*generator, str(rate_hz), str(seconds))]
        found = measure(station, [hub], loads, rate_hz * seconds)
    return {"sites": 1, "way": "plain hub, TCP", **found, "before": 0, "shed": 0}


def measure(station: Station, watched: Started, loads: Started, expected: float) -> dict[str, Any]:
    """Read all frames; `cpu_percent` and `memory_mb` are those of each watched process."""
    limit_s = time.monotonic() + START_S
    while not station.got:
        station.read(0.1)
        if time.monotonic() > limit_s:
            raise RuntimeError("no frame arrives")
    begin_s, before = time.monotonic(), [cpu_s(process.pid) for process in watched]
    while station.read(0.2) or len(station.got) < expected * MOST:
        if all(each.poll() is not None for each in loads):
            break
    elapsed_s = time.monotonic() - begin_s
    used = [cpu_s(p.pid) - was for p, was in zip(watched, before, strict=True)]
    while station.read(0.3):
        pass
    late_us = [(ns // 1000 - sent_us) % (1 << 32) for sent_us, ns in station.got]
    return {
        "sent": round(expected),
        "lost": round(expected) - len(station.got),
        "p50_us": float(np.percentile(late_us, 50)),
        "p99_us": float(np.percentile(late_us, 99)),
        "cpu_percent": [100 * cpu / elapsed_s for cpu in used],
        "memory_mb": [memory_mb(process.pid) for process in watched],
    }


def lost_in(path: Path) -> tuple[int, int]:
    """Return a fleet's count of lost frames, and of those that it could not process in time."""
    status = request(path, "fleet.status")
    lost = [vehicle["lost"] for site in status["sites"] for vehicle in site["vehicles"]]
    return sum(lost), status["overflowed"]


def cells(found: dict[str, Any]) -> tuple[object, ...]:
    """Return a row; of several fleets, the busiest counts."""
    keys = ("sites", "way", "sent", "lost", "before", "shed", "p50_us", "p99_us")
    costs = [*zip(found["cpu_percent"], found["memory_mb"], strict=True)]
    router = costs.pop(0) if len(costs) > 1 else ("", "")
    return (*(found[key] for key in keys), *router, *max(costs))


def main() -> None:
    """Run the benchmark."""
    parser = arguments(__doc__, seconds=10.0)
    parser.add_argument("--sites", type=int, nargs="+", default=SITES)
    parser.add_argument("--plain", action="store_true", help="one site over TCP before")
    parser.add_argument("--fleets", type=int, default=1)
    parser.add_argument("--rate", type=int, default=RATE_HZ, help="messages/s of each site")
    options = parser.parse_args()
    runs = [run_plain(options.rate, options.seconds)] if options.plain else []
    runs += [run(n, options.fleets, options.rate, options.seconds) for n in options.sites]
    show(f"sites at {options.rate} messages/s each, loopback", HEADS, map(cells, runs))
    write_json(options, {"runs": runs})


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        (publish if sys.argv[2] == "publish" else connect)(*sys.argv[3:])
    else:
        main()
