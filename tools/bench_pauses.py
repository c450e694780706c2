"""Find pauses of the gateway's loop in a demo, while ground stations connect and disconnect.

    python tools/bench_pauses.py --minutes 60

The demo simulates aircraft, records all data in files that are soon full, serves metrics, and has
clients over UDP, TCP and WebSocket that send every request. Printed are the longest turns of its
loop, without the time used by the machine: first until all aircraft send, then during telemetry.
The baseline, which runs at the same time, is a loop that does the same work in every turn.
"""

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path

from msgspec.structs import replace

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gateway.analysis.processes import begin_copy
from gateway.cli.live.demo import calibrated_aircraft, made_ahead
from gateway.cli.live.run import loop_comes_first
from gateway.clock import unix_time_us
from gateway.compiled.entry_point import load_entry_points
from gateway.config import GatewaySettings
from gateway.live.daemon import Daemon
from gateway.simulator.receiver import simulate
from tests.ports import free_ports
from tools.turns import LONG_US, TurnWatch, even_turns

GOAL_MS = LONG_US / 1e3
ROTATE_MB = 1.0
"""The smallest allowed value: some files a minute."""
LOOK_S = 0.1


def settings_in(folder: Path, vehicles: int, ports: list[int]) -> GatewaySettings:
    """Enable everything that may delay the loop."""
    settings = GatewaySettings()
    udp, tcp, web, metrics = ports
    endpoints = (f"udp-listen:127.0.0.1:{udp}", f"tcp-listen:127.0.0.1:{tcp}")
    hub = replace(
        settings.hub,
        endpoints=(*endpoints, f"ws-listen:127.0.0.1:{web}", "udp:localhost:9"),
        metrics_port=metrics,
        idle_timeout_s=5.0,
    )
    recording = replace(
        settings.recording, mode="always", folder=str(folder / "recordings"), rotate_mb=ROTATE_MB
    )
    return replace(
        settings,
        hub=hub,
        recording=recording,
        aircraft_folder=str(folder),
        simulator=replace(settings.simulator, vehicles=vehicles),
    )


async def fly(settings: GatewaySettings, watch: TurnWatch, seconds: float) -> None:
    """Run the daemon as `mavgate demo` does."""
    line = made_ahead(simulate(settings.simulator, unix_time_us()).frames())
    daemon = Daemon(settings, calibrated_aircraft(settings), lambda: settings, line)
    watch.install()
    with loop_comes_first(daemon.start):
        watch.restart()
        try:
            while len(daemon.snapshot().aircraft) < settings.simulator.vehicles:
                await asyncio.sleep(LOOK_S)
            print(f"longest turn of the start: {watch.longest().own_us / 1e3:.2f} ms")
            watch.restart()
            await asyncio.sleep(seconds)
            watch.stop()
        finally:
            daemon.close()


def run(options: argparse.Namespace, folder: Path) -> TurnWatch:
    """Fly while ground stations connect and disconnect."""
    ports = free_ports(4)
    settings = settings_in(folder, options.vehicles, ports)
    load_entry_points()
    watch = TurnWatch()
    stations = subprocess.Popen(
        [sys.executable, Path(__file__).with_name("changing_stations.py"), *map(str, ports)],
        stderr=subprocess.DEVNULL,
    )
    try:
        with asyncio.Runner(loop_factory=lambda: asyncio.SelectorEventLoop(watch)) as runner:
            runner.run(fly(settings, watch, 60.0 * options.minutes))
        if stations.poll() is not None:
            raise SystemExit("the stations have ended")
    finally:
        stations.terminate()
        stations.wait()
    return watch


def send_even_turns(seconds: float, to: Connection) -> None:
    """Send the results of the baseline."""
    to.send(even_turns(seconds))


def main() -> None:
    """Run, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--vehicles", type=int, default=2)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        # A separate control socket, not that of a gateway that runs on this machine.
        os.environ["XDG_RUNTIME_DIR"] = name
        baseline = begin_copy(send_even_turns, 60.0 * options.minutes)
        begin_s = time.monotonic()
        watch = run(options, Path(name))
        print(f"{(time.monotonic() - begin_s) / 60:.1f} min, {options.vehicles} aircraft")
        longest_ms = watch.longest().own_us / 1e3
        print(f"longest pause by the program: {longest_ms:.2f} ms (goal {GOAL_MS:.0f} ms)")
        print(watch.report())
        longest, wall_us, long_turns, turns = baseline.recv()
        print(
            f"baseline, a loop of even turns: {longest.own_us / 1e3:.2f} of {wall_us / 1e3:.2f} ms "
            f"at {watch.seconds_at(longest.end_ns):.1f} s"
        )
        print(f"  {long_turns} of {turns} turns took more than {GOAL_MS:.0f} ms")


if __name__ == "__main__":
    main()
