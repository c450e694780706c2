"""Key figures of a flight, and figures for pilots."""

import numpy as np
import pytest

from gateway.analysis import case as case_module
from gateway.analysis.case import (
    ESTIMATORS,
    SMOOTHED,
    changed_settings,
    make_case,
    outage_error_m,
    summarise,
    withheld_error_m,
)
from gateway.analysis.flight import FlightTrack, local_frame
from gateway.analysis.pilot_figures import pilot_figures
from gateway.analysis.reporting.estimators import comparison
from gateway.analysis.simulated import simulated_flight
from gateway.analysis.sweep import with_values
from gateway.recordings.fuse import with_estimator
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.vehicle_state.positions import LocalFrame
from tests.analysis.flights import DURATION_S, short_case, short_flight, true_track, with_imu


def test_summary_contains_the_key_figures() -> None:
    found = summarise(short_case())
    assert found["duration, s"] == pytest.approx(DURATION_S, abs=0.1)
    assert found["longest time without a fix, s"] == pytest.approx(3.2, abs=0.3)
    assert 8.0 < found["greatest ground speed, m/s"] < 25.0
    assert 20.0 < found["greatest height above the start, m"] < 90.0
    assert found["horizontal error, m RMS"] < 4.0
    assert 300.0 < found["distance flown, m"] < 900.0


def test_error_at_withheld_fixes_differs_between_estimators() -> None:
    names = (*ESTIMATORS, SMOOTHED)
    errors_m = {withheld_error_m(short_case(), name) for name in names}
    assert len(errors_m) == len(names)
    assert all(0.05 < error_m < 2.0 for error_m in errors_m)


def test_error_without_gps_exceeds_that_at_withheld_fixes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(case_module, "OUTAGE_S", 4.0)
    monkeypatch.setattr(case_module, "OUTAGE_EVERY_S", 12.0)
    case = short_case()
    drift_m = {name: outage_error_m(case, name) for name in ESTIMATORS}
    assert drift_m["paper"] > 1.5 * withheld_error_m(case, "paper")
    assert 0.1 < drift_m["eskf"] < drift_m["paper"]
    monkeypatch.setattr(case_module, "OUTAGE_EVERY_S", 600.0)
    assert np.isnan(outage_error_m(case, "eskf"))


def test_changed_settings_are_listed_with_both_values() -> None:
    a = short_case().fusion
    keys = ("estimation.estimator", "estimation.paper.accel_cutoff_hz")
    b = with_values(a, keys, ("paper", 5.0))
    assert changed_settings(a, a) == []
    assert changed_settings(a, b) == [
        ("estimation.estimator", "eskf", "paper"),
        ("estimation.paper.accel_cutoff_hz", 10.0, 5.0),
    ]


def test_comparison_of_two_settings_shows_difference_over_time() -> None:
    a = short_case()
    section = comparison(a, make_case(short_flight(), with_estimator(a.fusion, "paper")))
    assert [p.name for p in section.pictures] == ["comparison_difference", "comparison_map"]
    table = section.tables[0].frame.set_index("")
    assert table.loc["duration, s", "B − A"] == 0.0
    assert table.loc["tilt error, deg RMS", "B − A"] > 1.0
    assert section.tables[1].frame["setting"].tolist() == ["estimation.estimator"]


def test_comparison_of_two_flights_shows_profiles() -> None:
    other = simulated_flight(SimulatorSettings(imu_rate_hz=50, seed=5), duration_s=40.0)
    section = comparison(short_case(), make_case(other))
    assert [p.name for p in section.pictures] == ["comparison_profiles", "comparison_map"]
    table = section.tables[0].frame.set_index("")
    assert table.loc["duration, s", "B − A"] == pytest.approx(40.0 - DURATION_S, abs=0.1)


RATE_HZ = 50


def test_pilot_figures_agree_with_simulated_truth() -> None:
    case = short_case()
    assert case.frame is not None
    figures = pilot_figures(case.flight, case.track, case.frame)
    truth = true_track(case.flight)
    speed = np.hypot(truth.vel_n_mps[:, 0], truth.vel_n_mps[:, 1])
    assert figures.fastest_mps == pytest.approx(float(speed.max()), abs=1.0)
    height = truth.alt_amsl_m - truth.alt_amsl_m[0]
    assert figures.highest_m == pytest.approx(float(height.max()), abs=8.0)
    flown = speed[:-1] * np.diff(case.flight.time_s)
    assert figures.distance_m == pytest.approx(float(flown[height[1:] > 3.0].sum()), rel=0.05)
    assert [round(end - begin) for begin, end in figures.gps_outages_s] == [3]
    assert figures.link_losses_s == ()
    texts = [event.text for event in figures.events]
    assert texts[0] == "in the air"
    assert any(text.startswith("GPS lost for 3") for text in texts)
    assert [e.time_s for e in figures.events] == sorted(e.time_s for e in figures.events)


def made(north_m: np.ndarray, height_m: np.ndarray, speed_mps: np.ndarray) -> tuple:
    """Lay a motion along the meridian over the samples of the short flight."""
    flight = short_flight()
    frame = local_frame(flight)
    assert frame is not None
    lat = frame.lat_deg + north_m / frame.north_m(np.array([frame.lat_deg + 1.0]))[0]
    velocity = np.column_stack([speed_mps, np.zeros_like(speed_mps), np.zeros_like(speed_mps)])
    count = len(flight.time_us)
    track = FlightTrack(
        flight.time_us, np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)), lat,
        np.full(count, frame.lon_deg), frame.alt_m + height_m, velocity,
    )  # fmt: skip
    return flight, track, frame


def test_distance_excludes_ground_and_position_jumps() -> None:
    seconds = short_flight().time_s
    up = (seconds > 10.0) & (seconds < 30.0)
    north = np.where(seconds > 10.0, np.minimum(seconds - 10.0, 20.0) * 5.0, 0.0)
    north = north + np.where(seconds > 20.0, 1000.0, 0.0)
    flight, track, frame = made(north, np.where(up, 20.0, 0.0), np.where(up, 5.0, 0.0))
    figures = pilot_figures(flight, track, frame)
    assert figures.airborne_s == pytest.approx(20.0, abs=0.2)
    assert figures.distance_m == pytest.approx(100.0, abs=1.0)
    assert figures.farthest_m == pytest.approx(1100.0, abs=1.0)


def test_hop_of_one_second_is_not_airborne() -> None:
    seconds = short_flight().time_s
    up = (seconds > 10.0) & (seconds < 11.0)
    flight, track, frame = made(0.0 * seconds, np.where(up, 9.0, 0.0), np.where(up, 9.0, 0.0))
    assert pilot_figures(flight, track, frame).airborne_s == 0.0


def test_gap_in_samples_is_counted_as_link_loss() -> None:
    flight = short_flight()
    late = flight.time_us + np.where(flight.time_s > 20.0, 4_000_000, 0)
    case = short_case()
    assert case.frame is not None
    figures = pilot_figures(with_imu(flight, time_us=late), case.track, case.frame)
    ((begin, end),) = figures.link_losses_s
    assert end - begin == pytest.approx(4.0 + 1.0 / RATE_HZ, abs=0.05)


def test_figures_of_unknown_track_are_nan() -> None:
    flight = short_flight()
    count = len(flight.time_us)
    unknown = np.full(count, np.nan)
    track = FlightTrack(
        flight.time_us, np.full((count, 4), np.nan), unknown, unknown, unknown,
        np.full((count, 3), np.nan),
    )  # fmt: skip
    figures = pilot_figures(flight, track, LocalFrame(47.0, 8.0, 400.0))
    assert np.isnan([figures.highest_m, figures.fastest_mps, figures.farthest_m]).all()
    assert (figures.distance_m, figures.airborne_s) == (0.0, 0.0)
