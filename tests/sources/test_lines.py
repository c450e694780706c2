"""Lines of text: JSON, NMEA 0183, and faults; any chunking gives the same records."""

import json
import math
from typing import Any

import pytest
from pynmeagps import GET, NMEAMessage

from gateway.records import BaroRaw, GpsFix, GpsFixType, ImuRaw, NodeId, VehicleReport
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.sources.kinds import make_decoder, make_sources
from gateway.sources.settings import SourceSettings, parse_source
from gateway.sources.source import SourceInput
from gateway.sources.trial import SourceTrial, describe
from gateway.wire.framing import Fault

NODE = NodeId(3, 8)
MAP = """[columns]
time_us = { column = "t", scale = 1000.0 }
accel_x_b_mps2 = "ax"
accel_y_b_mps2 = "ay"
accel_z_b_mps2 = "az"
gyro_x_b_radps = "gx"
gyro_y_b_radps = "gy"
gyro_z_b_radps = "gz"
gps_lat_dege7 = { column = "lat", scale = 1e7 }
gps_lon_dege7 = { column = "lon", scale = 1e7 }
baro_pressure_pa = { column = "hpa", scale = 100.0 }
"""
HEADER = "t,ax,ay,az,gx,gy,gz,lat,lon,hpa\n"


def decode_csv(text: str, names: str = "") -> list[Any]:
    settings = SourceSettings(url=f"lines:stdin?columns=MAP{names}")
    (source,) = make_sources((settings,), lambda _: MAP)
    return source.decoder.feed(text.encode(), 1_000_000)


def test_csv_is_read_by_the_map_of_columns_of_files() -> None:
    values = "10,0.5,-1.25,9.8,0,0,0.5,48.5,11.5,1001.5\n20,0.5,-1.25,9.8,0,0,0.5,,,\n"
    found = decode_csv(HEADER + values)
    assert [type(each) for each in found] == [BaroRaw, GpsFix, ImuRaw, ImuRaw]
    baro, fix, first, second = found
    assert (baro.pressure_pa, fix.lat_dege7) == (pytest.approx(100_150.0), 485000000)
    assert second.time_us > first.time_us
    sample = SensorChain(NodeCalibration()).imu(first)
    assert sample.accel_b_mps2 == pytest.approx((0.5, 1.25, -9.8), abs=0.0004)
    assert sample.gyro_b_radps[2] == pytest.approx(-0.5, abs=0.0001)
    without = decode_csv(values, "&names=t,ax,ay,az,gx,gy,gz,lat,lon,hpa")
    assert [repr(each) for each in without] == [repr(each) for each in found]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("1,2,3\n", "before the line of column names"),
        (HEADER + "x,1,1,1,1,1,1,1,1,1\n", "not a number"),
        (HEADER + "5\n", "no value of the map"),
    ],
)
def test_csv_that_cannot_be_used_is_an_explained_fault(text: str, why: str) -> None:
    (fault,) = decode_csv(text)
    assert fault.kind == "csv"
    assert why in fault.detail


def test_wrong_map_is_refused_when_the_source_is_made() -> None:
    with pytest.raises(ValueError, match="map of columns"):
        make_sources((SourceSettings(url="lines:stdin?columns=MAP"),), lambda _: "[columns]\nx = 1")


def test_trial_names_rates_what_is_missing_and_a_map() -> None:
    trial = SourceTrial(parse_source("lines:stdin"))
    text = "time,acc_x,acc_y,acc_z\n1,2,3,4\n" + json_line(speed=1) + gga()
    trial.look_at(text.encode())
    events = decode(text)
    for event in events:
        trial.feed(event)
    shown = [*map(describe, events)]
    assert shown[-1] == "GPS fix 48.117300 11.516667 545.4 m, 9 satellites"
    assert shown[0].startswith("unused (text): 'time,acc_x,acc_y,acc_z'")
    summary = trial.summary(2.0)
    assert "fault text: 2, 1.0 a second" in summary
    assert "attitude: no; it needs accelerometer and gyroscope in one object" in "".join(summary)
    assert "position: yes" in summary
    assert 'accel_y_b_mps2 = { column = "acc_y", scale = 1 }' in summary


@pytest.mark.parametrize(
    ("url", "data", "reason", "words"),
    [
        (
            "crsf:/dev/ttyUSB0",
            b"",
            "",
            "in 10 s: check port /dev/ttyUSB0, baud rate 420000",
        ),
        ("crsf:/dev/ttyUSB0", b"", "unplugged", "in 10 s: not connected: unplugged"),
        ("ltm:udp:127.0.0.1:9", b"", "", "uses 127.0.0.1:9 of this machine, and the firewall"),
        (
            "ltm:/dev/ttyUSB0?baud=1200",
            bytes(99),
            "",
            "none is LTM: baud rate 1200",
        ),
        (
            "crsf:udp:127.0.0.1:9",
            b"a,b,c,d,e\n" * 9,
            "",
            "90 bytes arrive, none is CRSF: does",
        ),
    ],
)
def test_trial_without_a_record_advises_by_transport(
    url: str, data: bytes, reason: str, words: str
) -> None:
    trial, parsed = SourceTrial(parse_source(url)), parse_source(url)
    trial.look_at(data)
    for event in make_decoder(parsed, NODE).feed(data, 0):
        trial.feed(event)
    summary = trial.summary(10.0, reason)
    assert words in summary[-1]
    assert trial.records == 0
    assert "lines" not in " ".join(summary)


def decode(text: str | bytes, url: str = "lines:stdin", arrival_us: int = 1_000_000) -> list[Any]:
    data = text.encode() if isinstance(text, str) else text
    parsed = parse_source(url)
    return [*SourceInput(parsed, NODE, make_decoder(parsed, NODE)).events(data, arrival_us)]


def json_line(**content: object) -> str:
    return json.dumps(content) + "\n"


def nmea(kind: str, *fields: str, talker: str = "GN") -> str:
    """Write a sentence by an independent implementation."""
    return NMEAMessage(talker, kind, GET, payload=[*fields]).serialize().decode()


GGA = ("101530.20", "4807.038", "N", "01131.000", "E", "1", "09", "0.9", "545.4", "M", "46.9", "M")
RMC = ("101530.20", "A", "4807.038", "N", "01131.000", "E", "22.4", "084.4", "230326")


def gga(talker: str = "GN", *, time: str = GGA[0]) -> str:
    return nmea("GGA", time, *GGA[1:], "", "", talker=talker)


def rmc(talker: str = "GN", *, time: str = RMC[0]) -> str:
    return nmea("RMC", time, *RMC[1:], "", "", "A", talker=talker)


def test_imu_in_si_keeps_its_values_through_counts_and_mounting() -> None:
    line = json_line(accel_mps2=[0.5, -1.25, 9.8], gyro_dps=[10, -20, 300], mag_ut=[21, -3.5, -44])
    (raw,) = decode(line)
    assert isinstance(raw, ImuRaw)
    sample = SensorChain(NodeCalibration()).imu(raw)
    assert sample.accel_b_mps2 == pytest.approx((0.5, 1.25, -9.8), abs=0.0004)
    rates = [math.radians(rate) for rate in (10, 20, -300)]
    assert sample.gyro_b_radps == pytest.approx(rates, abs=math.radians(0.005))
    assert sample.mag_b_ut == pytest.approx((21, 3.5, 44), abs=0.006)


@pytest.mark.parametrize(
    ("key", "value", "same"),
    [
        ("accel_g", [0, 0, 1], {"accel_mps2": [0, 0, 9.80665]}),
        ("gyro_radps", [math.pi, 0, 0], {"gyro_dps": [180.0, 0, 0]}),
        ("mag_gauss", [0.2, 0, 0.4], {"mag_ut": [20, 0, 40]}),
    ],
)
def test_other_units_give_the_same_record(key: str, value: list[float], same: dict) -> None:
    rest = {"accel_mps2": [0, 0, 9.8], "gyro_dps": [1, 2, 3], "mag_ut": [20, 0, 40]}
    other = {k: v for k, v in rest.items() if k.split("_")[0] != key.split("_")[0]}
    assert decode(json_line(**other, **{key: value})) == decode(json_line(**other, **same))


def test_position_battery_and_link_become_records() -> None:
    line = json_line(
        lat=-33.5, lon=151.25, alt_m=12.5, speed_mps=5, course_deg=90, satellites=11, h_acc_m=1.5,
        pressure_hpa=1001.5, battery_v=11.1, rssi_dbm=-80, mode="AUTO", armed=True,
    )  # fmt: skip
    baro, fix, report = decode(line)
    assert (baro.pressure_pa, baro.node) == (100_150.0, NODE)
    assert (fix.lat_dege7, fix.lon_dege7, fix.satellites) == (-335_000_000, 1_512_500_000, 11)
    assert fix.vel_n_mps[:2] == pytest.approx((0.0, 5.0), abs=1e-9)
    assert math.isnan(fix.vel_n_mps[2]), "the climb is not reported"
    assert fix.fix_ok
    assert report.battery.voltage_v == 11.1
    assert math.isnan(report.battery.current_a)
    assert (report.mode, report.armed, report.signal.rssi_dbm) == ("AUTO", True, -80)


def test_own_clock_is_followed_and_arrival_is_used_without_one() -> None:
    decoder = make_decoder(parse_source("lines:stdin"), NODE)
    stamped = [
        decoder.feed(json_line(t_ms=t, pressure_hpa=1000).encode(), 5_000_000 + t * 1000 + late)[0]
        for t, late in ((0, 0), (10, 9000), (20, 0))
    ]
    assert [record.time_us for record in stamped] == [5_000_000, 5_010_000, 5_020_000]
    lines = json_line(pressure_hpa=1000) * 3
    times = [record.time_us for record in decode(lines, arrival_us=7_000_000)]
    assert times[0] == 7_000_000
    assert times == sorted(set(times)), "samples of one chunk have different times"


def test_id_selects_the_vehicle_unless_the_url_does() -> None:
    line = json_line(id=7, pressure_hpa=1000)
    assert decode(line)[0].node == NodeId(7, 8)
    own = json_line(id=3, pressure_hpa=1000)
    (fault, record) = decode(line + own, "lines:stdin?id=3")
    assert (fault.kind, "vehicle 3 only" in fault.detail, record.node) == ("id", True, NODE)
    assert decode(json_line(id=99, pressure_hpa=1000))[0].kind == "id"


@pytest.mark.parametrize("talker", ["GP", "GN", "GL", "GA"])
@pytest.mark.parametrize("rmc_first", [False, True])
def test_gga_and_rmc_of_one_time_are_one_fix(talker: str, rmc_first: bool) -> None:
    times = [f"10153{n}.00" for n in range(4)]
    pairs = [[gga(talker, time=t), rmc(talker, time=t)] for t in times]
    text = "".join(line for pair in pairs for line in (pair[::-1] if rmc_first else pair))
    fixes = [each for each in decode(text) if isinstance(each, GpsFix)][2:]
    assert len(fixes) == 2, "after the first time, which shows that both are sent"
    fix = fixes[-1]
    assert fix.lat_dege7 == round((48 + 7.038 / 60) * 1e7)
    assert (fix.alt_amsl_m, fix.satellites, fix.fix_type) == (545.4, 9, GpsFixType.FIX_3D)
    speed = 22.4 * 1852 / 3600
    assert math.hypot(*fix.vel_n_mps[:2]) == pytest.approx(speed)
    assert fix.vel_n_mps[1] > fix.vel_n_mps[0] > 0.0
    assert fix.utc_us == 1_774_260_933_000_000


def test_accuracies_come_from_gst_or_else_from_the_dilution() -> None:
    gst = nmea("GST", "101530.20", "5", "", "", "", "3.0", "4.0", "6.0")
    (fix,) = decode(gst + gga())
    assert (fix.h_acc_m, fix.v_acc_m) == (5.0, 6.0)
    gsa = nmea("GSA", "A", "2", *([""] * 12), "2.0", "0.9", "1.7")
    (fix,) = decode(gsa + gga())
    assert fix.fix_type is GpsFixType.FIX_2D
    assert fix.h_acc_m == pytest.approx(3.6)


@pytest.mark.parametrize(
    "text",
    [
        nmea("GGA", "101530.20", "", "", "", "", "0", "00", "99.9", "", "M", "", "M", "", ""),
        nmea("RMC", "100000.00", "A", "0000.0000", "N", "00000.0000", "E", "0", "0", "010626", ""),
        "$GPRMC,000000.00,A,0.000,N,0.000,E,0.0,0.0,050525,0.0,E\n",
        json_line(lat=0, lon=0, alt_m=50, satellites=7),
        nmea("RMC", *RMC, "", "", "N"),
    ],
    ids=["empty fields", "zeros", "short zeros", "json", "mode N"],
)
def test_lines_without_a_position_are_no_fix(text: str) -> None:
    (fix,) = decode(text)
    assert (fix.fix_ok, fix.fix_type) == (False, GpsFixType.NONE)


@pytest.mark.parametrize(
    ("date", "is_used"),
    [("281126", True), ("010124", True), ("140407", False), ("010113", False), ("060180", False)],
)
def test_date_before_the_first_year_is_not_used(date: str, is_used: bool) -> None:
    *faults, fix = decode(nmea("RMC", *RMC[:8], date, *RMC[9:]))
    assert (fix.fix_ok, fix.utc_us is not None) == (True, is_used)
    assert [each.kind for each in faults] == ([] if is_used else ["gps date"])


def test_true_heading_is_reported_without_an_attitude() -> None:
    (report,) = decode(nmea("HDT", "271.5", "T", talker="HE"))
    assert isinstance(report, VehicleReport)
    assert report.heading_rad == pytest.approx(math.radians(271.5))
    assert report.attitude_rad is None


@pytest.mark.parametrize(
    ("line", "kind", "why"),
    [
        ("hello", "text", "neither JSON"),
        ('{"lat": 1', "json", "not a JSON object"),
        ("[" * 3000, "text", "neither"),
        ('{"lat":' + "[" * 3000, "json", "not a JSON object"),
        ('{"speed": 3}', "json key", "speed"),
        ('{"lat": NaN, "lon": 4}', "json", "valid value"),
        ('{"lat": 91, "lon": 4}', "json", "valid value"),
        ('{"pressure_hpa": "1000"}', "json", "valid value"),
        ('{"pressure_hpa": 1' + "0" * 400 + "}", "json", "valid value"),
        ("$GPGGA,101530.20,4807.038*00", "nmea checksum", "checksum"),
        ("$GPGGA,x,y", "nmea", "cannot be read"),
        (nmea("GGA", "101530.20", "4775.84", *GGA[2:]).strip(), "nmea", "cannot be read"),
        (nmea("GGA", "101530.20", "9923.84", *GGA[2:]).strip(), "nmea", "cannot be read"),
        ("$PUBX,00", "nmea", "not an NMEA sentence"),
        ("x" * 5000, "too long", "longer"),
    ],
)
def test_line_that_cannot_be_used_is_an_explained_fault(line: str, kind: str, why: str) -> None:
    good = json_line(pressure_hpa=1000)
    fault, record = decode(f"{line}\n{good}")
    assert (type(fault), fault.kind) == (Fault, kind)
    assert why in fault.detail
    assert isinstance(record, BaroRaw), "and the next line is read"


def test_endless_line_is_dropped_with_a_bound() -> None:
    decoder = make_decoder(parse_source("lines:stdin"), NODE)
    faults = [fault for _ in range(100) for fault in decoder.feed(b"x" * 1000, 0)]
    assert {fault.kind for fault in faults} == {"too long"}
    sizes = [fault.size for fault in faults]
    assert max(sizes) < 4096 + 1000
    assert sum(sizes) >= 100_000 - 4096, "what is not dropped is less than a line"


def test_datagram_needs_no_line_feed() -> None:
    line = json_line(pressure_hpa=1000).strip()
    assert decode(line) == []
    assert len(decode(line, "lines:udp:127.0.0.1:5600")) == 1
