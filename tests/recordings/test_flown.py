"""Any recording becomes a flight that the simulated receiver sends again."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs
from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.columns import COLUMNS
from gateway.recordings.files import FlightError
from gateway.recordings.flown import open_flown
from gateway.recordings.rows import row_to_line
from gateway.recordings.table import encode_head
from gateway.records import NAN
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import packed
from tests.kit.recordings import START_US, make_records, write_table, write_tlog
from tests.recordings.flights import OPTIONS, flown_table, read

pytestmark = pytest.mark.io


def test_recording_of_two_parts_is_opened_as_one_flight(tmp_path: Path) -> None:
    header, rows = read(flown_table(12))
    half = len(rows) // 2
    first = write_table(tmp_path / "a_01_v1.csv", header, rows[:half])
    second = write_table(tmp_path / "a_02_v1.csv", header, rows[half:])
    flight = open_flown([first, second], OPTIONS)
    sampled = [row for row in rows if row.imu is not None]
    assert len(flight.time_s) == len(sampled)
    np.testing.assert_array_equal(
        flight.accel_b_mps2, [row.imu.accel_b_mps2 for row in sampled if row.imu]
    )
    fixes = [row.gps for row in rows if row.gps is not None and row.gps.fix_ok]
    assert 0 < len(flight.gps_time_s) <= len(fixes)
    assert flight.gps_lat_deg[-1] == pytest.approx(fixes[-1].lat_dege7 * 1e-7)
    assert np.isfinite(flight.baro_alt_m).sum() > 10


def test_early_fixes_and_late_or_incomplete_samples_are_left_out(tmp_path: Path) -> None:
    header, rows = read(flown_table(5))
    path = tmp_path / "a.csv"
    whole = open_flown([write_table(path, header, rows)], OPTIONS)
    fixed = [k for k, row in enumerate(rows) if row.gps is not None and row.gps.fix_ok]
    early = {"time_us": rows[0].time_us - 1}
    for number, changes in ((fixed[0], early), (fixed[2], {"fix_ok": False})):
        rows[number] = replace(rows[number], gps=structs.replace(rows[number].gps, **changes))
    number, sample = next((k, row.imu) for k, row in enumerate(rows) if k > 60 and row.imu)
    incomplete = structs.replace(sample, accel_b_mps2=(0.1, NAN, -9.8))
    rows[number] = replace(rows[number], raw=None, imu=incomplete)
    rows.insert(number + 5, rows[number + 3])
    flight = open_flown([write_table(path, header, rows)], OPTIONS)
    left_out = int(np.searchsorted(whole.time_s, (sample.time_us - rows[0].time_us) / 1e6))
    np.testing.assert_array_equal(flight.time_s, np.delete(whole.time_s, left_out))
    np.testing.assert_array_equal(flight.gps_time_s, np.delete(whole.gps_time_s, [0, 2]))


def test_single_sample_is_no_flight(tmp_path: Path) -> None:
    header, rows = read(flown_table(1))
    sample = next(row for row in rows if row.imu is not None)
    with pytest.raises(FlightError, match="1 row with acceleration and rate; a flight has more"):
        open_flown([write_table(tmp_path / "a.csv", header, [sample])], OPTIONS)


def test_raw_counts_are_calibrated(tmp_path: Path) -> None:
    header, rows = read(flown_table(2))
    whole, bare = write_table(tmp_path / "whole.csv", header, rows), tmp_path / "bare.csv"
    ends = ("_b_mps2", "_b_radps", "_b_ut")
    kept = [i for i, name in enumerate(COLUMNS) if not name.endswith(ends)]
    *head, names = encode_head(header).splitlines()
    lines = [names, *map(row_to_line, rows)]
    cut = [",".join(line.rstrip("\n").split(",")[i] for i in kept) for line in lines]
    bare.write_text("\n".join([*head, *cut, ""]))
    a, b = open_flown([whole], OPTIONS), open_flown([bare], OPTIONS)
    np.testing.assert_allclose(a.accel_b_mps2, b.accel_b_mps2, atol=1e-9)
    np.testing.assert_allclose(a.gyro_b_radps, b.gyro_b_radps, atol=1e-9)


def test_tlog_of_an_autopilot_is_opened(tmp_path: Path) -> None:
    records = []
    for k in range(300):
        at_us = 20_000 * k
        imu = mavlink.MAVLink_highres_imu_message(
            at_us, 0.1, 0.2, -9.8, 0.01, 0.02, 0.03, 0.2, 0.0, 0.4, 950.0, 0.0, 540.0, 20.0, 0x1FFF
        )
        records.append(RecordedFrame(START_US + at_us, packed(imu)))
        if k % 10 == 0:
            gps = mavlink.MAVLink_gps_raw_int_message(
                at_us, 3, 470_000_000 + k, 85_000_000, 540_000, 100, 100, 500, 0, 9
            )
            records.append(RecordedFrame(START_US + at_us, packed(gps)))
    flight = open_flown([write_tlog(tmp_path / "other.tlog", records)], OPTIONS)
    assert len(flight.time_s) == 300
    assert flight.rate_hz == pytest.approx(50.0)
    np.testing.assert_allclose(flight.accel_b_mps2[0], [0.1, 0.2, -9.8], atol=1e-6)
    np.testing.assert_allclose(flight.gps_lat_deg[-1], 47.000029, atol=1e-7)


def test_foreign_csv_is_opened(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.csv"
    rows = [f"{k / 50},{k},0,-9.8,0,0,0,{100 + k},90,7\n" for k in range(9)]
    rows[3] = "oops" + rows[3]
    names = "time_s,ax,ay,az,gx,gy,gz,baro_alt_m,gps_course_deg,gps_speed_ms"
    for name, value in {"gps_lat": 47, "gps_lon": 8}.items():
        names += f",{name}"
        rows[5] = rows[5].replace("\n", f",{value}\n")
    path.write_text(f"# gps_latency_s=0.17\n{names}\n" + "".join(rows))
    flight = open_flown([path], OPTIONS)
    assert flight.accel_b_mps2[:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8]
    np.testing.assert_allclose(flight.time_s, flight.accel_b_mps2[:, 0] / 50)
    np.testing.assert_allclose(flight.baro_alt_m, 100 + flight.accel_b_mps2[:, 0])
    np.testing.assert_allclose(flight.gps_vel_n_mps, [[0.0, 7.0, 0.0]], atol=1e-9)
    assert (flight.gps_latency_s, flight.gps_time_s.tolist()) == (0.17, [0.1])
    assert "left out 1 line that cannot be read" in caplog.text


def test_file_without_a_flight_is_refused(tmp_path: Path) -> None:
    path = write_tlog(tmp_path / "a.tlog", make_records(9))
    with pytest.raises(FlightError, match=r"a\.tlog: contains no HIGHRES_IMU"):
        open_flown([path], OPTIONS)
