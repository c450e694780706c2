from typing import Annotated

import pytest

from gateway.records import Vec3
from gateway.settings import Settings, setting
from gateway.vehicle.telemetry.health import Health
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.conftest import ManualClock
from tests.kit.ground_station import GroundStation
from tests.kit.records import BARO, FIX, SAMPLE, STATE, sample_at, state_at


class InnerSettings(Settings, frozen=True):
    """A section in a section."""

    alpha_gyro: Annotated[float, setting("Weight of the gyroscope.", ge=0.0, le=1.0)] = 0.75


class TuningSettings(Settings, frozen=True):
    """Every kind of setting that can be a parameter, and some that cannot."""

    cutoff_hz: Annotated[float, setting("Cutoff of a filter.", "Hz", ge=0.1, le=500.0)] = 10.0
    order: Annotated[int, setting("Order of a filter.", ge=1, le=8)] = 2
    enabled: Annotated[bool, setting("Whether it runs.")] = True
    shape: Annotated[str, setting("A free text.")] = "round"
    bias_mps2: Annotated[Vec3, setting("An offset.", "m/s2")] = (0.0, 1.0, 2.0)
    inner: InnerSettings = InnerSettings()


@pytest.fixture
def vehicle() -> Vehicle:
    return Vehicle(VehicleSettings(), 1, sections={"tuning": TuningSettings()})


@pytest.fixture
def located(vehicle: Vehicle, clock: ManualClock) -> Vehicle:
    """The vehicle when it knows where it is."""
    clock.now_us = 1_000_000
    vehicle.on_gps(FIX, clock.now_us)
    vehicle.on_baro(BARO, clock.now_us)
    vehicle.on_state(state_at(clock.now_us), sample_at(clock.now_us), clock.now_us)
    return vehicle


@pytest.fixture
def station(located: Vehicle, clock: ManualClock) -> GroundStation:
    """A trusted ground station of that vehicle."""
    return GroundStation(located, clock)


@pytest.fixture
def health() -> Health:
    """All sensors of an aircraft have just sent a good sample."""
    health = Health(1, 2.0)
    health.on_state(STATE, SAMPLE)
    health.on_baro(BARO)
    health.on_gps(FIX)
    return health
