"""`mavgate calibrate`: guide a person through a node's calibration, live or from a recording."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import msgspec
import typer
from rich import box
from rich.table import Table

from gateway.cli.live.run import ConfigOption, read_aircraft, read_settings
from gateway.cli.support.errors import refuse
from gateway.cli.support.recording_options import refusing
from gateway.cli.support.terminal import console_of
from gateway.config import GatewaySettings, save_aircraft
from gateway.edges.clock import GatewayClock
from gateway.edges.receiver.serial_port import SerialPort, SerialSettings
from gateway.flights.reading import ReadOptions, open_rows
from gateway.pipeline import PipelineSettings
from gateway.records import ImuRaw
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.procedure import (
    calibrate_accelerometer,
    calibrate_gyro,
    calibrate_level,
    calibrate_magnetometer,
    calibrate_mounting,
    is_still,
    seen_poses,
)
from gateway.sensing.solvers import MIN_POSES, CalibrationError, NodeSamples, node_samples
from gateway.units import US_PER_S
from gateway.wire.link import Link

PATIENCE_S: Final = 10.0
"""Without a sample for so long, nothing will come."""
POSE_S: Final = 3.0
REST_S: Final = 5.0
MAG_S: Final = 45.0
MAX_TRIES: Final = 24

console = console_of()


class Step(StrEnum):
    """What can be calibrated."""

    GYRO = "gyro"
    ACCEL = "accel"
    MAG = "mag"
    MOUNTING = "mounting"
    LEVEL = "level"


Capture = Callable[[float], NodeSamples]
"""Waits for so many seconds of samples."""


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("calibrate")(calibrate)


def calibrate(
    steps: Annotated[
        list[Step] | None, typer.Argument(help="Which; by default gyro accel mag level.")
    ] = None,
    *,
    vehicle: Annotated[int, typer.Option("--vehicle", min=1, max=31, help="Its id.")] = 1,
    log: Annotated[
        Path | None,
        typer.Option("--log", help="Solve what a recording holds, in place of the live link."),
    ] = None,
    port: Annotated[
        str | None, typer.Option("--port", "-p", help="Receiver's port, in place of the settings'.")
    ] = None,
    field_ut: Annotated[
        float | None,
        typer.Option("--field", min=10.0, max=100.0, help="Strength of the field here, uT."),
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show, but do not save.")] = False,
    config: ConfigOption = None,
) -> None:
    """Calibrate an aircraft's sensors and save the result with its residuals.

    The gateway must not run meanwhile: the receiver's port is read by one program at a time.
    """
    settings = read_settings(config)
    aircraft = read_aircraft(settings).get(vehicle, settings.default_aircraft)
    chosen = steps or [Step.GYRO, Step.ACCEL, Step.MAG, Step.LEVEL]
    old = aircraft.calibration
    if log is not None:
        samples = _read_log(log, settings, vehicle)
        new = _each(chosen, lambda step, known: _log_step(step, samples, known, field_ut), old)
    else:
        serial = settings.serial
        serial = serial if port is None else msgspec.structs.replace(serial, port=port)
        capture = _capture_from(serial, vehicle)
        new = _each(chosen, lambda step, known: _live_step(step, capture, known, field_ut), old)
    _show(old, new)
    if new == old or dry_run:
        return
    changed = msgspec.structs.replace(aircraft, calibration=new)
    with refusing():
        console.print(f"saved in {save_aircraft(settings, vehicle, changed)}")


def _each(
    steps: list[Step],
    solve: Callable[[Step, NodeCalibration], NodeCalibration],
    calibration: NodeCalibration,
) -> NodeCalibration:
    """Go through the steps; one that fails is said and the others go on."""
    for step in steps:
        try:
            calibration = solve(step, calibration)
            console.print(f"[green]{step}: done[/]")
        except CalibrationError as error:
            console.print(f"[red]{step}: {error}[/]")
    return calibration


def _live_step(
    step: Step, capture: Capture, calibration: NodeCalibration, field_ut: float | None
) -> NodeCalibration:
    match step:
        case Step.GYRO:
            _ask("Lay the aircraft down and do not touch it.")
            return calibrate_gyro(capture(REST_S), calibration)
        case Step.ACCEL:
            return calibrate_accelerometer(_six_sides(capture), calibration)
        case Step.MAG:
            _ask(
                f"Away from iron, turn the aircraft slowly about all its axes for {MAG_S:.0f} s, "
                "upside down too."
            )
            return calibrate_magnetometer(capture(MAG_S), calibration, field_ut)
        case Step.MOUNTING:
            _ask("Set the aircraft level, as it flies.")
            level = capture(POSE_S)
            _ask("Raise the nose by 30 deg or more and hold it there.")
            return calibrate_mounting(level, capture(POSE_S), calibration)
        case Step.LEVEL:
            _ask("Set the aircraft level, as it flies.")
            return calibrate_level(capture(POSE_S), calibration)


def _six_sides(capture: Capture) -> list[NodeSamples]:
    """Collect poses until all six sides were held; more of them make a better fit."""
    held: list[NodeSamples] = []
    for _ in range(MAX_TRIES):
        count = seen_poses(held)
        if count >= MIN_POSES:
            break
        _ask(f"Side {count + 1} of {MIN_POSES}: lay the node on another of its sides.")
        samples = capture(POSE_S)
        if not is_still(samples):
            console.print("It moved; once more.")
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
            raise CalibrationError("a recording does not tell which pose was level")


def _read_log(path: Path, settings: GatewaySettings, vehicle: int) -> NodeSamples:
    with refusing():
        table = open_rows(path, ReadOptions(current=PipelineSettings(settings.default_aircraft)))
        raws = [
            row.raw
            for row in table.plain_rows
            if row.raw is not None and row.raw.node.vehicle_id == vehicle
        ]
    if not raws:
        refuse(f"{path}: it holds no raw IMU samples of vehicle {vehicle}")
    return node_samples(raws)


def _capture_from(serial: SerialSettings, vehicle: int) -> Capture:
    return lambda seconds: node_samples(asyncio.run(_Listening(serial, vehicle).listen(seconds)))


@dataclass(slots=True)
class _Listening:
    """Reads the receiver until one aircraft's samples span a time."""

    serial: SerialSettings
    vehicle: int

    async def listen(self, seconds: float) -> list[ImuRaw]:
        clock, link, raws = GatewayClock(), Link(), list[ImuRaw]()
        done = asyncio.Event()

        def on_bytes(data: bytes, now_us: int) -> None:
            for record in link.feed(data, now_us):
                if isinstance(record, ImuRaw) and record.node.vehicle_id == self.vehicle:
                    raws.append(record)
            if raws and raws[-1].time_us - raws[0].time_us > seconds * US_PER_S:
                done.set()

        port = SerialPort(self.serial, on_bytes, lambda _: None, lambda _: None, clock)
        port.start()
        try:
            await asyncio.wait_for(done.wait(), seconds + PATIENCE_S)
        except TimeoutError:
            refuse(f"no samples of vehicle {self.vehicle}: is it on, and the port right?")
        finally:
            port.close()
        return raws


def _ask(text: str) -> None:
    console.print(f"\n[bold]{text}[/]")
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
