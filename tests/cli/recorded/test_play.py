"""What `mavgate play` makes of its files before it begins."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from gateway.cli.recorded.play import _lay_out, _open_all
from gateway.config import GatewaySettings
from gateway.flightlog.table.row import row_to_line
from gateway.flightlog.table.table import encode_head
from gateway.flightlog.tlog.tlog import TlogRecord
from gateway.flightlog.track import Track
from gateway.flights.reading import FlightError, ReadOptions
from gateway.pipeline import PipelineSettings
from tests.flightlog.frames import START_US, STEP_US, make_records, make_tlog
from tests.test_replay import fly, make_flight, read

pytestmark = pytest.mark.io

RECORDS = make_records(300)
OPTIONS = ReadOptions(PipelineSettings(GatewaySettings().default_aircraft))


def write(folder: Path, name: str, records: list[TlogRecord]) -> Path:
    path = folder / name
    path.write_bytes(make_tlog(records))
    return path


def lay_out(files: list[Path], *wished: int) -> list[Track]:
    with ExitStack() as opened:
        return _lay_out(_open_all(files, OPTIONS, opened), wished)


def test_parts_of_a_recording_are_one_flight(tmp_path: Path) -> None:
    parts = [write(tmp_path, f"a_0{n}.tlog", RECORDS[100 * n :][:100]) for n in (0, 1, 2)]
    tracks = lay_out(parts)
    assert [track.systems for track in tracks] == [{1}, {1}, {1}]
    assert [track.first_us for track in tracks] == [START_US + n * 100 * STEP_US for n in (0, 1, 2)]


def test_other_recordings_are_vehicles_of_their_own(tmp_path: Path) -> None:
    first = write(tmp_path, "first.tlog", RECORDS[:100])
    later = write(tmp_path, "later.tlog", RECORDS[200:])
    tracks = lay_out([first, later, first], 5)
    assert [track.systems for track in tracks] == [{5}, {1}, {2}]
    # Flights of other days begin together.
    assert [track.first_us for track in tracks] == [START_US] * 3


def test_parts_of_a_table_are_fused_as_one(tmp_path: Path, rng: np.random.Generator) -> None:
    header, rows = read(fly(GatewaySettings().default_aircraft, make_flight(rng, 10))[0])
    parts = []
    for number, some in ((1, rows[:200]), (2, rows[200:])):
        parts.append(tmp_path / f"a_0{number}_v1.csv")
        parts[-1].write_text(encode_head(header) + "".join(map(row_to_line, some)))
    (track,) = lay_out(parts)
    assert track.last_us == rows[-1].time_us


def test_a_file_without_frames_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FlightError, match=r"empty.tlog: is no recording"):
        lay_out([write(tmp_path, "a.tlog", RECORDS), write(tmp_path, "empty.tlog", [])])
