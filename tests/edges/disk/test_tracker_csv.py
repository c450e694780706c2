"""Tracker logs: what is in them, and what is wrong with them."""

import gzip
from pathlib import Path

import numpy as np
import pytest

from gateway.edges.disk.tracker_csv import FlightFileError, read_flight

pytestmark = pytest.mark.io

LOG = """# tracker declination_deg=0.8 gps_latency_s=0.15
time_s,ax,ay,az,gx,gy,gz,mx,my,mz,gps_time_s,gps_lat,gps_lon,note
0.00,0.1,0.2,-9.8,0.01,0.02,0.03,,,,,,,
0.02,0.1,0.2,-9.7,0.01,0.02,0.03,20.5,1,-30,0.015,-7.5,110.3,

0.04,0.1,0.2,-9.6,0.01,0.02,0.03,,,,,,,
"""


@pytest.mark.parametrize("packed", [False, True])
def test_reads_plain_and_gzipped(tmp_path: Path, packed: bool) -> None:
    # The content decides, not the name.
    path = tmp_path / "flight.csv"
    path.write_bytes(gzip.compress(LOG.encode()) if packed else LOG.encode())
    flight = read_flight(path)
    np.testing.assert_allclose(flight.time_s, [0.0, 0.02, 0.04])
    np.testing.assert_allclose(flight.accel_b_mps2[:, 2], [-9.8, -9.7, -9.6])
    np.testing.assert_allclose(flight.mag_b_ut[1], [20.5, 1.0, -30.0])
    assert np.isnan(flight.mag_b_ut[0]).all()
    assert flight.gps_time_s.tolist() == [0.015]
    assert flight.gps_latency_s == 0.15
    assert flight.rate_hz == pytest.approx(50.0)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "columns missing: time_s"),
        (LOG.replace("0.2,-9.7", "0.2,oops").encode(), "row 2, column az: 'oops' is no number"),
        (LOG.replace("0.2,-9.7", "-9.7").encode(), "row 2 has 13 cells, the header has 14"),
        (LOG.replace("0.04,", "0.01,").encode(), "goes back"),
        (LOG.replace("latency_s=0.15", "latency_s=soon").encode(), "soon"),
        (gzip.compress(LOG.encode())[:-9], "end-of-stream"),
        (b"\xff\xfe\x00", "is no CSV"),
    ],
)
def test_says_what_is_wrong(tmp_path: Path, content: bytes, said: str) -> None:
    path = tmp_path / "broken.csv"
    path.write_bytes(content)
    with pytest.raises(FlightFileError, match=said) as caught:
        read_flight(path)
    assert str(path) in str(caught.value)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FlightFileError, match="No such file"):
        read_flight(tmp_path / "none.csv")
