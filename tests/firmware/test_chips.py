"""Every chip that a board may carry under the name of another, and how it is reported."""

import math
from collections.abc import Callable

import pytest

from firmware.rig.boards import Parts
from firmware.rig.imu import IMU_CHIPS
from firmware.rig.world import Moment, World
from gateway.records import ImuFlags
from gateway.wire.payloads import ImuPayload, NodeStatusPayload
from tests.firmware.harness import Bench

pytestmark = [pytest.mark.io, pytest.mark.slow]

MakeBench = Callable[..., Bench]
IMU, MAG, BARO = 1, 2, 4
START_S = 0.45
"""Reset, self-test and set-up."""
MOMENT = Moment(
    accel_mps2=(9.80665, -4.903325, 2.4516625),
    gyro_radps=(math.radians(90), math.radians(-45), math.radians(100)),
    mag_ut=(20.0, -31.0, 43.0),
    temperature_degc=21.53,
    pressure_pa=94_321.5,
)


def still() -> World:
    return World(moment=lambda _time_s: MOMENT)


@pytest.mark.parametrize("name", [name for name in IMU_CHIPS if name != "broken"])
def test_imu_look_alike_is_used_and_opens_the_bypass(bench: MakeBench, name: str) -> None:
    rig = bench(world=still(), parts=Parts(imu=name))
    rig.imu_node(noise=False)
    rig.run(1.3)
    imu = rig.last(ImuPayload)
    assert imu.accel == (4096, -2048, 1024)
    assert imu.gyro == pytest.approx((2952, -1476, 3280), rel=0.001)
    assert imu.temperature == pytest.approx(-5100, abs=4)
    assert imu.flags & ~ImuFlags.MAG_NEW == ImuFlags.ACCEL_FILTERED
    assert len(rig.payloads(ImuPayload, since_s=START_S)) == pytest.approx(85, abs=2)
    status = rig.last(NodeStatusPayload)
    assert (status.sensors_present, status.sensors_failed) == (IMU | MAG | BARO, 0)


@pytest.mark.parametrize("name", ["MPU6500", "ICM-20689"])
def test_failed_self_test_of_a_later_chip_is_reported(bench: MakeBench, name: str) -> None:
    rig = bench(parts=Parts(imu=name))
    rig.imu_node().imu.self_test_works = False
    rig.run(START_S + 0.3)
    assert ImuFlags.SELF_TEST_FAILED in rig.last(ImuPayload).flags


def test_imu_that_ignores_its_ranges_is_not_used_but_the_compass_is(bench: MakeBench) -> None:
    rig = bench(parts=Parts(imu="broken"))
    rig.imu_node()
    rig.run(1.3)
    assert not rig.payloads(ImuPayload)
    status = rig.last(NodeStatusPayload)
    assert (status.sensors_present, status.sensors_failed) == (MAG | BARO, IMU)


def test_imu_with_constant_data_is_not_used(bench: MakeBench) -> None:
    rig = bench()
    imu = rig.imu_node().imu
    imu._store = lambda _values, _temperature_degc: None
    rig.run(1.3)
    assert not rig.payloads(ImuPayload)
    assert rig.last(NodeStatusPayload).sensors_failed == IMU
