"""Every chip that a board may carry under the name of another, and how it is reported."""

import math
from collections.abc import Callable

import pytest

from firmware.rig.barometer import BAROMETERS
from firmware.rig.boards import Parts
from firmware.rig.compass import make_compass
from firmware.rig.imu import IMU_CHIPS
from firmware.rig.world import Moment, World
from gateway.records import ImuFlags
from gateway.wire.payloads import (
    MAG_LSB_PER_GAUSS,
    BaroPayload,
    ImuPayload,
    NodeStatusPayload,
)
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


@pytest.mark.parametrize(
    ("name", "counts_per_gauss"),
    [
        ("HMC5883L", 1090),
        ("HMC5983", 1090),
        ("DA5883", 1090),
        ("QMC5883L", 3000),
        ("QMC5883P", 3750),
    ],
)
def test_compass_is_found_and_read_on_the_axes_of_its_footprint(
    bench: MakeBench, name: str, counts_per_gauss: int
) -> None:
    rig = bench(world=still(), parts=Parts(compass=name))
    rig.imu_node(noise=False)
    rig.run(2.3)
    imu = rig.last(ImuPayload)
    assert MAG_LSB_PER_GAUSS[imu.mag_gain] == counts_per_gauss
    assert imu.mag == pytest.approx([ut / 100 * counts_per_gauss for ut in MOMENT.mag_ut], abs=1)
    new = [p for p in rig.payloads(ImuPayload, since_s=1.3) if ImuFlags.MAG_NEW in p.flags]
    assert len(new) == pytest.approx(75, abs=3)
    status = rig.last(NodeStatusPayload)
    assert (status.sensors_present, status.sensors_failed) == (IMU | MAG | BARO, 0)
    assert status.bus_errors == 0


@pytest.mark.parametrize("name", ["QMC5883L", "QMC5883P"])
def test_field_beyond_the_compass_range_is_marked(bench: MakeBench, name: str) -> None:
    world = World(moment=lambda _time_s: Moment(mag_ut=(20.0, 850.0, 40.0)))
    rig = bench(world=world, parts=Parts(compass=name))
    rig.imu_node()
    rig.run(START_S + 0.15)
    assert rig.last(ImuPayload).mag == (-4096, -4096, -4096)


@pytest.mark.parametrize("name", ["DA5883", "QMC5883L", "QMC5883P"])
def test_compass_that_lost_its_set_up_is_set_up_again(bench: MakeBench, name: str) -> None:
    rig = bench(
        world=World(moment=lambda time_s: Moment(mag_ut=(22.0 + 10.0 * time_s, 1.5, 42.0))),
        parts=Parts(compass=name),
    )
    node = rig.imu_node()
    rig.run(0.8)
    node.compass.power_cycle()
    rig.run(0.6)
    last = rig.last(ImuPayload)
    per_ut = MAG_LSB_PER_GAUSS[last.mag_gain] / 100
    assert last.mag[0] == pytest.approx(per_ut * (22.0 + 10.0 * rig.now_s), abs=1.0 * per_ut)
    assert ImuFlags.MAG_ABSENT not in last.flags


def test_compass_that_is_exchanged_for_another_is_found(bench: MakeBench) -> None:
    rig = bench(world=still(), parts=Parts(compass="QMC5883P"))
    node = rig.imu_node()
    rig.run(0.8)
    node.compass.absent = True
    rig.run(0.3)
    assert ImuFlags.MAG_ABSENT in rig.last(ImuPayload).flags
    node.bus.devices.append(make_compass("HMC5883L", rig.setup.world, node._clock, node.imu))
    rig.run(0.4)
    assert (rig.last(ImuPayload).mag, rig.last(ImuPayload).mag_gain) == ((218, -338, 469), 1)


@pytest.mark.parametrize("name", BAROMETERS)
@pytest.mark.parametrize(
    ("pressure_pa", "temperature_degc"), [(94_321.5, 21.5), (30_000.0, -30.0), (109_000.0, 60.0)]
)
def test_barometer_gives_the_pressure_and_its_rate(
    bench: MakeBench, name: str, pressure_pa: float, temperature_degc: float
) -> None:
    moment = Moment(pressure_pa=pressure_pa, temperature_degc=temperature_degc)
    rig = bench(world=World(moment=lambda _time_s: moment), parts=Parts(barometer=name))
    rig.imu_node()
    rig.run(1.3)
    baro = rig.last(BaroPayload)
    # The BMP180's whole numbers round by some pascals.
    assert baro.pressure_centipa == pytest.approx(pressure_pa * 100, abs=800)
    assert baro.temperature_ddegc == pytest.approx(temperature_degc * 10, abs=1)
    assert len(rig.payloads(BaroPayload, since_s=START_S)) == pytest.approx(21, abs=2)
    status = rig.last(NodeStatusPayload)
    assert (status.sensors_present, status.sensors_failed) == (IMU | MAG | BARO, 0)
    assert status.bus_errors == 0


@pytest.mark.parametrize("name", BAROMETERS)
def test_barometer_that_disappears_and_returns_is_found_again(bench: MakeBench, name: str) -> None:
    rig = bench(world=still(), parts=Parts(barometer=name))
    node = rig.imu_node()
    rig.run(0.8)
    node.barometer.absent = True
    rig.run(0.5)
    assert ImuFlags.BARO_ABSENT in rig.last(ImuPayload).flags
    node.barometer.absent = False
    rig.run(0.5)
    assert ImuFlags.BARO_ABSENT not in rig.last(ImuPayload).flags
    assert len(rig.payloads(BaroPayload, since_s=1.5)) >= 6
