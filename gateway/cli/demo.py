"""`mavgate demo`: the whole gateway on a simulated receiver."""

import asyncio
import tempfile

import msgspec
import typer

from gateway.cli.run import (
    ConfigOption,
    EndpointOption,
    PlainOption,
    load_settings,
    or_refuse,
    serve,
    with_endpoints,
)
from gateway.config import GatewaySettings
from gateway.daemon import Daemon
from gateway.edges.clock import unix_time_us
from gateway.pipeline import AircraftSettings
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.flight import Aircraft
from gateway.simulator.receiver import simulate


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(demo)


def demo(
    *,
    config: ConfigOption = None,
    endpoint: EndpointOption = None,
    plain: PlainOption = False,
) -> None:
    """Fly the simulated tracker, over and over, until interrupted.

    The simulated receiver speaks the real protocol on a pseudo-terminal, at true rates.
    """

    def read() -> GatewaySettings:
        return with_endpoints(load_settings(config), endpoint)

    settings = or_refuse(read)
    line = simulate(settings.simulator, unix_time_us()).frames()
    aircraft = calibrated_aircraft(settings)
    # What a ground station has the demo save must not become the real aircraft's calibration.
    with tempfile.TemporaryDirectory(prefix="mavgate-demo-") as folder:
        settings = msgspec.structs.replace(settings, aircraft_folder=folder)
        asyncio.run(serve(lambda: Daemon(settings, aircraft, line), read, plain=plain))


def calibrated_aircraft(settings: GatewaySettings) -> dict[int, AircraftSettings]:
    """Calibrate the simulated aircraft as their owner would have done before the flight."""
    found = {}
    for index in range(settings.simulator.vehicles):
        simulated = Aircraft(settings.simulator, index)
        calibration = msgspec.convert(simulated.errors, NodeCalibration, from_attributes=True)
        found[simulated.vehicle_id] = msgspec.structs.replace(
            settings.default_aircraft, calibration=calibration
        )
    return found
