"""The commands that read recordings, run as people run them."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from gateway.config import GatewaySettings
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableFault, TableHeader, TableReader
from gateway.wire.mavlink_splitter import origin_of
from tests.kit.cli import run
from tests.kit.recordings import read_tlog
from tests.recordings.flights import flown_table

pytestmark = pytest.mark.io


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "flight.csv"
    path.write_bytes(flown_table(20))
    return path


def read_table(path: Path) -> tuple[TableHeader, list[TableRow]]:
    reader = TableReader()
    events = reader.feed(path.read_bytes(), final=True)
    assert not [event for event in events if isinstance(event, TableFault)]
    assert reader.header is not None
    return reader.header, [event for event in events if isinstance(event, TableRow)]


def test_interpolated_positions_lie_on_lines_between_fixes(table: Path, tmp_path: Path) -> None:
    out = tmp_path / "again.csv"
    run("fuse", table, "-o", out, "--position", "interpolated")
    _, rows = read_table(out)
    fixes = [(row.gps.time_us, row.gps.alt_amsl_m) for row in rows if row.gps]
    latency_us = round(1e6 * GatewaySettings().default_aircraft.estimation.reference.gps_latency_s)
    times, alts = np.array(fixes).T
    middle = rows[len(rows) // 2].state
    assert middle is not None
    assert middle.alt_amsl_m == pytest.approx(np.interp(middle.time_us, times - latency_us, alts))


def test_tables_of_two_aircraft_become_one_tlog_but_no_table(table: Path, tmp_path: Path) -> None:
    other, out = tmp_path / "other.csv", tmp_path / "both.tlog"
    other.write_bytes(table.read_bytes().replace(b'"vehicle_id":1', b'"vehicle_id":2', 1))
    assert "aircraft 1 and 2" in run("convert", table, other, "-o", tmp_path / "x.csv", code=2)
    run("convert", other, table, "-o", out)
    records = read_tlog(out)
    senders = [origin_of(record.frame)[0] for record in records]
    assert senders.count(1) == senders.count(2) > 500
    stamps = [record.time_us for record in records]
    assert stamps == sorted(set(stamps))


def test_foreign_csv_is_converted_by_its_column_map(tmp_path: Path) -> None:
    lines = ["time_s,ax,ay,az,gx,gy,gz,baro_alt_m,gps_time_s,gps_lat,gps_lon,gps_alt_m"]
    for i in range(500):
        gps = f"{0.02 * i},47.1,8.5,430" if i % 10 == 0 else ",,,"
        lines.append(f"{0.02 * i},0,0,-9.81,0,0,0,430,{gps}")
    source, out, own = (tmp_path / name for name in ("log.csv.gz", "flight.csv", "map.toml"))
    source.write_bytes(gzip.compress("\n".join(lines).encode()))
    run("convert", source, "-o", out)
    states = [row.state for row in read_table(out)[1] if row.state is not None]
    assert len(states) == 500
    assert states[-1].lat_deg == pytest.approx(47.1, abs=1e-6)
    assert math.isfinite(states[-1].alt_amsl_m)
    axes = [f'accel_{axis}_b_mps2 = "a{axis}"\ngyro_{axis}_b_radps = "g{axis}"' for axis in "xyz"]
    own.write_text("\n".join(["[columns]", 'time_us = "t"', *axes]))
    words = ("convert", source, "-o", out, "--force", "--columns", own)
    assert "has no column t" in run(*words, code=2)
    own.write_text(own.read_text().replace('"t"', '{ column = "time_s", scale = 1e6 }'))
    run(*words)
    _, rows = read_table(out)
    assert (len(rows), rows[-1].gps) == (500, None)


def test_part_given_twice_is_taken_once_and_reported(table: Path, tmp_path: Path) -> None:
    written = table.read_text()
    assert '"session":""' in written
    table.write_text(written.replace('"session":""', '"session":"flight"'))
    text = run("convert", table, table, "-o", tmp_path / "x.csv")
    files = (tmp_path / "x.csv", table)
    times, recorded = ([row.time_us for row in read_table(path)[1]] for path in files)
    assert f"left out {len(recorded) - 1} rows that overlap" in text
    assert times == [*recorded, recorded[-1]]
