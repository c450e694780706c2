"""A recording whose clock is not always in order is smoothed, or refused with advice."""

import gzip
from pathlib import Path

import msgspec
import numpy as np
import pytest

from gateway.analysis.flight import flight_of_files, fuse_track, smooth_track
from gateway.estimation.columns import NAV_ALT, NAV_ATTITUDE_STD, NAV_FLAGS, NAV_LAT, NAV_VEL
from gateway.estimation.record import FloatArray, IntArray
from gateway.recordings.columns import NAV, has_group
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_fusion import RecordedFusion
from gateway.recordings.recorded_table import header_for
from gateway.recordings.recording import open_recording
from gateway.records import NavFlags
from tests.kit.cli import run
from tests.kit.recordings import write_table
from tests.recordings.flights import OPTIONS, fly_from_the_middle

GOLDEN = Path(__file__).parents[1] / "golden" / "take_off.csv.gz"
HEAD_LINES = 2


def rows_of_golden() -> tuple[list[str], list[str]]:
    lines = gzip.decompress(GOLDEN.read_bytes()).decode().splitlines()
    return lines[:HEAD_LINES], lines[HEAD_LINES:]


def smoothed(path: Path) -> tuple[IntArray, FloatArray]:
    return states_of(RecordedFusion([open_recording(path)], OPTIONS, smooth=True, latency_s=0.0))


def states_of(fusion: RecordedFusion) -> tuple[IntArray, FloatArray]:
    """Return times and states in order of time; the flags also have what was in use live."""
    cells = np.concatenate([block.cells for block in fusion.table().blocks])
    states = cells[has_group(cells, NAV)][:, NAV]
    states = states[np.argsort(states[:, 0], kind="stable")]
    return states[:, 0].astype(np.int64), states[:, 1:]


def test_late_samples_are_sorted_by_time(tmp_path: Path) -> None:
    head, rows = rows_of_golden()
    rows[500], rows[501] = rows[501], rows[500]
    path = tmp_path / "late.csv"
    path.write_text("\n".join([*head, *rows]))
    (found_us, found), (expected_us, expected) = smoothed(path), smoothed(GOLDEN)
    np.testing.assert_array_equal(found_us, expected_us)
    np.testing.assert_array_equal(found[:, :NAV_FLAGS], expected[:, :NAV_FLAGS])


def test_clock_set_back_is_refused_with_advice(tmp_path: Path) -> None:
    head, rows = rows_of_golden()
    path, own, out = (tmp_path / f"{name}.csv" for name in ("log", "own", "out"))
    path.write_text("\n".join([*head, *rows]))
    run("convert", path, "-o", own)
    # A recording of our own has the gateway's clock, which is not continued where it goes back.
    lines = own.read_text().splitlines()
    own.write_text("\n".join([*lines, *lines[-500:]]))
    text = "own.csv: its clock goes back by 20.0 s at IMU sample 1877"
    assert text in run("fuse", own, "-o", out, "--smooth", code=2)
    with pytest.raises(FlightError, match=f"{text}.*leave out --smooth"):
        RecordedFusion([open_recording(own)], OPTIONS, smooth=True)


def recording_from_the_middle(
    folder: Path, rng: np.random.Generator, *, state: bool, lost_bytes: int = 0
) -> Path:
    settings, stored, rows = fly_from_the_middle("eskf", rng)
    kept = stored.estimation[: len(stored.estimation) - lost_bytes]
    stored = msgspec.structs.replace(stored, estimation=kept)
    lines = [stored, *rows] if state else rows
    return write_table(folder / f"{state}.csv", header_for(settings, 1), lines)


def test_recording_begun_in_flight_is_smoothed_from_its_stored_state(tmp_path: Path) -> None:
    firsts = {}
    for state in (False, True):
        path = recording_from_the_middle(tmp_path, np.random.default_rng(3), state=state)
        firsts[state] = states_of(RecordedFusion([open_recording(path)], OPTIONS, smooth=True))[1][
            0
        ]
        causal = states_of(RecordedFusion([open_recording(path)], OPTIONS))[1][0]
    assert firsts[False][NAV_ATTITUDE_STD] > 0.3
    assert firsts[True][NAV_ATTITUDE_STD] < 0.1
    np.testing.assert_allclose(firsts[True][:4], causal[:4], atol=0.05)
    np.testing.assert_allclose(firsts[True][NAV_ALT], causal[NAV_ALT], atol=5.0)
    # The report too.
    flight = flight_of_files([path], OPTIONS, name="cut")[0]
    for track in (fuse_track(flight, flight.fusion), smooth_track(flight, flight.fusion)[0]):
        np.testing.assert_allclose(track.alt_amsl_m[0], causal[NAV_ALT], atol=5.0)


@pytest.mark.parametrize("state", [False, True])
def test_flags_of_smoothed_rows_claim_nothing_that_is_not_known(
    tmp_path: Path, rng: np.random.Generator, state: bool
) -> None:
    path = recording_from_the_middle(tmp_path, rng, state=state)
    fusion = RecordedFusion([open_recording(path)], OPTIONS, smooth=True)
    cells = states_of(fusion)[1]
    flags = cells[:, NAV_FLAGS].astype(int)
    for flag, column in (
        (NavFlags.ATTITUDE_VALID, NAV_ATTITUDE_STD),
        (NavFlags.HEADING_VALID, NAV_ATTITUDE_STD + 2),
        (NavFlags.POSITION_VALID, NAV_LAT),
        (NavFlags.VELOCITY_VALID, NAV_VEL),
        (NavFlags.ALTITUDE_VALID, NAV_ALT),
    ):
        assert np.isfinite(cells[(flags & int(flag)) != 0, column]).all()
    assert (flags & int(NavFlags.ATTITUDE_VALID)).any()


def test_recording_with_an_unsuitable_state_is_smoothed_from_its_rows_and_reported(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = recording_from_the_middle(tmp_path, rng, state=True, lost_bytes=40)
    fusion = RecordedFusion([open_recording(path)], OPTIONS, smooth=True)
    assert len(states_of(fusion)[0])
    assert sum("truncated" in remark for remark in fusion.remarks) == 1
