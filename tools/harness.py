"""Shared parts of the benchmarks: options, processes and their cost, medians of rounds, tables."""

import argparse
import contextlib
import json
import math
import os
import socket
import statistics
import subprocess
import sys
import tty
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

CORES = sorted(os.sched_getaffinity(0))
"""Processor cores: a measured program runs on the last one, its source and clients on the first."""
PYTHON = sys.executable
MAVGATE = (PYTHON, "-m", "gateway.cli")
END_S = 10.0
"""Timeout of the end of a process, after which it is killed."""

Figures = dict[str, float]


def arguments(doc: str | None, *, rounds: int = 0, seconds: float = 0.0) -> argparse.ArgumentParser:
    """Return a parser with the options that the benchmarks share."""
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    if rounds:
        parser.add_argument("--rounds", type=int, default=rounds, help="the median counts")
    if seconds:
        parser.add_argument(
            "--seconds", type=type(seconds), default=seconds, help="of each single run"
        )
    parser.add_argument("--json", type=Path, help="write the figures to this file too")
    return parser


def write_json(options: argparse.Namespace, report: Mapping[str, Any]) -> None:
    """Write the figures to the file of `--json`, if any, with the load of the machine."""
    if options.json:
        options.json.write_text(json.dumps({"load": os.getloadavg(), **report}, indent=1) + "\n")


def show(title: str, columns: Sequence[str], rows: Iterable[Iterable[object]]) -> None:
    """Print rows as a table; numbers have three digits or more."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in columns:
        table.add_column(column, justify="right")
    for row in rows:
        table.add_row(*map(text_of, row))
    Console(width=250).print(title, table, sep="\n")


def text_of(value: object) -> str:
    """Return a cell of a table; an unknown number is empty."""
    if not isinstance(value, float):
        return f"{value:,}" if isinstance(value, int) else str(value)
    if math.isnan(value):
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def medians(rounds: Sequence[Figures], *, maxima: Iterable[str] = ()) -> Figures:
    """Return the median of each figure, the maximum of some, and the sum of the losses."""
    ways: dict[str, Any] = dict.fromkeys(maxima, max) | {"lost": sum}
    return {
        key: ways.get(key, statistics.median)([figures[key] for figures in rounds])
        for key in rounds[0]
    }


@contextlib.contextmanager
def running(*command: str, **options: Any) -> Iterator["subprocess.Popen[Any]"]:
    """Run a program without output until the end of the block; its options are those of `Popen`."""
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    process = subprocess.Popen(command, **quiet | options)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def run(*command: str) -> Figures:
    """Run a program; return its duration, and processor time and peak memory of it and its own."""
    begin_s = os.times().elapsed
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, command)
    cpu = usage.ru_utime + usage.ru_stime
    elapsed_s = os.times().elapsed - begin_s
    return {"s": elapsed_s, "cpu_s": cpu, "memory_mb": usage.ru_maxrss / 1024}


def cpu_s(pid: int) -> float:
    """Return the processor time of the threads of a process."""
    return 1e-9 * sum(
        int(task.read_text().split()[0]) for task in Path(f"/proc/{pid}/task").glob("*/schedstat")
    )


def memory_mb(pid: int) -> float:
    """Return the resident memory of a process."""
    status = Path(f"/proc/{pid}/status").read_text()
    return int(status.partition("VmRSS:")[2].split()[0]) / 1024


def udp_socket(port: int = 0) -> socket.socket:
    """Open a socket on a loopback port, by default a free one."""
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    sock.bind(("127.0.0.1", port))
    sock.setblocking(False)
    return sock


def port_of(sock: socket.socket) -> int:
    """Return the port of a socket."""
    return int(sock.getsockname()[1])


class SerialLine:
    """A pseudo-terminal: programs open `device`, the benchmark reads and writes `master`."""

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.device = os.ttyname(self._slave)

    def close(self) -> None:
        """Close both ends."""
        os.close(self.master)
        os.close(self._slave)
