"""PX4's and ArduPilot's own logs: written by the published formats, read back, fused."""

import math
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from gateway.analysis.metrics import rms, rotation_error, total_error_rad
from gateway.cli.support.options import read_options
from gateway.cli.support.recordings import load_flight
from gateway.config import GatewaySettings
from gateway.recordings.files import FlightError
from gateway.recordings.flown import open_flown
from gateway.recordings.recorded_table import RecordedTable
from gateway.recordings.recording import open_recording
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableReader
from gateway.records import BaroRaw, GpsFix, ImuCalibrated
from tests.kit.cli import run
from tests.recordings.flights import OPTIONS
from tests.recordings.formats import flown

pytestmark = pytest.mark.io

TODAY = GatewaySettings()

MAKERS: dict[str, tuple[Callable[[float], bytes], int]] = {
    "new.ulg": (lambda seconds: flown.make_ulog(seconds=seconds), 7),
    "old.ulg": (lambda seconds: flown.make_ulog(old=True, seconds=seconds), 7),
    "flight.bin": (flown.make_dataflash, 9),
    "flight.log": (flown.make_dataflash_text, 9),
}


def make_logs(folder: Path, seconds: float) -> Path:
    for name, (make, _) in MAKERS.items():
        flown.write(folder / name, make(seconds))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of the whole flight."""
    return make_logs(tmp_path_factory.mktemp("logs"), flown.DURATION_S)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Logs of its first third, which are read many times."""
    return make_logs(tmp_path_factory.mktemp("logs"), flown.DURATION_S / 3)


def rows_of(path: Path) -> tuple[RecordedTable, list[TableRow]]:
    table = open_recording(path).rows(OPTIONS)
    return table, list(table.plain_rows)


whole = cache(rows_of)


@pytest.mark.parametrize("name", MAKERS)
def test_logged_samples_are_read(folder: Path, name: str) -> None:
    table, rows = whole(folder / name)
    assert table.header.vehicle_id == MAKERS[name][1]
    assert table.remarks == []
    zero_us = flown.records()[0].time_us
    logged = [r for r in flown.records() if isinstance(r, ImuCalibrated)]
    imus = [row.imu for row in rows if row.imu is not None]
    assert [imu.time_us for imu in imus] == [r.time_us - zero_us for r in logged]
    for axis in ("accel_b_mps2", "gyro_b_radps"):
        np.testing.assert_allclose(
            [getattr(imu, axis) for imu in imus], [getattr(r, axis) for r in logged], rtol=1e-6
        )
    mags = [imu.mag_b_ut for imu in imus if imu.mag_b_ut]
    np.testing.assert_allclose(mags, [r.mag_b_ut for r in logged if r.mag_b_ut], atol=0.051)
    baros = [row.baro.pressure_pa for row in rows if row.baro]
    sent = [r.pressure_pa for r in flown.records() if isinstance(r, BaroRaw)]
    np.testing.assert_allclose(baros, sent, rtol=1e-6)


def test_repeated_magnetometer_field_is_read_once(tmp_path: Path) -> None:
    """PX4 of 2017 repeated the last one in every row, and marked it."""
    form = flown.FORMATS["sensor_combined"]
    form += "int32_t magnetometer_timestamp_relative;float[3] magnetometer_ga;"
    log = flown.Ulog({"sensor_combined": form}, {"MAV_SYS_ID": 7})
    inertial = (0.0, 0.0, 0.0, 4000, 0, 0.0, 0.0, -9.8, 4000)
    for number in range(12):
        mark = -500 if number % 3 == 0 else 0x7FFF_FFFF
        log.add("sensor_combined", 4000 * number, *inertial, mark, 0.2, 0.0, 0.4)
    _, rows = rows_of(flown.write(tmp_path / "older.ulg", b"".join(log.parts)))
    fields = [row.imu.mag_b_ut for row in rows if row.imu is not None]
    assert [bool(field) for field in fields] == [True, False, False] * 4


@pytest.mark.parametrize("name", MAKERS)
def test_fixes_have_all_values_of_the_log(folder: Path, name: str) -> None:
    table, rows = whole(folder / name)
    fixes = [row.gps for row in rows if row.gps]
    sent = [r for r in flown.records() if isinstance(r, GpsFix)]
    assert [f.fix_ok for f in fixes] == [r.fix_ok for r in sent]
    pairs = [(f, r) for f, r in zip(fixes, sent, strict=True) if r.fix_ok]
    assert len(pairs) > 100
    for f, r in pairs:
        for exact in ("lat_dege7", "lon_dege7", "satellites"):
            assert getattr(f, exact) == getattr(r, exact)
        for rounded in ("alt_amsl_m", "h_acc_m", "v_acc_m", "speed_acc_mps"):
            assert getattr(f, rounded) == pytest.approx(getattr(r, rounded), abs=0.006)
        assert f.vel_n_mps == pytest.approx(r.vel_n_mps, abs=1e-4)
        assert f.utc_us is not None
        assert r.utc_us is not None
        assert abs(f.utc_us - r.utc_us) <= 1000
    first = pairs[0][1]
    assert table.header.unix_us_at_zero is not None
    zero_us = flown.records()[0].time_us
    at_us = (first.utc_us or 0) - (first.time_us - zero_us)
    assert table.header.unix_us_at_zero == pytest.approx(at_us, abs=200_000)


@pytest.mark.parametrize("name", MAKERS)
def test_states_of_the_autopilot_are_read_for_comparison(folder: Path, name: str) -> None:
    _, rows = whole(folder / name)
    states = [row.state for row in rows if row.state]
    assert len(states) > 0.9 * len(flown.estimated())
    zero_us = flown.records()[0].time_us
    estimated = {b.time_us - zero_us: b for b in flown.estimated()}
    near = [(s, estimated[s.time_us]) for s in states if s.time_us in estimated]
    assert len(near) > 0.9 * len(states)
    error = total_error_rad(
        rotation_error(np.array([s.q_nb for s, _ in near]), np.array([b.q_nb for _, b in near]))
    )
    assert math.degrees(float(error.max())) < 0.02
    for s, b in near[20::50]:
        assert (s.lat_deg, s.lon_deg) == pytest.approx((b.lat_deg, b.lon_deg), abs=1e-7)
        assert s.vel_n_mps == pytest.approx(b.vel_n_mps, abs=1e-4)


@pytest.mark.parametrize("name", ["new.ulg", "flight.bin"])
def test_log_is_fused_to_the_true_attitude_and_position(
    folder: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "states.csv"
    run("fuse", folder / name, "-o", out, "--gps-latency", "0.15", "--estimator", "eskf")
    rows = [
        row
        for row in TableReader().feed(out.read_bytes(), final=True)
        if isinstance(row, TableRow) and row.state and row.time_us > 30_000_000
    ]
    assert len(rows) > 2000
    time_s = np.array([row.time_us + flown.records()[0].time_us for row in rows]) / 1e6
    truth = flown.simulated().trajectory.truth_at(time_s)
    q_nb = np.array([row.state.q_nb for row in rows if row.state])
    assert math.degrees(rms(total_error_rad(rotation_error(q_nb, truth.q_nb)))) < 2.0
    alt = np.array([row.state.alt_amsl_m for row in rows if row.state])
    assert rms(alt - truth.alt_amsl_m) < 3.0
    lat = np.array([row.state.lat_deg for row in rows if row.state])
    assert rms((lat - truth.lat_deg) * 111_000) < 3.0


def test_report_and_simulator_accept_autopilot_logs(folder: Path) -> None:
    # The autopilot's own attitude is one more row of a report.
    loaded = load_flight(folder / "flight.bin", TODAY, read_options(TODAY))
    assert loaded.recorded is not None
    assert np.isfinite(loaded.recorded.q_nb).all(axis=1).mean() > 0.9
    flight = open_flown([folder / "new.ulg"], OPTIONS)
    assert flight.duration_s == pytest.approx(flown.DURATION_S, abs=1.0)


def test_missing_package_is_named(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("ulog", "ulog_record"):
        monkeypatch.delitem(sys.modules, f"gateway.recordings.formats.{module}", raising=False)
    monkeypatch.setitem(sys.modules, "pyulog", None)
    text = run("convert", short / "new.ulg", "-o", tmp_path / "x.csv", code=2)
    assert "needs the extra formats" in text


@pytest.mark.parametrize("name", ["new.ulg", "flight.bin"])
def test_damage_is_counted_and_reported(short: Path, tmp_path: Path, name: str) -> None:
    data = (short / name).read_bytes()
    _, all_rows = whole(short / name)
    middle = len(data) // 2
    spoilt = flown.write(
        tmp_path / name, data[:middle] + b"\x00\xff" * 300 + data[middle + 777 : -11]
    )
    table, rows = rows_of(spoilt)
    assert len(all_rows) > len(rows) > 0.9 * len(all_rows)
    assert any("is damaged" in remark for remark in table.remarks)
    text = run("convert", spoilt, "-o", tmp_path / "x.csv")
    assert "is damaged" in text


CONSOLE = b"INFO  [blackbox] log file opened, free space 14 GB\r\n"


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(
    "before",
    [bytes(90), b"\xff" * 20_000, CONSOLE * 30, bytes(50) + CONSOLE],
    ids=["zeros", "erased", "text", "zeros and text"],
)
def test_bytes_before_a_log_are_left_out_and_reported(
    short: Path, tmp_path: Path, name: str, before: bytes
) -> None:
    path = flown.write(tmp_path / name, before + (short / name).read_bytes())
    table, rows = rows_of(path)
    assert repr(rows) == repr(whole(short / name)[1])
    # Text before a log of text is a title.
    size = len(before.rstrip(CONSOLE)) if name == "flight.log" else len(before)
    said = [f"{path}: left out {size} bytes before its first message"] if size else []
    assert table.remarks == said


@pytest.mark.parametrize("name", ["new.ulg", "old.ulg", "flight.bin"])
def test_samples_behind_a_lost_header_are_read(short: Path, tmp_path: Path, name: str) -> None:
    data = bytes(90) + (short / name).read_bytes()[90:]
    table, rows = rows_of(flown.write(tmp_path / name, data))
    assert len(rows) == len(whole(short / name)[1])
    assert any("before its first message" in remark for remark in table.remarks)


def test_fixes_behind_lost_formats_are_read(tmp_path: Path) -> None:
    """The first row is one of a lost format, so that the index of the log is empty."""
    formats = {name: form for name, form in flown.DATAFLASH.items() if name != "GPA"}
    rows = [row for row in flown.dataflash_rows(4.0) if row[0] != "GPA"]
    lost = len(flown.dataflash_of({name: formats[name] for name in ("FMT", "PARM")}, []))
    data = bytes(lost) + flown.dataflash_of(formats, rows)[lost:]
    _, found = rows_of(flown.write(tmp_path / "damaged.bin", data))
    assert sum(row.gps is not None for row in found) == sum(name == "GPS" for name, _ in rows)


def test_download_of_a_log_in_a_tlog_is_a_tlog(short: Path, tmp_path: Path) -> None:
    frame = b"\xfd\x09\0\0\0\x01\x01\0\0\0" + bytes(11)
    for name in ("new.ulg", "flight.bin"):
        data = bytes(8) + frame + bytes(8) + frame[:12] + (short / name).read_bytes()[:500]
        assert open_recording(flown.write(tmp_path / "download.tlog", data)).is_mavlink


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("share", [0.0, 0.002, 0.01])
def test_log_cut_before_its_samples_is_refused(
    short: Path, tmp_path: Path, name: str, share: float
) -> None:
    data = (short / name).read_bytes()
    stub = flown.write(tmp_path / name, data[: 100 + int(share * 8000)])
    with pytest.raises(FlightError, match=name):
        list(open_recording(stub).rows(OPTIONS).rows)
    assert name in run("info", stub, code=2)


@pytest.mark.parametrize("end", [b"\0" * 40, b"\x10\x27\xee", b"\xff" * 40, b"\x01\x00"])
def test_ulog_cut_in_its_formats_is_refused(tmp_path: Path, end: bytes) -> None:
    head = b"".join(flown.Ulog(flown.FORMATS, {"MAV_SYS_ID": 7}).parts[:6])
    stub = flown.write(tmp_path / "cut.ulg", head + end)
    with pytest.raises(FlightError, match=r"cut.ulg: contains no sensor_combined"):
        rows_of(stub)


@pytest.mark.parametrize(
    "formats",
    [
        ["vehicle_attitude:vehicle_attitude again;"],
        ["vehicle_attitude:a[3999] b;", "a:" + "b[3999] x;" * 50, "b:uint8_t x;"],
    ],
)
def test_ulog_with_endless_formats_is_refused(tmp_path: Path, formats: list[str]) -> None:
    log = flown.Ulog({}, {})
    log.parts += [flown.ulog_message(b"F", text.encode()) for text in formats]
    log.parts.append(flown.ulog_message(b"A", bytes(3) + b"vehicle_attitude"))
    path = flown.write(tmp_path / "odd.ulg", b"".join(log.parts))
    with pytest.raises(FlightError, match=r"odd.ulg: cannot be read as a ULog"):
        rows_of(path)


@pytest.mark.parametrize(
    ("odd", "is_read"),
    [
        # A dropout has its length in two bytes.
        (flown.ulog_message(b"O", b"\0"), True),
        # A message that seems to last beyond the end.
        (b"\xff\xffD", False),
    ],
)
def test_unreadable_end_of_a_ulog_is_reported(
    short: Path, tmp_path: Path, odd: bytes, is_read: bool
) -> None:
    data = (short / "new.ulg").read_bytes()
    middle = data.index(flown.SYNC, len(data) - 40_000) - 3
    spoilt = flown.write(tmp_path / "odd.ulg", data[:middle] + odd + data[middle:])
    table, rows = rows_of(spoilt)
    assert len(rows) > 0.4 * len(whole(short / "new.ulg")[1])
    lost = len(data) - middle + (0 if is_read else len(odd))
    assert f"left out {lost} bytes at its end" in " ".join(table.remarks)


@pytest.mark.parametrize("letters", [b"Q?", b"Q\xff"])
def test_dataflash_log_with_an_unknown_value_type_is_refused(
    tmp_path: Path, letters: bytes
) -> None:
    layout = flown.packed("FMT", (200, 12, b"NEW", letters, b"TimeUS,X"))
    data = flown.make_dataflash(1.0)
    path = flown.write(tmp_path / "odd.bin", data[:89] + layout + data[89:])
    with pytest.raises(FlightError, match=r"odd.bin: its list of formats is damaged"):
        rows_of(path)


def test_invalid_lines_of_a_text_log_are_counted(short: Path, tmp_path: Path) -> None:
    lines = (short / "flight.log").read_bytes().splitlines(keepends=True)
    _, all_rows = whole(short / "flight.log")
    numbers = [k for k, line in enumerate(lines) if line.startswith(b"IMU, ")]
    cut, wrong, nameless = numbers[50], numbers[70], numbers[90]
    lines[cut] = lines[cut][:20] + b"\n"
    lines[wrong] = lines[wrong].replace(b".", b"x")
    lines[nameless] = lines[nameless].replace(b"IMU", b"I%U")
    table, rows = rows_of(flown.write(tmp_path / "odd.log", b"".join(lines)))
    times_us = [row.time_us for row in rows if row.imu is not None]
    assert len(times_us) == len(set(times_us)) == sum(r.imu is not None for r in all_rows) - 3
    assert [r for r in table.remarks if "left out 3 messages that cannot be decoded" in r]
    assert not any("cannot be decoded" in r for r in whole(short / "flight.log")[0].remarks)


@pytest.mark.parametrize("name", ["flight.bin", "flight.log"])
def test_log_truncated_while_read_is_still_read_whole(
    short: Path, tmp_path: Path, name: str
) -> None:
    log = flown.write(tmp_path / name, (short / name).read_bytes())
    table = open_recording(log).rows(OPTIONS)
    rows = table.plain_rows
    first = next(rows)
    os.truncate(log, 0)
    assert repr([first, *rows]) == repr(whole(short / name)[1])
