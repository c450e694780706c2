"""Parquet as pyarrow reads it, and back as the table that it was made of."""

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from gateway.recordings import files
from gateway.recordings.columns import COLUMNS
from gateway.recordings.formats import parquet as parquet_file
from gateway.recordings.recording import open_recording
from gateway.recordings.workshop.convert import WRITERS, FlightToWrite
from gateway.recordings.workshop.editing import TlogEdits
from gateway.recordings.workshop.selection import FrameChoice
from tests.kit.cli import run
from tests.kit.recordings import START_US, STEP_US, make_records, write_tlog
from tests.recordings.flights import OPTIONS, commented_table
from tests.recordings.formats import flown

pytestmark = pytest.mark.io


@pytest.fixture
def table(tmp_path: Path) -> Path:
    return flown.write(tmp_path / "flight.csv", commented_table())


def test_columns_have_types_and_units(table: Path, tmp_path: Path) -> None:
    run("convert", table, "-o", tmp_path / "a.parquet")
    found = pq.read_table(tmp_path / "a.parquet")
    assert found.column_names == ["time", *COLUMNS, "comments"]
    kinds = {field.name: field.type for field in found.schema}
    assert kinds["time"] == pa.timestamp("us", "UTC")
    assert kinds["time_us"] == kinds["accel_x_raw"] == kinds["gps_lat_dege7"] == pa.int64()
    assert kinds["gps_fix_ok"] == pa.bool_()
    assert kinds["accel_x_b_mps2"] == kinds["nav_q_w"] == pa.float64()
    units = {f.name: f.metadata[b"unit"].decode() for f in found.schema if f.metadata}
    assert units["accel_x_b_mps2"] == "m/s^2"
    assert units["nav_vel_north_mps"] == "m/s"
    assert units["mag_x_b_ut"] == "uT"
    assert units["nav_lat_deg"] == "deg"
    assert units["gps_lat_dege7"] == "1e-7 deg"
    assert json.loads(found.schema.metadata[b"mavgate.header"])["vehicle_id"] == 1
    rows = [line for line in table.read_text().splitlines() if line[0].isdigit()]
    assert len(found) == len(rows)
    first = rows[0].split(",")
    assert found["time_us"][0].as_py() == int(first[0])
    assert found["time"].cast(pa.int64())[0].as_py() == START_US + int(first[0])
    assert found["nav_q_w"][0].as_py() == float(first[COLUMNS.index("nav_q_w")])
    assert found["gps_pdop"][0].as_py() is None


def test_info_and_convert_accept_parquet(table: Path, tmp_path: Path) -> None:
    columns = tmp_path / "flight.parquet"
    run("convert", table, "-o", columns)
    described = [json.loads(run("info", file, "--json")) for file in (table, columns)]
    assert described[1]["kind"] == "Parquet"
    for each in described:
        for name in ("kind", "size"):
            each.pop(name)
    assert described[0] == described[1]


def test_one_kind_of_message_is_a_typed_table(tmp_path: Path) -> None:
    path, out = write_tlog(tmp_path / "a.tlog", make_records(300)), tmp_path / "a.parquet"
    run("convert", path, "-o", out, "--message", "ATTITUDE_QUATERNION")
    found = pq.read_table(out)
    assert len(found) == 100
    assert found.schema.field("q1").type == pa.float32()
    assert found.schema.field("time_boot_ms").metadata == {b"unit": b"ms"}
    assert found.schema.field("repr_offset_q").type == pa.list_(pa.float32())
    assert found["time"].cast(pa.int64())[0].as_py() == START_US + STEP_US
    assert set(found["system_id"].to_pylist()) == {1}
    run("convert", path, "-o", out, "--message", "253", "--force")
    assert pq.read_table(out)["text"][0].as_py() == "number 2"
    mode = pq.read_schema(out).field("severity")
    assert (mode.type, mode.metadata) == (pa.uint8(), {b"enum": b"MAV_SEVERITY"})


def test_parquet_is_written_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """So memory is bounded by a few rows."""
    monkeypatch.setattr(parquet_file, "ROWS", 50)
    monkeypatch.setattr(files, "CHUNK", 5000)
    path = write_tlog(tmp_path / "a.tlog", make_records(3000))
    edits = TlogEdits(choice=FrameChoice(messages=frozenset({0})))
    flight = FlightToWrite([open_recording(path)], OPTIONS, edits)
    sizes = [len(piece) for piece in WRITERS[".parquet"](flight)]
    assert len(sizes) > 10
    assert max(sizes[:-1]) < 10_000


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-100], lambda data: data[:9000] + bytes(400) + data[9400:]]
)
def test_damaged_parquet_is_refused(table: Path, tmp_path: Path, damage: object) -> None:
    columns, spoilt = tmp_path / "flight.parquet", tmp_path / "spoilt.parquet"
    run("convert", table, "-o", columns)
    assert callable(damage)
    spoilt.write_bytes(damage(columns.read_bytes()))
    assert "cannot be read as Parquet" in run("convert", spoilt, "-o", tmp_path / "x.csv", code=2)


def test_foreign_parquet_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.parquet"
    pq.write_table(pa.table({"a": [1, 2]}), path)
    assert "no column time_us" in run("convert", path, "-o", tmp_path / "x.csv", code=2)


def test_messages_of_a_table_are_made_by_its_fusion(table: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.parquet"
    run("convert", table, "-o", out, "--message", "GLOBAL_POSITION_INT")
    found = pq.read_table(out)
    assert len(found) > 50
    assert found["lat"][len(found) // 2].as_py() == pytest.approx(471_234_567, abs=30_000)
