from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.geometry.rotation import matrix_from_euler_deg
from gateway.panel.state.calibration import (
    CELLS,
    ORIENTATIONS,
    CalibrationRun,
    RunState,
    seen_cells,
)
from gateway.sensing.calibrating import CalibrationStep
from gateway.units import US_PER_S
from gateway.vehicle.services.calibrator import SIDES
from tests.kit.vehicle_bench import G_MPS2, VehicleBench


def started(step: CalibrationStep) -> VehicleBench:
    bench = VehicleBench(CalibrationRun(1, step, 10 * US_PER_S))
    bench.send(bench.client.start_message())
    return bench


def test_each_of_six_sides_is_reported_once_done() -> None:
    bench = started(CalibrationStep.ACCEL)
    bias = np.array((0.3, -0.2, 0.1))
    for done, (axis, sign) in enumerate((a, s) for a in range(3) for s in (1.0, -1.0)):
        pose = bias + sign * G_MPS2 * np.eye(3)[axis]
        bench.hold(2.5, accel=tuple(pose.tolist()))
        assert bench.client.side_now == SIDES[2 * axis + (sign < 0)]
        assert len(bench.client.sides_done) >= done + 1
    assert sorted(bench.client.sides_done) == sorted(SIDES)
    bench.hold(2.1)
    [residual] = bench.client.residuals()
    assert residual.before == pytest.approx(0.2, abs=0.1)
    assert residual.after < 0.02


def test_magnetometer_shows_uncovered_directions() -> None:
    bench = started(CalibrationStep.MAG)
    rng = np.random.default_rng(2)
    directions = rng.normal(size=(1500, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    centre = np.array((12.0, -7.0, 4.0))
    upper = directions[directions[:, 2] < 0.0]
    for direction in upper[:400]:
        bench.hold(0.02, mag=tuple((centre + 48.0 * direction).tolist()))
    half = sum(bench.client.cover())
    assert 30 < half < 60
    for direction in directions[:1000]:
        if bench.client.state is not RunState.RUNNING:
            break
        bench.hold(0.02, mag=tuple((centre + 48.0 * direction).tolist()))
    assert bench.client.state is RunState.CHECKING
    bench.hold(2.1)
    assert sum(bench.client.cover()) > half
    found, radius = bench.client.sphere()
    assert found == pytest.approx(centre.tolist(), abs=0.2)
    assert radius == pytest.approx(48.0, abs=0.2)
    [residual] = bench.client.residuals()
    assert residual.before > 4.0
    assert residual.after < 0.1


def test_calibration_without_an_answer_fails() -> None:
    run = CalibrationRun(2, CalibrationStep.GYRO, 0)
    run.poll(5 * US_PER_S)
    assert (run.state, run.trouble) == (RunState.FAILED, "the aircraft does not answer")


@pytest.mark.parametrize(
    ("result", "text"), [(mavlink.MAV_RESULT_DENIED, "denied"), (200, "result 200")]
)
def test_denied_command_fails_the_calibration(result: int, text: str) -> None:
    run = CalibrationRun(1, CalibrationStep.GYRO, 0)
    command = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
    run.handle(mavlink.MAVLink_command_ack_message(command, result), 0)
    assert (run.state, run.trouble) == (RunState.FAILED, text)


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_orientation_turns_the_arrow_and_the_face_of_the_board(name: str) -> None:
    ways = {"nose": (1, 0, 0), "right wing": (0, 1, 0), "tail": (-1, 0, 0), "left wing": (0, -1, 0)}
    face, _, way = name.partition(", arrow to the ")
    matrix = np.array(matrix_from_euler_deg(ORIENTATIONS[name]))
    assert matrix @ (1, 0, 0) == pytest.approx(ways[way])
    assert matrix @ (0, 0, 1) == pytest.approx((0, 0, -1 if face == "face up" else 1))


def test_every_direction_has_its_own_cell() -> None:
    middles = CELLS.sum(axis=1)
    assert all(seen_cells(middles))
    assert sum(seen_cells(middles[:1])) == 1
    assert not any(seen_cells(np.empty((0, 3))))
    assert not any(seen_cells(np.full((2, 3), np.nan)))


@pytest.mark.parametrize(
    "kind", [mavlink.MAVLink_scaled_imu_message, mavlink.MAVLink_raw_imu_message]
)
def test_scaled_and_raw_imu_are_read_in_thousandths(kind: Any) -> None:
    run = CalibrationRun(1, CalibrationStep.MAG, 0)
    run.state = RunState.RUNNING
    for mag in ((200, -30, 400), (0, 0, 0)):
        run.handle(kind(0, 0, 0, -1000, 0, 0, 0, *mag), 0)
    # A field of nothing is that of a vehicle without a magnetometer.
    assert run.field_points.tolist() == [pytest.approx([20.0, -3.0, 40.0])]
    level = CalibrationRun(1, CalibrationStep.ACCEL, 0)
    level.state = RunState.RUNNING
    for axis, sign in ((axis, sign) for axis in range(3) for sign in (-1000, 1000)):
        for _ in range(30):
            level.handle(kind(0, *(sign * (n == axis) for n in range(3)), 0, 0, 0, 0, 0, 0), 0)
    assert level.residuals()[0].before == pytest.approx(0.0, abs=1e-3)
