"""The built-in simulated flight with its exact truth, for the analysis.

Separate from `flight`, because the simulator imports all of SciPy, which the panel does not need.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from gateway.analysis.flight import Flight, FlightTrack, Reference, flight_of_blocks
from gateway.recordings.fuse import FusionSettings, with_reference
from gateway.recordings.rows import RowBuilder
from gateway.recordings.table import block_of
from gateway.records import BaroRaw, GpsFix, ImuRaw
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, Trajectory
from gateway.units import US_PER_S
from gateway.wire.link import Link

SIMULATED_DESCRIPTION: Final = (
    "The built-in simulated flight of a small fixed-wing aircraft, 218 s like the paper's own: "
    "rest, take-off, a circuit with a figure of eight, landing. GPS is lost for 10 s and for 3 s, "
    "and some payloads are lost on the radio."
)
TRUTH_DESCRIPTION: Final = "the simulation's exact truth"


def simulated_flight(
    settings: SimulatorSettings | None = None,
    fusion: FusionSettings | None = None,
    duration_s: float = FLIGHT_S,
) -> Flight:
    """Simulate the built-in flight, with realistic losses and jitter of radio and serial line."""
    settings = msgspec.structs.replace(settings or SimulatorSettings(), vehicles=1)
    aircraft = SimulatedAircraft(settings)
    builder = RowBuilder()
    rows = [row for record in received(settings, duration_s) for row in builder.add(record)]
    flight = flight_of_blocks(
        [block_of([*rows, *builder.flush()])],
        NodeCalibration(**aircraft.errors),
        with_reference(fusion or FusionSettings(), gps_latency_s=settings.gps_latency_s),
        name="simulated flight",
        description=SIMULATED_DESCRIPTION,
    )
    return replace(flight, reference=_truth_of(aircraft.trajectory, flight))


def received(settings: SimulatorSettings, duration_s: float) -> Iterator[ImuRaw | BaroRaw | GpsFix]:
    """Yield the samples and fixes of a simulated flight as the gateway receives them."""
    link = Link()
    for frame in simulate(settings).frames(duration_s):
        for record in link.feed(frame.data, round(frame.time_s * US_PER_S)):
            if isinstance(record, ImuRaw | BaroRaw | GpsFix):
                yield record


def _truth_of(trajectory: Trajectory, flight: Flight) -> Reference:
    truth = trajectory.truth_at(flight.time_us.astype(np.float64) * 1e-6)
    columns = (truth.q_nb, truth.lat_deg, truth.lon_deg, truth.alt_amsl_m, truth.vel_n_mps)
    track = FlightTrack(flight.time_us, *columns)
    return Reference(track, is_exact=True, description=TRUTH_DESCRIPTION)
