"""The scoring tool from end to end, on one flight and one estimator."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.columns import NAV_ATTITUDE_STD, NAV_FLAGS, NAV_LAT
from tools import score_estimators
from tools.score_honesty import judged_by, share, shares_after, two_sigma
from tools.score_tables import show_honesty
from tools.spoil_flight import SPOILS


@pytest.mark.slow
def test_it_scores_one_flight_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = tmp_path / "scores.json"
    monkeypatch.setattr(score_estimators, "OWN", {"eskf": score_estimators.run_eskf})
    monkeypatch.setattr(score_estimators, "SPOILS", {"no_mag": SPOILS["no_mag"]})
    monkeypatch.setattr(score_estimators, "REPEATS", 1)
    words = ["--data", str(tmp_path), "--only", "simulated 11", "--no-peers", "--json", str(found)]
    monkeypatch.setattr(sys, "argv", ["score_estimators.py", *words])
    score_estimators.main()
    scores = json.loads(found.read_text())
    assert list(scores["flights"]) == ["simulated 11"]
    live, smoothed = (scores["flights"]["simulated 11"][name] for name in ("eskf", "smoothed"))
    assert smoothed["fix_out10"] < live["fix_out10"] < 8.0
    for told in ("heading_2s", "place_out10", "tilt_out30", "tilt_alone", "tilt_spoilt"):
        assert 0.0 < live[told] <= 1.0
    assert scores["spoilt"]["simulated 11"]["eskf"]["no_mag"][1] < 3.0
    tables = capsys.readouterr().out.splitlines()
    rows = [line for line in tables if line.split()[:2] == ["simulated", "11"]]
    assert [row.split()[2] for row in rows] == ["eskf", "smoothed"] * 2 + ["eskf"]
    assert max(map(len, tables)) <= 200


def test_a_word_that_names_no_flight_is_reported(tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="no flight is named glider: simulated 11, simulated 12"):
        score_estimators.flights_to_score(tmp_path, ["glider"])


def test_what_is_not_known_is_no_share() -> None:
    assert share(np.array([np.nan, 1.0, 0.0])) == 0.5
    assert np.isnan(share(np.array([np.nan])))
    show_honesty({"flight": {"eskf": {"tilt_2s": 0.5}, "paper": {}}})


@pytest.mark.slow
def test_two_sigma_counts_the_instants_within() -> None:
    (flight,) = score_estimators.flights_to_score(Path(), ["simulated 11"])
    out = score_estimators.run_eskf(flight)
    usual = two_sigma(flight, out)
    out[:, NAV_ATTITUDE_STD:NAV_FLAGS] = 1e-9
    assert share(usual["tilt"]) > 0.9
    assert share(two_sigma(flight, out)["tilt"]) == 0.0


@pytest.mark.slow
def test_a_judge_is_no_surer_than_it_tells() -> None:
    (flight,) = score_estimators.flights_to_score(Path(), ["simulated 11"])
    out = score_estimators.run_eskf(flight)
    judged = judged_by(flight, out)
    wrong = out.copy()
    wrong[:, NAV_ATTITUDE_STD:NAV_FLAGS] = 1e-9
    wrong[:, NAV_LAT] += 1e-6
    within = shares_after(judged, wrong, 30.0)
    assert within == {"tilt": 1.0, "heading": 1.0, "place": 1.0}
    wrong[:, NAV_LAT] += 1e-4
    assert shares_after(judged, wrong, 30.0)["place"] == pytest.approx(0.5, abs=0.01)
