"""`mavgate calibrate`: guided calibration of a node, live or from a recording."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
import typer
from rich.progress import TextColumn

from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import (
    CONFIG,
    argument,
    ask,
    folder_of,
    is_running,
    option,
    read_options,
    read_settings,
)
from gateway.cli.support.recordings import files_of
from gateway.cli.support.terminal import console_of, progress_bar, refuse, table_of
from gateway.clock import GatewayClock, unix_time_us
from gateway.config import GatewaySettings, load_aircraft, save_aircraft
from gateway.live.control_verbs import raw_of
from gateway.live.pty_port import PtyPort
from gateway.live.serial_port import SerialPort, SerialSettings, find_receiver
from gateway.printable import figure
from gateway.recordings.recording import open_recording
from gateway.records import ImuRaw, LinkReport, NodeStatus, RawRecord
from gateway.sensing import calibrating
from gateway.sensing.calibrating import CalibrationError, NodeSamples, node_samples
from gateway.sensing.calibrating import CalibrationStep as Step
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.units import RAD_PER_DEG, US_PER_S
from gateway.wire.link import Link
from gateway.wire.payloads import SENSOR_IMU

if TYPE_CHECKING:
    from gateway.simulator.trajectory import Workbench

POLL_S: Final = 0.5
"""Interval of the requests to a running gateway, s."""
SAMPLE_TIMEOUT_S: Final = 10.0
"""Timeout without any sample, s."""
POSE_S: Final = 3.0
REST_S: Final = 5.0
MAG_S: Final = 15.0
MAG_LIMIT_S: Final = 120.0
"""Minimum and maximum duration of turning the compass, s."""
SIDES_EVERY_S: Final = 0.5
MAG_SIDES: Final = 20
"""Sides, of `calibrating.FIELD_SIDES`, that are enough to end the turning."""
MAX_TRIES: Final = 24
MOVING_MPS: Final = 1.0
"""Minimum GPS speed in motion; a receiver at rest reports up to 0.3 m/s."""
MOVING_US: Final = 3 * US_PER_S
"""Time for which a motion detected by GPS counts."""

console = console_of()
app = typer.Typer()


SIDES: Final = (
    *("x arrow up", "x arrow down", "y arrow up", "y arrow down"),
    *("chips up", "chips down"),
)
"""Orientation of the board when +x, -x, +y, -y, +z, -z measures gravity."""


Capture = Callable[[float, bool], NodeSamples]
"""Waits for samples over some seconds, or also until the compass was turned to most sides."""


STEPS: Final = (Step.GYRO, Step.ACCEL, Step.LEVEL, Step.MAG)
"""The steps of a first calibration, in order."""
ATTITUDES_DEG: Final = {
    Step.MOUNTING: ((0.0, 0.0), (0.0, 45.0)),
    Step.ACCEL: ((0.0, 0.0), (180.0, 0.0), (90.0, 0.0), (-90.0, 0.0), (0.0, 90.0), (0.0, -90.0)),
}
"""Roll and pitch of a step's poses, deg; in other steps the aircraft is level."""


Poses = Callable[[Step], list[NodeSamples]]
"""Function that returns the samples of each pose of a step; raises CalibrationError with advice."""


@app.command()
def calibrate(
    steps: list[Step] | None = argument(f"Steps; by default {' '.join(STEPS)}."),
    *,
    vehicle: int = option("--vehicle", "Its id.", 1, min=1, max=31),
    log: Path | None = option("--log", "Calibrate from a recording, by name or file, instead."),
    port: str | None = opt.PORT,
    field_ut: float | None = option(
        "--field-strength", "Of the field here, uT.", min=10.0, max=100.0
    ),
    dry_run: bool = option("--dry-run", "Show the result, but do not save it.", False),
    simulated: bool = opt.SIMULATED,
) -> None:
    """Calibrate an aircraft's sensors and save the result with its residuals.

    Each step is saved when it is done; the exit code is 1 if one fails. A running gateway provides
    the samples and uses the result at once; without one, or with --port, the receiver is read
    directly.
    """
    settings = read_settings()
    aircraft = load_aircraft(settings).get(vehicle, settings.default_aircraft)
    old = aircraft.calibration
    is_other = simulated or log is not None or port is not None or CONFIG.get() is not None
    is_live = not is_other and is_running()
    if is_live:
        old = msgspec.convert(ask("imu.calibration", vehicle_id=vehicle), NodeCalibration)

    def save(calibration: NodeCalibration) -> None:
        if dry_run or simulated:
            return
        if is_live:
            values = msgspec.to_builtins(calibration)
            ask("imu.calibrate", vehicle_id=vehicle, calibration=values)
            console.print("used and saved by the gateway")
            return
        changed = msgspec.structs.replace(aircraft, calibration=calibration)
        console.print(f"saved in {save_aircraft(settings, vehicle, changed)}")

    serial = settings.serial
    serial = serial if port is None else msgspec.structs.replace(serial, port=port)
    with ExitStack() as opened:
        if log is not None:
            poses = _poses_of_log(_read_log(log, settings, vehicle))
        elif simulated:
            simulator = msgspec.structs.replace(settings.simulator, vehicle_id=vehicle)
            path, bench = opened.enter_context(simulated_receiver(simulator))
            serial = msgspec.structs.replace(serial, port=path)
            poses = poses_on(bench, capture_from(serial, vehicle))
        else:
            poses = poses_from(_capture_live(vehicle) if is_live else capture_from(serial, vehicle))
        new, missing = calibrate_each(steps or [*STEPS], poses, old, save, field_ut)
    _show(old, new)
    if missing:
        raise typer.Exit(1)


def calibrate_each(
    steps: list[Step],
    poses: Poses,
    calibration: NodeCalibration,
    save: Callable[[NodeCalibration], None],
    field_ut: float | None = None,
) -> tuple[NodeCalibration, list[Step]]:
    """Run the steps; each is saved when it is done, so an interruption loses only the present one.

    A failed step is reported, and the next one starts. Returns the calibration and the missing
    steps.
    """
    missing: list[Step] = []
    for number, step in enumerate(steps):
        if len(steps) > 1:
            console.print(f"\nStep {number + 1} of {len(steps)}: {step}")
        try:
            calibration = _solve(step, poses(step), calibration, field_ut)
        except CalibrationError as error:
            missing.append(step)
            console.print(f"{step}: {error}", style="red")
        except (KeyboardInterrupt, typer.Abort):
            missing += steps[number:]
            left = ", ".join(steps[number:])
            console.print(f"\nCancelled (interrupted). Remaining steps: {left}.", style="yellow")
            break
        else:
            console.print(f"{step}: done", style="green")
            save(calibration)
    return calibration, missing


def _solve(
    step: Step, poses: list[NodeSamples], calibration: NodeCalibration, field_ut: float | None
) -> NodeCalibration:
    match step:
        case Step.ACCEL:
            return calibrating.calibrate_accelerometer(poses, calibration)
        case Step.MAG:
            return calibrating.calibrate_magnetometer(poses[0].mag, calibration, field_ut)
        case Step.MOUNTING:
            return calibrating.calibrate_mounting(poses[0], poses[1], calibration)
    solve = calibrating.calibrate_gyro if step is Step.GYRO else calibrating.calibrate_level
    return solve(poses[0], calibration)


def poses_from(capture: Capture) -> Poses:
    """Return a function that asks a person for the poses."""

    def poses(step: Step) -> list[NodeSamples]:
        match step:
            case Step.GYRO:
                _ask("Lay the aircraft down and do not touch it.")
                return [capture(REST_S, False)]
            case Step.ACCEL:
                return _six_sides(capture)
            case Step.MAG:
                _ask(
                    "Away from steel, turn the aircraft slowly about all its axes, upside down "
                    "too, until most sides were measured."
                )
                return [capture(MAG_S, True)]
        _ask("Set the aircraft level, as it flies.")
        level = [capture(POSE_S, False)]
        if step is Step.MOUNTING:
            _ask("Raise the nose by 30° or more and hold it there.")
            level.append(capture(POSE_S, False))
        return level

    return poses


def poses_on(bench: Workbench, capture: Capture) -> Poses:
    """Return the poses of a simulated aircraft, which follows the instructions to a person."""

    def poses(step: Step) -> list[NodeSamples]:
        attitudes = cycle(ATTITUDES_DEG.get(step, ((0.0, 0.0),)))

        def moved(seconds: float, turned: bool) -> NodeSamples:
            bench.lay(*(angle * RAD_PER_DEG for angle in next(attitudes)))
            if turned:
                bench.turn()
            return capture(seconds, turned)

        return poses_from(moved)(step)

    return poses


@contextmanager
def simulated_receiver(settings: SimulatorSettings) -> Iterator[tuple[str, Workbench]]:
    """Run a simulated receiver and an aircraft on a workbench behind a pseudo-terminal."""
    # Imported here: the simulated flight requires SciPy, which a real first start does not.
    from gateway.simulator.flight import SimulatedAircraft
    from gateway.simulator.node import nodes_of
    from gateway.simulator.receiver import SimulatedReceiver
    from gateway.simulator.trajectory import Workbench

    bench = Workbench(settings)
    # The dropouts of the flight do not occur on a workbench.
    settings = msgspec.structs.replace(settings, gps_outages_s=())
    aircraft = SimulatedAircraft(settings, start_unix_us=unix_time_us(), motion=bench)
    receiver = SimulatedReceiver(settings, nodes_of(aircraft, settings))
    # In a thread with its own loop, since the main thread waits for input in between.
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    port = PtyPort(receiver.frames())
    thread.start()
    loop.call_soon_threadsafe(port.start)
    try:
        yield port.path, bench
    finally:
        loop.call_soon_threadsafe(port.close)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


def _poses_of_log(samples: NodeSamples) -> Poses:
    def poses(step: Step) -> list[NodeSamples]:
        if step in (Step.MOUNTING, Step.LEVEL):
            raise CalibrationError("a recording does not show which pose was level")
        return [samples]

    return poses


def _six_sides(capture: Capture) -> list[NodeSamples]:
    held: list[NodeSamples] = []
    for _ in range(MAX_TRIES):
        missing = _missing(held)
        if not missing:
            break
        done = len(SIDES) - len(missing)
        _ask(
            f"{done} of {len(SIDES)} sides are done. Lay the node on one of these and release "
            f"it: {', '.join(missing)}."
        )
        samples = capture(POSE_S, False)
        if not calibrating.still_windows(samples):
            console.print("It moved; trying again.")
        elif _missing([*held, samples]) == missing:
            console.print("That side was done before, or it is too oblique; trying again.")
        held.append(samples)
    return held


def _missing(samples: list[NodeSamples]) -> list[str]:
    seen = calibrating.sides_of(samples)
    return [name for number, name in enumerate(SIDES) if number not in seen]


def _read_log(path: Path, settings: GatewaySettings, vehicle: int) -> NodeSamples:
    raws, moving, moved_us = list[ImuRaw](), list[bool](), -MOVING_US
    (path, *_) = files_of([path], folder_of(settings), "tables")
    table = open_recording(path).rows(read_options(settings))
    for row in table.plain_rows:
        fix = row.gps
        if fix is not None and fix.node.vehicle_id == vehicle:
            moves = fix.fix_ok and math.hypot(*fix.vel_n_mps[:2]) > MOVING_MPS
            moved_us = fix.time_us if moves else -MOVING_US
        if row.raw is not None and row.raw.node.vehicle_id == vehicle:
            raws.append(row.raw)
            moving.append(row.time_us - moved_us < MOVING_US)
    if not raws:
        refuse(f"{path}: it contains no raw IMU samples of vehicle {vehicle}")
    return node_samples(raws, moving)


def capture_from(serial: SerialSettings, vehicle: int) -> Capture:
    """Return a capture from the receiver's port; raises PortNotFoundError if there is none."""
    # Fail before the person lays the aircraft on its sides, if the port does not exist.
    device = asyncio.run(find_receiver(serial))
    serial = msgspec.structs.replace(serial, port=device)
    shown: tuple[str, ...] = ()

    def capture(seconds: float, turned: bool) -> NodeSamples:
        nonlocal shown
        collecting = _Collecting(vehicle, seconds, turned)
        limit_s = collecting.limit_s + SAMPLE_TIMEOUT_S
        with collecting.bar:
            _, is_done = asyncio.run(listen(serial, collecting.add, limit_s))
        if not is_done:
            refuse(f"no samples of vehicle {vehicle}: is it on, and is the port right?")
        if collecting.chips not in ((), shown):
            shown = collecting.chips
            console.print(f"sensors: {', '.join(shown)}")
        return node_samples(collecting.raws)

    return capture


async def listen(
    serial: SerialSettings, take: Callable[[list[RawRecord]], bool], limit_s: float
) -> tuple[LinkReport, bool]:
    """Read the receiver until `take` has enough; return its report, and whether it was enough."""
    clock, link, done = GatewayClock(), Link(), asyncio.Event()

    def on_bytes(data: bytes, now_us: int) -> None:
        if take(link.feed(data, now_us)):
            done.set()

    port = SerialPort(serial, on_bytes, lambda _: None, lambda _: None, clock)
    port.start()
    try:
        with suppress(TimeoutError):
            await asyncio.wait_for(done.wait(), limit_s)
        return link.report(clock(), connected=port.connected, port=serial.port), done.is_set()
    finally:
        port.close()


class _Collecting:
    """Collect one aircraft's samples over a time, or until most sides were measured."""

    def __init__(self, vehicle: int, seconds: float, turned: bool) -> None:
        self._vehicle, self._seconds, self._turned = vehicle, seconds, turned
        self.raws: list[ImuRaw] = []
        self.chips: tuple[str, ...] = ()
        """Chips that the IMU node last reported."""
        self._shown_s = 0.0
        label = "sides of the field measured" if turned else "listening"
        total = calibrating.FIELD_SIDES if turned else seconds
        unit = f"of {total}" if turned else "s"
        self.bar = progress_bar(TextColumn(f"{{task.completed:.0f}} {unit}"))
        self._task = self.bar.add_task(label, total=total)
        self.limit_s = MAG_LIMIT_S if turned else seconds

    def add(self, records: Iterable[RawRecord]) -> bool:
        """Process the next records; return whether the samples are complete."""
        raws, seconds = self.raws, self._seconds
        for record in records:
            if record.node.vehicle_id != self._vehicle:
                continue
            if isinstance(record, ImuRaw):
                raws.append(record)
            elif isinstance(record, NodeStatus) and record.sensors_present & SENSOR_IMU:
                self.chips = record.chips
        span_s = (raws[-1].time_us - raws[0].time_us) / US_PER_S if raws else 0.0
        if not self._turned:
            self.bar.update(self._task, completed=min(span_s, seconds), refresh=True)
            return span_s > seconds
        if span_s < self._shown_s + SIDES_EVERY_S:
            return False
        self._shown_s = span_s
        sides = calibrating.field_sides(node_samples(raws))
        self.bar.update(self._task, completed=sides, refresh=True)
        return span_s > MAG_LIMIT_S or (span_s > seconds and sides >= MAG_SIDES)


def _capture_live(vehicle: int) -> Capture:
    for aircraft in ask("status")["aircraft"]:
        boards = aircraft["boards"] if aircraft["vehicle_id"] == vehicle else ()
        for board in boards:
            if board["chips"] and board["sensors_present"] & SENSOR_IMU:
                console.print(f"sensors: {', '.join(board['chips'])}")

    def capture(seconds: float, turned: bool) -> NodeSamples:
        collecting, idle_s = _Collecting(vehicle, seconds, turned), 0.0
        ask("imu.samples", vehicle_id=vehicle)
        with collecting.bar:
            is_done = False
            while not is_done:
                time.sleep(POLL_S)
                found = ask("imu.samples", vehicle_id=vehicle)
                idle_s = 0.0 if found else idle_s + POLL_S
                if idle_s > SAMPLE_TIMEOUT_S:
                    refuse(f"no samples of vehicle {vehicle}: is it on?")
                is_done = collecting.add(map(raw_of, found))
        return node_samples(collecting.raws)

    return capture


def _ask(text: str) -> None:
    console.print(f"\n{text}", style="bold")
    typer.prompt("Enter when ready", default="", show_default=False)


def _show(old: NodeCalibration, new: NodeCalibration) -> None:
    rows = []
    for name in new.__struct_fields__:
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            is_rate = name.endswith("_radps")
            shown = name.removesuffix("_radps") + ", °/s" if is_rate else name
            scale = 1.0 / RAD_PER_DEG if is_rate else 1.0
            rows.append((shown, _text(before, scale), _text(after, scale)))
    columns = ("setting", "before", "after")
    console.print(table_of(*columns, left=3, rows=rows) if rows else "nothing changed")


def _text(value: object, scale: float) -> str:
    if isinstance(value, tuple):
        return f"({', '.join(_text(item, scale) for item in value)})"
    return figure(value * scale, ".5g") if isinstance(value, float) else str(value)
