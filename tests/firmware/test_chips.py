"""Every chip that a board may carry under the name of another, and how it is reported."""

import math
from collections.abc import Callable

import pytest

from firmware.rig.barometer import BAROMETERS
from firmware.rig.boards import Parts
from firmware.rig.compass import make_compass
from firmware.rig.gps import GPS_MODULES
from firmware.rig.imu import IMU_CHIPS
from firmware.rig.world import Moment, Solution, World
from gateway.records import GpsFixType, ImuFlags, RadioState
from gateway.wire.payloads import (
    MAG_LSB_PER_GAUSS,
    BaroPayload,
    GpsFixPayload,
    GpsQualityPayload,
    ImuPayload,
    NodeStatusPayload,
    chip_names,
)
from tests.firmware.harness import Bench

pytestmark = [pytest.mark.io, pytest.mark.slow]

MakeBench = Callable[..., Bench]
IMU, MAG, BARO, GPS = 1, 2, 4, 8
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


@pytest.mark.parametrize("name", ["MPU6050", "MPU6500", "ICM-20689"])
def test_failed_self_test_is_reported_and_samples_continue(bench: MakeBench, name: str) -> None:
    rig = bench(parts=Parts(imu=name))
    rig.imu_node().imu.self_test_works = False
    rig.run(START_S + 0.3)
    assert ImuFlags.SELF_TEST_FAILED in rig.last(ImuPayload).flags
    assert rig.last(NodeStatusPayload).sensors_failed == IMU


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


@pytest.mark.parametrize("name", ["HMC5883L", "DA5883", "QMC5883L", "QMC5883P"])
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
    tolerance = 5 if name == "HMC5883L" else 1.0 * per_ut
    assert last.mag[0] == pytest.approx(per_ut * (22.0 + 10.0 * rig.now_s), abs=tolerance)
    assert ImuFlags.MAG_ABSENT not in last.flags
    stale = [p for p in rig.payloads(ImuPayload, since_s=0.85) if p.mag[0] < 30.5 * per_ut]
    assert not any(ImuFlags.MAG_NEW in p.flags for p in stale)


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


GPS_BAUDS = (4800, 9600, 19_200, 38_400, 57_600, 115_200, 230_400)
FOUND_S = 5.0
UBX_HZ, NMEA_HZ = 5, 1
SPEED_CASES = [
    *((name, None) for name in GPS_MODULES),
    *((name, baud) for name in ("u-blox M8", "u-blox M10", "NMEA") for baud in GPS_BAUDS),
    *(("u-blox, no acknowledgement", baud) for baud in (4800, 57_600, 230_400)),
]


@pytest.mark.parametrize(("name", "baud"), SPEED_CASES)
def test_gps_is_found_at_its_stored_speed_and_sends_its_full_rate(
    bench: MakeBench, name: str, baud: int | None
) -> None:
    rig = bench(parts=Parts(gps=name, gps_baud=baud))
    node = rig.gps_node()
    rig.run(FOUND_S)
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
    utc = rig.last(GpsQualityPayload).utc
    assert utc is not None
    assert utc.isoformat().startswith("2026-11-19T00:00:06")
    status = rig.last(NodeStatusPayload)
    assert (status.sensors_present, status.sensors_failed) == (GPS, 0)
    assert node.mcu.resets == 0


@pytest.mark.parametrize("name", ["u-blox 6", "u-blox M10"])
@pytest.mark.parametrize("baud", [4800, 38_400, 57_600, 230_400])
def test_gps_that_sends_nothing_is_found(bench: MakeBench, name: str, baud: int) -> None:
    rig = bench(parts=Parts(gps=name, gps_baud=baud))
    rig.gps_node().gps.store_no_messages()
    rig.run(FOUND_S + 1.0)
    assert rig.payloads(GpsFixPayload)
    assert len(rig.payloads(GpsFixPayload, since_s=FOUND_S)) == UBX_HZ


def test_gps_that_never_acknowledges_loses_no_fix_once_it_is_set_up(bench: MakeBench) -> None:
    rig = bench(parts=Parts(gps="u-blox, no acknowledgement"))
    rig.gps_node()
    rig.run(7.0)
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
    bench: MakeBench, name: str, baud: int, limit_s: float
) -> None:
    rig = bench(parts=Parts(gps=name, gps_baud=57_600))
    node = rig.gps_node()
    rig.run(FOUND_S)
    node.gps.reset(baud)
    reset_s = rig.now_s
    rig.run(FOUND_S + 1.0)
    again = [t for t, f in rig.frames if isinstance(f.payload, GpsFixPayload) and t > reset_s + 0.3]
    assert again[0] - reset_s < limit_s
    assert node.gps.dynamic_model == (0 if name == "NMEA" else 8)
    assert node.mcu.resets == 0


def test_gps_that_disappears_is_reported_and_found_when_it_returns(bench: MakeBench) -> None:
    rig = bench(parts=Parts(gps="u-blox M10"))
    node = rig.gps_node()
    rig.run(FOUND_S)
    node.gps.absent = True
    rig.run(3.5)
    assert rig.last(NodeStatusPayload).sensors_failed == GPS
    assert rig.last(NodeStatusPayload).bus_errors < 10
    node.gps.absent = False
    rig.run(FOUND_S)
    assert len(rig.payloads(GpsFixPayload, since_s=rig.now_s - 1.0)) == UBX_HZ
    assert rig.last(NodeStatusPayload).sensors_failed == 0


def test_nmea_accuracy_comes_from_the_dilution_of_precision(bench: MakeBench) -> None:
    solution = Solution(pdop=3.0, alt_amsl_m=100.0, geoid_separation_m=-7.5)
    rig = bench(world=World(solution=lambda _time_s: solution), parts=Parts(gps="NMEA"))
    rig.gps_node()
    rig.run(FOUND_S)
    quality = rig.last(GpsQualityPayload)
    # The model's horizontal dilution is half, its vertical dilution 0.8 of that of the position.
    assert (quality.h_acc_cm, quality.v_acc_cm, quality.speed_acc_cmps) == (600, 960, 150)
    assert (quality.pdop_centi, quality.geoid_separation_cm) == (300, -750)
    assert quality.course_acc_cdeg == 65_535


def test_nmea_receiver_without_a_fix_reports_none(bench: MakeBench) -> None:
    blind = Solution(fix_type=0, fix_ok=False, satellites=2)
    rig = bench(world=World(solution=lambda _time_s: blind), parts=Parts(gps="NMEA"))
    rig.gps_node()
    rig.run(FOUND_S)
    fix, quality = rig.last(GpsFixPayload), rig.last(GpsQualityPayload)
    assert (fix.fix_type, fix.fix_ok, fix.satellites) == (GpsFixType.NONE, False, 2)
    assert quality.h_acc_cm == 65_535


WORKING_RADIOS = ("nRF24L01+", "nRF24L01", "Si24R1", "clone with ACTIVATE")
ACTIVATED = {"nRF24L01", "clone with ACTIVATE"}


@pytest.mark.parametrize("receiver", WORKING_RADIOS)
@pytest.mark.parametrize("node", WORKING_RADIOS)
def test_radio_clones_work_with_one_another(bench: MakeBench, receiver: str, node: str) -> None:
    rig = bench(parts=Parts(radio=receiver, node_radio=node))
    rig.imu_node()
    rig.run(2.3)
    assert len(rig.payloads(ImuPayload, since_s=1.0)) == pytest.approx(130, abs=3)
    assert rig.lost(0) == 0
    expected = dict.fromkeys(ACTIVATED, RadioState.ACTIVATED)
    status = rig.last(NodeStatusPayload)
    assert status.radio == expected.get(node, RadioState.OK)
    assert status.reset_cause == 1
    assert rig.statuses[-1].radio == expected.get(receiver, RadioState.OK)


@pytest.mark.parametrize(
    ("radio", "state"),
    [
        ("loses FEATURE", RadioState.LOSES_SETTINGS),
        ("loses DYNPD", RadioState.LOSES_SETTINGS),
        ("loses the rate", RadioState.LOSES_SETTINGS),
        ("loses its address", RadioState.LOSES_SETTINGS),
    ],
)
def test_receiver_reports_a_radio_that_keeps_no_configuration(
    bench: MakeBench, radio: str, state: RadioState
) -> None:
    rig = bench(parts=Parts(radio=radio))
    rig.imu_node()
    rig.run(2.2)
    assert not rig.frames
    assert [status.radio for status in rig.statuses] == [state, state]


def test_receiver_reports_a_radio_that_does_not_answer_and_that_it_is_back(
    bench: MakeBench,
) -> None:
    rig = bench()
    rig.imu_node()
    rig.receiver.radio.absent = True
    rig.run(2.2)
    assert [status.radio for status in rig.statuses] == [RadioState.ABSENT] * 2
    assert rig.receiver.mcu.resets == 0
    rig.receiver.radio.absent = False
    rig.run(1.5)
    assert rig.statuses[-1].radio == RadioState.OK
    assert rig.payloads(ImuPayload)


@pytest.mark.parametrize(
    ("parts", "names"),
    [
        (Parts(), ("MPU6050", "HMC5883L", "BMP180")),
        (Parts("MPU6500", "QMC5883L", "BMP280"), ("MPU6500", "QMC5883L", "BMP280")),
        (Parts("ICM-20689", "QMC5883P", "BME280"), ("ICM-20689", "QMC5883P", "BME280")),
        (
            Parts("clone 0x72", "DA5883", "BMP280 at 0x77"),
            ("MPU6050 look-alike, id 0x72", "HMC5883L", "BMP280"),
        ),
        (Parts("clone 0x00"), ("MPU6050 look-alike, id 0x00", "HMC5883L", "BMP180")),
    ],
)
def test_imu_node_reports_its_chips(bench: MakeBench, parts: Parts, names: tuple[str, ...]) -> None:
    rig = bench(parts=parts)
    rig.imu_node()
    rig.run(1.2)
    status = rig.last(NodeStatusPayload)
    assert status.chips is not None
    assert chip_names(status.chips, status.sensors_present) == names


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("u-blox 6", "u-blox 6 at 57600 baud"),
        ("u-blox 7", "u-blox 7 at 57600 baud"),
        ("u-blox M8", "u-blox M8 at 57600 baud"),
        ("u-blox 9", "u-blox 9 at 57600 baud"),
        ("u-blox M10", "u-blox M10 at 57600 baud"),
        (
            "u-blox, no acknowledgement",
            "u-blox look-alike at 57600 baud, acknowledges nothing",
        ),
        ("NMEA", "NMEA receiver at 9600 baud"),
    ],
)
def test_gps_node_reports_its_receiver(bench: MakeBench, name: str, text: str) -> None:
    rig = bench(parts=Parts(gps=name))
    rig.gps_node()
    rig.run(FOUND_S + 1.2)
    status = rig.last(NodeStatusPayload)
    assert status.chips is not None
    assert chip_names(status.chips, status.sensors_present) == (text,)
