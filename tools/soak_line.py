"""Run the daemon for long on a line that corrupts bytes, and check its account and its memory.

The simulated tracker's frames pass a pseudo-terminal on which a share of all bytes is replaced by
others. At the end the daemon's counts are compared with what was really sent, and its memory with
what it was after a minute.
"""

import argparse
import asyncio
import os
import socket
import time
import tty
from pathlib import Path

import msgspec
import numpy as np
from rich.progress import Progress

from gateway.config import GatewaySettings
from gateway.live.daemon import Daemon
from gateway.records import GpsFixType, ImuFlags, LinkReport, NodeId
from gateway.wire import payloads
from gateway.wire.framing import encode_frame

GPS_EVERY = 40
"""IMU payloads for each fix: 200 Hz and 5 Hz."""
ALLOWED_GROWTH_KIB = 2048
SETTLED_SHARE = 0.2
"""The memory after this share of the run is the one to compare with."""


class Tracker:
    """Two nodes with true counters."""

    def __init__(self) -> None:
        self.seq = [0, 0]
        self.frame_seq = 0

    def frame(self, time_us: int, node: int, payload: payloads.Payload) -> bytes:
        """Build the next frame of a node."""
        header = payloads.Header(NodeId(1, node), self.seq[node] % 65536, time_us % 2**32)
        packet = payloads.encode_payload(header, payload)
        content = payloads.encode_radio(self.frame_seq % 256, node, time_us % 2**32, packet)
        self.seq[node] += 1
        self.frame_seq += 1
        return encode_frame(content)


def sample(index: int) -> payloads.ImuPayload:
    """Make the counts of a level node that turns slowly."""
    gyro = round(300 * np.sin(index / 500))
    return payloads.ImuPayload(
        (20, -15, 4096), (3, -2, gyro), (200, 30, -380), -3900, ImuFlags.MAG_NEW, 2, 2, 1
    )


def fix(index: int) -> payloads.GpsFixPayload:
    """Make a fix that stands still."""
    itow_ms = index * 5
    place = (-77_656_000, 1_103_728_000, 110_000)
    return payloads.GpsFixPayload(itow_ms, *place, (0, 0, 0), GpsFixType.FIX_3D, True, 12)


def corrupt(frame: bytes, share: float, burst: int, rng: np.random.Generator) -> bytes:
    """Replace a share of the bytes by others, in runs of `burst`."""
    data = np.frombuffer(frame, np.uint8).copy()
    starts = np.flatnonzero(rng.random(data.size) < share / burst)
    for start in starts:
        run = data[start : start + burst]
        run ^= rng.integers(1, 256, run.size, dtype=np.uint8)
    return data.tobytes()


def resident_kib() -> int:
    """Return how much memory this process holds."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") // 1024


async def soak(options: argparse.Namespace) -> int:
    """Run, print the account, and return the exit status."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    sink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sink.bind(("127.0.0.1", 0))
    settings = GatewaySettings()
    serial = msgspec.structs.replace(settings.serial, port=os.ttyname(slave))
    endpoint = f"udp:127.0.0.1:{sink.getsockname()[1]}"
    hub = msgspec.structs.replace(settings.hub, endpoints=(endpoint,))
    settings = msgspec.structs.replace(settings, serial=serial, hub=hub)
    daemon = Daemon(settings, {}, lambda: settings)
    daemon.start()
    tracker, rng = Tracker(), np.random.default_rng(options.seed)
    total = round(options.seconds * options.rate)
    begin, settled_kib = time.monotonic(), 0
    with Progress() as progress:
        task = progress.add_task("soaking", total=total)
        for index in range(total):
            time_us = round(index * 1e6 / options.rate)
            data = tracker.frame(time_us, 0, sample(index))
            if index % GPS_EVERY == 0:
                data += tracker.frame(time_us, 1, fix(index))
            os.write(master, corrupt(data, options.share, options.burst, rng))
            if index == round(SETTLED_SHARE * total):
                settled_kib = resident_kib()
            if index % round(options.rate) == 0:
                progress.update(task, completed=index)
            await asyncio.sleep(max(0.0, begin + index / options.rate - time.monotonic()))
    await asyncio.sleep(1.5)
    snapshot = daemon.snapshot()
    daemon.close()
    sink.close()
    return judge(snapshot.report, tracker, settled_kib)


def judge(report: LinkReport, tracker: Tracker, settled_kib: int) -> int:
    """Print the account and return whether it adds up."""
    status = 0
    for link in sorted(report.nodes, key=lambda node: node.node.node_id):
        if link.node.vehicle_id != 1 or link.node.node_id > 1:
            print(f"a ghost: {link}")
            continue
        sent = tracker.seq[link.node.node_id]
        counted = link.received + link.lost
        print(
            f"node {link.node.node_id}: sent {sent}, received {link.received} "
            f"({100 * link.received / sent:.2f} %), lost {link.lost}, together {counted}"
        )
        # What was lost before the first and after the last good frame cannot be known.
        status |= not 0 <= sent - counted < 0.02 * sent + 500
    faults = ", ".join(f"{count} {kind}" for kind, count in report.faults)
    growth = resident_kib() - settled_kib
    print(f"frames: sent {tracker.frame_seq}, accepted {report.frames}, faults: {faults}")
    print(f"memory: {settled_kib} KiB settled, {growth:+d} KiB at the end")
    status |= growth > ALLOWED_GROWTH_KIB
    print("the account does not add up" if status else "the account adds up, memory is flat")
    return status


def main() -> None:
    """Read the options and run."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--rate", type=float, default=200.0, help="IMU frames a second")
    parser.add_argument("--share", type=float, default=0.1, help="of bytes that are corrupted")
    parser.add_argument("--burst", type=int, default=1, help="bytes corrupted in a row")
    parser.add_argument("--seed", type=int, default=1)
    raise SystemExit(asyncio.run(soak(parser.parse_args())))


if __name__ == "__main__":
    main()
