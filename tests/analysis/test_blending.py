from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from gateway.analysis.blending import (
    PAPER_TABLE,
    blend_table,
    grows,
    make_judge,
    score,
    with_weights,
    withhold,
)
from gateway.analysis.reporting.estimators import weights
from gateway.recordings.fuse import FusionSettings
from tests.analysis.flights import short_case, short_flight


def test_the_papers_table_grows_both_ways() -> None:
    assert grows(PAPER_TABLE, "north_m")
    assert grows(PAPER_TABLE, "east_m")


def test_a_table_that_falls_somewhere_does_not_grow() -> None:
    table = PAPER_TABLE.copy()
    table.loc[4, "east_m"] = 1.0
    assert grows(table, "north_m")
    assert not grows(table, "east_m")


def test_the_table_has_the_papers_shape() -> None:
    case = short_case()
    table = blend_table(case.flight, case.fusion, 1.0)
    assert isinstance(table, pd.DataFrame)
    assert grows(table, "north_m")
    assert grows(table, "east_m")
    assert table.iloc[0][["alpha", "beta"]].tolist() == [0.1, 0.1]
    assert table["held_m"].idxmin() == 0


def test_interpolated_gps_scores_zero_against_itself() -> None:
    flight = short_flight()
    judge = make_judge(flight, withhold(flight, 5))
    found = score(judge.interpolated, judge)
    assert found["north_m"] == found["east_m"] == found["interpolated_m"] == 0.0
    assert 0.0 < found["held_m"] < 2.0


def test_truth_scores_zero_against_the_reference() -> None:
    flight = short_flight()
    assert flight.reference is not None
    judge = make_judge(flight, np.ones(len(flight.fixes), np.bool_))
    found = score(flight.reference.track, judge)
    assert found["reference_m"] == pytest.approx(0.0)
    assert np.isnan(found["held_m"])


def test_weights_choose_the_papers_estimator() -> None:
    changed = with_weights(FusionSettings(), 0.3, 0.7).estimation
    assert (changed.estimator, changed.paper.alpha_accel, changed.paper.beta_velocity) == (
        "paper", 0.3, 0.7,
    )  # fmt: skip


def test_no_table_where_no_fix_judges() -> None:
    case = short_case()
    blind = replace(case.flight, scored=np.zeros(len(case.flight.time_us), dtype=bool))
    assert weights(replace(case, flight=blind)) is None
