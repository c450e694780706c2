"""Measure the effect of a faulty client of the hub on the others.

Four healthy clients of the hub are sent 500 messages a second while a fifth one has a fault, or
untrusted clients send forged frames, too many requests, or open too many connections
(`fault_traffic.py`). For each fault, runs with and without it take turns; the healthy clients must
lose no frame and have no gap above 100 ms, and their p99 latency must be within twice the
undisturbed one. The source of the fault takes processor time too, which on two cores affects the
result.
"""

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial

import msgspec

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.records import ClientInterval, Outgoing
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.ports import free_ports
from tools.bench_hub import Bench, source_frames
from tools.fault_traffic import TRUSTED, UNTRUSTED
from tools.harness import PYTHON, Figures, arguments, medians, running, show, write_json

HEALTHY = 4
RATE_HZ = 500
LIMIT = 2.0
"""Maximum p99 latency, in multiples of the undisturbed one."""
GAP_LIMIT_US = 100_000
TRAFFIC = {
    "a client is killed, again and again": "die",
    "1000 clients a second come and go": "visit",
    "datagrams of 0 and 65507 bytes": "odd",
    "untrusted clients forge heartbeats and copies": "forge",
    "an untrusted client asks for answers to all, 400/s": "to-all",
    "31 untrusted clients ask 4000 times a second": "ports",
    "31 trusted clients ask 4000 times a second": "trusted-ports",
    "31 untrusted clients request all parameters, 400/s": "lists",
    "16 untrusted clients have files sent byte by byte": "bursts",
    "one machine crowds a port": "crowd",
    "two stations with one id ask the same": "twins",
    "another gateway is joined twice": "join",
}
"""Faults that are kinds of `fault_traffic.py`."""
SETTLE_S = 4.0
"""Pause after a fault: a dead client is removed after three seconds."""
RELOAD_S = 0.2
Fault = Callable[[], AbstractContextManager[object]]


async def serve(port: int, tcp_port: int, web_port: int, closed_port: int, *clients: int) -> None:
    """Run the measured hub, with a vehicle; SIGHUP adds or removes a client with a closed port."""
    calm = HubSettings(
        endpoints=(
            *(f"udp-listen:{TRUSTED}:{port}", f"tcp-listen:{TRUSTED}:{tcp_port}"),
            f"udp-listen:{UNTRUSTED}:{port}?trusted=no",
            f"udp-listen:127.0.0.3:{port}?trusted=yes",
            f"ws-listen:{TRUSTED}:{web_port}",
            *(f"udp:127.0.0.1:{client}" for client in clients),
        )
    )
    refused = msgspec.structs.replace(
        calm, endpoints=(*calm.endpoints, f"udp:127.0.0.1:{closed_port}")
    )
    clock, vehicle = GatewayClock(), Vehicle(VehicleSettings(), 1)

    def perform(actions: Iterable[object]) -> None:
        for action in actions:
            if isinstance(action, Outgoing):
                hub.send(action)
            elif isinstance(action, ClientInterval):
                hub.set_interval(action)

    hub = Hub(
        calm,
        lambda incoming: perform(vehicle.handle(incoming, clock())),
        clock,
        on_gone=vehicle.remove_client,
    )
    hub.start()
    asyncio.get_running_loop().add_signal_handler(
        signal.SIGHUP, lambda: hub.apply(refused if hub.settings is calm else calm)
    )
    while True:
        perform(vehicle.poll(clock()))
        await asyncio.sleep(0.01)


class FaultBench(Bench):
    """The hub with a TCP and a WebSocket port, and faults of its clients."""

    def __init__(self) -> None:
        self._others = free_ports(3)
        super().__init__(self._command, HEALTHY, source_frames())

    def _command(self, port: int, clients: list[int]) -> list[str]:
        ports = (port, *self._others, *clients)
        return [PYTHON, "-m", "tools.fault_hub", "--serve", *map(str, ports)]

    def faults(self) -> dict[str, Fault]:
        """Return the faults by name."""
        tcp_port, web_port, _ = self._others
        return {
            "a client stops, TCP open": partial(self.stopped, tcp_port, "read"),
            "a browser stalls, WebSocket open": partial(self.stopped, web_port, "read-web"),
            "a port is refused": self.refused,
            "settings are reloaded 5 times a second": self.reloaded,
            **{name: partial(self.traffic, self.port, kind) for name, kind in TRAFFIC.items()},
        }

    @contextmanager
    def refused(self) -> Iterator[None]:
        """Add a client whose port is closed."""
        self.process.send_signal(signal.SIGHUP)
        time.sleep(RELOAD_S)
        yield
        self.process.send_signal(signal.SIGHUP)

    @contextmanager
    def reloaded(self) -> Iterator[None]:
        """Add and remove that client repeatedly."""
        ended = threading.Event()

        def reload() -> None:
            while not ended.is_set():
                for _ in ("add", "remove"):
                    self.process.send_signal(signal.SIGHUP)
                    time.sleep(RELOAD_S)

        thread = threading.Thread(target=reload)
        thread.start()
        yield
        ended.set()
        thread.join()

    @contextmanager
    def stopped(self, port: int, kind: str) -> Iterator[None]:
        """Stop a reading client with its connection open."""
        with self.traffic(port, kind) as client:
            os.kill(client.pid, signal.SIGSTOP)
            yield
            os.kill(client.pid, signal.SIGCONT)

    @contextmanager
    def traffic(self, port: int, kind: str) -> Iterator["subprocess.Popen[bytes]"]:
        """Run one kind of hostile traffic."""
        with running(PYTHON, "-m", "tools.fault_traffic", str(port), kind, stderr=None) as source:
            time.sleep(1.0)
            yield source
            if source.poll() is not None:
                raise SystemExit(f"{source.args!r} ended")
        if kind == "visit":
            time.sleep(SETTLE_S)


def measure(bench: FaultBench, fault: Fault, rounds: int, seconds: float) -> Figures:
    """Measure runs without and with a fault in turn."""
    calm: list[Figures] = []
    disturbed: list[Figures] = []
    for _ in range(rounds):
        for trouble, results in ((nullcontext, calm), (fault, disturbed)):
            with trouble():
                results.append(bench.latency(seconds, RATE_HZ))
    before, after = (medians(results, maxima=["gap_us"]) for results in (calm, disturbed))
    return after | {"p99_calm_us": before["p99_us"], "gap_calm_us": before["gap_us"]}


def holds(found: Figures) -> bool:
    """Return whether the healthy clients were not affected."""
    latency_holds = found["p99_us"] <= LIMIT * found["p99_calm_us"]
    return not found["lost"] and latency_holds and found["gap_us"] <= GAP_LIMIT_US


def main() -> None:
    """Run all faults."""
    parser = arguments(__doc__, rounds=3, seconds=2.0)
    parser.add_argument("--only", metavar="WORD", default="", help="faults with this word")
    options = parser.parse_args()
    with FaultBench() as bench:
        found = {
            name: measure(bench, fault, options.rounds, options.seconds)
            for name, fault in bench.faults().items()
            if options.only in name
        }
    keys = ("lost", "p99_calm_us", "p99_us", "gap_calm_us", "gap_us")
    show(
        f"{HEALTHY} healthy clients at {RATE_HZ} messages/s",
        ("fault", "lost", "p99 µs quiet", "p99 µs", "gap µs quiet", "gap µs", "holds"),
        [
            (name, *(row[key] for key in keys), "yes" if holds(row) else "no")
            for name, row in found.items()
        ],
    )
    write_json(options, found)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--serve"]:
        asyncio.run(serve(*map(int, sys.argv[2:])))
    else:
        main()
