"""Recordings opened and laid out for the player."""

from contextlib import ExitStack
from pathlib import Path

import msgspec
import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.answers.log_answers import VehicleAnswers
from gateway.config import GatewaySettings
from gateway.recordings.files import FlightError
from gateway.recordings.opening import PlayedFlight, lay_out, open_flights
from gateway.recordings.recorded_table import header_for
from gateway.recordings.recording import open_recording
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import STATION, Sender, read_back
from tests.kit.recordings import START_US, STEP_US, make_records, make_tlog, write_table, write_tlog
from tests.recordings.flights import OPTIONS, flown_table, fly, make_flight, read

pytestmark = pytest.mark.io

RECORDS = make_records(300)


def laid_out(files: list[Path], *wanted_ids: int) -> list[PlayedFlight]:
    with ExitStack() as opened:
        return lay_out(open_flights(files, OPTIONS, opened), wanted_ids, with_commands=False)


def test_parts_of_a_recording_are_one_flight(tmp_path: Path) -> None:
    parts = [write_tlog(tmp_path / f"a_0{n}.tlog", RECORDS[100 * n :][:100]) for n in (0, 1, 2)]
    (flight,) = laid_out(parts)
    assert flight.system_ids == {1: 1}
    firsts = [track.first_us for track in flight.tracks]
    assert firsts == [START_US + n * 100 * STEP_US for n in (0, 1, 2)]


def test_recording_that_grows_is_played_as_it_was_opened(tmp_path: Path) -> None:
    path = write_tlog(tmp_path / "a.tlog", RECORDS[:100])
    with ExitStack() as opened:
        (flight,) = open_flights([path], OPTIONS, opened)
        (source,) = flight.sources
        before = source.read(0, 1 << 20)
        with path.open("ab") as file:
            file.write(make_tlog(RECORDS[100:]))
        assert source.read(0, 1 << 20) == before == make_tlog(RECORDS[:100])
        assert source.read(len(before), 1 << 20) == b""


def test_end_of_rows_is_found_without_reading_all_of_them(tmp_path: Path) -> None:
    header, rows = read(flown_table(5))
    header = msgspec.structs.replace(header, unix_us_at_zero=START_US)
    table = write_table(tmp_path / "a.csv", header, rows)
    other, log = tmp_path / "other.csv", tmp_path / "a.bin"
    other.write_text("time_s,ax,ay,az,gx,gy,gz\n1.5,0,0,-9.8,0,0,0\n2.5,0,0,-9.8,0,0,0\n")
    log.write_bytes(b"\xa3\x95\x80")
    found = [open_recording(path).end_us(OPTIONS) for path in (table, other, log)]
    assert found == [START_US + rows[-1].time_us, 2_500_000, None]


def test_damage_is_among_the_remarks(tmp_path: Path) -> None:
    path = tmp_path / "a.tlog"
    path.write_bytes(make_tlog(RECORDS[:9]) + b"\xff" * 99 + make_tlog(RECORDS[9:]) + b"\0" * 6)
    with ExitStack() as opened:
        (flight,) = open_flights([path], OPTIONS, opened)
    damaged, incomplete = flight.remarks
    assert "99 bytes in 1 place" in damaged
    assert "the last record is incomplete (6 bytes)" in incomplete


def test_other_recordings_get_separate_vehicles(tmp_path: Path) -> None:
    first = write_tlog(tmp_path / "first.tlog", RECORDS[:100])
    later = write_tlog(tmp_path / "later.tlog", RECORDS[200:])
    flights = laid_out([first, later, first], 5)
    assert [flight.system_ids for flight in flights] == [{1: 5}, {1: 1}, {1: 2}]
    # Flights of other days begin together.
    assert [track.first_us for flight in flights for track in flight.tracks] == [START_US] * 3
    assert [flight.shift_us for flight in flights] == [0, -200 * STEP_US, 0]


def test_fused_flight_answers_with_the_settings_of_its_fusion(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    then = GatewaySettings().default_aircraft
    vehicle = msgspec.structs.replace(then.vehicle, node_silent_s=7.5)
    header, rows = read(fly(msgspec.structs.replace(then, vehicle=vehicle), make_flight(rng, 3))[0])
    (flight,) = laid_out([write_table(tmp_path / "a_01_v1.csv", header, rows)])
    answers = VehicleAnswers(flight.answers, 1, 1, lambda: START_US)
    (silent,) = (f for n, f in answers.parameters().items() if "SILENT" in n)
    assert read_back(silent).param_value == 7.5
    assert len(answers.frames(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)) == 1


def test_settings_changed_in_flight_are_answered_from_their_time(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    then = GatewaySettings().default_aircraft
    paper = msgspec.structs.replace(then.estimation.paper, accel_cutoff_hz=3.5)
    estimation = msgspec.structs.replace(then.estimation, paper=paper)
    changed = header_for(msgspec.structs.replace(then, estimation=estimation), 1)
    header, rows = read(fly(then, make_flight(rng, 6))[0])
    half = len(rows) // 2
    path = write_table(tmp_path / "a_01_v1.csv", header, [*rows[:half], changed, *rows[half:]])
    with ExitStack() as opened:
        (flight,) = lay_out(open_flights([path], OPTIONS, opened), with_commands=False)
        (track,) = flight.tracks
        while not track.prepare(rows[-1].time_us):
            pass
    answered = {}
    for at_us in (rows[0].time_us, rows[-1].time_us):
        answers = VehicleAnswers(flight.answers, 1, 1, lambda at_us=at_us: at_us).parameters()
        (cutoff,) = (frame for name, frame in answers.items() if "ACC_CUTOFF" in name)
        answered[at_us] = read_back(cutoff).param_value
    assert list(answered.values()) == [then.estimation.paper.accel_cutoff_hz, 3.5]


def test_ground_station_is_no_vehicle(tmp_path: Path) -> None:
    records = [*RECORDS[:9], RecordedFrame(RECORDS[9].time_us, Sender(42, STATION).heartbeat())]
    (flight,) = laid_out([write_tlog(tmp_path / "a.tlog", records)])
    assert flight.system_ids == {1: 1}


def test_file_without_frames_is_refused(tmp_path: Path) -> None:
    files = [write_tlog(tmp_path / "a.tlog", RECORDS), write_tlog(tmp_path / "empty.tlog", [])]
    with pytest.raises(FlightError, match=r"empty.tlog: unknown file format"):
        laid_out(files)


def test_vehicles_of_a_recording_follow_the_id_of_its_first(tmp_path: Path) -> None:
    both = write_tlog(tmp_path / "both.tlog", [*RECORDS[:50], *make_records(50, system_id=7)])
    first, second = laid_out([both, both], 200)
    assert (first.system_ids, second.system_ids) == ({1: 200, 7: 201}, {1: 1, 7: 7})
    assert laid_out([both], 249)[0].system_ids[7] < 249, "ground stations begin at 250"
