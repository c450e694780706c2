"""Measure a fleet: many simulated sites, one router, one `mavgate fleet`, one ground station.

For each number of sites: frames lost, latency from the load generator's clock before it publishes
to this process's clock when the ground station reads (p50 and p99), CPU of router and fleet in per
cent of a core, their memory. The sites are load generators, several in each of a few processes:
they publish ATTITUDE frames that carry the time; no gateway runs behind them. What the plain hub
does for one source is measured by bench_hub.py.

`--unsubscribed N` adds sites whose names no pattern matches: what they publish must cost the fleet
nothing. `--fleets 2` splits the sites between two fleets on one router.
"""

import argparse
import json
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.wire.mavlink_splitter import message_id_of, origin_of, split_datagram
from tools.bench_hub import cpu_ns, resident_kib, udp_socket

SITES = (1, 10, 50, 200)
RATE_HZ = 60
GENERATORS = 2
START_S = 60.0
SETTLE_S = 3.0
ATTITUDE = 30

ROUTER = """
import json, sys, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
print("open", flush=True)
sys.stdin.read()
"""

GENERATOR = """
import json, sys, time, zenoh
from pymavlink.dialects.v20 import common as mavlink
place, names = sys.argv[1], sys.argv[2].split(",")
rate, seconds = int(sys.argv[3]), float(sys.argv[4])
config = zenoh.Config()
config.insert_json5("mode", '"client"')
config.insert_json5("connect/endpoints", json.dumps([place]))
config.insert_json5("scouting/multicast/enabled", "false")
session = zenoh.open(config)
drop = zenoh.CongestionControl.DROP
sites = []
for name in names:
    link = mavlink.MAVLink(None, 1, 1)
    key = f"mavlink/{name}/1/out"
    outlet = session.declare_publisher(key, congestion_control=drop, express=True)
    token = session.liveliness().declare_token(f"mavlink/{name}/site/{session.zid()}")
    sites.append((link, outlet, token))
def publish(link, outlet, message):
    outlet.put(bytes(message.pack(link)))
    link.seq = (link.seq + 1) % 256
for link, outlet, _ in sites:
    publish(link, outlet, mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3))
time.sleep(2)
begin = time.monotonic()
count = round(rate * seconds)
for number in range(count * len(sites)):
    due = begin + number / (rate * len(sites))
    if (wait := due - time.monotonic()) > 0:
        time.sleep(wait)
    link, outlet, _ = sites[number % len(sites)]
    now = time.time_ns() // 1000 % (1 << 32)
    publish(link, outlet, mavlink.MAVLink_attitude_message(now, 0, 0, 0, 0, 0, 1))
print(count * len(sites), flush=True)
time.sleep(2)
"""


@dataclass(frozen=True)
class FleetRun:
    """One run."""

    sites: int
    sent: int
    lost: int
    p50_us: float
    p99_us: float
    router_cpu_percent: float
    fleet_cpu_percent: float
    router_kib: int
    fleet_kib: int


class GroundStation:
    """Reads frames and notes how late they are."""

    def __init__(self) -> None:
        self._sock = udp_socket()
        self.port: int = self._sock.getsockname()[1]
        self.late_us: list[int] = []
        self.systems: set[int] = set()

    def read(self, wait_s: float) -> bool:
        """Take what comes within some time; return whether anything came."""
        if not select.select([self._sock], [], [], wait_s)[0]:
            return False
        now_us = time.time_ns() // 1000
        try:
            while True:
                for frame in split_datagram(self._sock.recv(2048)):
                    if isinstance(frame, bytes) and message_id_of(frame) == ATTITUDE:
                        sent_us = int.from_bytes(frame[10:14], "little")
                        self.late_us.append((now_us - sent_us) % (1 << 32))
                        self.systems.add(origin_of(frame)[0])
        except BlockingIOError:
            return True

    def close(self) -> None:
        """Close the socket."""
        self._sock.close()


def free_place() -> str:
    """Find a place for a router."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{free.getsockname()[1]}"


def start(*words: str, home: Path | None = None) -> "subprocess.Popen[str]":
    """Start a Python process whose lines can be read."""
    env = os.environ | ({"HOME": str(home), "XDG_RUNTIME_DIR": str(home)} if home else {})
    return subprocess.Popen(
        [sys.executable, *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=env,
    )


def wait_for(file: Path) -> None:
    """Wait until a fleet can be asked."""
    limit = time.monotonic() + START_S
    while not file.exists():
        if time.monotonic() > limit:
            raise RuntimeError(f"no fleet: there is no {file}")
        time.sleep(0.1)


def generators(
    place: str, names: list[str], rate_hz: int, seconds: float
) -> list["subprocess.Popen[str]"]:
    """Start the load, the sites shared out to a few processes."""
    shares = [names[n::GENERATORS] for n in range(min(GENERATORS, len(names)))]
    return [
        start("-c", GENERATOR, place, ",".join(share), str(rate_hz), str(seconds))
        for share in shares
    ]


def run(sites: int, unsubscribed: int, fleets: int, rate_hz: int, seconds: float) -> FleetRun:
    """Measure one number of sites."""
    place, station = free_place(), GroundStation()
    with tempfile.TemporaryDirectory() as folder:
        router = start("-c", ROUTER, place)
        assert router.stdout is not None
        router.stdout.readline()
        started = [router]
        for number in range(fleets):
            home = Path(folder) / str(number)
            home.mkdir()
            end = f"udp:127.0.0.1:{station.port}"
            words = ("fleet", "--connect", place, "--site", f"{number}-*", "--endpoint", end)
            started.append(start("-m", "gateway.cli", *words, home=home))
            wait_for(home / "mavgate" / "fleet.sock")
        watched = list(started)
        time.sleep(SETTLE_S)
        names = [f"{number % fleets}-{number}" for number in range(sites)]
        others = [f"other-{number}" for number in range(unsubscribed)]
        started += generators(place, names + others, rate_hz, seconds)
        try:
            return _measure(sites, station, watched, started[1 + fleets :], rate_hz * seconds)
        finally:
            for each in started:
                each.kill()
                each.communicate()
            station.close()


def _measure(
    sites: int,
    station: GroundStation,
    watched: list["subprocess.Popen[str]"],
    loads: list["subprocess.Popen[str]"],
    each: float,
) -> FleetRun:
    limit = time.monotonic() + START_S
    while not station.late_us:
        station.read(0.1)
        if time.monotonic() > limit:
            raise RuntimeError("nothing comes from the fleet")
    begin_ns, before = time.monotonic_ns(), [cpu_ns(process.pid) for process in watched]
    while any(load.poll() is None for load in loads):
        moved = station.read(0.2)
        if not moved and all(load.poll() is not None for load in loads):
            break
        if not moved and len(station.late_us) >= sites * each:
            break
    elapsed_ns = time.monotonic_ns() - begin_ns
    used = [cpu_ns(p.pid) - was for p, was in zip(watched, before, strict=True)]
    while station.read(0.3):
        pass
    sent = round(sites * each)
    return FleetRun(
        sites=sites,
        sent=sent,
        lost=sent - len(station.late_us),
        p50_us=float(np.percentile(station.late_us, 50)),
        p99_us=float(np.percentile(station.late_us, 99)),
        router_cpu_percent=100 * used[0] / elapsed_ns,
        fleet_cpu_percent=100 * max(used[1:]) / elapsed_ns,
        router_kib=resident_kib(watched[0].pid),
        fleet_kib=max(resident_kib(process.pid) for process in watched[1:]),
    )


def show(runs: list[FleetRun], rate_hz: int) -> None:
    """Print the figures."""
    table = Table(title=f"Sites at {rate_hz} messages/s each, loopback", box=box.SIMPLE_HEAD)
    for column in (
        "sites", "sent", "lost", "p50 µs", "p99 µs", "router CPU %", "fleet CPU %",
        "router MiB", "fleet MiB",
    ):  # fmt: skip
        table.add_column(column, justify="right")
    for each in runs:
        table.add_row(
            str(each.sites),
            f"{each.sent:,}",
            str(each.lost),
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
    parser.add_argument("--fleets", type=int, default=1)
    parser.add_argument("--rate", type=int, default=RATE_HZ, help="messages/s of each site")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each run")
    options = parser.parse_args()
    runs = [
        run(sites, options.unsubscribed, options.fleets, options.rate, options.seconds)
        for sites in options.sites
    ]
    show(runs, options.rate)
    if options.json:
        report = {"load": os.getloadavg(), "runs": [asdict(each) for each in runs]}
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
