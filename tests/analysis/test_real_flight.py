"""Table I on a real fixed-wing flight with its GPS thinned to one fix a second."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from gateway.analysis.blending import blend_table, grows
from gateway.analysis.flight import flight_of_blocks
from gateway.analysis.sweep import with_value
from gateway.recordings.files import read_chunks
from gateway.recordings.formats.csv import ColumnMap, CsvReader
from gateway.recordings.fuse import FusionSettings
from gateway.recordings.reading import TRACKER_LOG
from gateway.sensing.calibration import NodeCalibration

IN_FLIGHT = slice(15_000, 27_000)
"""Lines of the log: four minutes of the flight."""

pytestmark = [pytest.mark.io, pytest.mark.slow]


def test_the_table_has_the_papers_shape(data_dir: Path) -> None:
    text = b"".join(read_chunks(data_dir / "arduplane_testlog2.csv.gz")).decode()
    lines = text.splitlines()
    columns = msgspec.toml.decode(TRACKER_LOG.read_bytes(), type=ColumnMap)
    fusion = FusionSettings()
    for name, value in (
        ("gps_latency_s", 0.28), ("declination", "fixed"), ("declination_deg", 11.0)
    ):  # fmt: skip
        fusion = with_value(fusion, f"estimation.reference.{name}", value)
    flight = flight_of_blocks(
        CsvReader(columns).blocks([*lines[:2], *lines[IN_FLIGHT]]),
        NodeCalibration(), fusion, name="arduplane", story="",
    )  # fmt: skip
    table = blend_table(flight, fusion, 1.0)
    for error in ("north_m", "east_m", "held_m"):
        assert grows(table, error)
    assert np.argmin(table["held_m"]) == 0
    assert table.iloc[0]["north_m"] < 2.5
