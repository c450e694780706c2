"""Measure the delay of the hub's loop by a flood of foreign frames, and its throughput.

    python tools/bench_flood.py --clients 4 16 64

A vehicle's link sends as fast as the hub reads, by UDP or by TCP, and each frame goes to N clients.
Printed are frames delivered a second, their processor time, and the longest turn of the hub's loop,
during which no other data is sent. The baseline, which alternates with it, is the same hub reading
up to 4 KiB at one wake-up for any number of clients.
"""

import argparse
import asyncio
import itertools
import socket
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.transports.base import READ_BYTES
from tools.bench_hub import source_frames, udp_socket
from tools.turns import TurnWatch

BATCH = 64
"""Datagrams sent between two pauses, so that the hub gets a processor."""
REST_S = 0.0002


class GreedyHub(Hub):
    """The baseline."""

    read_bytes = READ_BYTES


def flood(kind: str, port: int) -> None:
    """Send until killed."""
    frames = source_frames()
    if kind == "tcp":
        with socket.create_connection(("127.0.0.1", port)) as link:
            while True:
                link.sendall(b"".join(frames))
    with socket.socket(type=socket.SOCK_DGRAM) as link:
        link.connect(("127.0.0.1", port))
        for number, frame in enumerate(itertools.cycle(frames)):
            link.send(frame)
            if number % BATCH == 0:
                time.sleep(REST_S)


async def forward(
    make: type[Hub], kind: str, clients: int, watch: TurnWatch, seconds: float
) -> tuple[float, float]:
    """Forward the flood; return frames delivered a second and processor time per frame."""
    sinks = [udp_socket() for _ in range(clients)]
    taking = [f"udp:127.0.0.1:{sink.getsockname()[1]}" for sink in sinks]
    endpoints = (f"{kind}-listen:127.0.0.1:0", *taking)
    hub = make(HubSettings(endpoints=endpoints, max_clients=500), lambda _: None, GatewayClock())
    hub.start()
    (port,) = hub.listening_ports()
    command = [sys.executable, __file__, "--send", kind, str(port)]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as source:
        while hub.counters().forwarded < BATCH:
            await asyncio.sleep(0.01)
        watch.restart()
        before, used_s = hub.counters().forwarded, time.process_time()
        await asyncio.sleep(seconds)
        watch.stop()
        used_s = time.process_time() - used_s
        delivered = clients * (hub.counters().forwarded - before)
        source.kill()
    hub.close()
    for sink in sinks:
        sink.close()
    return delivered / seconds, used_s / delivered


def measure(make: type[Hub], kind: str, clients: int, seconds: float) -> str:
    """Run one hub; return its figures as a line."""
    watch = TurnWatch()
    with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner:
        per_s, cost_s = runner.run(forward(make, kind, clients, watch, seconds))
    worst_ms = watch.longest().own_us / 1e3
    return f"{per_s:8,.0f}/s, {cost_s * 1e6:.2f} us each, longest turn {worst_ms:6.2f} ms"


def main() -> None:
    """Run, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--clients", type=int, nargs="+", default=[4, 16, 64])
    parser.add_argument("--seconds", type=float, default=2.0, help="of each single run")
    parser.add_argument("--send", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.send:
        flood(options.send[0], int(options.send[1]))
    for clients, kind in itertools.product(options.clients, ("udp", "tcp")):
        for name, make in (("hub", Hub), ("4 KiB at once", GreedyHub)):
            figures = measure(make, kind, clients, options.seconds)
            print(f"{kind} to {clients:3}, {name:13}: {figures}", flush=True)


if __name__ == "__main__":
    main()
