"""`mavgate demo`: the whole gateway on a simulated receiver.

The frames are produced by a separate process, or by the firmware on simulated chips.
"""

import importlib
import logging
import signal
import sys
import tempfile
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Final, Literal, cast

import typer
from msgspec.structs import replace

from gateway.aircraft import AircraftSettings
from gateway.analysis.processes import begin_copy
from gateway.cli.live.panel import launched_panel
from gateway.cli.live.run import refuse_conflicts, serve, with_endpoints
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import (
    CONFIG,
    folder_of,
    option,
    read_options,
    read_settings,
    settings_file,
)
from gateway.cli.support.recordings import files_of, progress_of
from gateway.cli.support.terminal import refuse
from gateway.clock import unix_time_us
from gateway.compiled.entry_point import load_entry_points
from gateway.config import GatewaySettings
from gateway.flashing.boards import Radio
from gateway.live.daemon import Daemon
from gateway.live.service import run_event_loop
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame

log = logging.getLogger(__name__)

NOT_RECORDED: Final = "not recording without --record or `mavgate record start`"
app = typer.Typer()
AT_ONCE: Final = 16
"""Frames per message of the pipe, which buffers some hundreds in advance."""
CHECKOUT: Final = Path(__file__).resolve().parents[3]


TrackerName = Literal["crsf", "lines", "phone"]
"""Kinds of simulated trackers other than our boards."""


@app.command()
def demo(
    *,
    endpoint: list[str] | None = opt.ENDPOINT,
    plain: bool = opt.PLAIN,
    record: bool = option("--record", "Record it from the start.", False),
    flight: Path | None = option(
        "--flight -f", "Fly a recording instead: by its name, or any file."
    ),
    firmware: Radio | None = option(
        "--firmware", "Run the boards' own programs on simulated chips, with this radio."
    ),
    tracker: TrackerName | None = option(
        "--tracker", "Fly it through the bytes of another kind of tracker."
    ),
    panel: bool = option("--panel/--no-panel", "Start the panel too.", True),
    duplicate_ids: bool = opt.DUPLICATE_IDS,
) -> None:
    """Fly the simulated tracker repeatedly until interrupted.

    The simulated receiver sends the real protocol on a pseudo-terminal, at true rates. A recording
    that is flown instead restarts at its end, with a message.
    """
    file = CONFIG.get()  # Read here: a reload runs in another thread, without the context.

    def read() -> GatewaySettings:
        return with_endpoints(read_settings(file), endpoint)

    one = (settings := read()).simulator
    ids = [one.vehicle_id + number for number in range(1 if flight else one.vehicles)]
    refuse_conflicts(ids, settings, allowed=duplicate_ids)
    # First, as it takes seconds to load; the simulator is therefore imported later.
    page, daemons = launched_panel(wanted=panel), list[Daemon]()
    load_entry_points()

    def report(text: str) -> None:
        log.info(text)
        for daemon in daemons:
            daemon.announce(text)

    try:
        if flight is not None:
            line, aircraft = recorded_line(settings, flight, report)
        else:
            boards = firmware and firmware_line(one, unix_time_us(), firmware)
            line = made_ahead(boards or simulated_line(one, tracker))
            aircraft = calibrated_aircraft(settings)
    except ValueError as error:
        refuse(str(error))
    # Parameters that a ground station stores in the demo must not affect the real aircraft's.
    with tempfile.TemporaryDirectory(prefix="mavgate-demo-") as folder:

        def own(settings: GatewaySettings) -> GatewaySettings:
            recording = replace(settings.recording, mode="always" if record else "manual")
            return replace(settings, aircraft_folder=folder, recording=recording)

        def daemon() -> Daemon:
            log.info("recording.mode is not used here: %s", "recording" if record else NOT_RECORDED)
            start = (own(settings), aircraft, lambda: own(read()), line, tracker or "")
            daemons.append(Daemon(*start, settings_file().parent))
            return daemons[-1]

        run_event_loop(serve(daemon, plain=plain, panel=page), settings.hub.event_loop)


def simulated_line(settings: SimulatorSettings, source: TrackerName | None) -> Iterator[TimedFrame]:
    """Simulate the aircraft, as frames of the receiver or bytes of another source."""
    from gateway.simulator.receiver import simulate
    from gateway.simulator.source_bytes import SOURCE_BYTES

    if source is not None:
        return SOURCE_BYTES[source](settings, unix_time_us())
    return simulate(settings, unix_time_us()).frames()


def recorded_line(
    settings: GatewaySettings, name: Path, report: Callable[[str], None] = log.info
) -> tuple[Iterator[TimedFrame], dict[int, AircraftSettings]]:
    """Send a recording as its nodes would have sent it, with unchanged calibrated values."""
    from gateway.recordings.flown import open_flown
    from gateway.recordings.fuse import with_reference
    from gateway.simulator.recorded import in_rounds, replay

    files = files_of([name], folder_of(settings), "tables")
    with progress_of(files) as advance:
        options = read_options(settings, progress=advance)
        flight = open_flown(files, options)
    aircraft = with_reference(settings.default_aircraft, gps_latency_s=flight.gps_latency_s)

    def on_round(number: int) -> None:
        report(f"Recording ended after {flight.duration_s:.0f} s; round {number} begins")

    receiver = replay(settings.simulator, flight, unix_time_us())
    frames = in_rounds(made_ahead(receiver.frames()), flight.duration_s, on_round)
    return frames, {settings.simulator.vehicle_id: aircraft}


def calibrated_aircraft(settings: GatewaySettings) -> dict[int, AircraftSettings]:
    """Return the simulated aircraft with the calibration that a user would have made before."""
    from gateway.simulator.flight import SimulatedAircraft

    found = {}
    for index in range(settings.simulator.vehicles):
        simulated = SimulatedAircraft(settings.simulator, index)
        calibration = NodeCalibration(**simulated.errors)
        found[simulated.vehicle_id] = replace(settings.default_aircraft, calibration=calibration)
    return found


def made_ahead(frames: Iterator[TimedFrame]) -> Generator[TimedFrame]:
    """Produce frames in a background process, to relieve the event loop that plays them."""
    return _take(begin_copy(_make, frames))


def _take(receiver: Connection) -> Generator[TimedFrame]:
    with receiver, suppress(EOFError):
        while True:
            for made in receiver.recv():
                yield TimedFrame(*made)
    log.warning("the simulated receiver has ended")


def _make(frames: Iterator[TimedFrame], sender: Connection) -> None:
    # Ctrl+C and hang-up of the terminal are handled by the gateway, which ends this process.
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    while made := [(f.time_s, f.data, f.damaged) for f in islice(frames, AT_ONCE)]:
        sender.send(made)


def firmware_line(
    settings: SimulatorSettings, start_unix_us: int, radio: str
) -> Iterator[TimedFrame]:
    """Fly the simulated aircraft with the firmware on simulated chips."""
    if not (CHECKOUT / "firmware" / "rig").is_dir():
        refuse("--firmware needs a checkout of the project, not an installed package")
    if str(CHECKOUT) not in sys.path:
        sys.path.append(str(CHECKOUT))
    line = importlib.import_module("firmware.rig.line")
    try:
        return cast(Iterator[TimedFrame], line.frames(settings, start_unix_us, radio))
    except (RuntimeError, OSError) as error:
        refuse(f"--firmware: {error}")
