"""A change by a ground station reaches the stage that it concerns, and only that one."""

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings
from gateway.estimation.select import EstimationSettings
from gateway.records import FusedSample, Incoming
from tests.kit.ground_station import command, of_kind
from tests.kit.mavlink import packed
from tests.kit.pipeline_bench import PipelineBench
from tests.kit.records import raw_at


class Bench(PipelineBench):
    """A pipeline with one aircraft on the table and one ground station."""

    def __init__(self, estimator: str = "paper") -> None:
        super().__init__(AircraftSettings(estimation=EstimationSettings(estimator=estimator)))

    def run(self, seconds: float, **changes: Any) -> FusedSample:
        """Let raw samples come at 100 Hz; the last one fused."""
        fused = []
        for _ in range(round(seconds * 100)):
            self.now_us += 10_000
            out = self.take(raw_at(self.now_us, **changes))
            fused += [record for record in out.records if isinstance(record, FusedSample)]
            self.keep(self.pipeline.poll(self.now_us))
        return fused[-1]

    def send(self, message: Any) -> None:
        incoming = Incoming(7, packed(message, 255, 190), trusted=True)
        self.keep(self.pipeline.handle(incoming, self.now_us))

    def set(self, name: str, value: float) -> None:
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        self.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, kind))

    def calibrate(self, *params: float) -> None:
        self.send(command(mavlink.MAV_CMD_PREFLIGHT_CALIBRATION, *params))

    def parameters(self) -> dict[str, float]:
        return {m.param_id: m.param_value for m in of_kind(self.messages, "PARAM_VALUE")}


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize(
    ("biased", "params", "sensor", "expected"),
    [
        ({"gyro_raw": (33, -66, 16)}, (1,), "gyro_b_radps", (0.0, 0.0, 0.0)),
        ({"accel_raw": (400, -300, 4066)}, (0, 0, 0, 0, 2), "accel_b_mps2", (0.0, 0.0, None)),
        ({"accel_raw": (100, -50, 4196)}, (0, 0, 0, 0, 4), "accel_b_mps2", (0.0, 0.0, -9.80665)),
    ],
    ids=["gyroscope", "level", "accelerometer"],
)
def test_error_is_removed_by_its_calibration(
    bench: Bench, biased: dict[str, Any], params: tuple[int, ...], sensor: str,
    expected: tuple[float | None, ...],
) -> None:  # fmt: skip
    before = getattr(bench.run(0.5, **biased).sample, sensor)
    assert max(map(abs, before[:2])) > 0.03
    bench.calibrate(*params)
    bench.run(4.0, **biased)
    after = getattr(bench.run(0.1, **biased).sample, sensor)
    for found, wanted in zip(after, expected, strict=True):
        assert wanted is None or found == pytest.approx(wanted, abs=1e-6)
    if sensor == "gyro_b_radps":
        assert bench.parameters()["CAL_GYRO_BIAS_X"] == pytest.approx(before[0], rel=1e-6)


def test_mounting_is_set_angle_by_angle(bench: Bench) -> None:
    """A pitch of 90° on the way: there, roll and yaw turn about the same axis."""
    down_b = bench.run(0.1).sample.accel_b_mps2
    assert down_b == pytest.approx((0.0, 0.0, -9.80665), abs=1e-6)
    for name, angle in (("CAL_MNT_PIT", 90.0), ("CAL_MNT_ROLL", 30.0), ("CAL_MNT_YAW", -45.0)):
        bench.set(name, angle)
    expected = ((0.0, 0.965926, 0.258819), (0.0, 0.258819, -0.965926), (-1.0, 0.0, 0.0))
    mounting = bench.pipeline.aircraft[1].settings.calibration.mounting
    np.testing.assert_allclose(mounting, expected, atol=1e-6)
    turned = np.array(expected) @ (0.0, 0.0, 9.80665)
    assert bench.run(0.1).sample.accel_b_mps2 == pytest.approx(tuple(turned), abs=1e-5)
    reported = bench.parameters()
    assert [reported[f"CAL_MNT_{angle}"] for angle in ("ROLL", "PIT", "YAW")] == [30.0, 90.0, -45.0]


def test_mounting_angles_follow_a_level_calibration(bench: Bench) -> None:
    bench.run(0.1)
    bench.set("CAL_MNT_ROLL", 170.0)
    bench.calibrate(0, 0, 0, 0, 2)
    bench.run(4.0)
    assert abs(bench.parameters()["CAL_MNT_ROLL"]) == pytest.approx(180.0, abs=1e-3)


def test_mounting_angle_out_of_range_changes_nothing(bench: Bench) -> None:
    bench.run(0.1)
    before = bench.pipeline.aircraft[1].settings.calibration
    for name, angle in (("CAL_MNT_PIT", 91.0), ("CAL_MNT_YAW", -181.0), ("CAL_MNT_ROLL", math.nan)):
        bench.set(name, angle)
        assert bench.messages[-2].get_type() == "PARAM_ERROR"
    assert bench.pipeline.aircraft[1].settings.calibration == before


def test_changed_weight_does_not_restart_the_estimator(bench: Bench) -> None:
    """Turned by the gyroscope alone: a restarted estimator would lose the turn."""
    bench.run(2.0)
    turning = {"gyro_raw": (0, 0, -3280)}
    before = bench.run(0.5, **turning).state.q_nb
    bench.set("PAPER_ALPHA_YAW", 1.0)
    after = bench.run(0.01).state.q_nb
    assert bench.parameters()["PAPER_ALPHA_YAW"] == 1.0
    assert after == pytest.approx(before, abs=1e-3)
    assert bench.run(1.0).state.q_nb == pytest.approx(before, abs=1e-2), "the compass is left out"


@pytest.mark.parametrize(("name", "value"), [("ESKF_MAG_NOISE", 3.0), ("REF_GPS_LATENCY", 0.2)])
def test_retuned_kalman_filter_keeps_its_state(name: str, value: float) -> None:
    bench = Bench("eskf")
    before = bench.run(5.0).state
    bench.set(name, value)
    after = bench.run(0.01).state
    assert bench.parameters()[name] == pytest.approx(value)
    assert after.q_nb == pytest.approx(before.q_nb, abs=1e-3)
    assert after.flags == before.flags


def test_changed_estimator_starts_without_state(bench: Bench) -> None:
    for choice in (1.0, 0.0, 1.0):
        bench.set("EST_ESTIMATOR", choice)
        assert abs(bench.run(3.0).state.q_nb[1]) < 1e-3
