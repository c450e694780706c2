"""Interpolated and withheld fixes, and Table I on simulated and real flights."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from gateway.analysis.blending import (
    SplitFlight,
    error_at_fixes_m,
    grows,
    interpolate,
    paper_table,
    score,
    thin,
    withhold,
    withhold_spans,
)
from gateway.analysis.flight import Fixes, fixes_of, flight_of_blocks
from gateway.analysis.reporting.estimators import _draw_heat_map, weights
from gateway.analysis.reporting.style import WIDE_IN
from gateway.analysis.sweep import blend_table, with_value
from gateway.recordings.files import read_chunks
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.reading import TRACKER_LOG
from gateway.sensing.calibration import NodeCalibration
from tests.analysis.flights import DURATION_S, short_case, short_flight, true_track


def line(valid_s: list[float]) -> Fixes:
    """Fixes of a straight flight across the date line."""
    s = np.array(valid_s)
    valid_us = np.round(s * 1e6).astype(np.int64)
    lon = (179.9 + 0.1 * s + 180.0) % 360.0 - 180.0
    return Fixes(valid_us + 100_000, valid_us, 45.0 + s, lon, 10.0 * s, np.outer(s, [1, 2, 3]))


def test_interpolation_is_linear_between_times_of_validity() -> None:
    time_us = np.array([500_000, 1_500_000])
    track = interpolate(line([0.0, 1.0, 2.0]), time_us)
    assert track.lat_deg == pytest.approx([45.5, 46.5])
    assert track.lon_deg == pytest.approx([179.95, -179.95])
    assert track.alt_amsl_m == pytest.approx([5.0, 15.0])
    assert track.vel_n_mps[1] == pytest.approx([1.5, 3.0, 4.5])


@pytest.mark.parametrize(
    ("valid_s", "known"),
    [([0.0, 1.0, 5.0, 6.0], [False, True, False, True, False]), ([1.0], [False] * 5)],
    ids=["long gap", "single fix"],
)
def test_interpolation_is_nan_outside_fixes_and_across_long_gaps(
    valid_s: list[float], known: list[bool]
) -> None:
    time_us = np.array([-1, 500_000, 3_000_000, 5_500_000, 6_000_001])
    assert np.isfinite(interpolate(line(valid_s), time_us).lat_deg).tolist() == known


def test_track_across_date_line_is_compared_with_fixes_near_it() -> None:
    fixes = line([0.0, 0.5, 0.8, 1.2, 2.0])
    track = interpolate(fixes, np.array([0, 700_000, 1_100_000, 2_000_000]))
    assert np.abs(error_at_fixes_m(track, fixes)).max() < 1e-6


def test_thinning_keeps_one_fix_per_second() -> None:
    flight = short_flight()
    keep = thin(flight, 1.0)
    kept, dropped = flight.with_fixes(keep), flight.with_fixes(~keep)
    intervals_s = np.diff(fixes_of(kept).arrival_us) * 1e-6
    assert intervals_s.min() > 0.9
    assert np.median(intervals_s) == pytest.approx(1.0, abs=0.1)
    assert len(fixes_of(kept)) + len(fixes_of(dropped)) == len(fixes_of(flight))
    assert len(kept.fixes) + len(dropped.fixes) == len(flight.fixes)


def test_every_nth_usable_fix_is_withheld() -> None:
    flight = short_flight()
    keep = withhold(flight, 4)
    kept, held = flight.with_fixes(keep), flight.with_fixes(~keep)
    total = len(fixes_of(flight))
    assert len(fixes_of(held)) == total // 4
    assert len(fixes_of(kept)) == total - total // 4


def test_fixes_of_some_seconds_are_withheld_and_the_last_of_each_span_compared() -> None:
    flight = short_flight()
    keep, ends = withhold_spans(flight, 4.0, 12.0)
    begin_us = int(flight.time_us[0])
    phases_s = [(fix.time_us - begin_us) * 1e-6 % 12.0 for fix in flight.fixes]
    usable = set(fixes_of(flight).arrival_us.tolist())
    held = [p for p, kept in zip(phases_s, keep, strict=True) if not kept]
    assert held
    assert min(held) >= 8.0
    assert all(
        kept == (phase < 8.0)
        for fix, phase, kept in zip(flight.fixes, phases_s, keep, strict=True)
        if fix.time_us in usable
    )
    last = [p for p, is_end in zip(phases_s, ends, strict=True) if is_end]
    assert 1 <= len(last) <= DURATION_S // 12.0
    assert min(last) > 11.5
    assert not (keep & ends).any()


def test_truth_agrees_with_fixes_at_their_time_of_validity() -> None:
    truth, fixes = true_track(short_flight()), fixes_of(short_flight())
    error = error_at_fixes_m(truth, fixes)
    assert np.hypot(*error.T).max() < 5.0
    worse = error_at_fixes_m(truth, replace(fixes, valid_us=fixes.arrival_us))
    assert np.nanmean(np.hypot(*worse.T)) > np.nanmean(np.hypot(*error.T))


def test_table_with_one_decrease_does_not_grow() -> None:
    table = paper_table()
    assert grows(table, "north_m")
    assert grows(table, "east_m")
    table.loc[4, "east_m"] = 1.0
    assert not grows(table, "east_m")


def test_heat_map_of_a_flight_along_a_meridian_is_drawn() -> None:
    _draw_heat_map(paper_table().assign(east_m=0.0), WIDE_IN)


def test_errors_of_simulated_flight_grow_with_both_weights() -> None:
    case = short_case()
    table = blend_table(case.flight, case.fusion, 1.0)
    assert isinstance(table, pd.DataFrame)
    assert grows(table, "north_m")
    assert grows(table, "east_m")
    assert table.iloc[0][["alpha", "beta"]].tolist() == [0.1, 0.1]
    assert table["held_m"].idxmin() == 0


def test_interpolated_gps_and_truth_score_zero_against_themselves() -> None:
    flight = short_flight()
    split = SplitFlight.by(flight, withhold(flight, 5))
    found = score(split.interpolated, split)
    assert found["north_m"] == found["east_m"] == found["interpolated_m"] == 0.0
    assert 0.0 < found["held_m"] < 2.0
    split = SplitFlight.by(flight, np.ones(len(flight.fixes), np.bool_))
    found = score(true_track(flight), split)
    assert found["reference_m"] == pytest.approx(0.0)
    assert np.isnan(found["held_m"])


def test_flight_without_scored_samples_has_no_weight_table() -> None:
    case = short_case()
    blind = replace(case.flight, scored=np.zeros(len(case.flight.time_us), dtype=bool))
    assert weights(replace(case, flight=blind)) is None


IN_FLIGHT = slice(15_000, 21_000)
"""Lines of the log: two minutes of the flight."""


@pytest.mark.io
@pytest.mark.slow
def test_errors_of_real_flight_grow_with_both_weights(data_dir: Path) -> None:
    text = b"".join(read_chunks(data_dir / "arduplane_testlog2.csv.gz")).decode()
    lines = text.splitlines()
    columns = msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
    fusion = FusionSettings()
    for name, value in (
        ("gps_latency_s", 0.28), ("declination", "fixed"), ("declination_deg", 11.0)
    ):  # fmt: skip
        fusion = with_value(fusion, f"estimation.reference.{name}", value)
    flight = flight_of_blocks(
        CsvReader(columns).blocks([*lines[:2], *lines[IN_FLIGHT]]),
        NodeCalibration(), fusion, name="arduplane", description="",
    )  # fmt: skip
    table = blend_table(flight, fusion, 1.0)
    for error in ("north_m", "east_m", "held_m"):
        assert grows(table, error)
    assert np.argmin(table["held_m"]) == 0
    assert table.iloc[0]["north_m"] < 2.5
