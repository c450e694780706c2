"""Kill a recorder at random times: its recordings must be readable.

A child process records frames and fused samples at a true rate until it is killed (SIGKILL). Then
its files are read: all records must be present in order from the first one on, only the truncated
end may be damaged, and at most the last second may be missing.

A second means the data that the child records in one, which may take longer on a busy machine.
Syncs to its disk never end: a kill loses only data that was not yet passed to the kernel. If even
that waits for the disk, more may be lost, so `--any-loss` checks only the written data.

    python -m tools.kill_recorder [--kills 200] [--seed 1]
"""

import argparse
import asyncio
import functools
import mmap
import os
import signal
import struct
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from gateway.clock import GatewayClock, unix_time_us
from gateway.live.recorder import Recorder
from gateway.live.session import RecordingSettings
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableFault, TableHeader, TableReader
from gateway.recordings.tlog import TlogScanner
from gateway.records import FusedSample
from gateway.wire.recorded_frames import Batch
from tests.kit.records import raw_at, sample_at, state_at

RATE_HZ = 200
"""Fused samples a second, each with two frames."""
LONGEST_S = 3.0
SHORTEST_S = 0.3
MAX_LOST_S = 1.0
NUMBERS = struct.Struct("QQ")
"""Data shared with a child: its samples, and the recorder's size of its larger file."""
PATIENCE_S = 240.0
LOOK_S = 0.001


@functools.cache
def make_frame(number: int) -> bytes:
    """Make a frame that contains its number."""
    message = mavlink.MAVLink_system_time_message(0, number)
    return bytes(message.pack(mavlink.MAVLink(None, 1, 1)))


def make_sample(number: int) -> FusedSample:
    """Make a sample that contains its number."""
    time_us = number * 1000
    raw = raw_at(time_us, node_time_us=number)
    return FusedSample(1, raw, sample_at(time_us), state_at(time_us, vel_n_mps=(0, 0, number / 3)))


def never_sync(_: int) -> None:
    """Simulate a sync to a disk that never ends."""
    threading.Event().wait()


async def record_for_ever(folder: Path, shared: mmap.mmap) -> None:
    """Record numbered frames and samples until it is killed; share the counts."""
    os.fsync = os.fdatasync = never_sync  # type: ignore[assignment]
    settings = RecordingSettings(folder=str(folder), mode="always", free_floor_mb=0)
    clock = GatewayClock()
    recorder = Recorder(settings, clock, unix_time_us, lambda _: TableHeader(), lambda *_: None)
    recorder.start()
    await recorder.settle()
    number = 0
    while True:
        recorder.flight(make_sample(number))
        for frame in (2 * number, 2 * number + 1):
            recorder.frame(make_frame(frame))
        number += 1
        shared[:] = NUMBERS.pack(number, recorder.status().part_bytes)
        await asyncio.sleep(1 / RATE_HZ)


def kill_one(folder: Path, life_s: float) -> float:
    """Kill a recorder after some time, and return the lost time in seconds.

    Raises AssertionError if its files are damaged.
    """
    shared = mmap.mmap(-1, NUMBERS.size)
    child = os.fork()
    if child == 0:
        asyncio.run(record_for_ever(folder, shared))
    end_s = time.monotonic() + PATIENCE_S
    recorded = in_file = 0
    while (recorded < life_s * RATE_HZ or not in_file) and time.monotonic() < end_s:
        time.sleep(LOOK_S)
        recorded, in_file = NUMBERS.unpack(shared[:])
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    recorded, in_file = NUMBERS.unpack(shared[:])
    assert recorded >= life_s * RATE_HZ, f"only {recorded} samples in {PATIENCE_S} s"
    assert 0 < in_file <= max(path.stat().st_size for path in folder.iterdir())
    written = sum(check_tlog(path.read_bytes()) for path in folder.glob("*.tlog"))
    for path in folder.glob("*.csv"):
        check_table(path.read_bytes())
    return (recorded - written / 2) / RATE_HZ


def check_tlog(data: bytes) -> int:
    """Check that a tlog contains all its frames from the first on; return their number."""
    batch = TlogScanner(strict=True).feed(data, final=True)
    check_tail(batch, len(data))
    for number, record in enumerate(batch.records()):
        assert record.frame == make_frame(number), f"{record.frame.hex()} is not frame {number}"
    return len(batch)


def check_tail(batch: Batch, size: int) -> None:
    """Check that only the end is damaged."""
    assert len(batch.damage) <= 1, batch.damage
    assert all(run.offset + run.size == size for run in batch.damage), batch.damage


def check_table(data: bytes) -> None:
    """Check that a table contains all its rows from the first on, and only its end is damaged."""
    events = TableReader().feed(data, final=True)
    faults = [event for event in events if isinstance(event, TableFault)]
    assert faults in ([], events[-1:]), faults
    for number, row in enumerate(event for event in events if isinstance(event, TableRow)):
        assert row.time_us == number * 1000, f"row of {row.time_us} µs at place {number}"


def main() -> None:
    """Kill, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--any-loss", action="store_true", help="accept any loss")
    args = parser.parse_args()
    lives_s = np.random.default_rng(args.seed).uniform(SHORTEST_S, LONGEST_S, args.kills)
    lost_s = []
    # The kernels are loaded here once, so that no child spends its time on it.
    check_tlog(b"")
    with tempfile.TemporaryDirectory(prefix="mavgate-kill-") as name:
        for number, life_s in enumerate(lives_s.tolist()):
            folder = Path(name) / str(number)
            lost_s.append(kill_one(folder, life_s))
    print(f"{args.kills} kills: every recording opens, only the cut end is damaged")
    print(f"lost: mean {np.mean(lost_s):.3f} s, most {max(lost_s):.3f} s")
    if max(lost_s) > MAX_LOST_S and not args.any_loss:
        sys.exit(f"more than {MAX_LOST_S} s lost")


if __name__ == "__main__":
    main()
