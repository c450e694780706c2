import json
from pathlib import Path

import msgspec
import numpy as np
import pandas as pd
import pytest

from gateway.batch.statistics import (
    choose,
    errors_by_group,
    folds_of,
    lead_of,
    versus,
    why_leads,
    write_season_page,
)
from gateway.batch.tasks import FlightResult
from gateway.config import load
from tests.kit.cli import run

GROUPS = [f"{1 + k % 2} 2026-06-{1 + k // 4:02d}" for k in range(40)]


def test_flights_of_one_day_stay_in_one_fold() -> None:
    fold = folds_of(GROUPS)
    assert {len(set(fold[[g == group for g in GROUPS]].tolist())) for group in GROUPS} == {1}
    assert fold.max() == 9
    assert np.bincount(fold).tolist() == [4] * 10


def test_flights_of_a_single_day_are_folds_of_their_own() -> None:
    assert sorted(folds_of(["1 2026-06-01"] * 4).tolist()) == [0, 1, 2, 3]


def test_flights_are_judged_by_the_choice_of_other_folds() -> None:
    """On noise alone the best of many points leads by luck; judged by others, on average not."""
    in_sample, judged = [], []
    for seed in range(12):
        errors = np.exp(np.random.default_rng(seed).normal(0.0, 0.3, (40, 60)))
        found = choose(errors, np.ones(40), GROUPS)
        assert found.over_base is not None
        in_sample.append(np.log(found.means[found.winner]))
        judged.append(np.log(found.over_base.ratio))
    assert np.mean(in_sample) < -0.1
    assert np.mean(judged) > -0.05


def test_true_lead_is_distinguished_from_chance(rng: np.random.Generator) -> None:
    errors = np.exp(rng.normal(0.0, 0.1, (40, 5)))
    errors[:, 3] *= 0.8
    found = choose(errors, np.exp(rng.normal(0.0, 0.1, 40)), GROUPS)
    assert (found.winner, found.folds, found.stable) == (3, 10, 10)
    lead = found.over_base
    assert lead is not None
    assert lead.low is not None
    assert lead.high is not None
    assert lead.low < lead.ratio < lead.high < 0.9
    assert lead.ratio == pytest.approx(0.8, abs=0.05)
    assert lead.units == 20
    assert "more than chance" in lead.text


def test_flights_without_scores_are_left_out() -> None:
    errors = np.array([[1.0, 2.0], [np.nan, 1.0], [1.0, 3.0]])
    found = choose(errors, np.array([2.0, 2.0, np.nan]), ["a", "b", "c"])
    assert found.winner == 0
    assert np.isnan(found.judged[1])
    assert found.means == pytest.approx([1.0, 6.0**0.5])
    with pytest.raises(ValueError, match="no flight has enough fixes"):
        choose(np.full((2, 2), np.nan), np.ones(2), ["a", "b"])


def test_single_day_cannot_be_separated_from_chance() -> None:
    lead = lead_of(np.array([1.0, 1.0]), np.array([2.0, 2.0]), ["a", "a"])
    assert lead is not None
    assert (lead.ratio, lead.p) == (pytest.approx(0.5), None)
    assert "it cannot be separated from chance" in lead.text
    same = lead_of(np.ones(3), np.ones(3), ["a", "b", "c"])
    assert same is not None
    assert same.p == 1.0
    assert lead_of(np.array([np.nan]), np.ones(1), ["a"]) is None


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


def test_page_of_flights_too_short_to_be_judged_has_no_picture(tmp_path: Path) -> None:
    page = write_season_page([flight("a_01_v1.csv", 1)], tmp_path, None).read_text()
    assert "a_01_v1.csv" in page
    assert "Share of the flights" not in page


def season_of(eskf_m: float, paper_m: float, drifts_m: dict[str, float]) -> list[FlightResult]:
    """Ten flights of ten days with these errors at withheld fixes and without GPS."""
    figures = {"held_m": {"eskf": eskf_m, "paper": paper_m}, "drift_m": drifts_m}
    return [
        msgspec.structs.replace(flight(str(day), 1), began=f"2026-06-{day:02}", figures=figures)
        for day in range(1, 11)
    ]


def test_lead_of_an_estimator_is_explained() -> None:
    text = why_leads(season_of(1.0, 2.0, {"eskf": 4.0, "paper": 31.0}))
    assert text.startswith("eskf leads paper: -50.0 % error over 10 flights on 10 aircraft-days")
    assert "drifts less: after 10 s without GPS it is 4.0 m off, paper 31.0 m; it dist" in text
    text = why_leads(season_of(2.0, 1.0, {"eskf": 4.0, "paper": 31.0}))
    assert text.startswith("paper leads eskf: -50.0 %")
    assert "not in drifting less: after 10 s without GPS it is 31.0 m off, eskf 4.0 m." in text
    assert "drift" not in why_leads(season_of(1.0, 2.0, {}))
    assert why_leads([flight("a", 1, eskf=1.0)]) == ""


def test_degraded_flights_are_listed_worst_first() -> None:
    then = [flight("a", 1, eskf=1.0), flight("b", 1, eskf=1.0), flight("c", 1, eskf=1.0)]
    now = [flight("a", 1, eskf=1.04), flight("b", 1, eskf=2.0), flight("c", 1, eskf=3.0)]
    found = versus([*now, flight("new", 1, eskf=9.0)], then)
    assert found.worse[["location", "after_m"]].to_numpy().tolist() == [["c", 3.0], ["b", 2.0]]
    assert found.compared == 3


@pytest.mark.io
def test_sweep_of_season_finds_one_set_of_settings(season: Path, tmp_path: Path) -> None:
    words = ("batch", "sweep", season, "-o", tmp_path, "--vary", "beta=0.1,0.5,0.9", "--jobs", 2)
    text = run(*words, code=1)
    assert "3 points on 4 flights, in 4 folds by aircraft and day" in text
    assert "against the recorded settings" in text
    assert "p = " in text
    kept = [json.loads(path.read_bytes()) for path in (tmp_path / "results").iterdir()]
    scores = np.array([entry["figures"]["scores"] for entry in kept if entry["error"] is None])
    winner = (0.1, 0.5, 0.9)[int(np.exp(np.log(scores).mean(axis=0)).argmin())]
    best = load(tmp_path / "best.toml").estimation
    assert (best.estimator, best.paper.beta_velocity) == ("paper", winner)
    table = pd.read_csv(tmp_path / "sweep.csv")
    assert len(table) == 4
    assert table["chosen by others"].gt(0.0).all()


@pytest.mark.io
def test_sweep_accepts_several_flights(season: Path, tmp_path: Path) -> None:
    flights = [season / name for name in ("alpha_01_v1.csv", "gamma_01_v2.csv")]
    best = tmp_path / "best.toml"
    text = run("sweep", *flights, "--beta", "0.1,0.9", "-o", best, "--jobs", 2)
    assert "2 points on 2 flights" in text
    assert load(best).estimation.estimator == "paper"
    assert "give a grid" in run("sweep", *flights, "--optimise", 3, "--beta", "0:1", code=2)
