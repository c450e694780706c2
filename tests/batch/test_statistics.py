import re
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from gateway.batch.statistics import choose, errors_by_group, versus, why_leads, write_flights_page
from gateway.batch.tasks import FlightResult
from gateway.config import load
from tests.kit.cli import run


def test_point_with_the_least_mean_error_is_chosen_from_flights_with_all_scores() -> None:
    errors = np.array([[1.0, 2.0], [np.nan, 1.0], [1.0, 3.0]])
    found = choose(errors, np.array([2.0, 2.0, 8.0]))
    assert (found.winner, found.base_mean) == (0, pytest.approx(4.0))
    assert found.means == pytest.approx([1.0, 6.0**0.5])
    with pytest.raises(ValueError, match="no flight has enough fixes"):
        choose(np.full((2, 2), np.nan), np.ones(2))


def flight(location: str, vehicle: int, **held_m: float) -> FlightResult:
    return FlightResult(
        location=location, digest=location, key="", task="report", version="", vehicle=vehicle,
        began="2026-06-01 10:00:00", figures={"held_m": held_m},
    )  # fmt: skip


def test_errors_are_summed_up_by_aircraft_and_estimator() -> None:
    rows = errors_by_group(
        [flight("a", 1, eskf=1.0), flight("b", 1, eskf=3.0), flight("c", 2, eskf=8.0, paper=1.0)]
    )
    assert rows.drop(columns="9 in 10 below, m").to_numpy().tolist() == [
        ["all", "eskf", 3, 3.0, 8.0],
        ["all", "paper", 1, 1.0, 1.0],
        ["1", "eskf", 2, 2.0, 3.0],
        ["2", "eskf", 1, 8.0, 8.0],
        ["2", "paper", 1, 1.0, 1.0],
    ]


def test_page_of_flights_too_short_to_be_evaluated_has_no_picture(tmp_path: Path) -> None:
    page = write_flights_page([flight("a_01_v1.csv", 1)], tmp_path, None).read_text()
    assert "a_01_v1.csv" in page
    assert "Share of the flights" not in page


def flights_with(eskf_m: float, paper_m: float, drifts_m: dict[str, float]) -> list[FlightResult]:
    """Ten flights of ten days with these errors at withheld fixes and without GPS."""
    figures = {"held_m": {"eskf": eskf_m, "paper": paper_m}, "drift_m": drifts_m}
    return [
        msgspec.structs.replace(flight(str(day), 1), began=f"2026-06-{day:02}", figures=figures)
        for day in range(1, 11)
    ]


def test_lead_of_an_estimator_is_explained() -> None:
    text = why_leads(flights_with(1.0, 2.0, {"eskf": 4.0, "paper": 31.0}))
    assert text.startswith("eskf leads paper: median errors of 1.00 and 2.00 m over 10 flights.")
    assert "drifts less: after 10 s without GPS it is 4.0 m off, paper 31.0 m; it dist" in text
    text = why_leads(flights_with(2.0, 1.0, {"eskf": 4.0, "paper": 31.0}))
    assert text.startswith("paper leads eskf: median errors of 1.00 and 2.00 m")
    assert "not in drifting less: after 10 s without GPS it is 31.0 m off, eskf 4.0 m." in text
    assert "drift" not in why_leads(flights_with(1.0, 2.0, {}))
    assert why_leads([flight("a", 1, eskf=1.0)]) == ""


def test_degraded_flights_are_listed_worst_first() -> None:
    then = [flight("a", 1, eskf=1.0), flight("b", 1, eskf=1.0), flight("c", 1, eskf=1.0)]
    now = [flight("a", 1, eskf=1.04), flight("b", 1, eskf=2.0), flight("c", 1, eskf=3.0)]
    found = versus([*now, flight("new", 1, eskf=9.0)], then)
    assert found.worse[["location", "after_m"]].to_numpy().tolist() == [["c", 3.0], ["b", 2.0]]
    assert found.compared == 3


@pytest.mark.io
def test_sweep_of_a_folder_finds_one_set_of_settings(batch: Path, tmp_path: Path) -> None:
    best, table = tmp_path / "best.toml", tmp_path / "trials.csv"
    words = ("sweep", batch, "--vary", "beta=0.1,0.5,0.9", "-o", best, "--table", table)
    text = run(*words, "--jobs", 2, code=1)
    assert "3 points on 4 flights; mean with the recorded settings" in text
    assert "1 of 5 recordings failed" in text
    ranked = re.findall(r" (0\.[159]) (0\.\d+)", text)
    winner, means = float(ranked[0][0]), [float(mean) for _, mean in ranked]
    assert (len(means), means) == (3, sorted(means))
    estimation = load(best).estimation
    assert (estimation.estimator, estimation.paper.beta_velocity) == ("paper", winner)
    rows = pd.read_csv(table)
    assert np.exp(np.log(rows["best settings"]).mean()) == pytest.approx(means[0], rel=1e-3)
    words = (
        "sweep",
        batch / "alpha_01_v1.csv",
        batch,
        "--optimise",
        3,
        "--vary",
        "beta=0:1",
    )
    assert "give a grid" in run(*words, code=2)
