"""The IMU node's program against the models of its three sensors."""

import bisect
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from firmware.rig.barometer import Words
from firmware.rig.imu import PWR_MGMT_1, SELF_TEST
from firmware.rig.world import Moment, World
from gateway.records import ImuFlags
from gateway.wire.payloads import BaroPayload, ImuPayload, NodeStatusPayload
from tests.firmware.harness import BARO, IMU, MAG, START_S, MakeRig, still

pytestmark = [pytest.mark.io, pytest.mark.slow]

FILTERED = ImuFlags.ACCEL_FILTERED | ImuFlags.GYRO_FILTERED
CLIPPED = ImuFlags.ACCEL_CLIPPED | ImuFlags.GYRO_CLIPPED


def test_rates_are_100_imu_75_mag_25_baro(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(3.5)
    imu = rig.payloads(ImuPayload, since_s=1.0)
    baro = rig.payloads(BaroPayload, since_s=1.0)
    assert len(imu) == pytest.approx(250, abs=2)
    assert sum(ImuFlags.MAG_NEW in payload.flags for payload in imu) == pytest.approx(187, abs=4)
    assert len(baro) == pytest.approx(62, abs=2)
    status = rig.last(NodeStatusPayload)
    assert status.sample_rate_hz == pytest.approx(100, abs=1)
    assert (status.sensors_present, status.sensors_failed, status.bus_errors) == (7, 0, 0)
    assert status.supply_mv == pytest.approx(3300, abs=20)
    assert 0 < status.loop_max_us < 2000
    # Every one of the IMU's samples was read: a tenth of them makes the payloads.
    assert len(node.imu.sampled_ps) > 3000


def test_node_time_is_the_moment_of_the_sample(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(1.5)
    sampled_us = sorted(ps / 1e6 for ps in node.imu.sampled_ps)
    late_us = []
    for _, frame in rig.frames:
        if isinstance(frame.payload, ImuPayload):
            # The clock starts some hundred microseconds behind the reset.
            stamp_us = frame.header.node_time_us + 500
            late_us.append(stamp_us - sampled_us[bisect.bisect(sampled_us, stamp_us) - 1])
    assert len(late_us) > 90
    assert max(late_us) - min(late_us) < 20


def test_butterworth_attenuates_vibration_and_passes_manoeuvre(imu_rig: MakeRig) -> None:
    def moment(time_s: float) -> Moment:
        slow = 3.0 * math.sin(2 * math.pi * 1.0 * time_s)
        return Moment(accel_mps2=(slow + 8.0 * math.sin(2 * math.pi * 90.0 * time_s), 0.0, 9.80665))

    rig, _ = imu_rig(START_S + 2.2, world=World(moment=moment), noise=False)
    x = [payload.accel[0] for payload in rig.payloads(ImuPayload, since_s=START_S + 0.2)]
    assert max(x) == pytest.approx(3.0 / 9.80665 * 4096, rel=0.06)
    assert min(x) == pytest.approx(-3.0 / 9.80665 * 4096, rel=0.06)


def test_raw_mode_sends_means_and_reports_it(imu_rig: MakeRig, build: Callable[..., Path]) -> None:
    settings = "-DIMU_RAW=1 -DRADIO_KBPS=250 -DVEHICLE_ID=3 -DBARO_OVERSAMPLING=0"
    folder = build(settings, programs=("imu_node", "receiver"))
    rig, _ = imu_rig(
        1.5, build=folder, world=still(gyro_radps=(math.radians(100), 0.0, 0.0)), noise=False
    )
    imu = rig.last(ImuPayload)
    assert imu.flags & FILTERED == 0
    assert imu.gyro == (3280, 0, 0)
    assert rig.frames[-1][1].header.node.vehicle_id == 3
    assert {frame.pipe for _, frame in rig.frames} == {4}


def test_8_mhz_build_keeps_time_and_rate(imu_rig: MakeRig, build: Callable[..., Path]) -> None:
    rig, _ = imu_rig(2.5, build=build("", 8_000_000), frequency_hz=8_000_000)
    assert len(rig.payloads(ImuPayload, since_s=1.0)) == pytest.approx(150, abs=2)
    assert rig.sensors[1] == 0
    assert not rig.faults


def test_clipping_is_reported(imu_rig: MakeRig) -> None:
    world = still(accel_mps2=(0.0, 0.0, 100.0), gyro_radps=(0.0, -30.0, 0.0))
    rig, _ = imu_rig(START_S + 0.2, world=world)
    imu = rig.last(ImuPayload)
    assert imu.accel[2] == 32767
    assert imu.flags & CLIPPED == CLIPPED


@pytest.mark.parametrize(
    ("absent", "flag", "bits"),
    [("compass", ImuFlags.MAG_ABSENT, MAG), ("barometer", ImuFlags.BARO_ABSENT, BARO)],
)
def test_absent_sensor_is_reported_and_found_when_it_comes(
    imu_rig: MakeRig, absent: str, flag: ImuFlags, bits: int
) -> None:
    rig, node = imu_rig()
    device = getattr(node, absent)
    device.absent = True
    rig.run(1.6)
    assert flag in rig.last(ImuPayload).flags
    assert rig.sensors == (7 & ~bits, bits)
    assert len(rig.payloads(ImuPayload, since_s=0.6)) == pytest.approx(100, abs=2)
    device.absent = False
    rig.run(1.2)
    assert flag not in rig.last(ImuPayload).flags
    assert rig.sensors[0] == 7


def test_missing_imu_leaves_barometer_and_status(imu_rig: MakeRig) -> None:
    rig, node = imu_rig()
    node.imu.absent = True
    rig.run(1.6)
    assert not rig.payloads(ImuPayload)
    assert len(rig.payloads(BaroPayload)) > 20
    assert rig.sensors == (BARO, IMU | MAG)
    node.imu.absent = False
    node.imu.power_cycle()
    rig.run(0.8)
    assert len(rig.payloads(ImuPayload)) > 40
    assert not rig.last(ImuPayload).flags & ImuFlags.MAG_ABSENT


def test_imu_that_falls_asleep_in_flight_is_woken(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(1.0)
    node.imu.power_cycle()
    rig.run(0.5)
    assert len(rig.payloads(ImuPayload, since_s=1.15)) > 30
    assert not rig.last(ImuPayload).flags & ImuFlags.MAG_ABSENT


def test_imu_without_its_interrupt_is_polled_and_reported(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(0.8)
    chip, woken = node.imu, 0
    write = chip.write_register

    def count(register: int, value: int) -> None:
        nonlocal woken
        woken += register == PWR_MGMT_1
        write(register, value)

    chip.write_register, chip.interrupt_works = count, False
    rig.run(1.4)
    assert 3 <= woken <= 8
    assert rig.sensors[1] == IMU
    assert len(rig.payloads(BaroPayload, since_s=1.2)) == pytest.approx(25, abs=2)
    chip.interrupt_works = True
    rig.run(1.2)
    assert rig.sensors[1] == 0


def test_interrupted_self_test_restores_ranges(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(world=still(gyro_radps=(1.0, 0.0, 0.0)), noise=False)
    chip, read = node.imu, node.imu.read_register

    def refuse_what_follows(register: int) -> int:
        if register == SELF_TEST + 3:
            chip.refuse_bytes = 1
        return read(register)

    chip.read_register = refuse_what_follows
    rig.run(START_S + 0.3)
    assert rig.last(ImuPayload).gyro == (round(math.degrees(1.0) * 32.8), 0, 0)


def test_refused_bytes_are_counted_and_skipped(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(0.8)
    node.barometer.refuse_bytes = 2
    node.imu.refuse_bytes = 1
    rig.run(1.2)
    assert (rig.last(NodeStatusPayload).bus_errors, rig.sensors[1]) == (3, 0)
    assert len(rig.payloads(ImuPayload, since_s=0.8)) == pytest.approx(120, abs=2)


@pytest.mark.parametrize("clocks", [1, 8])
def test_hung_slave_is_clocked_free(imu_rig: MakeRig, clocks: int) -> None:
    rig, node = imu_rig(0.8)
    node.bus.hang(clocks)
    rig.run(1.3)
    assert rig.last(NodeStatusPayload).bus_errors >= 1
    assert rig.sensors[1] == 0
    assert len(rig.payloads(ImuPayload, since_s=0.8)) > 120


def test_permanently_held_bus_stops_samples_but_not_node(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(0.8)
    node.bus.hang(10**6)
    rig.run(1.5)
    assert node.mcu.resets == 0
    assert rig.sensors[1] == 7
    before = len(rig.payloads(ImuPayload))
    node.bus.hang(0)
    rig.run(0.8)
    assert len(rig.payloads(ImuPayload)) > before + 30
    assert not rig.last(ImuPayload).flags & (ImuFlags.MAG_ABSENT | ImuFlags.BARO_ABSENT)


@pytest.mark.parametrize("pressure_pa", [30_000.0, 70_000.0, 109_000.0])
def test_other_calibration_words_give_the_same_pressure(
    imu_rig: MakeRig, pressure_pa: float
) -> None:
    rig, node = imu_rig(world=still(pressure_pa=pressure_pa, temperature_degc=-8.0))
    node.barometer.__init__(
        rig.setup.world,
        lambda: node.mcu.now_ps,
        Words(7911, -1022, -14429, 33996, 25204, 16739, 5498, 57, -32768, -11786, 2723),
    )
    rig.run(START_S + 0.15)
    baro = rig.last(BaroPayload)
    assert baro.pressure_centipa == pytest.approx(pressure_pa * 100, abs=400)
    assert baro.temperature_ddegc == pytest.approx(-80, abs=1)
