import pytest

from tools.flights import Flight, simulated_flight


@pytest.fixture(scope="session")
def flight() -> Flight:
    return simulated_flight(21, calibrated=True)
