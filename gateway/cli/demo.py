"""`mavgate demo`: the whole gateway on a simulated receiver."""

import asyncio

import msgspec
import typer

from gateway.cli.run import (
    ConfigOption,
    EndpointOption,
    PlainOption,
    read_settings,
    serve,
    with_endpoints,
)
from gateway.daemon import Daemon
from gateway.edges.clock import unix_time_us
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.flight import Aircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.sensors import SensorErrors
from gateway.simulator.settings import SimulatorSettings


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
    settings = with_endpoints(read_settings(config), endpoint)
    line = simulate(settings.simulator, unix_time_us()).frames()
    calibrations = ideal_calibrations(settings.simulator)
    asyncio.run(serve(lambda: Daemon(settings, calibrations, line), plain=plain))


def ideal_calibrations(settings: SimulatorSettings) -> dict[int, NodeCalibration]:
    """Calibrate the simulated aircraft as their owner would have done before the flight."""
    aircraft = (Aircraft(settings, index) for index in range(settings.vehicles))
    return {a.vehicle_id: _calibration(a.errors) for a in aircraft}


def _calibration(errors: SensorErrors) -> NodeCalibration:
    return msgspec.convert(errors, NodeCalibration, from_attributes=True)
