"""A calibration in progress, and the directions that the magnetometer has covered."""

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink
from scipy.spatial import ConvexHull

from gateway.panel.state.commands import command_long, result_text
from gateway.panel.state.fields import FloatArray
from gateway.records import NAN, Vec3
from gateway.sensing.calibrating import CalibrationStep, fit_sphere
from gateway.units import STANDARD_GRAVITY_MPS2, US_PER_S, UT_PER_GAUSS
from gateway.vehicle.services.calibrator import SIDES

_GOLDEN: Final = (1.0 + math.sqrt(5.0)) / 2.0
MILLI: Final = 1e-3
_MILLI: Final = (MILLI * STANDARD_GRAVITY_MPS2, MILLI, MILLI * UT_PER_GAUSS)
SCALES: Final = {"HIGHRES_IMU": (1.0, 1.0, UT_PER_GAUSS), "SCALED_IMU": _MILLI, "RAW_IMU": _MILLI}
"""Units of specific force, rate and field in a message, m/s2, rad/s and uT."""
NO_ANSWER_US: Final = 4 * US_PER_S
"""Timeout of the answer to the command, from the last message of the vehicle."""
GIVEN_UP_US: Final = 200 * US_PER_S
AFTER_US: Final = 2 * US_PER_S
"""Time for which samples are evaluated after the calibration."""
WINDOW: Final = 25
"""Samples for one of the six sides: half a second at the requested rate."""
MAX_SAMPLES: Final = 3000
MIN_FIT: Final = 30
SIDE_NAMES: Final = {
    "down": "level",
    "up": "upside down",
    "left": "on its left side",
    "right": "on its right side",
    "front": "nose down",
    "back": "tail down",
}
"""Names by the lower side of the aircraft, as in the `[cal]` texts; down is level."""
ORIENTATIONS: Final = {
    f"{face}, arrow to {way}": (roll_deg, 0.0, yaw_deg)
    for face, roll_deg in (("face up", 180.0), ("face down", 0.0))
    for way, yaw_deg in (
        ("the nose", 0.0), ("the right wing", 90.0), ("the tail", 180.0), ("the left wing", -90.0),
    )
}  # fmt: skip
"""Roll, pitch and yaw from the sensor's axes to the body's, deg, by the orientation of the board
in the aircraft; its x arrow is printed next to the chips."""
SIDE_SHARE: Final = 0.85
_STARTED: Final = re.compile(r"^\[cal\] calibration started: \d+ (\w+)")
_PROGRESS: Final = re.compile(r"^\[cal\] progress <(\d+)>")
_SIDE_DONE: Final = re.compile(r"^\[cal\] (\w+) side done")
_DONE: Final = re.compile(r"^\[cal\] calibration done")
_FAILED: Final = re.compile(r"^\[cal\] calibration failed: (.+)")
_CANCELLED: Final = re.compile(r"^\[cal\] calibration cancelled")
CALIBRATE: Final = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
PARAMS: Final[dict[CalibrationStep, tuple[float, ...]]] = {
    CalibrationStep.GYRO: (1.0,),
    CalibrationStep.MAG: (0.0, 1.0),
    CalibrationStep.ACCEL: (0.0, 0.0, 0.0, 0.0, 1.0),
    CalibrationStep.LEVEL: (0.0, 0.0, 0.0, 0.0, 2.0),
}


def _make_cells() -> FloatArray:
    edges = [(0.0, s, t * _GOLDEN) for s in (-1.0, 1.0) for t in (-1.0, 1.0)]
    corners = np.array([np.roll(edge, n) for n in range(3) for edge in edges])
    cells = []
    # The faces of an icosahedron, each divided into four.
    for face in ConvexHull(corners).simplices:
        p, q, r = (_unit(corners[n]) for n in face)
        pq, qr, rp = _unit(p + q), _unit(q + r), _unit(r + p)
        cells += [(p, pq, rp), (q, qr, pq), (r, rp, qr), (pq, qr, rp)]
    return np.array(cells)


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / np.linalg.norm(vector))


CELLS: Final = _make_cells()
"""Corners of the cells on the unit sphere, shape (80, 3, 3)."""
_MIDDLES: Final = np.array([_unit(cell.sum(axis=0)) for cell in CELLS])


def seen_cells(vectors: FloatArray) -> list[bool]:
    """Return, for each of `CELLS`, whether one of the vectors, shape (n, 3), points into it.

    They may have any length but zero; rows that are not finite are ignored.
    """
    finite = vectors[np.isfinite(vectors).all(axis=1)]
    nearest = (finite @ _MIDDLES.T).argmax(axis=1)
    found: list[bool] = np.isin(np.arange(len(CELLS)), nearest).tolist()
    return found


class RunState(StrEnum):
    """State of a calibration."""

    ASKED = "asked"
    RUNNING = "running"
    CHECKING = "checking"
    """Done; the remaining error is being measured."""
    DONE = "done"
    FAILED = "failed"

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self in (RunState.DONE, RunState.FAILED)


@dataclass(frozen=True, slots=True)
class Residual:
    """One measure of a sensor's error, before and after."""

    name: str
    unit: str
    before: float
    after: float


@dataclass(slots=True)
class _Samples:
    accel: list[FloatArray] = field(default_factory=list)
    gyro: list[FloatArray] = field(default_factory=list)
    mag: list[FloatArray] = field(default_factory=list)


class CalibrationRun:
    """One calibration of one vehicle."""

    def __init__(self, system_id: int, step: CalibrationStep, now_us: int) -> None:
        self.system_id = system_id
        self.step = step
        self.state = RunState.ASKED
        self.progress = 0
        """Progress in percent, as reported by the vehicle."""
        self.trouble = ""
        self.sides_done: list[str] = []
        self.side_now: str | None = None
        """The present lower side, if it is unambiguous."""
        self._before, self._after = _Samples(), _Samples()
        self._side_means: dict[str, FloatArray] = {}
        self._began_us = self._received_us = now_us
        self._done_us = 0

    def start_message(self) -> Any:
        """Return the command that starts it."""
        return command_long(self.system_id, CALIBRATE, *PARAMS[self.step])

    def cancel_message(self) -> Any:
        """Return the command that cancels it: all zero."""
        return command_long(self.system_id, CALIBRATE)

    def handle(self, message: Any, now_us: int) -> None:
        """Handle one message of the vehicle."""
        match message.get_type():
            case "COMMAND_ACK" if message.command == CALIBRATE:
                self._handle_ack(message, now_us)
            case "STATUSTEXT":
                self._handle_text(message.text, now_us)
            case kind if kind in SCALES:
                self._add_sample(*_sample(message, *SCALES[kind]))

    def poll(self, now_us: int) -> None:
        """Fail if an answer is missing; end the evaluation after its time."""
        if self.state is RunState.ASKED and now_us - self._received_us > NO_ANSWER_US:
            self._fail("the aircraft does not answer")
        elif self.state is RunState.RUNNING and now_us - self._began_us > GIVEN_UP_US:
            self._fail("no result was received")
        elif self.state is RunState.CHECKING and now_us - self._done_us > AFTER_US:
            self.state = RunState.DONE

    @property
    def field_points(self) -> FloatArray:
        """The magnetic field so far, shape (n, 3), uT, body FRD."""
        return np.array(self._before.mag).reshape(-1, 3)

    def sphere(self) -> tuple[Vec3, float]:
        """Return centre and radius of the sphere of the magnetic field, uT; NaN if unknown."""
        points = self.field_points
        if not len(points):
            return (0.0, 0.0, 0.0), NAN
        if len(points) >= MIN_FIT:
            centre, radius = fit_sphere(points)
            spread = float(np.ptp(points, axis=0).max())
            # A small patch fits a sphere of any size: use the middle until it is larger.
            if math.isfinite(radius) and radius < spread:
                return centre, radius
        x, y, z = (points.min(axis=0) + points.max(axis=0)).tolist()
        middle = (0.5 * x, 0.5 * y, 0.5 * z)
        return middle, float(np.linalg.norm(points - middle, axis=1).max())

    def cover(self) -> list[bool]:
        """Return, for each of `CELLS`, whether the magnetic field was measured in it."""
        centre, _ = self.sphere()
        return seen_cells(self.field_points - centre)

    def residuals(self) -> list[Residual]:
        """Return the errors before and after, as far as known."""
        match self.step:
            case CalibrationStep.GYRO:
                return [Residual("Rate at rest", "°/s", *self._each(_rate_degps))]
            case CalibrationStep.LEVEL:
                return [Residual("Tilt when level", "°", *self._each(_tilt_deg))]
            case CalibrationStep.ACCEL:
                return [Residual("Error of gravity over the six sides", "m/s²", *self._sides_rms())]
            case CalibrationStep.MAG:
                return [Residual("Spread of the field's strength", "µT", *self._field_rms())]
            case CalibrationStep.MOUNTING:
                return []

    def _handle_ack(self, message: Any, now_us: int) -> None:
        self._received_us = now_us
        if self.state.is_over or self.state is RunState.CHECKING:
            return
        if message.result == mavlink.MAV_RESULT_IN_PROGRESS:
            self.state = RunState.RUNNING
            if message.progress <= 100:
                self.progress = max(self.progress, message.progress)
        elif message.result == mavlink.MAV_RESULT_ACCEPTED:
            # PX4 accepts at once and reports the rest by texts; the gateway accepts at the end.
            if self.state is RunState.RUNNING:
                self._finish(now_us)
            else:
                self.state = RunState.RUNNING
        else:
            self._fail(result_text(message.result))

    def _handle_text(self, text: str, now_us: int) -> None:
        if match := _FAILED.match(text):
            # The acknowledgement, which has no reason, arrives before this text.
            self.state, self.trouble = RunState.FAILED, match[1]
        if self.state.is_over:
            return
        self._received_us = now_us
        if match := _PROGRESS.match(text):
            self.progress = max(self.progress, min(int(match[1]), 100))
        elif match := _SIDE_DONE.match(text):
            if match[1] not in self.sides_done:
                self.sides_done.append(match[1])
        elif _STARTED.match(text):
            self.state = RunState.RUNNING
        elif _DONE.match(text):
            self._finish(now_us)
        elif _CANCELLED.match(text):
            self._fail("cancelled")

    def _finish(self, now_us: int) -> None:
        if self.state is RunState.CHECKING:
            return
        self.state, self.progress, self._done_us = RunState.CHECKING, 100, now_us
        if self.step is CalibrationStep.ACCEL:
            self.sides_done = list(SIDE_NAMES)

    def _fail(self, why: str) -> None:
        if self.state is not RunState.FAILED:
            self.state, self.trouble = RunState.FAILED, why

    def _add_sample(self, accel: FloatArray, gyro: FloatArray, mag: FloatArray) -> None:
        into = {RunState.RUNNING: self._before, RunState.CHECKING: self._after}.get(self.state)
        if into is None:
            return
        # Zero is the field of a vehicle without a magnetometer.
        if np.isfinite(mag).all() and mag.any() and len(into.mag) < MAX_SAMPLES:
            into.mag.append(mag)
        if len(into.accel) >= MAX_SAMPLES:
            del into.accel[0], into.gyro[0]
        into.accel.append(accel)
        into.gyro.append(gyro)
        if into is self._before and self.step is CalibrationStep.ACCEL:
            self._note_side()

    def _note_side(self) -> None:
        """Note the lower side, and the gravity measured on it."""
        recent = np.array(self._before.accel[-WINDOW:])
        mean = recent.mean(axis=0)
        axis = int(np.abs(mean).argmax())
        self.side_now = None
        if abs(mean[axis]) < SIDE_SHARE * STANDARD_GRAVITY_MPS2:
            return
        # By axis of body FRD: with the reaction to gravity along the axis, and against it.
        self.side_now = side = SIDES[2 * axis + int(mean[axis] < 0.0)]
        if len(recent) == WINDOW and recent.std(axis=0).max() < 0.5:
            self._side_means.setdefault(side, mean)

    def _each(self, measure: Callable[[_Samples], float]) -> tuple[float, float]:
        return measure(self._before), measure(self._after) if self.state.is_over else NAN

    def _sides_rms(self) -> tuple[float, float]:
        if len(self._side_means) < len(SIDES):
            return NAN, NAN
        means = np.array(list(self._side_means.values()))
        error = np.linalg.norm(means, axis=1) - STANDARD_GRAVITY_MPS2
        middle = 0.5 * (means.max(axis=0) + means.min(axis=0))
        left = np.linalg.norm(means - middle, axis=1) - STANDARD_GRAVITY_MPS2
        after = _rms(left) if self.state is RunState.DONE else NAN
        return _rms(error), after

    def _field_rms(self) -> tuple[float, float]:
        points = self.field_points
        if len(points) < MIN_FIT:
            return NAN, NAN
        strength = np.linalg.norm(points, axis=1)
        centre, radius = self.sphere()
        left = np.linalg.norm(points - centre, axis=1) - radius
        after = _rms(left) if self.state is RunState.DONE else NAN
        return _rms(strength - strength.mean()), after


def _sample(message: Any, *scales: float) -> Iterator[FloatArray]:
    for name, scale in zip(("acc", "gyro", "mag"), scales, strict=True):
        yield np.array([getattr(message, f"{axis}{name}") for axis in "xyz"]) * scale


def _rate_degps(samples: _Samples) -> float:
    if not samples.gyro:
        return NAN
    return math.degrees(float(np.linalg.norm(np.mean(samples.gyro, axis=0))))


def _tilt_deg(samples: _Samples) -> float:
    if not samples.accel:
        return NAN
    x, y, z = np.mean(samples.accel, axis=0).tolist()
    return math.degrees(math.atan2(math.hypot(x, y), -z))


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
