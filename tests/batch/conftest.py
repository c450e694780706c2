"""A small season, written once for all tests of the room."""

from pathlib import Path

import pytest

from tests.batch.season_flights import write_flight


@pytest.fixture(scope="session")
def season(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four flights of two aircraft on three days, one in two parts' names, and a broken file."""
    place = tmp_path_factory.mktemp("flights")
    write_flight(place / "alpha_01_v1.csv", vehicle=1, day=0, noise_m=0.2)
    write_flight(place / "beta_01_v1.csv", vehicle=1, day=1, noise_m=0.2)
    write_flight(place / "gamma_01_v2.csv", vehicle=2, day=1, noise_m=0.2)
    write_flight(place / "delta_01_v2.csv", vehicle=2, day=2, noise_m=0.2)
    (place / "broken.csv").write_text("x,y\n1,2\n")
    return place
