"""`mavgate calibrate`: guide a person through a node's calibration, live or from a recording."""

import asyncio
import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final, Protocol

import msgspec
import typer
from rich import box
from rich.progress import BarColumn, Progress, TaskID, TextColumn
from rich.table import Table

from gateway.cli.support.errors import refuse
from gateway.cli.support.named_recordings import files_of, folder_of
from gateway.cli.support.recording_options import refusing
from gateway.cli.support.settings_options import (
    ConfigOption,
    read_aircraft,
    read_options,
    read_settings,
)
from gateway.cli.support.terminal import console_of
from gateway.clock import GatewayClock
from gateway.config import GatewaySettings, save_aircraft
from gateway.live.serial_port import (
    PortNotFoundError,
    SerialPort,
    SerialSettings,
    find_receiver,
)
from gateway.recordings.reading import open_rows
from gateway.records import GpsFix, ImuRaw
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.procedure import (
    FIELD_SIDES,
    SIDES,
    calibrate_accelerometer,
    calibrate_gyro,
    calibrate_level,
    calibrate_magnetometer,
    calibrate_mounting,
    field_sides,
    is_still,
    missing_sides,
)
from gateway.sensing.solvers import CalibrationError, NodeSamples, node_samples
from gateway.units import US_PER_S
from gateway.wire.link import Link

PATIENCE_S: Final = 10.0
"""Without a sample for so long, give up."""
POSE_S: Final = 3.0
REST_S: Final = 5.0
MAG_S: Final = 15.0
MAG_LIMIT_S: Final = 120.0
"""The compass is turned for at least and at most this long."""
SIDES_EVERY_S: Final = 0.5
MAG_SIDES: Final = 20
"""Of `FIELD_SIDES`: enough to end the turning."""
MAX_TRIES: Final = 24
MOVING_MPS: Final = 1.0
"""GPS speed that is not rest; a receiver at rest reports up to 0.3 m/s."""
MOVING_US: Final = 3 * US_PER_S
"""A movement by GPS counts for this long."""

console = console_of()


class Step(StrEnum):
    """What can be calibrated."""

    GYRO = "gyro"
    ACCEL = "accel"
    MAG = "mag"
    MOUNTING = "mounting"
    LEVEL = "level"


class Capture(Protocol):
    """Waits for samples."""

    def __call__(self, seconds: float, *, turned: bool = False) -> NodeSamples:
        """Return samples of so many seconds, or until the compass was turned to most sides."""


Solve = Callable[[Step, NodeCalibration], NodeCalibration]
Save = Callable[[NodeCalibration], None]


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("calibrate")(calibrate)


def calibrate(
    steps: Annotated[
        list[Step] | None, typer.Argument(help="Steps; by default gyro accel mag level.")
    ] = None,
    *,
    vehicle: Annotated[int, typer.Option("--vehicle", min=1, max=31, help="Its id.")] = 1,
    log: Annotated[
        Path | None,
        typer.Option("--log", help="Calibrate from a recording, by name or file, instead."),
    ] = None,
    port: Annotated[
        str | None, typer.Option("--port", "-p", help="Receiver's port, instead of the settings'.")
    ] = None,
    field_ut: Annotated[
        float | None,
        typer.Option("--field", min=10.0, max=100.0, help="Strength of the field here, uT."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the result, but do not save it.")
    ] = False,
    config: ConfigOption = None,
) -> None:
    """Calibrate an aircraft's sensors and save the result with its residuals.

    Each step is saved when it is done. The gateway must not run meanwhile: the receiver's port is
    read by one program at a time.
    """
    settings = read_settings(config)
    aircraft = read_aircraft(settings).get(vehicle, settings.default_aircraft)
    chosen = steps or [Step.GYRO, Step.ACCEL, Step.MAG, Step.LEVEL]
    old = aircraft.calibration

    def save(calibration: NodeCalibration) -> None:
        if dry_run:
            return
        changed = msgspec.structs.replace(aircraft, calibration=calibration)
        with refusing():
            console.print(f"saved in {save_aircraft(settings, vehicle, changed)}")

    if log is not None:
        samples = _read_log(log, settings, vehicle)
        solve: Solve = lambda step, known: _log_step(step, samples, known, field_ut)  # noqa: E731
    else:
        serial = settings.serial
        serial = serial if port is None else msgspec.structs.replace(serial, port=port)
        capture = capture_from(serial, vehicle)
        solve = lambda step, known: live_step(step, capture, known, field_ut)  # noqa: E731
    _show(old, calibrate_each(chosen, solve, old, save))


def calibrate_each(
    steps: list[Step], solve: Solve, calibration: NodeCalibration, save: Save
) -> NodeCalibration:
    """Run the steps; each is saved when it is done, so aborting loses only the present one.

    A failed step is reported, and the next one starts.
    """
    for number, step in enumerate(steps):
        if len(steps) > 1:
            console.print(f"\nStep {number + 1} of {len(steps)}: {step}")
        try:
            calibration = solve(step, calibration)
        except CalibrationError as error:
            console.print(f"{step}: {error}", style="red")
        except (KeyboardInterrupt, typer.Abort):
            left = ", ".join(steps[number:])
            console.print(f"\nBroken off. Not done: {left}.", style="yellow")
            break
        else:
            console.print(f"{step}: done", style="green")
            save(calibration)
    return calibration


def live_step(
    step: Step, capture: Capture, calibration: NodeCalibration, field_ut: float | None
) -> NodeCalibration:
    """Ask for the poses of a step, and solve it; raises CalibrationError with advice."""
    match step:
        case Step.GYRO:
            _ask("Lay the aircraft down and do not touch it.")
            return calibrate_gyro(capture(REST_S), calibration)
        case Step.ACCEL:
            return calibrate_accelerometer(_six_sides(capture), calibration)
        case Step.MAG:
            _ask(
                "Away from iron, turn the aircraft slowly about all its axes, upside down too, "
                "until most sides were seen."
            )
            samples = capture(MAG_S, turned=True)
            return calibrate_magnetometer(samples, calibration, field_ut)
        case Step.MOUNTING:
            _ask("Set the aircraft level, as it flies.")
            level = capture(POSE_S)
            _ask("Raise the nose by 30 deg or more and hold it there.")
            return calibrate_mounting(level, capture(POSE_S), calibration)
        case Step.LEVEL:
            _ask("Set the aircraft level, as it flies.")
            return calibrate_level(capture(POSE_S), calibration)


def _six_sides(capture: Capture) -> list[NodeSamples]:
    """Collect poses until the node was laid on all its sides."""
    held: list[NodeSamples] = []
    for _ in range(MAX_TRIES):
        missing = missing_sides(held)
        if not missing:
            break
        done = len(SIDES) - len(missing)
        _ask(
            f"{done} of {len(SIDES)} sides are done. Lay the node on one of these and let it "
            f"go: {', '.join(missing)}."
        )
        samples = capture(POSE_S)
        if not is_still(samples):
            console.print("It moved; once more.")
        elif missing_sides([*held, samples]) == missing:
            console.print("That side was done before, or it is too far from upright; once more.")
        held.append(samples)
    return held


def _log_step(
    step: Step, samples: NodeSamples, calibration: NodeCalibration, field_ut: float | None
) -> NodeCalibration:
    match step:
        case Step.GYRO:
            return calibrate_gyro(samples, calibration)
        case Step.ACCEL:
            return calibrate_accelerometer([samples], calibration)
        case Step.MAG:
            return calibrate_magnetometer(samples, calibration, field_ut)
        case Step.MOUNTING | Step.LEVEL:
            raise CalibrationError("a recording does not show which pose was level")


def _read_log(path: Path, settings: GatewaySettings, vehicle: int) -> NodeSamples:
    raws, moving, fix = list[ImuRaw](), list[bool](), _Fix()
    with refusing():
        (path, *_) = files_of([path], folder_of(settings), "tables")
        table = open_rows(path, read_options(settings))
        for row in table.plain_rows:
            if row.gps is not None and row.gps.node.vehicle_id == vehicle:
                fix = _Fix(row.gps.time_us, _speed_mps(row.gps) > MOVING_MPS)
            if row.raw is not None and row.raw.node.vehicle_id == vehicle:
                raws.append(row.raw)
                moving.append(fix.moving and row.time_us - fix.time_us < MOVING_US)
    if not raws:
        refuse(f"{path}: it holds no raw IMU samples of vehicle {vehicle}")
    return node_samples(raws, moving)


@dataclass(frozen=True, slots=True)
class _Fix:
    """Data of the newest fix."""

    time_us: int = 0
    moving: bool = False


def _speed_mps(fix: GpsFix) -> float:
    north, east, _ = fix.vel_n_mps
    return math.hypot(north, east) if fix.fix_ok else 0.0


def capture_from(serial: SerialSettings, vehicle: int) -> Capture:
    """Return a capture from the receiver's port; ends the command if that cannot be opened."""
    try:
        # Nobody shall lay an aircraft on its sides for a port that is not there.
        device = asyncio.run(find_receiver(serial))
    except PortNotFoundError as error:
        refuse(str(error))
    serial = msgspec.structs.replace(serial, port=device)

    def capture(seconds: float, *, turned: bool = False) -> NodeSamples:
        return asyncio.run(_Listening(serial, vehicle, turned).listen(seconds))

    return capture


class _Listening:
    """Read the receiver until one aircraft's samples span a time, and cover most sides if asked."""

    def __init__(self, serial: SerialSettings, vehicle: int, turned: bool) -> None:
        self._serial, self._vehicle, self._turned = serial, vehicle, turned
        self._raws: list[ImuRaw] = []
        self._shown_s = 0.0
        label = "sides of the field seen" if turned else "listening"
        unit = f"{{task.completed:.0f}} of {FIELD_SIDES}" if turned else "{task.completed:.0f} s"
        self._bar = Progress(
            TextColumn(label), BarColumn(), TextColumn(unit),
            console=console, transient=True, auto_refresh=False, disable=not console.is_terminal,
        )  # fmt: skip

    async def listen(self, seconds: float) -> NodeSamples:
        clock, link, done = GatewayClock(), Link(), asyncio.Event()
        task = self._bar.add_task("", total=FIELD_SIDES if self._turned else seconds)

        def on_bytes(data: bytes, now_us: int) -> None:
            for record in link.feed(data, now_us):
                if isinstance(record, ImuRaw) and record.node.vehicle_id == self._vehicle:
                    self._raws.append(record)
            if self._is_done(seconds, task):
                done.set()

        port = SerialPort(self._serial, on_bytes, lambda _: None, lambda _: None, clock)
        port.start()
        limit_s = MAG_LIMIT_S if self._turned else seconds
        try:
            with self._bar:
                await asyncio.wait_for(done.wait(), limit_s + PATIENCE_S)
        except TimeoutError:
            refuse(f"no samples of vehicle {self._vehicle}: is it on, and the port right?")
        finally:
            port.close()
        return node_samples(self._raws)

    def _is_done(self, seconds: float, task: TaskID) -> bool:
        raws = self._raws
        span_s = (raws[-1].time_us - raws[0].time_us) / US_PER_S if raws else 0.0
        if not self._turned:
            self._bar.update(task, completed=min(span_s, seconds), refresh=True)
            return span_s > seconds
        if span_s < self._shown_s + SIDES_EVERY_S:
            return False
        self._shown_s = span_s
        sides = field_sides(node_samples(raws))
        self._bar.update(task, completed=sides, refresh=True)
        return span_s > MAG_LIMIT_S or (span_s > seconds and sides >= MAG_SIDES)


def _ask(text: str) -> None:
    console.print(f"\n{text}", style="bold")
    typer.prompt("Enter when ready", default="", show_default=False)


def _show(old: NodeCalibration, new: NodeCalibration) -> None:
    """Print what changed."""
    table = Table(box=box.SIMPLE_HEAD)
    for column in ("setting", "before", "after"):
        table.add_column(column)
    for name in new.__struct_fields__:
        before, after = getattr(old, name), getattr(new, name)
        if before != after:
            table.add_row(name, _text(before), _text(after))
    console.print(table if table.row_count else "nothing changed")


def _text(value: object) -> str:
    if isinstance(value, tuple):
        inner = ", ".join(_text(item) for item in value)
        return f"({inner})"
    return f"{value:.5g}" if isinstance(value, float) else str(value)
