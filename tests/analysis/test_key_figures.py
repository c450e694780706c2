import msgspec
import pytest

from gateway.analysis.case import (
    ESTIMATORS,
    SMOOTHED,
    changed_settings,
    make_case,
    summarise,
    with_estimator,
    withheld_error_m,
)
from gateway.analysis.reporting.estimators import comparison
from gateway.analysis.simulated import simulated_flight
from gateway.simulator.simulator_settings import SimulatorSettings
from tests.analysis.flights import DURATION_S, short_case, short_flight


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


def test_settings_that_differ_are_listed() -> None:
    a = short_case().fusion
    paper = msgspec.structs.replace(a.estimation.paper, accel_cutoff_hz=5.0)
    estimation = msgspec.structs.replace(a.estimation, estimator="paper", paper=paper)
    b = msgspec.structs.replace(a, estimation=estimation)
    assert changed_settings(a, a) == []
    assert changed_settings(a, b) == [
        ("estimation.estimator", "eskf", "paper"),
        ("estimation.paper.accel_cutoff_hz", 10.0, 5.0),
    ]


def test_two_settings_are_compared_over_time() -> None:
    a = short_case()
    section = comparison(a, make_case(short_flight(), with_estimator(a.fusion, "paper")))
    assert [p.name for p in section.pictures] == ["comparison_difference", "comparison_map"]
    table = section.tables[0].frame.set_index("")
    assert table.loc["duration, s", "B − A"] == 0.0
    assert table.loc["tilt error, deg RMS", "B − A"] > 1.0
    assert section.tables[1].frame["setting"].tolist() == ["estimation.estimator"]


def test_two_flights_are_compared_by_their_profiles() -> None:
    other = simulated_flight(SimulatorSettings(imu_rate_hz=50, seed=5), duration_s=40.0)
    section = comparison(short_case(), make_case(other))
    assert [p.name for p in section.pictures] == ["comparison_profiles", "comparison_map"]
    table = section.tables[0].frame.set_index("")
    assert table.loc["duration, s", "B − A"] == pytest.approx(40.0 - DURATION_S, abs=0.1)
