"""Measure the way from the serial byte to the datagram: latency and CPU share.

A frame with one IMU sample is written to a pseudo-terminal and the ATTITUDE_QUATERNION that it
becomes is awaited on a UDP port, at several frame rates. The baseline, measured in the same run, is
a program that reads the same line and sends a datagram of the same size for every delimiter,
without decoding, fusing or encoding anything. The greatest latency at the highest rate is the
longest pause, the machine's own included: the baseline tells those.
"""

import argparse
import contextlib
import itertools
import json
import math
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
import tty
from collections import deque
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink
from rich import box
from rich.console import Console
from rich.progress import track
from rich.table import Table

from gateway.records import ImuFlags, NodeId
from gateway.wire import payloads
from gateway.wire.framing import encode_frame

RATES_HZ = (60, 200, 1000)
QUATERNION_SIZE = 44
"""A MAVLink 2 ATTITUDE_QUATERNION frame."""
WARM_UP_S = 3.0
START_LIMIT_S = 120.0
CLOCK_TICKS = os.sysconf("SC_CLK_TCK")

BASELINE = """
import os, socket, sys
line = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY)
out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
while data := os.read(line, 4096):
    for _ in range(data.count(0)):
        out.sendto(bytes(44), ("127.0.0.1", int(sys.argv[2])))
"""

CONFIG = """
[vehicle.rates]
attitude_quaternion_hz = 1000
"""


def frames(rate_hz: int) -> Iterator[bytes]:
    """Make an endless row of IMU frames of a level node that turns slowly."""
    for seq in itertools.count():
        gyro = round(300 * math.sin(seq / 500))
        payload = payloads.ImuPayload(
            accel=(20, -15, 4096),
            gyro=(3, -2, gyro),
            mag=(200, 30, -380),
            temperature=-3900,
            flags=ImuFlags.MAG_NEW if seq % 3 == 0 else ImuFlags(0),
            accel_range=2,
            gyro_range=2,
            mag_gain=1,
        )
        node_us = round(seq * 1e6 / rate_hz) % 2**32
        header = payloads.Header(NodeId(1, 0), seq % 65536, node_us)
        packet = payloads.encode_payload(header, payload)
        yield encode_frame(payloads.encode_radio(seq % 256, 0, node_us, packet))


def cpu_seconds(pid: int) -> float:
    """Return how much CPU time a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / CLOCK_TICKS


def is_answer(datagram: bytes) -> bool:
    """Return whether a datagram is what one IMU frame becomes."""
    if len(datagram) == QUATERNION_SIZE and datagram[0] == 0:
        return True
    message_id = int.from_bytes(datagram[7:10], "little")
    return datagram[0] == 0xFD and message_id == mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION


def exchange(
    master: int, sock: socket.socket, source: Iterator[bytes], rate_hz: int, seconds: float
) -> list[float]:
    """Send frames at a rate and match each with its answer, in order.

    Returns
    -------
    list of float
        Latencies in µs.
    """
    latencies: list[float] = []
    waiting: deque[float] = deque()
    begin = time.perf_counter()
    count, total = 0, round(seconds * rate_hz)
    while count < total or (waiting and time.perf_counter() < begin + seconds + 1.0):
        now = time.perf_counter()
        due = begin + count / rate_hz
        if now >= due and count < total:
            frame = next(source)
            waiting.append(time.perf_counter())
            os.write(master, frame)
            count += 1
            continue
        # Sleeping to the end would wake too late at 1000 frames/s: the last part is polled.
        ready, _, _ = select.select([sock], [], [], max(0.0, due - now - 2e-4))
        if ready:
            arrival = time.perf_counter()
            if is_answer(sock.recv(2048)) and waiting:
                latencies.append((arrival - waiting.popleft()) * 1e6)
    if waiting:
        raise SystemExit(f"{len(waiting)} of {total} frames were not answered")
    return latencies


def measure(command: list[str], master: int, port: int, rate_hz: int, seconds: float) -> dict:
    """Run a program on the line and measure it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind(("127.0.0.1", port))
        sock.setblocking(False)
        process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
        try:
            source = frames(rate_hz)
            await_answer(process, master, sock, source, rate_hz)
            exchange(master, sock, source, rate_hz, WARM_UP_S)
            cpu, wall = cpu_seconds(process.pid), time.perf_counter()
            latencies = exchange(master, sock, source, rate_hz, seconds)
            share = (cpu_seconds(process.pid) - cpu) / (time.perf_counter() - wall)
        finally:
            process.terminate()
            process.wait(10)
    p50, p99 = np.percentile(latencies, [50, 99])
    return {
        "samples": len(latencies),
        "p50_us": float(p50),
        "p99_us": float(p99),
        "max_us": max(latencies),
        "cpu_percent": 100 * share,
    }


def await_answer(
    process: subprocess.Popen,
    master: int,
    sock: socket.socket,
    source: Iterator[bytes],
    rate_hz: int,
) -> None:
    """Feed the line until the program answers, then let it run dry."""
    deadline = time.monotonic() + START_LIMIT_S
    while time.monotonic() < deadline and process.poll() is None:
        os.write(master, next(source))
        if select.select([sock], [], [], 1 / rate_hz)[0] and is_answer(sock.recv(2048)):
            while select.select([sock], [], [], 0.3)[0]:
                sock.recv(2048)
            return
    raise SystemExit(f"no answer from {process.args}")


def main() -> None:
    """Run every rate and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=20.0, help="per rate and program")
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    options = parser.parse_args()
    results = []
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        (folder / "bench.toml").write_text(CONFIG)
        runs = [(name, rate) for rate in RATES_HZ for name in ("plain forwarder", "mavgate")]
        for name, rate in track(runs, "measuring"):
            master, slave = os.openpty()
            tty.setraw(slave)
            port = free_port()
            endpoint = f"udp:127.0.0.1:{port}"
            line = os.ttyname(slave)
            gateway = f"-m gateway.cli run --plain --config {folder}/bench.toml --port {line}"
            command = {
                "mavgate": [sys.executable, *gateway.split(), "--endpoint", endpoint],
                "plain forwarder": [sys.executable, "-c", BASELINE, line, str(port)],
            }[name]
            figures = measure(command, master, port, rate, options.seconds)
            results.append({"program": name, "rate_hz": rate, **figures})
            os.close(master)
            os.close(slave)
    show(results)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1) + "\n")


def free_port() -> int:
    """Find a UDP port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        return int(sock.getsockname()[1])


def show(results: list[dict]) -> None:
    """Print the figures as a table."""
    table = Table(title="serial byte in to datagram out", box=box.SIMPLE_HEAD)
    for column in ("frames/s", "program", "samples", "p50 µs", "p99 µs", "max µs", "CPU %"):
        table.add_column(column, justify="left" if column == "program" else "right")
    for row in results:
        table.add_row(
            str(row["rate_hz"]),
            row["program"],
            str(row["samples"]),
            *(f"{row[key]:.0f}" for key in ("p50_us", "p99_us", "max_us")),
            f"{row['cpu_percent']:.1f}",
        )
    console = Console()
    console.print(table)
    for program in dict.fromkeys(row["program"] for row in results):
        # Where frames come fastest, a pause of the program meets one just as it begins.
        worst = max((r for r in results if r["program"] == program), key=itemgetter("rate_hz"))
        console.print(
            f"longest pause of the {program}: {worst['max_us'] / 1e3:.1f} ms in "
            f"{worst['samples'] / worst['rate_hz']:.0f} s at {worst['rate_hz']} frames/s"
        )


if __name__ == "__main__":
    main()
