import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.geometry.quaternion import from_euler, rotate_inverse
from gateway.records import Vec3
from gateway.sensing.calibration import NodeCalibration
from gateway.vehicle.service import CalibrationMeasured
from gateway.vehicle.services.calibrator import FIXED_MAG_CAL_YAW
from tests.kit.ground_station import GroundStation, of_kind, results, texts

G = 9.80665
DOWN = np.array((0.0, 0.0, -G))
CALIBRATE = mavlink.MAV_CMD_PREFLIGHT_CALIBRATION
ACCEPTED, NOT_NOW, DENIED, UNSUPPORTED, FAILED, IN_PROGRESS = 0, 1, 2, 3, 4, 5
GYRO, MAG = (1,), (0, 1)
SIX_SIDES, LEVEL, SIMPLE = (0, 0, 0, 0, 1), (0, 0, 0, 0, 2), (0, 0, 0, 0, 4)

Motion = Callable[[float], dict[str, Any]]


def run(station: GroundStation, seconds: float, motion: Motion, **state: Any) -> list[Any]:
    """Feed samples at 100 Hz; acknowledgements and texts."""
    messages = (mavlink.MAVLINK_MSG_ID_COMMAND_ACK, mavlink.MAVLINK_MSG_ID_STATUSTEXT)
    return station.fly(seconds, 100.0, motion, messages, **state)


def take_off(station: GroundStation) -> list[Any]:
    return run(station, 3.0, lambda _: {}, vel_n_mps=(20.0, 0.0, 0.0))


def cal_texts(found: list[Any]) -> list[str]:
    return [t.removeprefix("[cal] ") for t in texts(found) if t.startswith("[cal] ")]


def rest(gyro: Vec3 = (0.0, 0.0, 0.0), accel: Vec3 = (0.0, 0.0, -G), noise: float = 0.01) -> Motion:
    rng = np.random.default_rng(1)

    def motion(_time_s: float) -> dict[str, Any]:
        rates, forces = (np.array((gyro, accel)) + rng.normal(scale=noise, size=(2, 3))).tolist()
        return {"gyro_b_radps": tuple(rates), "accel_b_mps2": tuple(forces)}

    return motion


def correction(station: GroundStation) -> NodeCalibration:
    [found] = station.of(CalibrationMeasured)
    return found.correction


def assert_failed(station: GroundStation, found: list[Any], why: str = "") -> None:
    assert results(found)[-1] == FAILED
    assert cal_texts(found)[-1].startswith(f"calibration failed: {why}")
    assert station.of(CalibrationMeasured) == []


def test_gyro_calibration_measures_the_bias_at_rest(station: GroundStation) -> None:
    found = station.command(CALIBRATE, *GYRO)
    assert results(found) == [IN_PROGRESS]
    assert cal_texts(found) == ["calibration started: 2 gyro"]
    found = run(station, 4.0, rest(gyro=(0.02, -0.03, 0.01)))
    assert results(found) == [IN_PROGRESS] * 9 + [ACCEPTED]
    progress = [m.progress for m in of_kind(found, "COMMAND_ACK")][:-1]
    assert progress == [10, 20, 30, 40, 50, 60, 70, 80, 90]
    assert cal_texts(found)[-1] == "calibration done: gyro"
    assert correction(station).gyro_bias_radps == pytest.approx((0.02, -0.03, 0.01), abs=0.003)


def test_level_calibration_measures_the_tilt_of_the_mounting(station: GroundStation) -> None:
    station.command(CALIBRATE, *LEVEL)
    tilted = rotate_inverse(from_euler(0.1, -0.05, 0.0), (0.0, 0.0, -G))
    run(station, 4.0, rest(accel=tilted))
    level = np.array(correction(station).mounting) @ np.array(tilted)
    assert level == pytest.approx((0.0, 0.0, -G), abs=0.02)


def test_accelerometer_calibration_measures_the_bias_while_level(station: GroundStation) -> None:
    station.command(CALIBRATE, *SIMPLE)
    run(station, 4.0, rest(accel=(0.3, -0.2, -G + 0.1)))
    assert correction(station).accel_bias_mps2 == pytest.approx((0.3, -0.2, 0.1), abs=0.005)


def test_six_side_calibration_names_the_sides_and_measures_the_bias(station: GroundStation) -> None:
    bias = np.array((0.3, -0.2, 0.1))
    assert results(station.command(CALIBRATE, *SIX_SIDES)) == [IN_PROGRESS]
    found = []
    for axis in range(3):
        for sign in (1.0, -1.0):
            side = bias + sign * G * np.eye(3)[axis]
            found += run(station, 2.5, rest(accel=tuple(side.tolist())))
            found += run(station, 0.5, lambda t: {"gyro_b_radps": (3.0 * math.sin(9.0 * t),) * 3})
    assert results(found)[-1] == ACCEPTED
    sides = [text.split()[0] for text in cal_texts(found) if "side done" in text]
    # Specific force points away from the ground: along +x the tail lies below, along -z the belly.
    # As the pictures of QGroundControl are named: a bank to the left is "left".
    assert sides == ["back", "front", "left", "right", "up"]
    assert correction(station).accel_bias_mps2 == pytest.approx(tuple(bias), abs=0.005)


def test_level_side_is_named_down(station: GroundStation) -> None:
    station.command(CALIBRATE, *SIX_SIDES)
    assert "down side done, rotate to a different side" in cal_texts(run(station, 2.5, rest()))


def tumble(centre: Vec3, radius: float) -> Motion:
    def motion(time_s: float) -> dict[str, Any]:
        q = from_euler(2.1 * time_s, 1.3 * math.sin(0.7 * time_s), 0.9 * time_s)
        field = rotate_inverse(q, (0.4 * radius, 0.0, 0.9165 * radius))
        return {"mag_b_ut": tuple(f + c for f, c in zip(field, centre, strict=True))}

    return motion


def test_magnetometer_calibration_measures_hard_and_soft_iron(station: GroundStation) -> None:
    station.command(CALIBRATE, *MAG)
    around, centre = tumble((0.0, 0.0, 0.0), 48.0), np.array((12.0, -7.0, 30.0))

    def motion(time_s: float) -> dict[str, Any]:
        return {"mag_b_ut": tuple(around(time_s)["mag_b_ut"] * np.array((1.2, 1, 1)) + centre)}

    assert results(run(station, 30.0, motion))[-1] == ACCEPTED
    found = correction(station)
    assert found.mag_hard_iron_ut == pytest.approx(tuple(centre), abs=0.1)
    matrix = np.array(found.mag_soft_iron)
    assert matrix[1, 1] / matrix[0, 0] == pytest.approx(1.2, rel=1e-3)


def test_fixed_yaw_calibration_measures_the_hard_iron(station: GroundStation) -> None:
    found = station.command(FIXED_MAG_CAL_YAW, 90.0, 0.0, 0.0, 0.0, 47.4, 8.5)
    assert results(found) == [IN_PROGRESS]
    lying = rest()
    # Facing east, north is to the left; 21 uT level and 43 uT down, declination 3 deg.
    run(station, 4.0, lambda t: {**lying(t), "mag_b_ut": (1.1 + 5.0, -21.2, 43.1)})
    assert correction(station).mag_hard_iron_ut == pytest.approx((5.0, 0.0, 0.0), abs=1.5)


@pytest.mark.parametrize("params", [GYRO, MAG, SIX_SIDES, LEVEL, SIMPLE])
def test_calibration_is_denied_in_flight(station: GroundStation, params: tuple[int, ...]) -> None:
    take_off(station)
    found = station.command(CALIBRATE, *params)
    assert (results(found), cal_texts(found)) == ([DENIED], ["calibration failed: in flight"])
    assert results(station.command(CALIBRATE)) == [ACCEPTED], "what runs may be cancelled"


@pytest.mark.parametrize("params", [GYRO, MAG, SIX_SIDES])
def test_take_off_fails_a_running_calibration(
    station: GroundStation, params: tuple[int, ...]
) -> None:
    station.command(CALIBRATE, *params)
    assert_failed(station, take_off(station), "in flight")


def moved(time_s: float) -> dict[str, Any]:
    return {"gyro_b_radps": (math.sin(5.0 * time_s), 0.0, 0.0)}


@pytest.mark.parametrize(
    ("params", "seconds", "motion"),
    [
        *((params, 4.0, moved) for params in (GYRO, LEVEL, SIMPLE)),
        (GYRO, 4.0, rest(gyro=(0.0, 0.0, 0.36))),
        (SIMPLE, 4.0, rest(accel=(2.1, 0.0, -9.5))),
        (LEVEL, 4.0, rest(accel=(5.2, 0.0, -8.3))),
        (MAG, 40.0, tumble((0.0, 210.0, 0.0), 48.0)),
        (MAG, 40.0, tumble((0.0, 0.0, 0.0), 110.0)),
        (MAG, 40.0, lambda t: tumble((0.0, 0.0, 0.0), 48.0 * (1.0 + 0.3 * math.sin(50.0 * t)))(t)),
        (MAG, 61.0, lambda t: {"mag_b_ut": (20.0 * math.cos(t), 20.0 * math.sin(t), 40.0)}),
    ],
)
def test_calibration_without_evidence_fails(
    station: GroundStation, params: tuple[int, ...], seconds: float, motion: Motion
) -> None:
    station.command(CALIBRATE, *params)
    found = run(station, seconds, motion)
    assert_failed(station, found, "it was moved" if motion is moved else "")


def turn(rate_degps: float) -> Motion:
    """Turn steadily: the gyroscope's noise is that of rest; only the magnetic field shows it."""
    rate = math.radians(rate_degps)
    lying, noise = rest(gyro=(0.0, 0.0, rate)), np.random.default_rng(5)

    def motion(time_s: float) -> dict[str, Any]:
        field = (20.0 * math.cos(rate * time_s), -20.0 * math.sin(rate * time_s), 40.0)
        return {**lying(time_s), "mag_b_ut": tuple(field + noise.normal(0, 0.5, 3))}

    return motion


def shake(noise_mps2: float) -> Motion:
    noise, still = np.random.default_rng(3), {"gyro_b_radps": (0.0, 0.0, 0.0)}
    return lambda _: still | {"accel_b_mps2": tuple(DOWN + noise.normal(0, noise_mps2, 3))}


@pytest.mark.parametrize(
    ("motion", "result"),
    [
        # A hand that trembles, a steady turn, and shaking.
        *((rest(noise=0.015), ACCEPTED), (rest(noise=0.04), FAILED)),
        *((turn(0.0), ACCEPTED), (turn(2.8), FAILED)),
        *((shake(0.25), ACCEPTED), (shake(0.4), FAILED)),
    ],
)
def test_gyro_calibration_fails_in_motion_beyond_a_trembling_hand(
    station: GroundStation, motion: Motion, result: int
) -> None:
    station.command(CALIBRATE, *GYRO)
    assert results(run(station, 4.0, motion))[-1] == result


def test_calibration_without_samples_times_out(station: GroundStation) -> None:
    station.command(CALIBRATE, *GYRO)
    assert results(station.wait(61.0)) == [FAILED]


def test_cancelled_calibration_has_no_result(station: GroundStation) -> None:
    station.command(CALIBRATE, *GYRO)
    found = station.command(CALIBRATE)
    assert (results(found), cal_texts(found)) == ([ACCEPTED], ["calibration cancelled"])
    assert results(run(station, 4.0, rest())) == []
    assert results(station.command(CALIBRATE)) == [ACCEPTED], "nothing to cancel is no fault"


def test_second_calibration_is_temporarily_rejected(station: GroundStation) -> None:
    station.command(CALIBRATE, *GYRO)
    assert results(station.command(CALIBRATE, *GYRO)) == [IN_PROGRESS], "sent again for a lost ACK"
    assert results(station.command(CALIBRATE, *MAG)) == [NOT_NOW]


@pytest.mark.parametrize(
    "params", [(1, 1), (2,), (0, 0, 1), (0, 0, 0, 1), (0,) * 6 + (1,), (1, 0, 0, 0, 2)]
)
def test_unknown_calibration_is_refused(station: GroundStation, params: tuple[int, ...]) -> None:
    assert results(station.command(CALIBRATE, *params)) == [UNSUPPORTED]


def test_heartbeat_reports_a_running_calibration(station: GroundStation) -> None:
    station.command(CALIBRATE, *GYRO)
    beats = of_kind(station.wait(1.5), "HEARTBEAT")
    assert beats[-1].system_status == mavlink.MAV_STATE_CALIBRATING
