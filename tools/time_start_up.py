"""Measure the processor time and the memory of the gateway's start, and of small commands.

Printed are the best of five runs of `mavgate --help` and `mavgate status`; then, for `mavgate run`
on a simulated receiver, time, processor time and memory from its call to its first datagram and to
its first attitude. The baselines are an empty Python program, and `mavlogdump.py --help`.
"""

import os
import select
import tempfile
import time
from itertools import takewhile
from pathlib import Path

from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.wire.mavlink_messages import HEARTBEAT_ID
from gateway.wire.mavlink_splitter import message_id_of
from tools.harness import (
    MAVGATE,
    PYTHON,
    SerialLine,
    arguments,
    cpu_s,
    memory_mb,
    port_of,
    run,
    running,
    show,
    udp_socket,
    write_json,
)

REPEATS = 5
START_UNIX_US = 1_781_187_930_000_000
ATTITUDE_ID = 30
LIMIT_S = 60.0
Row = tuple[object, ...]


def command(name: str, *words: str) -> Row:
    """Measure a program; the best of some runs."""
    runs = [run(*words) for _ in range(REPEATS)]
    return name, *(min(figures[key] for figures in runs) for key in ("s", "cpu_s")), ""


def gateway(folder: Path) -> list[Row]:
    """Measure a gateway's start with a connected receiver, and a command to it."""
    settings, line, client = folder / "gateway.toml", SerialLine(), udp_socket()
    os.set_blocking(line.master, False)
    settings.write_text(f'[hub]\nendpoints = ["udp:127.0.0.1:{port_of(client)}"]\n')
    frames = simulate(SimulatorSettings(gps_first_fix_s=0.5), START_UNIX_US).frames()
    words = ("run", "--plain", "--config", str(settings), "--port", line.device)
    wanted, rows, begin_s = [HEARTBEAT_ID, ATTITUDE_ID], list[Row](), time.monotonic()
    with running(*MAVGATE, *words) as process:
        for frame in takewhile(lambda frame: wanted and frame.time_s < LIMIT_S, frames):
            while (early_s := begin_s + frame.time_s - time.monotonic()) > 0.0:
                if select.select([client], [], [], early_s)[0]:
                    received = message_id_of(client.recv(2048))
                    while wanted and received == wanted[0]:
                        wanted.pop(0)
                        name = f"mavgate run to message {received}"
                        costs = cpu_s(process.pid), memory_mb(process.pid)
                        rows.append((name, time.monotonic() - begin_s, *costs))
            # A receiver does not wait until its frames are read.
            if select.select([], [line.master], [], 0.0)[1]:
                os.write(line.master, frame.data)
        rows.append(command("mavgate status", *MAVGATE, "status"))
    line.close()
    client.close()
    return rows


def main() -> None:
    """Measure and print."""
    options = arguments(__doc__).parse_args()
    dump = str(Path(PYTHON).with_name("mavlogdump.py"))
    rows = [
        command("python -c pass", PYTHON, "-c", "pass"),
        command("mavlogdump.py --help", PYTHON, dump, "--help"),
        command("mavgate --help", *MAVGATE, "--help"),
    ]
    with tempfile.TemporaryDirectory() as folder:
        # A separate control socket, not that of a gateway that runs on this machine.
        os.environ["XDG_RUNTIME_DIR"] = folder
        rows += gateway(Path(folder))
    show("start-up", ("program", "s", "CPU s", "MB"), rows)
    write_json(options, {"rows": rows})


if __name__ == "__main__":
    main()
