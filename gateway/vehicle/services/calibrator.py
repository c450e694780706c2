"""Calibration on command: measure the remaining error of the calibrated samples.

| command            | what the operator does                   | what is measured                |
| ------------------ | ---------------------------------------- | ------------------------------- |
| param1 = 1, gyro   | leave it at rest, 3 s                    | mean rate: the bias             |
| param5 = 2, level  | leave it level and at rest, 3 s          | roll and pitch of the mounting  |
| param5 = 4, accel  | leave it level and at rest, 3 s          | mean less gravity: the bias     |
| param5 = 1, accel  | rest it on each of its six sides in turn | middle of the extremes, by axis |
| param2 = 1, mag    | turn it about all axes, up to a minute   | centre of the sphere            |

None is done in flight, where nothing is at rest. An error larger than any intact sensor of the
kind has is refused: then the aircraft moved.

Progress goes out as COMMAND_ACK (in progress) and as the `[cal]` texts that ground stations read;
the result is an action, because the calibration belongs to another stage.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.records import ImuSample, Vec3
from gateway.units import RAD_PER_DEG, STANDARD_GRAVITY_MPS2, US_PER_S
from gateway.vehicle.actions import (
    INFO,
    Answer,
    CalibrationKind,
    CalibrationMeasured,
    Reply,
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

REST_US: Final = 3 * US_PER_S
SIDE_US: Final = US_PER_S
MAG_MIN_US: Final = 10 * US_PER_S
TIMEOUT_US: Final = 60 * US_PER_S
SIX_SIDES_TIMEOUT_US: Final = 180 * US_PER_S

MAX_REST_GYRO_RADPS: Final = 0.05
"""Standard deviation; hand-held trembling is above, an idling engine may be too."""
MAX_REST_ACCEL_MPS2: Final = 0.5
MAX_FIELD_DRIFT_UTPS: Final = 0.2
"""A steady turn is as quiet as a rest, but the field turns: 0.6 deg/s at mid latitudes."""
MIN_FIELD_SAMPLES: Final = 20
MOST: Final = {
    CalibrationKind.GYRO: (20.0 * RAD_PER_DEG, "it turned"),
    CalibrationKind.ACCEL: (2.0, "it was moved or not level"),
    CalibrationKind.LEVEL: (30.0 * RAD_PER_DEG, "it was not level"),
    CalibrationKind.MAG: (200.0, "iron or a current is near"),
}
"""Greatest error along an axis, and the likely cause of a greater one. The first two are the
limits of the MPU6050's data sheet, doubled for the accelerometer because of soldering."""
FIELD_UT: Final = (15.0, 100.0)
"""Strength of the Earth's field, a scale that is off by a third included."""
MAX_FIELD_RESIDUAL: Final = 0.1
"""Deviation of the field's strength, as a share of it."""
SIDE_SHARE: Final = 0.9
"""Share of gravity that one axis must carry for the aircraft to lie on that side."""
MIN_SPREAD: Final = 1.2
"""Least spread of the field along each axis, in radii of the sphere: 2 is all round."""
MAG_SAMPLES: Final = 2000
MIN_MAG_SAMPLES: Final = 100
FIT_EVERY: Final = 50

SIDES: Final = ("back", "front", "left", "right", "up", "down")
"""Which side lies below when +x, -x, +y, -y, +z, -z reads plus one gravity; level is "down"."""


@dataclass(slots=True)
class _Run:
    kind: CalibrationKind
    command: Command
    began_us: int
    six_sides: bool = False
    window_us: int | None = None
    gyro: list[Vec3] = field(default_factory=list)
    accel: list[Vec3] = field(default_factory=list)
    mag: list[Vec3] = field(default_factory=list)
    mag_times_us: list[int] = field(default_factory=list)
    sides: dict[int, Vec3] = field(default_factory=dict)
    progress: int = 0

    @property
    def deadline_us(self) -> int:
        return self.began_us + (SIX_SIDES_TIMEOUT_US if self.six_sides else TIMEOUT_US)


class Calibrator:
    """At most one calibration at a time."""

    def __init__(self, vehicle_id: int, in_flight: Callable[[], bool]) -> None:
        self._vehicle_id = vehicle_id
        self._in_flight = in_flight
        self._run: _Run | None = None

    @property
    def busy(self) -> bool:
        """Whether a calibration is under way."""
        return self._run is not None

    def start(self, command: Command, now_us: int) -> Outcome:
        """Carry out MAV_CMD_PREFLIGHT_CALIBRATION; all zero cancels."""
        gyro, mag = whole(command.params[0]), whole(command.params[1])
        accel = whole(command.extra[0])
        asked = {
            (1, 0, 0): (CalibrationKind.GYRO, False),
            (0, 1, 0): (CalibrationKind.MAG, False),
            (0, 0, 1): (CalibrationKind.ACCEL, True),
            (0, 0, 2): (CalibrationKind.LEVEL, False),
            (0, 0, 4): (CalibrationKind.ACCEL, False),
        }.get((gyro, mag, accel))
        if asked is None:
            values = (*command.params, *command.extra, command.height_m)
            nothing = not any(whole(value) for value in values)
            return (ACCEPTED, self._cancel()) if nothing else (UNSUPPORTED, [])
        if self._in_flight():
            return DENIED, _text("calibration failed: in flight")
        kind, six_sides = asked
        if self._run is not None:
            again = (self._run.kind, self._run.six_sides) == asked
            return (IN_PROGRESS if again else NOT_NOW), []
        self._run = _Run(kind, command, now_us, six_sides)
        return IN_PROGRESS, _text(f"calibration started: 2 {kind}")

    def on_sample(self, sample: ImuSample) -> list[Answer]:
        """Take in one calibrated sample while a calibration is under way."""
        run = self._run
        if run is None:
            return []
        if self._in_flight():
            return self._fail("in flight")
        if run.kind is CalibrationKind.MAG:
            return self._on_mag(run, sample)
        if sample.mag_b_ut is not None and not run.six_sides:
            run.mag.append(sample.mag_b_ut)
            run.mag_times_us.append(sample.time_us)
        if run.window_us is None:
            run.window_us = sample.time_us
        run.gyro.append(sample.gyro_b_radps)
        run.accel.append(sample.accel_b_mps2)
        length_us = SIDE_US if run.six_sides else REST_US
        passed_us = sample.time_us - run.window_us
        if passed_us >= length_us:
            return self._on_window(run)
        return [] if run.six_sides else self._announce(run, 100 * passed_us // length_us)

    def poll(self, now_us: int) -> list[Answer]:
        """End a calibration that takes too long."""
        if self._run is None or now_us < self._run.deadline_us:
            return []
        return self._fail("timed out")

    def next_due_us(self) -> int | None:
        """Return when to give up."""
        return self._run.deadline_us if self._run else None

    def _on_window(self, run: _Run) -> list[Answer]:
        gyro, accel = np.array(run.gyro), np.array(run.accel)
        run.gyro.clear()
        run.accel.clear()
        run.window_us = None
        at_rest = (
            float(gyro.std(axis=0).max()) < MAX_REST_GYRO_RADPS
            and float(accel.std(axis=0).max()) < MAX_REST_ACCEL_MPS2
        )
        if run.six_sides:
            return self._on_side(run, accel.mean(axis=0)) if at_rest else []
        if not at_rest or _field_turns(run):
            return self._fail("it was moved")
        if run.kind is CalibrationKind.GYRO:
            return self._done(run, _vector(gyro.mean(axis=0)))
        mean = _vector(accel.mean(axis=0))
        if run.kind is CalibrationKind.LEVEL:
            return self._done(run, _tilt(mean))
        return self._done(run, (mean[0], mean[1], mean[2] + STANDARD_GRAVITY_MPS2))

    def _on_side(self, run: _Run, mean: NDArray[np.float64]) -> list[Answer]:
        axis = int(np.abs(mean).argmax())
        if abs(float(mean[axis])) < SIDE_SHARE * STANDARD_GRAVITY_MPS2:
            return []
        side = 2 * axis + (float(mean[axis]) < 0.0)
        if side in run.sides:
            return []
        run.sides[side] = _vector(mean)
        if len(run.sides) == len(SIDES):
            low = [run.sides[2 * n + 1][n] for n in range(3)]
            high = [run.sides[2 * n][n] for n in range(3)]
            x, y, z = (0.5 * (a + b) for a, b in zip(low, high, strict=True))
            return self._done(run, (x, y, z))
        texts = _text(f"{SIDES[side]} side done, rotate to a different side")
        return texts + self._announce(run, 100 * len(run.sides) // len(SIDES))

    def _on_mag(self, run: _Run, sample: ImuSample) -> list[Answer]:
        if sample.mag_b_ut is None:
            return []
        if len(run.mag) < MAG_SAMPLES:
            run.mag.append(sample.mag_b_ut)
        passed_us = sample.time_us - run.began_us
        enough = len(run.mag) >= MIN_MAG_SAMPLES and len(run.mag) % FIT_EVERY == 0
        if not enough or passed_us < MAG_MIN_US:
            return self._announce(run, min(90, 100 * passed_us // TIMEOUT_US))
        points = np.array(run.mag)
        centre, radius = fit_sphere(points)
        if not math.isfinite(radius) or np.ptp(points, axis=0).min() < MIN_SPREAD * radius:
            return self._fail("turn it about all axes") if len(run.mag) >= MAG_SAMPLES else []
        residual = float(np.std(np.linalg.norm(points - centre, axis=1)))
        is_earths = FIELD_UT[0] <= radius <= FIELD_UT[1] and residual <= MAX_FIELD_RESIDUAL * radius
        return self._done(run, centre) if is_earths else self._fail(MOST[run.kind][1])

    def _announce(self, run: _Run, percent: int) -> list[Answer]:
        step = percent // 10 * 10
        if step <= run.progress:
            return []
        run.progress = step
        return [run.command.ack(IN_PROGRESS, step), *_text(f"progress <{step}>")]

    def _done(self, run: _Run, error_b: Vec3) -> list[Answer]:
        most, why = MOST[run.kind]
        if max(map(abs, error_b)) > most:
            return self._fail(why)
        self._run = None
        measured = CalibrationMeasured(self._vehicle_id, run.kind, error_b)
        return [measured, run.command.ack(ACCEPTED), *_text(f"calibration done: {run.kind}")]

    def _fail(self, why: str) -> list[Answer]:
        run, self._run = self._run, None
        ack = [run.command.ack(FAILED)] if run else []
        return [*ack, *_text(f"calibration failed: {why}")]

    def _cancel(self) -> list[Answer]:
        run, self._run = self._run, None
        return _text("calibration cancelled") if run else []


def fit_sphere(points: NDArray[np.float64]) -> tuple[Vec3, float]:
    """Fit a sphere by linear least squares: `|p|^2 = 2 c.p + (r^2 - |c|^2)`.

    Parameters
    ----------
    points : ndarray, shape (n, 3)
        At least four.

    Returns
    -------
    centre : tuple of 3 floats
    radius : float
        NaN where the points lie on no sphere.
    """
    system = np.column_stack((2.0 * points, np.ones(len(points))))
    solution = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
    centre = solution[:3]
    square = float(solution[3] + centre @ centre)
    return _vector(centre), math.sqrt(square) if square > 0.0 else math.nan


def _field_turns(run: _Run) -> bool:
    """Return whether the field turned during rest; False without a magnetometer."""
    if len(run.mag) < MIN_FIELD_SAMPLES:
        return False
    times_s = (np.array(run.mag_times_us) - run.mag_times_us[0]) / US_PER_S
    slope = np.polyfit(times_s, np.array(run.mag), 1)[0]
    return float(np.linalg.norm(slope)) > MAX_FIELD_DRIFT_UTPS


def _tilt(mean_b_mps2: Vec3) -> Vec3:
    x, y, z = mean_b_mps2
    return (math.atan2(-y, -z), math.atan2(x, math.hypot(y, z)), 0.0)


def _vector(values: Any) -> Vec3:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _text(text: str) -> list[Answer]:
    return [Reply(message) for message in chunks(StatusText(INFO, f"[cal] {text}"))]
