"""Measure a fleet: many simulated sites, one router, one `mavgate fleet`, one ground station.

For each number of sites: frames lost, latency from the load generator's clock before it publishes
to this process's clock when the ground station reads (p50 and p99), CPU of router and fleet in per
cent of a core, their memory. The sites are load generators, several in each of a few processes:
they publish ATTITUDE frames that contain the time, without a gateway. `--plain` measures one site
that connects to a plain hub over TCP, without Zenoh, as the baseline.

`--unsubscribed N` adds sites whose names no pattern matches, and which must not cost the fleet
anything. `--fleets 2` splits the sites between two fleets on one router.
"""

import argparse
import contextlib
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.live.control_socket import request
from gateway.wire.mavlink_splitter import MavFrame, MavlinkSplitter
from tools.bench_hub import cpu_ns, hub_command, resident_kib, udp_socket

SITES = (1, 10, 50, 200)
RATE_HZ = 60
GENERATORS = 2
START_S = 60.0
MOST = 0.98
"""Share of the sent frames after which, at a timeout, the rest counts as lost."""
SETTLE_S = 3.0
ATTITUDE = 30

ROUTER = """
import sys
from gateway.hub.transports.zenoh.session import open_session, session_config
session = open_session(session_config(sys.argv[1], "", "router"))
print("open", flush=True)
sys.stdin.read()
"""

LOAD = """
import sys, time
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import common as mavlink
EXTRA = bytes((mavlink.MAVLink_attitude_message.crc_extra,))
def load(ways, rate, seconds):
    link = mavlink.MAVLink(None, 1, 1)
    for way in ways:
        way(bytes(mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3).pack(link)))
    frame = bytearray(mavlink.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 1).pack(link))
    time.sleep(2)
    begin = time.monotonic()
    for number in range(round(rate * seconds) * len(ways)):
        wait = begin + number / (rate * len(ways)) - time.monotonic()
        # What is due within half a millisecond leaves together: to sleep costs more than to send.
        if wait > 0.0005:
            time.sleep(wait)
        frame[4] = (1 + number // len(ways)) % 256
        frame[10:14] = (time.time_ns() // 1000 % (1 << 32)).to_bytes(4, "little")
        body = bytes(frame[1:-2])
        frame[-2:] = mcrf4xx(EXTRA, mcrf4xx(body)).to_bytes(2, "little")
        ways[number % len(ways)](bytes(frame))
    time.sleep(2)
"""

GENERATOR = (
    LOAD
    + """
from gateway.hub.transports.zenoh.session import out_key, presence_key
from gateway.hub.transports.zenoh.session import open_session, session_config
import zenoh
session = open_session(session_config(sys.argv[1], ""))
ways, tokens = [], []
for name in sys.argv[2].split(","):
    drop = zenoh.CongestionControl.DROP
    publisher = session.declare_publisher(out_key(name, 1), congestion_control=drop)
    tokens.append(session.liveliness().declare_token(presence_key(name, session.zid())))
    ways.append(publisher.put)
load(ways, int(sys.argv[3]), float(sys.argv[4]))
"""
)

TCP_GENERATOR = (
    LOAD
    + """
import socket
with socket.create_connection(("127.0.0.1", int(sys.argv[1]))) as link:
    link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    load([link.sendall], int(sys.argv[2]), float(sys.argv[3]))
"""
)


@dataclass(frozen=True)
class FleetRun:
    """Results of one run."""

    sites: int
    way: str
    sent: int
    lost: int
    lost_before: int
    """Lost frames that the fleet itself has counted by their sequence numbers."""
    shed: int
    """Lost frames that the fleet could not process in time, and has counted."""
    p50_us: float
    p99_us: float
    router_cpu_percent: float
    fleet_cpu_percent: float
    router_kib: int
    fleet_kib: int


@dataclass(frozen=True)
class Processes:
    """The measured processes and the load generators."""

    watched: "list[subprocess.Popen[str]]"
    """The router, if any, and the fleets or the hub."""
    loads: "list[subprocess.Popen[str]]"
    sockets: list[Path]
    """Control sockets of the fleets."""


@dataclass
class Station:
    """A ground station that notes the time in each frame of one message, and when it was read."""

    message_id: int
    clock: Callable[[], int] = time.monotonic_ns
    sock: socket.socket = field(default_factory=udp_socket)
    splitter: MavlinkSplitter = field(default_factory=MavlinkSplitter)
    got: list[tuple[int, int]] = field(default_factory=list)
    """The time in the first four bytes of each frame's payload, and the clock at reading, ns."""

    @property
    def port(self) -> int:
        """Port of the station."""
        return int(self.sock.getsockname()[1])

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


def free_locator() -> str:
    """Return a Zenoh locator of a free local TCP port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def start(*words: str, home: Path | None = None) -> "subprocess.Popen[str]":
    """Start a Python process whose output lines can be read."""
    env = os.environ | ({"HOME": str(home), "XDG_RUNTIME_DIR": str(home)} if home else {})
    return subprocess.Popen(
        [sys.executable, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=env,
    )


def start_router(locator: str) -> "subprocess.Popen[str]":
    """Start a Zenoh router, and wait until it is open."""
    router = start("-c", ROUTER, locator)
    assert router.stdout is not None
    router.stdout.readline()
    return router


def wait_for(file: Path) -> None:
    """Wait until a fleet answers requests."""
    limit = time.monotonic() + START_S
    while not file.exists():
        if time.monotonic() > limit:
            raise RuntimeError(f"no fleet: there is no {file}")
        time.sleep(0.1)


def generators(
    locator: str, names: list[str], rate_hz: int, seconds: float
) -> list["subprocess.Popen[str]"]:
    """Start the load generators, with the sites divided between a few processes."""
    shares = [names[n::GENERATORS] for n in range(min(GENERATORS, len(names)))]
    return [
        start("-c", GENERATOR, locator, ",".join(share), str(rate_hz), str(seconds))
        for share in shares
    ]


def run(sites: int, unsubscribed: int, fleets: int, rate_hz: int, seconds: float) -> FleetRun:
    """Measure one number of sites."""
    locator, station = free_locator(), Station(ATTITUDE, time.time_ns)
    with tempfile.TemporaryDirectory() as folder:
        watched, sockets = [start_router(locator)], []
        for number in range(fleets):
            home = Path(folder) / str(number)
            home.mkdir()
            url = f"udp:127.0.0.1:{station.port}"
            words = ("fleet", "--connect", locator, "--site", f"{number}-*", "--endpoint", url)
            watched.append(start("-m", "gateway.cli", *words, home=home))
            sockets.append(home / "mavgate" / "fleet.sock")
            wait_for(sockets[-1])
        time.sleep(SETTLE_S)
        names = [f"{number % fleets}-{number}" for number in range(sites)]
        others = [f"other-{number}" for number in range(unsubscribed)]
        loads = generators(locator, names + others, rate_hz, seconds)
        processes = Processes(watched, loads, sockets)
        way = "Zenoh" if fleets == 1 else f"Zenoh, {fleets} fleets"
        try:
            return _measure(sites, way, station, processes, sites * rate_hz * seconds)
        finally:
            end_all(processes, station)


def run_plain(rate_hz: int, seconds: float) -> FleetRun:
    """Measure one site that connects to a plain hub over TCP."""
    station = Station(ATTITUDE, time.time_ns)
    _, *words = hub_command("tcp-listen:127.0.0.1:0", f"udp:127.0.0.1:{station.port}")
    hub = start(*words)
    assert hub.stdout is not None
    port = hub.stdout.readline().strip()
    load = start("-c", TCP_GENERATOR, port, str(rate_hz), str(seconds))
    processes = Processes([hub], [load], [])
    try:
        return _measure(1, "plain hub, TCP", station, processes, rate_hz * seconds)
    finally:
        end_all(processes, station)


def end(process: "subprocess.Popen[str]") -> None:
    """End a process."""
    process.kill()
    process.communicate()


def end_all(processes: Processes, station: Station) -> None:
    """End all processes of a run."""
    for each in (*processes.watched, *processes.loads):
        end(each)
    station.sock.close()


def _measure(
    sites: int, way: str, station: Station, processes: Processes, expected: float
) -> FleetRun:
    limit = time.monotonic() + START_S
    while not station.got:
        station.read(0.1)
        if time.monotonic() > limit:
            raise RuntimeError("nothing comes")
    watched = processes.watched
    begin_ns, before = time.monotonic_ns(), [cpu_ns(process.pid) for process in watched]
    while station.read(0.2) or len(station.got) < expected * MOST:
        if all(load.poll() is not None for load in processes.loads):
            break
    elapsed_ns = time.monotonic_ns() - begin_ns
    used = [cpu_ns(p.pid) - was for p, was in zip(watched, before, strict=True)]
    while station.read(0.3):
        pass
    sent = round(expected)
    late_us = [(ns // 1000 - sent_us) % (1 << 32) for sent_us, ns in station.got]
    missed, shed = np.sum([(0, 0), *map(lost_in, processes.sockets)], axis=0).tolist()
    shares = [100 * ns / elapsed_ns for ns in used]
    memory = [resident_kib(process.pid) for process in watched]
    if not processes.sockets:
        shares, memory = [0.0, *shares], [0, *memory]
    return FleetRun(
        sites=sites,
        way=way,
        sent=sent,
        lost=sent - len(station.got),
        lost_before=missed,
        shed=shed,
        p50_us=float(np.percentile(late_us, 50)),
        p99_us=float(np.percentile(late_us, 99)),
        router_cpu_percent=shares[0],
        fleet_cpu_percent=max(shares[1:]),
        router_kib=memory[0],
        fleet_kib=max(memory[1:]),
    )


def lost_in(path: Path) -> tuple[int, int]:
    """Return a fleet's count of lost frames, and of those that it could not process in time."""
    status = request(path, "fleet.status")
    lost = [vehicle["lost"] for site in status["sites"] for vehicle in site["vehicles"]]
    return sum(lost), status["overflowed"]


def show(runs: list[FleetRun], rate_hz: int) -> None:
    """Print the figures."""
    table = Table(title=f"Sites at {rate_hz} messages/s each, loopback", box=box.SIMPLE_HEAD)
    for column in (
        "sites", "way", "sent", "lost", "before", "shed", "p50 µs", "p99 µs", "router CPU %",
        "fleet CPU %",
        "router MiB", "fleet MiB",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for each in runs:
        table.add_row(
            str(each.sites),
            each.way,
            f"{each.sent:,}",
            str(each.lost),
            str(each.lost_before),
            str(each.shed),
            f"{each.p50_us:,.0f}",
            f"{each.p99_us:,.0f}",
            f"{each.router_cpu_percent:.1f}",
            f"{each.fleet_cpu_percent:.1f}",
            f"{each.router_kib / 1024:.0f}",
            f"{each.fleet_kib / 1024:.0f}",
        )
    Console(width=120).print(table)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--sites", type=int, nargs="+", default=SITES)
    parser.add_argument("--unsubscribed", type=int, default=0)
    parser.add_argument("--plain", action="store_true", help="one site over TCP before")
    parser.add_argument("--fleets", type=int, default=1)
    parser.add_argument("--rate", type=int, default=RATE_HZ, help="messages/s of each site")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of each run")
    options = parser.parse_args()
    runs = [run_plain(options.rate, options.seconds)] if options.plain else []
    runs += [
        run(sites, options.unsubscribed, options.fleets, options.rate, options.seconds)
        for sites in options.sites
    ]
    show(runs, options.rate)
    if options.json:
        report = {"load": os.getloadavg(), "runs": [asdict(each) for each in runs]}
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
