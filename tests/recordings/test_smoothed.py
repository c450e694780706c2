"""A recording whose clock is not always in order is smoothed, or refused with advice."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from gateway.estimation.record import FloatArray, IntArray
from gateway.recordings.files import FlightError
from gateway.recordings.recorded_fusion import RecordedFusion
from tests.kit.cli import invoke
from tests.recordings.flights import OPTIONS

GOLDEN = Path(__file__).parents[1] / "golden" / "take_off.csv.gz"
HEAD_LINES = 2


def rows_of_golden() -> tuple[list[str], list[str]]:
    lines = gzip.decompress(GOLDEN.read_bytes()).decode().splitlines()
    return lines[:HEAD_LINES], lines[HEAD_LINES:]


def smoothed(path: Path) -> tuple[IntArray, FloatArray]:
    return RecordedFusion([path], OPTIONS, smooth=True, latency_s=0.0).states()


def test_late_samples_are_sorted_by_time(tmp_path: Path) -> None:
    head, rows = rows_of_golden()
    rows[500], rows[501] = rows[501], rows[500]
    path = tmp_path / "late.csv"
    path.write_text("\n".join([*head, *rows]))
    for found, expected in zip(smoothed(path), smoothed(GOLDEN), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_clock_set_back_is_refused_with_advice(tmp_path: Path) -> None:
    head, rows = rows_of_golden()
    path, own, out = (tmp_path / f"{name}.csv" for name in ("log", "own", "out"))
    path.write_text("\n".join([*head, *rows]))
    invoke("convert", path, "-o", own, code=0)
    # A recording of our own has the gateway's clock, which is not continued where it goes back.
    lines = own.read_text().splitlines()
    own.write_text("\n".join([*lines, *lines[-500:]]))
    text = "own.csv: its clock goes back by 20.0 s at IMU sample 1877"
    refused = invoke("fuse", own, "-o", out, "--smooth")
    assert text in " ".join(refused.output.split())
    assert refused.exit_code == 2
    with pytest.raises(FlightError, match=f"{text}.*leave out --smooth"):
        RecordedFusion([own], OPTIONS, smooth=True)
