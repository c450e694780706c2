"""The commands that read recordings, run as people run them."""

import gzip
import math
from pathlib import Path

import msgspec
import numpy as np
import pytest

from gateway.config import GatewaySettings
from gateway.recordings.columns import TableRow
from gateway.recordings.table import TableFault, TableHeader, TableReader
from gateway.wire.mavlink_splitter import origin_of
from tests.kit.cli import run
from tests.kit.recordings import make_records, read_tlog, write_tlog
from tests.recordings.flights import flown_table

pytestmark = pytest.mark.io

RECORDS = make_records(500)


@pytest.fixture
def tlog(tmp_path: Path) -> Path:
    return write_tlog(tmp_path / "flight.tlog", RECORDS)


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


def test_tlog_is_trimmed_to_a_range(tlog: Path, tmp_path: Path) -> None:
    out = tmp_path / "part.tlog"
    run("convert", tlog, "-o", out, "--from", "0:02", "--to", "4")
    assert read_tlog(out) == RECORDS[100:201]


@pytest.mark.parametrize("ending", ["csv", "tlog", "kml", "parquet"])
@pytest.mark.parametrize("options", [("--from", "99:00"), ("--from", "2100-01-01T00:00:00Z")])
def test_range_without_samples_is_refused(
    tlog: Path, table: Path, tmp_path: Path, ending: str, options: tuple[str, str]
) -> None:
    for source in (tlog, table) if ending in ("tlog", "kml") else (table,):
        out = tmp_path / f"out.{ending}"
        text = run("convert", source, "-o", out, *options, code=2)
        assert "nothing between that begin and end" in text
        assert not out.exists()


@pytest.mark.parametrize(
    "words",
    ["convert {} -o out.tlog", "fuse {} -o out.csv", "extract {} --params out.param",
     "diff {} {} --html out.html", "sweep {} --vary beta=0.1,0.9 -o out.toml", "report {} -o out"],
)  # fmt: skip
def test_existing_output_is_overwritten_only_with_force(
    table: Path, monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    monkeypatch.chdir(table.parent)
    out = Path(words.split()[-1])
    if out.suffix == "":
        out.mkdir()
        out /= "index.html"
    out.write_text("dear")
    assert "use --force to overwrite" in run(
        *words.format("flight.csv", "flight.csv").split(), code=2
    )
    assert out.read_text() == "dear"
    if words.startswith("convert"):
        run(*words.format("flight.csv").split(), "--force")
        assert read_tlog(out)


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


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("convert -o x.tlog --from soon", "invalid time"),
        ("convert -o x.tlog --from 4 --to 2", "from --from 4 to --to 2 is empty"),
        ("convert -o x.kml", "{0}: nothing to draw, since the flight has no position"),
        ("play --from 1:30", "it ends after 10.0 s, before --from"),
        ("play --to 2010-01-01", "nothing between that begin and end"),
        ("play --from 9 --to 2010-01-01", "nothing between that begin and end"),
    ],
)
def test_impossible_options_for_a_recording_are_refused(
    tlog: Path, monkeypatch: pytest.MonkeyPatch, words: str, text: str
) -> None:
    monkeypatch.chdir(tlog.parent)
    command, *options = words.split()
    endpoint = ("--endpoint", "udp:127.0.0.1:1") if command == "play" else ()
    assert text.format(tlog) in run(command, tlog, *options, *endpoint, code=2)
    assert [*tlog.parent.iterdir()] == [tlog]


def test_part_given_twice_is_taken_once_and_reported(table: Path, tmp_path: Path) -> None:
    written = table.read_text()
    assert '"session":""' in written
    table.write_text(written.replace('"session":""', '"session":"flight"'))
    text = run("convert", table, table, "-o", tmp_path / "x.csv")
    files = (tmp_path / "x.csv", table)
    times, recorded = ([row.time_us for row in read_table(path)[1]] for path in files)
    assert f"left out {len(recorded) - 1} rows that overlap" in text
    assert times == [*recorded, recorded[-1]]


def test_info_as_text_reports_incomplete_and_damaged_records(tlog: Path) -> None:
    assert "500 records" in (text := run("info", tlog))
    assert "HEARTBEAT" in text
    whole = tlog.read_bytes()
    tlog.write_bytes(whole[:-3])
    text = run("info", tlog)
    assert "the last record is incomplete" in text
    assert "damaged" not in text
    tlog.write_bytes(whole[:1000] + b"\xaa" * 77 + whole[1000:])
    assert "damaged" in run("info", tlog)


@pytest.mark.parametrize("content", [b"", b"not MAVLink at all"])
def test_file_that_is_no_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.tlog"
    path.write_bytes(content)
    for command, *words in (["info"], ["recover"], ["play"], ["convert", "-o", "x.kml"]):
        assert f"{path}: unknown file format" in run(command, path, *words, code=2)
    assert not list(tmp_path.glob("x.*.tlog"))
    assert "No such file" in run("info", tmp_path / "none.tlog", code=2)


def test_recover_keeps_intact_records_of_a_tlog(tlog: Path, tmp_path: Path) -> None:
    data = tlog.read_bytes()
    tlog.write_bytes(data[:1000] + b"\xaa" * 77 + data[1000:-5] + bytes(4096))
    text = run("recover", tlog)
    found = read_tlog(tmp_path / "flight.recovered.tlog")
    assert len(found) >= 498
    assert all(record in RECORDS for record in found)
    assert "bytes left out" in text
    assert tlog.read_bytes()[1000:1077] == b"\xaa" * 77


def test_recover_keeps_intact_rows_of_a_table(table: Path, tmp_path: Path) -> None:
    whole = table.read_bytes()
    lines = whole.split(b"\n")
    lines[10] = b"\0" * 50
    table.write_bytes(b"\n".join(lines)[:-7])
    text = run("recover", table)
    assert "line 11" in text
    _, rows = read_table(tmp_path / "flight.recovered.csv")
    assert len(rows) == len(lines) - 4 - 2


def test_recover_keeps_rows_of_a_table_without_its_head(table: Path, tmp_path: Path) -> None:
    whole = table.read_bytes()
    table.write_bytes(whole.replace(b"# header: {", b"# header: }", 1))
    text = run("recover", table)
    assert "head is lost" in text
    header, rows = read_table(tmp_path / "flight.recovered.csv")
    assert header.settings == {}
    assert len(rows) == whole.count(b"\n") - 3
    run("fuse", tmp_path / "flight.recovered.csv", "-o", tmp_path / "x.csv")


def test_recover_to_another_format_is_refused(tlog: Path, table: Path, tmp_path: Path) -> None:
    for file, out, kept in (
        (table, tmp_path / "x.tlog", ".csv"),
        (tlog, tmp_path / "x.csv", ".tlog"),
    ):
        text = run("recover", file, "-o", out, code=2)
        assert f"is repaired as a {kept}; then `mavgate convert` that" in text
        assert not out.exists()


def test_trimmed_flight_is_fused_from_its_begin(table: Path, tmp_path: Path) -> None:
    plain, fused = tmp_path / "plain.csv", tmp_path / "fused.csv"
    run("convert", table, "-o", plain, "--from", "5", "--to", "10")
    run("fuse", table, "-o", fused, "--from", "5", "--to", "10")
    assert fused.read_bytes() == plain.read_bytes()
    header, rows = read_table(fused)
    assert not header.cold_start
    times_us = [row.time_us for row in read_table(table)[1]]
    within = [t for t in times_us if 5_000_000 <= t - times_us[0] <= 10_000_000]
    assert [row.time_us for row in rows] == within


def test_head_of_a_fused_table_has_the_settings_of_its_fusion(table: Path, tmp_path: Path) -> None:
    config = tmp_path / "other.toml"
    config.write_text('[estimation]\nestimator = "paper"\n')
    again, twice = tmp_path / "again.csv", tmp_path / "twice.csv"
    run("fuse", table, "-o", again, "--fuse-with", "current", "--config", config)
    run("fuse", again, "-o", twice)
    assert twice.read_bytes() == again.read_bytes() != table.read_bytes()


def test_record_commands_manage_files_without_a_gateway(tmp_path: Path) -> None:
    config, folder = tmp_path / "x.toml", tmp_path / "rec"
    config.write_text(f'[recording]\nfolder = "{folder}"\n')
    folder.mkdir()
    write_tlog(folder / "a_01.tlog", RECORDS)
    assert "nothing runs" in run("record", "start", code=2)
    listed = msgspec.json.decode(run("info", "--json", "-c", config))
    assert [recording["name"] for recording in listed] == ["a"]
    run("record", "rename", "first flight", "-c", config)
    assert "aborted" in run("record", "delete", "last", "-c", config, code=1).lower()
    assert [path.name for path in folder.glob("*.tlog")] == ["first flight_01.tlog"]
    run("record", "delete", "last", "--yes", "-c", config)
    assert list(folder.glob("*.tlog")) == []


@pytest.mark.parametrize("ending", ["csv", "tlog", "kml", "gpx", "geojson", "mcap", "parquet"])
@pytest.mark.parametrize("source", ["tlog", "table"])
def test_unknown_vehicle_is_refused_with_those_of_the_file(
    request: pytest.FixtureRequest, tmp_path: Path, source: str, ending: str
) -> None:
    file = request.getfixturevalue(source)
    text = run("convert", file, "-o", tmp_path / f"x.{ending}", "--system", "7", code=2)
    assert f"{file}: no vehicle 7 in this file; it has 1" in text


def test_files_of_different_kinds_are_refused(tlog: Path, table: Path, tmp_path: Path) -> None:
    text = run("convert", tlog, table, "-o", tmp_path / "x.kml", code=2)
    assert "the files differ in format" in text
    assert f"{tlog}: tlog" in text
    (page := tmp_path / "page.html").write_text("<html></html>")
    text = run("convert", tlog, page, "-o", tmp_path / "x.tlog", code=2)
    assert f"{page}: unknown file format" in text
