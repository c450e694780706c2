"""A small folder of recordings, written once for all tests of the package."""

from pathlib import Path

import pytest

from tests.batch.flights import write_flight


@pytest.fixture(scope="session")
def batch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four flights of two aircraft on three days, and a broken file."""
    folder = tmp_path_factory.mktemp("flights")
    write_flight(folder / "alpha_01_v1.csv", vehicle=1, day=0, noise_m=0.2)
    write_flight(folder / "beta_01_v1.csv", vehicle=1, day=1, noise_m=0.2)
    write_flight(folder / "gamma_01_v2.csv", vehicle=2, day=1, noise_m=0.2)
    write_flight(folder / "delta_01_v2.csv", vehicle=2, day=2, noise_m=0.2)
    (folder / "broken.csv").write_text("x,y\n1,2\n")
    return folder
