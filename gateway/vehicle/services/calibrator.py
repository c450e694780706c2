"""Calibration on command, from samples that have the present calibration.

| command                     | what the operator does                | what is solved       |
| --------------------------- | ------------------------------------- | -------------------- |
| PREFLIGHT_CALIBRATION 1 = 1 | leave it at rest, 3 s                 | gyroscope bias       |
| PREFLIGHT_CALIBRATION 5 = 2 | leave it level and at rest, 3 s       | tilt of the mounting |
| PREFLIGHT_CALIBRATION 5 = 4 | leave it level and at rest, 3 s       | accelerometer bias   |
| PREFLIGHT_CALIBRATION 5 = 1 | rest it on each of its six sides      | bias and scale       |
| PREFLIGHT_CALIBRATION 2 = 1 | turn it about all axes, up to 1 min   | hard and soft iron   |
| FIXED_MAG_CAL_YAW           | leave it at rest at a heading, 3 s    | hard iron            |

`gateway.sensing.calibrating` solves them. None is done in flight.

Progress goes out as COMMAND_ACK (in progress) and as the `[cal]` texts that ground stations read;
the result is an action, because the calibration belongs to another stage.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from gateway.geometry.geomagnetism import MagneticField, magnetic_field, year_of
from gateway.records import ImuSample, NavFlags, NavState
from gateway.sensing.calibrating import (
    IN_BODY_AXES,
    CalibrationError,
    MoreNeeded,
    NodeSamples,
    calibrate_accelerometer,
    calibrate_accelerometer_level,
    calibrate_gyro,
    calibrate_level,
    calibrate_magnetometer,
    calibrate_magnetometer_by_yaw,
    sides_of,
    still_windows,
)
from gateway.sensing.calibration import NodeCalibration
from gateway.units import US_PER_S
from gateway.vehicle.requested_messages import whole
from gateway.vehicle.service import INFO, Answer, CalibrationMeasured, Service, StatusText
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    FAILED,
    IN_PROGRESS,
    NOT_NOW,
    UNSUPPORTED,
    Command,
    Outcome,
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
"""The lower side when +x, -x, +y, -y, +z, -z measures plus one gravity; level is "down"."""


Method = Callable[[NodeSamples, NodeCalibration], NodeCalibration]

METHODS: Final[dict[tuple[int, int, int], tuple[str, Method | None]]] = {
    (1, 0, 0): ("gyro", calibrate_gyro),
    (0, 0, 2): ("level", calibrate_level),
    (0, 0, 4): ("accel", calibrate_accelerometer_level),
    (0, 0, 1): ("accel", None),
    (0, 1, 0): ("mag", None),
}
"""Kind by the parameters 1, 2 and 5 of PREFLIGHT_CALIBRATION; with its solver if one rest
suffices."""


@dataclass(slots=True)
class _Run:
    kind: str
    at_rest: Method | None
    method: tuple[float, ...]
    """The parameters that request it."""
    command: Command
    began_us: int
    samples: list[ImuSample] = field(default_factory=list)
    mag: list[ImuSample] = field(default_factory=list)
    """Those of the samples that have a field."""
    poses: list[NodeSamples] = field(default_factory=list)
    """Samples of each side that it rested on."""
    progress: int = 0

    @property
    def has_sides(self) -> bool:
        """Whether the operator rests it on six sides."""
        return self.kind == "accel" and self.at_rest is None

    @property
    def deadline_us(self) -> int:
        return self.began_us + (SIX_SIDES_TIMEOUT_US if self.has_sides else TIMEOUT_US)

    def add(self, sample: ImuSample) -> int:
        """Collect a sample; return the time that all samples span."""
        self.samples.append(sample)
        if sample.mag_b_ut is not None and len(self.mag) < MAG_SAMPLES:
            self.mag.append(sample)
        return sample.time_us - self.samples[0].time_us

    def collected(self) -> NodeSamples:
        """Return the collected samples, in body axes, and start again."""
        found = NodeSamples(
            time_s=np.array([sample.time_us for sample in self.samples]) / US_PER_S,
            accel=np.array([sample.accel_b_mps2 for sample in self.samples]),
            gyro=np.array([sample.gyro_b_radps for sample in self.samples]),
            mag_time_s=np.array([sample.time_us for sample in self.mag]) / US_PER_S,
            mag=np.array([sample.mag_b_ut for sample in self.mag], float).reshape(-1, 3),
            moving=np.zeros(len(self.samples), np.bool_),
        )
        self.samples, self.mag = [], []
        return found


class Calibrator(Service):
    """At most one calibration at a time, and none in flight.

    The field of the Earth is looked up at the position of the newest estimate, if there is one.
    """

    def __init__(self, in_flight: Callable[[], bool], state: Callable[[], NavState | None]) -> None:
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
        if asked in METHODS:
            return self._begin(_Run(*METHODS[asked], asked, command, now_us))
        if any(whole(value) for value in command.params):
            return UNSUPPORTED, []
        run, self._run = self._run, None
        return ACCEPTED, _text("calibration cancelled") if run else []

    def start_by_yaw(self, command: Command, now_us: int) -> Outcome:
        """Carry out MAV_CMD_FIXED_MAG_CAL_YAW: parameter 1 is the heading in deg."""
        yaw_deg = command.params[0]
        if not math.isfinite(yaw_deg):
            return UNSUPPORTED, []

        def solve(samples: NodeSamples, calibration: NodeCalibration) -> NodeCalibration:
            there, yaw_rad = self._field_at(command), math.radians(yaw_deg)
            return calibrate_magnetometer_by_yaw(samples, calibration, yaw_rad, there)

        return self._begin(_Run("mag", solve, (yaw_deg,), command, now_us))

    def _begin(self, run: _Run) -> Outcome:
        if self._in_flight():
            return DENIED, _text("calibration failed: in flight")
        if self._run is not None:
            return (IN_PROGRESS if run.method == self._run.method else NOT_NOW), []
        self._run = run
        return IN_PROGRESS, _text(f"calibration started: 2 {run.kind}")

    def on_sample(self, sample: ImuSample) -> list[Answer]:
        """Process a calibrated sample during a calibration."""
        if (run := self._run) is None:
            return []
        if self._in_flight():
            return self._fail("in flight")
        passed_us = run.add(sample)
        if run.has_sides:
            return self._on_side(run) if passed_us > SIDE_US else []
        if run.at_rest is None:
            return self._on_mag(run, passed_us) if sample.mag_b_ut is not None else []
        if passed_us <= REST_US:
            return self._announce(run, min(99, 100 * passed_us // REST_US))
        return self._solve(run, run.collected())

    def poll(self, now_us: int) -> list[Answer]:
        """End a calibration that takes too long."""
        is_late = self._run is not None and now_us >= self._run.deadline_us
        return self._fail("timed out") if is_late else []

    def next_due_us(self) -> int | None:
        """Return when to give up."""
        return self._run.deadline_us if self._run else None

    def _solve(self, run: _Run, samples: NodeSamples) -> list[Answer]:
        """Solve one rest, or the poses if there is no method for one."""
        try:
            if run.at_rest is None:
                return self._done(run, calibrate_accelerometer(run.poses, IN_BODY_AXES))
            return self._done(run, run.at_rest(samples, IN_BODY_AXES))
        except CalibrationError as error:
            return self._fail(str(error) if still_windows(samples) else MOVED)

    def _field_at(self, command: Command) -> MagneticField:
        """Return the field of the Earth at the location of the command, or of the estimate."""
        state, (lat_deg, lon_deg, _) = self._state(), command.location
        if not (lat_deg or lon_deg) and state and NavFlags.POSITION_VALID in state.flags:
            lat_deg, lon_deg = state.lat_deg, state.lon_deg
        if not (lat_deg or lon_deg):
            raise CalibrationError("no position: wait for GPS, or give latitude and longitude")
        return magnetic_field(lat_deg, lon_deg, 0.0, year_of(None))

    def _on_side(self, run: _Run) -> list[Answer]:
        samples, before = run.collected(), sides_of(run.poses)
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
            field = np.array([sample.mag_b_ut for sample in run.mag])
            return self._done(run, calibrate_magnetometer(field, IN_BODY_AXES))
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
        measured = CalibrationMeasured(correction)
        return [measured, run.command.ack(ACCEPTED), *_text(f"calibration done: {run.kind}")]

    def _fail(self, why: str) -> list[Answer]:
        run, self._run = self._run, None
        return [*([run.command.ack(FAILED)] if run else []), *_text(f"calibration failed: {why}")]


def _text(text: str) -> list[Answer]:
    return chunks(StatusText(INFO, f"[cal] {text}"))
