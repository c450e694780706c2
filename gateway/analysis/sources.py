"""Where flights come from: the simulator and recordings."""

from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Final

import msgspec
import numpy as np

from gateway.analysis.flight_arrays import (
    Flight,
    FlightTrack,
    FloatArray,
    FusionSettings,
    IntArray,
    Reference,
    flight_of_records,
    track_of_states,
)
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings
from gateway.flightlog.table.row import TableRow
from gateway.records import ImuCalibrated, NavState, RawRecord
from gateway.replay import records_of
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.sensors import SensorErrors
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.trajectory import FLIGHT_S, Trajectory
from gateway.units import US_PER_S
from gateway.wire.link import Link

SIMULATED_STORY: Final = (
    "The built-in simulated flight of a small fixed-wing aircraft, 218 s like the paper's own: "
    "rest, take-off, a circuit with a figure of eight, landing. GPS is lost for 10 s and for 3 s, "
    "and some payloads are lost on the radio."
)
TRUTH_STORY: Final = "the simulation's exact truth"
NEAR_US: Final = 50_000


def simulated_flight(
    settings: SimulatorSettings | None = None,
    fusion: FusionSettings | None = None,
    duration_s: float = FLIGHT_S,
) -> Flight:
    """Fly the built-in flight.

    Parameters
    ----------
    settings : SimulatorSettings, optional
        The simulator's; its GPS latency becomes that of the fusion.
    fusion : FusionSettings, optional
        Everything else that the fusion needs.
    duration_s : float
        How much of it.

    Returns
    -------
    Flight
        With exact truth as its reference.
    """
    settings = msgspec.structs.replace(settings or SimulatorSettings(), vehicles=1)
    aircraft = SimulatedAircraft(settings)
    flight = flight_of_records(
        _received(settings, duration_s),
        ideal_calibration(aircraft.errors),
        name="simulated flight",
        story=SIMULATED_STORY,
        fusion=with_latency(fusion or FusionSettings(), settings.gps_latency_s),
    )
    return replace(flight, reference=_truth_of(aircraft.trajectory, flight))


def _received(settings: SimulatorSettings, duration_s: float) -> Iterator[RawRecord]:
    """Let the nodes' payloads go by radio and serial line, with losses and jitter, as live."""
    link = Link()
    for frame in simulate(settings).frames(duration_s):
        yield from link.feed(frame.data, round(frame.time_s * US_PER_S))


def ideal_calibration(errors: SensorErrors) -> NodeCalibration:
    """Return the calibration that undoes the simulated sensors' constant errors."""
    return msgspec.convert(errors, NodeCalibration, from_attributes=True)


def _truth_of(trajectory: Trajectory, flight: Flight) -> Reference:
    truth = trajectory.truth_at(flight.time_us.astype(np.float64) * 1e-6)
    track = FlightTrack(
        time_us=flight.time_us,
        q_nb=truth.q_nb,
        lat_deg=truth.lat_deg,
        lon_deg=truth.lon_deg,
        alt_amsl_m=truth.alt_amsl_m,
        vel_n_mps=truth.vel_n_mps,
    )
    return Reference(track, is_exact=True, story=TRUTH_STORY)


def with_latency(fusion: FusionSettings, latency_s: float) -> FusionSettings:
    """Set how old the GPS fixes are at their arrival."""
    estimation: EstimationSettings = fusion.estimation
    reference: ReferenceSettings = msgspec.structs.replace(
        estimation.reference, gps_latency_s=latency_s
    )
    estimation = msgspec.structs.replace(estimation, reference=reference)
    return msgspec.structs.replace(fusion, estimation=estimation)


def flight_of_rows(
    rows: Iterable[TableRow],
    calibration: NodeCalibration,
    fusion: FusionSettings,
    *,
    name: str,
    story: str,
) -> Flight:
    """Take a flight out of a recording.

    Parameters
    ----------
    rows : iterable of TableRow
        In the order of time.
    calibration : NodeCalibration
        Of the IMU node, for rows that hold counts.
    fusion : FusionSettings
        The settings that belong to the flight.
    name, story : str
        See `Flight`.

    Returns
    -------
    Flight
        With the states that were recorded, if there are any.

    Raises
    ------
    ValueError
        If there are fewer than two IMU samples.
    """
    states: list[NavState] = []

    def records() -> Iterator[RawRecord | ImuCalibrated]:
        for row in rows:
            if row.state is not None:
                states.append(row.state)
            yield from records_of(row)

    flight = flight_of_records(records(), calibration, name=name, story=story, fusion=fusion)
    if not states:
        return flight
    return replace(flight, recorded=at_times(track_of_states(states), flight.time_us))


def judged_by(flight: Flight, rows: Iterable[TableRow], name: str) -> Flight:
    """Take the states of a recording as a flight's reference.

    Parameters
    ----------
    flight : Flight
    rows : iterable of TableRow
        On the clock of the flight, in the order of time.
    name : str
        What the reference is called.

    Returns
    -------
    Flight

    Raises
    ------
    ValueError
        If the recording holds no state.
    """
    states = [row.state for row in rows if row.state is not None]
    if not states:
        raise ValueError(f"{name}: holds no states to judge by")
    track = at_times(track_of_states(states), flight.time_us)
    return replace(
        flight, reference=Reference(track, is_exact=False, story=f"the states in {name}")
    )


def at_times(track: FlightTrack, time_us: IntArray) -> FlightTrack:
    """Take the rows of a track that are nearest to given times.

    Parameters
    ----------
    track : FlightTrack
        In the order of time.
    time_us : ndarray, shape (N,)
        Where it has no row within `NEAR_US`, nothing is known.

    Returns
    -------
    FlightTrack
        One row for each of the times.
    """
    after = np.searchsorted(track.time_us, time_us).clip(1, max(len(track.time_us) - 1, 1))
    before = after - 1
    after = after.clip(0, len(track.time_us) - 1)
    late = track.time_us[after] - time_us < time_us - track.time_us[before]
    nearest = np.where(late, after, before)
    near = np.abs(track.time_us[nearest] - time_us) <= NEAR_US

    def chosen(values: FloatArray) -> FloatArray:
        return np.where(near if values.ndim == 1 else near[:, np.newaxis], values[nearest], np.nan)

    return FlightTrack(
        time_us=time_us,
        q_nb=chosen(track.q_nb),
        lat_deg=chosen(track.lat_deg),
        lon_deg=chosen(track.lon_deg),
        alt_amsl_m=chosen(track.alt_amsl_m),
        vel_n_mps=chosen(track.vel_n_mps),
    )
