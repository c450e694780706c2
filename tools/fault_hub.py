"""Measure the effect of a faulty client of the hub on the others.

Four healthy clients of the hub are sent 500 messages a second while a fifth one has a fault, or
untrusted clients send forged frames, too many requests, or open too many connections
(`fault_traffic.py`). For each fault, runs with and without it take turns; the healthy clients must
lose no frame and have no gap above 100 ms, and their p99 latency must be within twice the
undisturbed one. The source of the fault takes processor time too, which on two cores affects the
result.

As root, and if network namespaces are allowed, everything runs in a separate network with a virtual
Ethernet cable that can be disconnected; otherwise that fault is omitted.
"""

import argparse
import json
import math
import os
import shutil
import signal
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path

from rich import box
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from tests.ports import free_ports
from tools.bench_hub import HANDSHAKE, Bench, Latency, source_frames

HEALTHY = 4
RATE_HZ = 500
LIMIT = 2.0
"""Maximum p99 latency, in multiples of the undisturbed one."""
GAP_LIMIT_US = 100_000
UNTRUSTED_CLIENTS = {
    "untrusted clients forge heartbeats and copies": "forge",
    "an untrusted client asks for answers to all, 400/s": "to-all",
    "31 untrusted clients ask 4000 times a second": "ports",
    "31 trusted clients ask 4000 times a second": "trusted-ports",
    "31 untrusted clients request all parameters, 400/s": "lists",
    "16 untrusted clients have files sent byte by byte": "bursts",
    "one machine crowds a port": "crowd",
    "two stations with one id ask the same": "twins",
}
"""Faults that are kinds of `fault_traffic.py`."""
TRAFFIC = Path(__file__).with_name("fault_traffic.py")
PART_S = 4.0
"""Pause after a fault: a dead client is removed after three seconds."""
NEAR, FAR, FAR_PLACE, FAR_ADDRESS = "near0", "far0", "10.99.0.2", "02:00:00:00:00:02"

HUB = """
import asyncio, signal, sys
import msgspec
from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.records import ClientInterval, Outgoing
from gateway.hub.settings import HubSettings
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings

async def main():
    port, tcp_port, web_port, closed_port, far, *clients = sys.argv[1:]
    endpoints = (f"udp-listen:127.0.0.1:{port}", f"tcp-listen:127.0.0.1:{tcp_port}",
                 f"udp-listen:127.0.0.2:{port}?trusted=no",
                 f"udp-listen:127.0.0.3:{port}?trusted=yes",
                 f"ws-listen:127.0.0.1:{web_port}",
                 *(f"udp:127.0.0.1:{client}" for client in clients),
                 *([f"udp:{far}:14550"] if far else []))
    calm = HubSettings(endpoints=endpoints)
    refused = msgspec.structs.replace(calm, endpoints=(*endpoints, f"udp:127.0.0.1:{closed_port}"))
    clock, vehicle = GatewayClock(), Vehicle(VehicleSettings(), 1)
    def perform(actions):
        for action in actions:
            if isinstance(action, Outgoing):
                hub.send(action)
            elif isinstance(action, ClientInterval):
                hub.set_interval(action)
    hub = Hub(calm, lambda incoming: perform(vehicle.handle(incoming, clock())), clock,
              on_gone=vehicle.remove_client)
    hub.start()
    loop = asyncio.get_running_loop()
    def poll():
        perform(vehicle.poll(clock()))
        loop.call_later(0.01, poll)
    poll()
    loop.add_signal_handler(signal.SIGHUP, lambda: hub.apply(
        refused if hub.settings is calm else calm))
    await asyncio.Event().wait()

asyncio.run(main())
"""

SPEAK = """
import socket, sys, time
from pymavlink.dialects.v20 import common as mavlink
port, what = int(sys.argv[1]), sys.argv[2]
target = ("127.0.0.1", port)
def beat(system):
    link = mavlink.MAVLink(None, system, 190)
    return bytes(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3).pack(link))
if what == "die":
    while True:
        for _ in range(4):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
                client.sendto(beat(200), target)
                time.sleep(0.05)
elif what == "visit":
    beats = [beat(system) for system in range(1, 201)]
    begin = time.monotonic()
    for visit in range(1 << 30):
        time.sleep(max(0.0, begin + visit / 1000 - time.monotonic()))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.sendto(beats[visit % 200], target)
else:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.sendto(beat(200), target)
    while True:
        for data in (b"", b"\\xfe" * 65507, b"\\xfd" * 65507, bytes(65507)):
            client.sendto(data, target)
        time.sleep(0.02)
"""

PULL = """
import subprocess, sys, time
near, place, address = sys.argv[1:]
while True:
    for words in (f"link set {near} down", f"link set {near} up",
                  f"neigh replace {place} lladdr {address} dev {near}"):
        subprocess.run(["ip", *words.split()], check=True)
        if not words.endswith("up"):
            time.sleep(0.5)
"""


class FaultBench(Bench):
    """The hub with a TCP and a WebSocket port, and faults of its clients."""

    def __init__(self, *, cable: bool) -> None:
        self._far = FAR_PLACE if cable else ""
        self.tcp_port, self.web_port, self._closed_port = free_ports(3)
        super().__init__(self._command, HEALTHY, source_frames())

    def _command(self, port: int, clients: list[int]) -> list[str]:
        ports = (port, self.tcp_port, self.web_port, self._closed_port, self._far, *clients)
        return [sys.executable, "-c", HUB, *map(str, ports)]

    @contextmanager
    def refused(self) -> Iterator[None]:
        """Configure one more client, whose port is closed."""
        self.process.send_signal(signal.SIGHUP)
        time.sleep(0.2)
        yield
        self.process.send_signal(signal.SIGHUP)

    @contextmanager
    def reloaded(self) -> Iterator[None]:
        """Reload the settings five times a second."""
        code = "import os,sys,time\nwhile True: os.kill(int(sys.argv[1]), 1); time.sleep(0.2)"
        with process(code, self.process.pid):
            yield

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Stop a TCP client with its connection open."""
        code = (
            "import socket,sys\nlink = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\n"
            "while link.recv(4096): pass"
        )
        with process(code, self.tcp_port) as client:
            time.sleep(0.3)
            os.kill(client.pid, signal.SIGSTOP)
            yield

    @contextmanager
    def stalled(self) -> Iterator[None]:
        """Stop a page with its WebSocket open."""
        code = (
            "import socket,sys\nlink = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\n"
            f"link.sendall({HANDSHAKE!r})\nwhile link.recv(4096): pass"
        )
        with process(code, self.web_port) as browser:
            time.sleep(0.3)
            os.kill(browser.pid, signal.SIGSTOP)
            yield

    @contextmanager
    def visited(self) -> Iterator[None]:
        """Let a thousand clients a second send one frame and leave."""
        with process(SPEAK, self.port, "visit"):
            yield
        time.sleep(PART_S)

    @contextmanager
    def joined(self) -> Iterator[None]:
        """Connect another gateway by two links."""
        code = (
            "import asyncio,sys\nfrom gateway.clock import GatewayClock\n"
            "from gateway.hub.hub import Hub\n"
            "from gateway.hub.settings import HubSettings\n"
            "async def main():\n"
            "    cables = tuple(f'udp:127.0.0.{n}:{sys.argv[1]}' for n in (1, 3))\n"
            "    Hub(HubSettings(endpoints=cables), lambda _: None, GatewayClock()).start()\n"
            "    await asyncio.Event().wait()\nasyncio.run(main())"
        )
        with process(code, self.port):
            time.sleep(1.0)
            yield

    @contextmanager
    def troubled(self, kind: str) -> Iterator[None]:
        """Run one kind of hostile traffic."""
        with process(TRAFFIC, self.port, kind):
            time.sleep(1.0)
            yield

    def spoken(self, what: str) -> Callable[[], AbstractContextManager[object]]:
        """Return a context in which a client sends abnormal data to the listening port."""
        return lambda: process(SPEAK, self.port, what)


@contextmanager
def pulled() -> Iterator[None]:
    """Disconnect and connect the cable to one more client every second."""
    with process(PULL, NEAR, FAR_PLACE, FAR_ADDRESS):
        yield


def lay_cable() -> bool:
    """Create a cable in a separate network; return whether that succeeded."""
    ip("link", "set", "lo", "up")
    try:
        ip("link", "add", NEAR, "type", "veth", "peer", FAR, "address", FAR_ADDRESS)
    except subprocess.CalledProcessError:
        return False
    ip("addr", "add", "10.99.0.1/24", "dev", NEAR)
    for end in (NEAR, FAR):
        ip("link", "set", end, "up")
    return True


def ip(*words: str) -> None:
    """Run the command `ip`."""
    subprocess.run(["ip", *words], check=True)


@contextmanager
def process(program: str | Path, *arguments: object) -> Iterator["subprocess.Popen[bytes]"]:
    """Run Python code, or the code of a file, as a child process that must not end by itself."""
    code = (program,) if isinstance(program, Path) else ("-c", program)
    child = subprocess.Popen([sys.executable, *code, *map(str, arguments)])
    try:
        time.sleep(0.3)
        yield child
        if child.poll() is not None:
            raise SystemExit(f"{child.args!r} ended")
    finally:
        child.kill()
        child.wait()


def main() -> None:
    """Run all faults."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each single run")
    parser.add_argument("--only", metavar="WORD", help="faults whose name has this word")
    parser.add_argument("--own-network", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not options.own_network and os.geteuid() == 0 and all(map(shutil.which, ("unshare", "ip"))):
        own = ["unshare", "--net", sys.executable, *sys.argv, "--own-network"]
        if subprocess.run([*own[:2], "true"], check=False).returncode == 0:
            os.execvp(own[0], own)
    cable = options.own_network and lay_cable()
    bench = FaultBench(cable=cable)
    faults: dict[str, Callable[[], AbstractContextManager[object]]] = {
        "client killed, again and again": bench.spoken("die"),
        "client stopped, TCP open": bench.stopped,
        "browser stalled, WebSocket open": bench.stalled,
        "port refused": bench.refused,
        "1000 clients a second come and go": bench.visited,
        "datagrams of 0 and 65507 bytes": bench.spoken("odd"),
        "settings reloaded 5 times a second": bench.reloaded,
    }
    for name, kind in UNTRUSTED_CLIENTS.items():
        faults[name] = partial(bench.troubled, kind)
    faults["joined twice to another gateway"] = bench.joined
    if cable:
        faults["interface down and up"] = pulled
    faults = {name: fault for name, fault in faults.items() if (options.only or "") in name}
    table = Table(title=f"{HEALTHY} healthy clients at {RATE_HZ} messages/s", box=box.SIMPLE_HEAD)
    for column in (
        "fault", "lost", "p99 µs quiet", "p99 µs", "ratio", "gap ms quiet", "gap ms", "holds"
    ):  # fmt: skip
        table.add_column(column, justify="right")
    figures: dict[str, dict[str, float]] = {}
    try:
        for name, fault in faults.items():
            calm: list[Latency] = []
            troubled: list[Latency] = []
            for _ in range(options.rounds):
                for trouble, results in ((nullcontext, calm), (fault, troubled)):
                    with trouble():
                        results.append(bench.latency(options.seconds, RATE_HZ))
            before = statistics.median(result.p99_us for result in calm)
            after = statistics.median(result.p99_us for result in troubled)
            lost = sum(result.lost for result in troubled)
            gaps = [max(result.gap_us for result in results) for results in (calm, troubled)]
            figures[name] = {
                "lost": lost,
                "p99_calm_us": before,
                "p99_us": after,
                "gap_calm_us": gaps[0],
                "gap_us": gaps[1],
            }
            good = lost == 0 and after <= LIMIT * before and gaps[1] <= GAP_LIMIT_US
            # An undisturbed run that lost frames, on a busy machine, has no latency.
            ratio = after / before if before else math.nan
            row = [f"{before:.0f}", f"{after:.0f}", f"{ratio:.2f}"]
            row += [*(f"{gap / 1000:.1f}" for gap in gaps), "yes" if good else "no"]
            table.add_row(name, str(lost), *row)
    finally:
        bench.close()
    Console(width=120).print(table)
    if options.json:
        report = {"load": os.getloadavg(), "faults": figures}
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
