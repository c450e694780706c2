"""Every chip that a board may carry under the name of another, and how it is reported."""

import math
from itertools import cycle, pairwise, product

import pytest

from firmware.rig.barometer import BAROMETERS
from firmware.rig.boards import Parts
from firmware.rig.compass import make_compass
from firmware.rig.gps import GPS_MODULES
from firmware.rig.imu import IMU_CHIPS
from firmware.rig.world import Moment, World
from gateway.records import GpsFixType, ImuFlags, RadioState
from gateway.wire.payloads import (
    MAG_LSB_PER_GAUSS,
    BaroPayload,
    GpsFixPayload,
    GpsQualityPayload,
    ImuPayload,
    NodeStatusPayload,
)
from tests.firmware.harness import BARO, GPS, IMU, MAG, START_S, MakeRig, always, still

pytestmark = [pytest.mark.io, pytest.mark.slow]

MAG_UT = (20.0, -31.0, 43.0)
BROKEN_IMUS = {"ignores its ranges": MAG | BARO, "constant data": IMU | MAG | BARO}
"""Reported as present."""
WORKING_IMUS = [name for name in IMU_CHIPS if name not in BROKEN_IMUS]
COMPASSES = {
    "HMC5883L": ("HMC5883L", 1090), "HMC5983": ("HMC5883L", 1090), "DA5883": ("HMC5883L", 1090),
    "QMC5883L": ("QMC5883L", 3000), "QMC5883P": ("QMC5883P", 3750),
}  # fmt: skip
"""Reported name and counts per gauss."""
AIRS = ((94_321.5, 21.53), (30_000.0, -30.0), (109_000.0, 60.0))
BOARDS = [*zip(product(BAROMETERS, AIRS), cycle(WORKING_IMUS), cycle(COMPASSES), strict=False)]
"""Every barometer at every pressure and temperature, and every IMU and compass at least once."""


def at_rest(pressure_pa: float = 94_321.5, temperature_degc: float = 21.53) -> World:
    return still(
        accel_mps2=(9.80665, -4.903325, 2.4516625),
        gyro_radps=(math.radians(90), math.radians(-45), math.radians(100)),
        mag_ut=MAG_UT,
        temperature_degc=temperature_degc,
        pressure_pa=pressure_pa,
    )


@pytest.mark.parametrize(("of_barometer", "imu", "compass"), BOARDS, ids=str)
def test_look_alikes_are_found_and_read_with_their_scales_and_rates(
    imu_rig: MakeRig, of_barometer: tuple[str, tuple[float, float]], imu: str, compass: str
) -> None:
    barometer, (pressure_pa, temperature_degc) = of_barometer
    parts = Parts(imu=imu, compass=compass, barometer=barometer)
    rig, _ = imu_rig(1.8, world=at_rest(pressure_pa, temperature_degc), parts=parts, noise=False)
    sample = rig.last(ImuPayload)
    assert sample.accel == (4096, -2048, 1024)
    assert sample.gyro == pytest.approx((2952, -1476, 3280), rel=0.001)
    assert sample.temperature == pytest.approx((temperature_degc - 36.53) * 340, abs=4)
    assert sample.flags & ~ImuFlags.MAG_NEW == ImuFlags.ACCEL_FILTERED
    assert (sample.accel_range, sample.gyro_range) == (2, 2)
    assert len(rig.payloads(ImuPayload, since_s=START_S)) == pytest.approx(135, abs=2)
    shown, counts_per_gauss = COMPASSES[compass]
    assert MAG_LSB_PER_GAUSS[sample.mag_gain] == counts_per_gauss
    # On the axes of the footprint.
    assert sample.mag == pytest.approx([ut / 100 * counts_per_gauss for ut in MAG_UT], abs=1)
    new = [p for p in rig.payloads(ImuPayload, since_s=1.3) if ImuFlags.MAG_NEW in p.flags]
    assert len(new) == pytest.approx(37, abs=3)
    baro = rig.last(BaroPayload)
    # The BMP180's whole numbers round by some pascals.
    assert baro.pressure_centipa == pytest.approx(pressure_pa * 100, abs=800)
    assert baro.temperature_ddegc == pytest.approx(temperature_degc * 10, abs=1)
    assert len(rig.payloads(BaroPayload, since_s=START_S)) == pytest.approx(34, abs=2)
    assert rig.sensors == (IMU | MAG | BARO, 0)
    named = imu.replace("clone", "MPU6050 look-alike, id")
    assert rig.chips == (named, shown, barometer.removesuffix(" at 0x77"))
    assert rig.last(NodeStatusPayload).bus_errors == 0


@pytest.mark.parametrize("name", ["MPU6050", "MPU6500", "ICM-20689"])
def test_failed_self_test_is_reported_and_samples_continue(imu_rig: MakeRig, name: str) -> None:
    rig, node = imu_rig(parts=Parts(imu=name))
    node.imu.self_test_works = False
    rig.run(START_S + 0.3)
    assert ImuFlags.SELF_TEST_FAILED in rig.last(ImuPayload).flags
    assert rig.sensors[1] == IMU


@pytest.mark.parametrize(("name", "present"), BROKEN_IMUS.items())
def test_broken_imu_is_not_used_but_the_compass_is(
    imu_rig: MakeRig, name: str, present: int
) -> None:
    rig, _ = imu_rig(1.3, parts=Parts(imu=name))
    assert not rig.payloads(ImuPayload)
    assert rig.sensors == (present, IMU)


@pytest.mark.parametrize(
    ("name", "east_ut", "counts"),
    [
        ("HMC5883L", 500.0, (218, -4096, 436)),
        ("QMC5883L", 850.0, (-4096, -4096, -4096)),
        ("QMC5883P", 850.0, (-4096, -4096, -4096)),
    ],
)
def test_field_beyond_the_compass_range_is_marked(
    imu_rig: MakeRig, name: str, east_ut: float, counts: tuple[int, ...]
) -> None:
    world = still(mag_ut=(20.0, east_ut, 40.0))
    rig, _ = imu_rig(START_S + 0.15, world=world, parts=Parts(compass=name))
    assert rig.last(ImuPayload).mag == counts


@pytest.mark.parametrize("name", ["HMC5883L", "DA5883", "QMC5883L", "QMC5883P"])
def test_compass_that_lost_its_set_up_is_set_up_again(imu_rig: MakeRig, name: str) -> None:
    world = World(moment=lambda time_s: Moment(mag_ut=(22.0 + 10.0 * time_s, 1.5, 42.0)))
    rig, node = imu_rig(0.8, world=world, parts=Parts(compass=name))
    node.compass.power_cycle()
    rig.run(0.6)
    last = rig.last(ImuPayload)
    per_ut = MAG_LSB_PER_GAUSS[last.mag_gain] / 100
    tolerance = 5 if name == "HMC5883L" else 1.0 * per_ut
    assert last.mag[0] == pytest.approx(per_ut * (22.0 + 10.0 * rig.now_s), abs=tolerance)
    assert ImuFlags.MAG_ABSENT not in last.flags
    stale = [p for p in rig.payloads(ImuPayload, since_s=0.85) if p.mag[0] < 30.5 * per_ut]
    assert not any(ImuFlags.MAG_NEW in p.flags for p in stale)


def test_compass_that_is_exchanged_for_another_is_found(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(0.8, world=at_rest(), parts=Parts(compass="QMC5883P"))
    node.compass.absent = True
    rig.run(0.3)
    assert ImuFlags.MAG_ABSENT in rig.last(ImuPayload).flags
    node.bus.devices.append(make_compass("HMC5883L", at_rest(), lambda: node.mcu.now_ps, node.imu))
    rig.run(0.4)
    assert (rig.last(ImuPayload).mag, rig.last(ImuPayload).mag_gain) == ((218, -338, 469), 1)


@pytest.mark.parametrize("name", BAROMETERS)
def test_barometer_that_disappears_and_returns_is_found_again(imu_rig: MakeRig, name: str) -> None:
    rig, node = imu_rig(0.8, world=at_rest(), parts=Parts(barometer=name))
    node.barometer.absent = True
    rig.run(0.5)
    assert ImuFlags.BARO_ABSENT in rig.last(ImuPayload).flags
    node.barometer.absent = False
    rig.run(0.5)
    assert ImuFlags.BARO_ABSENT not in rig.last(ImuPayload).flags
    assert len(rig.payloads(BaroPayload, since_s=1.5)) >= 6


GPS_BAUDS = (4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400)
FOUND_S = 5.0
UBX_HZ, NMEA_HZ = 5, 1
SPEED_CASES = [
    *((name, None) for name in GPS_MODULES),
    *((name, baud) for name in ("u-blox M10", "NMEA") for baud in GPS_BAUDS),
    *(("u-blox M8", baud) for baud in (4800, 230_400)),
    *(("u-blox, no acknowledgement", baud) for baud in (4800, 57_600, 230_400)),
]


@pytest.mark.parametrize(("name", "baud"), SPEED_CASES)
def test_gps_is_found_at_its_stored_speed_and_sends_its_full_rate(
    gps_rig: MakeRig, name: str, baud: int | None
) -> None:
    rig, node = gps_rig(FOUND_S, parts=Parts(gps=name, gps_baud=baud))
    assert rig.payloads(GpsFixPayload)
    rig.run(2.0)
    is_nmea = name.startswith("NMEA")
    fixes = rig.payloads(GpsFixPayload, since_s=FOUND_S)
    assert len(fixes) == (2 * NMEA_HZ if is_nmea else 2 * UBX_HZ)
    assert node.gps.dynamic_model == (0 if is_nmea else 8)
    # NMEA has no velocity down: there it is the difference of two heights, which are the same.
    down_cmps = 0 if is_nmea else -89
    for fix in fixes:
        assert fix.lat_dege7 == pytest.approx(-77_123_456, abs=2)
        assert fix.lon_dege7 == pytest.approx(1_103_654_321, abs=2)
        assert fix.alt_amsl_mm == pytest.approx(153_250, abs=50 if is_nmea else 0)
        assert fix.vel_n_cmps == pytest.approx((1234, -567, down_cmps), abs=1)
        assert (fix.fix_type, fix.fix_ok) == (GpsFixType.FIX_3D, True)
    assert str(rig.last(GpsQualityPayload).utc).startswith("2026-11-19 00:00:06")
    assert rig.sensors == (GPS, 0)
    shown = f"NMEA receiver at {baud or 9600} baud" if is_nmea else f"{name} at 57600 baud"
    if name.endswith("no acknowledgement"):
        shown = "u-blox look-alike at 57600 baud, acknowledges nothing"
    assert rig.chips == (shown,)
    assert node.mcu.resets == 0


@pytest.mark.parametrize("name", ["u-blox 6", "u-blox M10"])
@pytest.mark.parametrize("baud", [4800, 38_400, 57_600, 230_400])
def test_gps_that_sends_nothing_is_found(gps_rig: MakeRig, name: str, baud: int) -> None:
    rig, node = gps_rig(parts=Parts(gps=name, gps_baud=baud))
    node.gps.store_no_messages()
    rig.run(FOUND_S + 1.0)
    assert rig.payloads(GpsFixPayload)
    assert len(rig.payloads(GpsFixPayload, since_s=FOUND_S)) == UBX_HZ


def test_gps_that_never_acknowledges_loses_no_fix_once_it_is_set_up(gps_rig: MakeRig) -> None:
    rig, _ = gps_rig(7.0, parts=Parts(gps="u-blox, no acknowledgement"))
    assert len(rig.payloads(GpsFixPayload, since_s=3.0)) == 4 * UBX_HZ


@pytest.mark.parametrize(
    ("name", "baud", "limit_s"),
    [
        ("u-blox M8", 9600, 3.0),
        ("u-blox M10", 38_400, FOUND_S),
        ("u-blox 6", 9600, FOUND_S),
        # An NMEA receiver counts as lost only after three seconds: it sends once a second.
        ("NMEA", 9600, 6.0),
    ],
)
def test_gps_that_resets_in_flight_is_found_again(
    gps_rig: MakeRig, name: str, baud: int, limit_s: float
) -> None:
    rig, node = gps_rig(FOUND_S, parts=Parts(gps=name, gps_baud=57_600))
    node.gps.reset(baud)
    reset_s = rig.now_s
    rig.run(FOUND_S + 1.0)
    again = [t for t, f in rig.frames if isinstance(f.payload, GpsFixPayload) and t > reset_s + 0.3]
    assert again[0] - reset_s < limit_s
    assert node.gps.dynamic_model == (0 if name == "NMEA" else 8)
    assert node.mcu.resets == 0


def test_gps_that_disappears_is_reported_and_found_when_it_returns(gps_rig: MakeRig) -> None:
    rig, node = gps_rig(FOUND_S, parts=Parts(gps="u-blox M10"))
    node.gps.absent = True
    rig.run(3.5)
    assert rig.sensors[1] == GPS
    assert rig.last(NodeStatusPayload).bus_errors < 10
    node.gps.absent = False
    rig.run(FOUND_S)
    assert len(rig.payloads(GpsFixPayload, since_s=rig.now_s - 1.0)) == UBX_HZ
    assert rig.sensors[1] == 0


def test_nmea_accuracy_comes_from_the_dilution_of_precision(gps_rig: MakeRig) -> None:
    world = always(pdop=3.0, alt_amsl_m=100.0, geoid_separation_m=-7.5)
    rig, _ = gps_rig(FOUND_S, world=world, parts=Parts(gps="NMEA"))
    quality = rig.last(GpsQualityPayload)
    # The model's horizontal dilution is half, its vertical dilution 0.8 of that of the position.
    assert (quality.h_acc_cm, quality.v_acc_cm, quality.speed_acc_cmps) == (600, 960, 150)
    assert (quality.pdop_centi, quality.geoid_separation_cm) == (300, -750)
    assert quality.course_acc_cdeg == 65_535


@pytest.mark.parametrize("name", ["u-blox M8", "NMEA"])
def test_no_fix_is_reported_and_sent_on(gps_rig: MakeRig, name: str) -> None:
    blind = always(fix_type=0, fix_ok=False, satellites=2, time_valid=False, h_acc_m=4e6)
    rig, _ = gps_rig(FOUND_S, world=blind, parts=Parts(gps=name))
    fix, quality = rig.last(GpsFixPayload), rig.last(GpsQualityPayload)
    assert (fix.fix_type, fix.fix_ok, fix.satellites) == (GpsFixType.NONE, False, 2)
    assert (quality.h_acc_cm, quality.utc, rig.sensors[1]) == (65_535, None, 0)


RADIO, CLONES = "nRF24L01+", ("nRF24L01", "Si24R1", "clone with ACTIVATE")
ACTIVATED = {"nRF24L01", "clone with ACTIVATE"}
RADIO_PAIRS = [(RADIO, RADIO), *product(CLONES, [RADIO]), *product([RADIO], CLONES),
               *pairwise([*CLONES, CLONES[0]])]  # fmt: skip


@pytest.mark.parametrize(("receiver", "node"), RADIO_PAIRS)
def test_radio_clones_work_with_one_another(imu_rig: MakeRig, receiver: str, node: str) -> None:
    rig, _ = imu_rig(1.4, parts=Parts(radio=receiver, node_radio=node))
    assert len(rig.payloads(ImuPayload, since_s=1.0)) == pytest.approx(40, abs=3)
    assert rig.lost(0) == 0
    expected = dict.fromkeys(ACTIVATED, RadioState.ACTIVATED)
    status = rig.last(NodeStatusPayload)
    assert status.radio == expected.get(node, RadioState.OK)
    assert status.reset_cause == 1
    assert rig.statuses[-1].radio == expected.get(receiver, RadioState.OK)


@pytest.mark.parametrize("part", ["FEATURE", "DYNPD", "the rate", "its address"])
def test_receiver_reports_a_radio_that_keeps_no_configuration(imu_rig: MakeRig, part: str) -> None:
    rig, _ = imu_rig(2.2, parts=Parts(radio=f"loses {part}"))
    assert not rig.frames
    assert [status.radio for status in rig.statuses] == [RadioState.LOSES_SETTINGS] * 2


def test_receiver_reports_a_radio_that_does_not_answer_and_that_it_is_back(
    imu_rig: MakeRig,
) -> None:
    rig, _ = imu_rig()
    rig.receiver.radio.absent = True
    rig.run(2.2)
    assert [status.radio for status in rig.statuses] == [RadioState.ABSENT] * 2
    assert rig.receiver.mcu.resets == 0
    rig.receiver.radio.absent = False
    rig.run(1.5)
    assert rig.statuses[-1].radio == RadioState.OK
    assert rig.payloads(ImuPayload)
