import numpy as np
import pytest

from gateway.analysis.blending import error_at_fixes_m, interpolate, thin, withhold
from gateway.analysis.flight import Fixes, fixes_of
from tests.analysis.flights import short_flight


def line(valid_s: list[float]) -> Fixes:
    """Fixes of a straight flight across the date line."""
    s = np.array(valid_s)
    valid_us = np.round(s * 1e6).astype(np.int64)
    lon = (179.9 + 0.1 * s + 180.0) % 360.0 - 180.0
    return Fixes(valid_us + 100_000, valid_us, 45.0 + s, lon, 10.0 * s, np.outer(s, [1, 2, 3]))


def test_interpolation_is_linear_between_the_times_of_validity() -> None:
    time_us = np.array([500_000, 1_500_000])
    track = interpolate(line([0.0, 1.0, 2.0]), time_us)
    assert track.lat_deg == pytest.approx([45.5, 46.5])
    assert track.lon_deg == pytest.approx([179.95, -179.95])
    assert track.alt_amsl_m == pytest.approx([5.0, 15.0])
    assert track.vel_n_mps[1] == pytest.approx([1.5, 3.0, 4.5])


def test_nothing_is_known_outside_and_across_long_gaps() -> None:
    time_us = np.array([-1, 500_000, 3_000_000, 5_500_000, 6_000_001])
    track = interpolate(line([0.0, 1.0, 5.0, 6.0]), time_us)
    assert np.isfinite(track.lat_deg).tolist() == [False, True, False, True, False]


def test_one_fix_is_no_line() -> None:
    assert np.isnan(interpolate(line([1.0]), np.array([1_000_000])).lat_deg).all()


def test_a_track_over_the_date_line_is_compared_with_the_fixes_there() -> None:
    fixes = line([0.0, 0.5, 0.8, 1.2, 2.0])
    track = interpolate(fixes, np.array([0, 700_000, 1_100_000, 2_000_000]))
    assert np.abs(error_at_fixes_m(track, fixes)).max() < 1e-6


def test_thinning_keeps_one_fix_a_second() -> None:
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


def test_the_truth_is_near_the_fixes_at_their_time_of_validity() -> None:
    flight = short_flight()
    assert flight.reference is not None
    error = error_at_fixes_m(flight.reference.track, fixes_of(flight))
    assert np.hypot(*error.T).max() < 5.0
    late = fixes_of(flight)
    shifted = Fixes(
        late.arrival_us, late.arrival_us, late.lat_deg, late.lon_deg, late.alt_amsl_m,
        late.vel_n_mps,
    )  # fmt: skip
    worse = error_at_fixes_m(flight.reference.track, shifted)
    assert np.nanmean(np.hypot(*worse.T)) > np.nanmean(np.hypot(*error.T))
