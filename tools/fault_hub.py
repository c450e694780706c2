"""Measure what trouble with one client costs the others.

Four healthy clients of the hub are sent 500 messages a second while something happens to a fifth.
For each fault, runs with and without it take turns; the healthy clients' loss must be zero and
their p99 latency stays near the undisturbed one. What makes the trouble takes processor time of its
own, which on two cores is part of what is measured.
"""

import argparse
import json
import os
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

from bench_hub import Bench, Latency, source_frames
from rich import box
from rich.console import Console
from rich.table import Table

HEALTHY = 4
RATE_HZ = 500

HUB = """
import asyncio, signal, sys
import msgspec
from gateway.edges.clock import GatewayClock
from gateway.edges.hub import Hub
from gateway.routing.settings import HubSettings

async def main():
    port, tcp_port, closed_port, *clients = sys.argv[1:]
    endpoints = (f"udp-listen:127.0.0.1:{port}", f"tcp-listen:127.0.0.1:{tcp_port}",
                 *(f"udp:127.0.0.1:{client}" for client in clients))
    calm = HubSettings(endpoints=endpoints)
    refused = msgspec.structs.replace(calm, endpoints=(*endpoints, f"udp:127.0.0.1:{closed_port}"))
    hub = Hub(calm, lambda incoming: None, GatewayClock())
    hub.start()
    loop = asyncio.get_running_loop()
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
    while True:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.sendto(beat(1 + int(time.time() * 1000) % 200), target)
        time.sleep(0.002)
else:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.sendto(beat(200), target)
    while True:
        for data in (b"", b"\\xfe" * 65507, b"\\xfd" * 65507, bytes(65507)):
            client.sendto(data, target)
        time.sleep(0.02)
"""


class FaultBench(Bench):
    """The hub with a TCP port too, and ways to trouble it."""

    def __init__(self) -> None:
        with socket.socket() as probe, socket.socket(type=socket.SOCK_DGRAM) as closed:
            probe.bind(("127.0.0.1", 0))
            closed.bind(("127.0.0.1", 0))
            self.tcp_port: int = probe.getsockname()[1]
            self._closed_port: int = closed.getsockname()[1]
        super().__init__(self._command, HEALTHY, source_frames())

    def _command(self, port: int, clients: list[int]) -> list[str]:
        ports = (port, self.tcp_port, self._closed_port, *clients)
        return [sys.executable, "-c", HUB, *map(str, ports)]

    @contextmanager
    def refused(self) -> Iterator[None]:
        """Have one more client configured whose port is closed."""
        self.process.send_signal(signal.SIGHUP)
        time.sleep(0.2)
        yield
        self.process.send_signal(signal.SIGHUP)

    @contextmanager
    def reloaded(self) -> Iterator[None]:
        """Have the settings reloaded five times a second."""
        code = "import os,sys,time\nwhile True: os.kill(int(sys.argv[1]), 1); time.sleep(0.2)"
        with process(code, self.process.pid):
            yield

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Have a TCP client stopped with its connection open."""
        code = (
            "import socket,sys\nlink = socket.create_connection(('127.0.0.1', int(sys.argv[1])))\n"
            "while link.recv(4096): pass"
        )
        with process(code, self.tcp_port) as client:
            time.sleep(0.3)
            os.kill(client.pid, signal.SIGSTOP)
            yield

    def spoken(self, what: str) -> Callable[[], AbstractContextManager[object]]:
        """Have a client speak to the listening port in some odd way."""
        return lambda: process(SPEAK, self.port, what)


@contextmanager
def process(code: str, *arguments: object) -> Iterator["subprocess.Popen[bytes]"]:
    """Run a piece of Python beside us."""
    child = subprocess.Popen([sys.executable, "-c", code, *map(str, arguments)])
    try:
        time.sleep(0.3)
        yield child
    finally:
        child.kill()
        child.wait()


def main() -> None:
    """Run all faults."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=2.0, help="of each single run")
    options = parser.parse_args()
    bench = FaultBench()
    faults: dict[str, Callable[[], AbstractContextManager[object]]] = {
        "client killed, again and again": bench.spoken("die"),
        "client stopped, TCP open": bench.stopped,
        "port refused": bench.refused,
        "500 clients a second come and go": bench.spoken("visit"),
        "datagrams of 0 and 65507 bytes": bench.spoken("odd"),
        "settings reloaded 5 times a second": bench.reloaded,
    }
    table = Table(title=f"{HEALTHY} healthy clients at {RATE_HZ} messages/s", box=box.SIMPLE_HEAD)
    for column in ("fault", "lost", "p99 µs undisturbed", "p99 µs", "ratio"):
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
            lost = sum(result.lost for result in calm + troubled)
            figures[name] = {"lost": lost, "p99_calm_us": before, "p99_us": after}
            table.add_row(name, str(lost), f"{before:.0f}", f"{after:.0f}", f"{after / before:.2f}")
    finally:
        bench.close()
    Console(width=120).print(table)
    if options.json:
        report = {"load": os.getloadavg(), "faults": figures}
        options.json.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
