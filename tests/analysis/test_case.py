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
from gateway.analysis.reporting.estimators import comparison
from gateway.analysis.simulated import simulated_flight
from gateway.analysis.sweep import with_values
from gateway.recordings.fuse import with_estimator
from gateway.simulator.simulator_settings import SimulatorSettings
from tests.analysis.flights import DURATION_S, short_case, short_flight, true_track


def test_summary_contains_the_key_figures() -> None:
    found = summarise(short_case())
    assert found["duration, s"] == pytest.approx(DURATION_S, abs=0.1)
    assert found["longest time without a fix, s"] == pytest.approx(3.2, abs=0.3)
    assert 8.0 < found["greatest ground speed, m/s"] < 25.0
    assert 20.0 < found["greatest height above first position, m"] < 90.0
    assert found["horizontal error, m RMS"] < 4.0
    assert 250.0 < found["distance flown, m"] < 350.0


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


def test_flight_for_pilots_agrees_with_simulated_truth() -> None:
    flight, truth = short_case().pilot, true_track(short_flight())
    speed = np.hypot(truth.vel_n_mps[:, 0], truth.vel_n_mps[:, 1])
    assert flight.facts.fastest_mps == pytest.approx(float(speed.max()), abs=1.0)
    height = truth.alt_amsl_m - truth.alt_amsl_m[0]
    assert flight.facts.highest_m == pytest.approx(float(height.max()), abs=8.0)
    flown = float((speed[:-1] * np.diff(short_flight().time_s)).sum())
    assert flight.facts.distance_m == pytest.approx(flown, rel=0.05)
    ((begin_us, end_us),) = flight.facts.gps_outages_us or ()
    assert round((end_us - begin_us) / 1e6) == 3
    assert flight.facts.gaps == ()
    texts = [event.text for event in flight.events]
    assert texts[0] == "in the air"
    assert any(text.startswith("GPS lost for 3") for text in texts)
    assert [e.time_s for e in flight.events] == sorted(e.time_s for e in flight.events)
