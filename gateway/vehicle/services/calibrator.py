"""Calibration on command, of the samples as they are calibrated now.

| command                     | what the operator does                | what is solved       |
| --------------------------- | ------------------------------------- | -------------------- |
| PREFLIGHT_CALIBRATION 1 = 1 | leave it at rest, 3 s                 | gyroscope bias       |
| PREFLIGHT_CALIBRATION 5 = 2 | leave it level and at rest, 3 s       | tilt of the mounting |
| PREFLIGHT_CALIBRATION 5 = 4 | leave it level and at rest, 3 s       | accelerometer bias   |
| PREFLIGHT_CALIBRATION 5 = 1 | rest it on each of its six sides      | the same, and scale  |
| PREFLIGHT_CALIBRATION 2 = 1 | turn it about all axes, up to 1 min   | hard and soft iron   |
| FIXED_MAG_CAL_YAW           | leave it at rest at a heading, 3 s    | hard iron            |

`gateway.sensing.calibrating` solves them. None is done in flight, where nothing is at rest.

Progress goes out as COMMAND_ACK (in progress) and as the `[cal]` texts that ground stations read;
the result is an action, because the calibration belongs to another stage.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gateway.geometry.geomagnetism import magnetic_field, year_of
from gateway.records import ImuSample, NavFlags, NavState, Vec3
from gateway.sensing.calibrating import (
    IN_BODY_AXES,
    CalibrationError,
    MoreNeeded,
    NodeSamples,
    calibrate_accelerometer,
    calibrate_accelerometer_level,
    calibrate_gyro,
    calibrate_level,
    calibrate_magnetometer_by_yaw,
    sides_of,
    solve_magnetometer,
    still_windows,
    with_magnetometer,
)
from gateway.sensing.calibration import NodeCalibration
from gateway.units import US_PER_S
from gateway.vehicle.requests import (
    INFO,
    Answer,
    CalibrationKind,
    CalibrationMeasured,
    Reply,
    Service,
    StatusText,
)
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    FAILED,
    IN_PROGRESS,
    NOT_NOW,
    UNSUPPORTED,
    Command,
    Outcome,
    whole,
)
from gateway.vehicle.telemetry.announcements import chunks

FIXED_MAG_CAL_YAW: Final = 42006
"""MAV_CMD_FIXED_MAG_CAL_YAW, of the dialect ardupilotmega."""
REST_US: Final = 3 * US_PER_S
SIDE_US: Final = US_PER_S
MAG_MIN_US: Final = 10 * US_PER_S
TIMEOUT_US: Final = 60 * US_PER_S
SIX_SIDES_TIMEOUT_US: Final = 180 * US_PER_S
MAG_SAMPLES: Final = 2000
FIT_EVERY: Final = 50
MOVED: Final = "it was moved"

SIDES: Final = ("back", "front", "left", "right", "up", "down")
"""Which side lies below when +x, -x, +y, -y, +z, -z reads plus one gravity; level is "down"."""


@dataclass(slots=True)
class _Run:
    kind: CalibrationKind
    command: Command
    began_us: int
    six_sides: bool = False
    simple: bool = False
    yaw_rad: float | None = None
    times_us: list[int] = field(default_factory=list)
    gyro: list[Vec3] = field(default_factory=list)
    accel: list[Vec3] = field(default_factory=list)
    mag: list[Vec3] = field(default_factory=list)
    mag_times_us: list[int] = field(default_factory=list)
    poses: list[NodeSamples] = field(default_factory=list)
    """Of each side that it lay on."""
    progress: int = 0

    @property
    def deadline_us(self) -> int:
        return self.began_us + (SIX_SIDES_TIMEOUT_US if self.six_sides else TIMEOUT_US)

    def take(self, sample: ImuSample) -> int:
        """Collect a sample; return how long they span."""
        self.times_us.append(sample.time_us)
        self.gyro.append(sample.gyro_b_radps)
        self.accel.append(sample.accel_b_mps2)
        if sample.mag_b_ut is not None and len(self.mag) < MAG_SAMPLES:
            self.mag.append(sample.mag_b_ut)
            self.mag_times_us.append(sample.time_us)
        return sample.time_us - self.times_us[0]

    def samples(self) -> NodeSamples:
        """Return what was collected, in body axes, and start again."""
        found = NodeSamples(
            time_s=np.array(self.times_us) / US_PER_S,
            accel=np.array(self.accel),
            gyro=np.array(self.gyro),
            mag_time_s=np.array(self.mag_times_us) / US_PER_S,
            mag=np.array(self.mag, float).reshape(-1, 3),
            moving=np.zeros(len(self.times_us), np.bool_),
        )
        for collected in (self.times_us, self.accel, self.gyro, self.mag, self.mag_times_us):
            collected.clear()
        return found


class Calibrator(Service):
    """At most one calibration at a time.

    Parameters
    ----------
    vehicle_id : int
        Whose sensors they are.
    in_flight : callable
        Whether it flies.
    state : callable
        The newest estimate, if there is any: where the field of the Earth is looked up.
    """

    def __init__(
        self,
        vehicle_id: int,
        in_flight: Callable[[], bool],
        state: Callable[[], NavState | None] = lambda: None,
    ) -> None:
        self._vehicle_id = vehicle_id
        self._in_flight = in_flight
        self._state = state
        self._run: _Run | None = None

    @property
    def busy(self) -> bool:
        """Whether a calibration is under way."""
        return self._run is not None

    def start(self, command: Command, now_us: int) -> Outcome:
        """Carry out MAV_CMD_PREFLIGHT_CALIBRATION; all zero cancels."""
        asked = (whole(command.params[0]), whole(command.params[1]), whole(command.params[4]))
        run = {
            (1, 0, 0): _Run(CalibrationKind.GYRO, command, now_us),
            (0, 1, 0): _Run(CalibrationKind.MAG, command, now_us),
            (0, 0, 1): _Run(CalibrationKind.ACCEL, command, now_us, six_sides=True),
            (0, 0, 2): _Run(CalibrationKind.LEVEL, command, now_us),
            (0, 0, 4): _Run(CalibrationKind.ACCEL, command, now_us, simple=True),
        }.get(asked)
        if run is None:
            nothing = not any(whole(value) for value in command.params)
            return (ACCEPTED, self._cancel()) if nothing else (UNSUPPORTED, [])
        return self._begin(run)

    def start_by_yaw(self, command: Command, now_us: int) -> Outcome:
        """Carry out MAV_CMD_FIXED_MAG_CAL_YAW: parameter 1 is the heading in deg."""
        yaw_deg = command.params[0]
        if not math.isfinite(yaw_deg):
            return UNSUPPORTED, []
        yaw_rad = math.radians(yaw_deg)
        return self._begin(_Run(CalibrationKind.MAG, command, now_us, yaw_rad=yaw_rad))

    def _begin(self, run: _Run) -> Outcome:
        if self._in_flight():
            return DENIED, _text("calibration failed: in flight")
        if (old := self._run) is not None:
            same = (old.kind, old.six_sides, old.simple, old.yaw_rad)
            again = same == (run.kind, run.six_sides, run.simple, run.yaw_rad)
            return (IN_PROGRESS if again else NOT_NOW), []
        self._run = run
        return IN_PROGRESS, _text(f"calibration started: 2 {run.kind}")

    def on_sample(self, sample: ImuSample) -> list[Answer]:
        """Take in one calibrated sample while a calibration is under way."""
        run = self._run
        if run is None:
            return []
        if self._in_flight():
            return self._fail("in flight")
        passed_us = run.take(sample)
        if run.kind is CalibrationKind.MAG and run.yaw_rad is None:
            return self._on_mag(run, passed_us) if sample.mag_b_ut is not None else []
        if run.six_sides:
            return self._on_side(run) if passed_us > SIDE_US else []
        if passed_us <= REST_US:
            return self._announce(run, min(99, 100 * passed_us // REST_US))
        return self._solve(run, run.samples())

    def poll(self, now_us: int) -> list[Answer]:
        """End a calibration that takes too long."""
        if self._run is None or now_us < self._run.deadline_us:
            return []
        return self._fail("timed out")

    def next_due_us(self) -> int | None:
        """Return when to give up."""
        return self._run.deadline_us if self._run else None

    def _solve(self, run: _Run, samples: NodeSamples) -> list[Answer]:
        try:
            return self._done(run, self._correction(run, samples))
        except CalibrationError as error:
            return self._fail(str(error) if still_windows(samples) else MOVED)

    def _correction(self, run: _Run, samples: NodeSamples) -> NodeCalibration:
        if run.kind is CalibrationKind.GYRO:
            return calibrate_gyro(samples, IN_BODY_AXES)
        if run.kind is CalibrationKind.LEVEL:
            return calibrate_level(samples, IN_BODY_AXES)
        if run.simple:
            return calibrate_accelerometer_level(samples, IN_BODY_AXES)
        if run.yaw_rad is None:
            return calibrate_accelerometer(run.poses, IN_BODY_AXES)
        lat_deg, lon_deg, _ = run.command.location
        state = self._state()
        if (
            not (lat_deg or lon_deg)
            and state is not None
            and NavFlags.POSITION_VALID in state.flags
        ):
            lat_deg, lon_deg = state.lat_deg, state.lon_deg
        if not (lat_deg or lon_deg):
            raise CalibrationError("no position: wait for GPS, or give latitude and longitude")
        there = magnetic_field(lat_deg, lon_deg, 0.0, year_of(None))
        return calibrate_magnetometer_by_yaw(samples, IN_BODY_AXES, run.yaw_rad, there)

    def _on_side(self, run: _Run) -> list[Answer]:
        samples, before = run.samples(), sides_of(run.poses)
        new = sides_of([samples]) - before
        if not new:
            return []
        run.poses.append(samples)
        if len(before) + 1 == len(SIDES):
            return self._solve(run, samples)
        texts = _text(f"{SIDES[new.pop()]} side done, rotate to a different side")
        return texts + self._announce(run, 100 * (len(before) + 1) // len(SIDES))

    def _on_mag(self, run: _Run, passed_us: int) -> list[Answer]:
        if passed_us < MAG_MIN_US or len(run.mag) % FIT_EVERY:
            return self._announce(run, min(90, 100 * passed_us // TIMEOUT_US))
        try:
            fit = solve_magnetometer(np.array(run.mag))
            return self._done(run, with_magnetometer(IN_BODY_AXES, fit))
        except MoreNeeded:
            is_full = len(run.mag) >= MAG_SAMPLES
            return self._fail("turn it about all axes") if is_full else []
        except CalibrationError as error:
            return self._fail(str(error))

    def _announce(self, run: _Run, percent: int) -> list[Answer]:
        step = percent // 10 * 10
        if step <= run.progress:
            return []
        run.progress = step
        return [run.command.ack(IN_PROGRESS, step), *_text(f"progress <{step}>")]

    def _done(self, run: _Run, correction: NodeCalibration) -> list[Answer]:
        self._run = None
        measured = CalibrationMeasured(self._vehicle_id, run.kind, correction)
        return [measured, run.command.ack(ACCEPTED), *_text(f"calibration done: {run.kind}")]

    def _fail(self, why: str) -> list[Answer]:
        run, self._run = self._run, None
        ack = [run.command.ack(FAILED)] if run else []
        return [*ack, *_text(f"calibration failed: {why}")]

    def _cancel(self) -> list[Answer]:
        run, self._run = self._run, None
        return _text("calibration cancelled") if run else []


def _text(text: str) -> list[Answer]:
    return [Reply(message) for message in chunks(StatusText(INFO, f"[cal] {text}"))]
