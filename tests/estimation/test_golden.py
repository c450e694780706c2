"""The change indicator: a fused golden flight differs from the committed result only on purpose."""

import csv
from pathlib import Path

import numpy as np
import pytest

from tools.make_golden import ESTIMATORS, GOLDEN, fused


def table(lines: list[str]) -> tuple[list[str], np.ndarray]:
    head, *rows = csv.reader(lines)
    return head, np.array([[float(cell) if cell else np.nan for cell in row] for row in rows])


@pytest.mark.io
@pytest.mark.slow
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_golden_flight(estimator: str) -> None:
    expected_file: Path = GOLDEN / f"take_off.{estimator}.expected.csv"
    names, expected = table(expected_file.read_text().splitlines())
    found_names, found = table(fused(GOLDEN / "take_off.csv.gz", estimator))
    assert found_names == names
    for column, name in enumerate(names):
        both = found[:, column], expected[:, column]
        np.testing.assert_allclose(*both, rtol=0, atol=1e-6, err_msg=name)
