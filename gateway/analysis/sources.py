"""Where flights come from: the simulator and recordings."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
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
    settled,
)
from gateway.estimation.reference import ReferenceSettings
from gateway.estimation.select import EstimationSettings
from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.recordings.columns import (
    BARO,
    GPS,
    GPS_CODEC,
    NAV,
    NAV_CODEC,
    NODE_TIME,
    RAW,
    SI,
    has_group,
)
from gateway.recordings.fuse import calibrated_of
from gateway.recordings.table import TableBlock
from gateway.records import GpsFix, RawRecord
from gateway.sensing.calibration import IDENTITY3, Correction, NodeCalibration, new_field_ut
from gateway.sensing.chain import SensorChain
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
NO_COUNTS: Final = -1


def simulated_flight(
    settings: SimulatorSettings | None = None,
    fusion: FusionSettings | None = None,
    duration_s: float = FLIGHT_S,
) -> Flight:
    """Fly the built-in flight."""
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
    """Send the nodes' payloads by radio and serial line, with losses and jitter, as live."""
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


def flight_of_blocks(
    blocks: Iterable[TableBlock],
    calibration: NodeCalibration,
    fusion: FusionSettings,
    *,
    name: str,
    story: str,
) -> Flight:
    """Build a flight from a recording.

    Raises ValueError if there are fewer than two IMU samples.
    """
    pieces = [_arrays_of(block.cells, calibration) for block in blocks if len(block)]
    if sum(len(piece.time_us) for piece in pieces) < 2:
        raise ValueError(f"{name}: {sum(len(p.time_us) for p in pieces)} IMU samples are no flight")
    columns = {
        column: np.concatenate([getattr(piece, column) for piece in pieces])
        for column in _Arrays.__slots__
        if column != "fixes"
    }
    fixes = [fix for piece in pieces for fix in piece.fixes]
    time_us = columns["time_us"]
    node_time_us, bare_mag = columns["node_time_us"], columns["mag_uncalibrated_b_ut"]
    has_counts = bool((node_time_us != NO_COUNTS).all())
    flight = Flight(
        name=name,
        story=story,
        fusion=fusion,
        time_us=time_us,
        accel_b_mps2=columns["accel_b_mps2"],
        gyro_b_radps=columns["gyro_b_radps"],
        mag_b_ut=columns["mag_b_ut"],
        flags=columns["flags"],
        baro_time_us=columns["baro_time_us"],
        baro_alt_m=columns["baro_alt_m"],
        fixes=tuple(fixes),
        scored=settled(time_us, fixes, fusion.estimation.reference),
        node_time_us=node_time_us if has_counts else None,
        mag_uncalibrated_b_ut=bare_mag if has_counts else None,
    )
    states = columns["states"]
    if not len(states):
        return flight
    return replace(flight, recorded=at_times(_track_of_cells(states), time_us))


@dataclass(frozen=True, slots=True)
class _Arrays:
    """The columns of a flight in one block of a recording."""

    time_us: IntArray
    accel_b_mps2: FloatArray
    gyro_b_radps: FloatArray
    mag_b_ut: FloatArray
    flags: IntArray
    node_time_us: IntArray
    """`NO_COUNTS` for a sample without counts."""
    mag_uncalibrated_b_ut: FloatArray
    baro_time_us: IntArray
    baro_alt_m: FloatArray
    fixes: list[GpsFix]
    states: FloatArray
    """Cells of `NAV_COLUMNS`."""


def _arrays_of(cells: FloatArray, calibration: NodeCalibration) -> _Arrays:
    has_counts = has_group(cells, RAW)
    samples = cells[has_counts | has_group(cells, SI)]
    chain = SensorChain(calibration)
    accel, gyro, mag, _, flags = calibrated_of(samples, chain)
    turned = Correction(calibration.mag_mounting, IDENTITY3, (0.0, 0.0, 0.0))
    counts = samples[:, RAW]
    bare_mag = turned.apply_all(new_field_ut(np.nan_to_num(counts), flags))
    baros = cells[has_group(cells, BARO)][:, BARO]
    fixes = [GPS_CODEC.read(row, 1) for row in cells[has_group(cells, GPS)][:, GPS].tolist()]
    node_time_us = np.where(np.isnan(counts[:, 0]), NO_COUNTS, samples[:, NODE_TIME])
    return _Arrays(
        time_us=samples[:, 0].astype(np.int64),
        accel_b_mps2=accel,
        gyro_b_radps=gyro,
        mag_b_ut=mag,
        flags=flags,
        node_time_us=node_time_us.astype(np.int64),
        mag_uncalibrated_b_ut=bare_mag,
        baro_time_us=baros[:, 0].astype(np.int64),
        baro_alt_m=np.array([*map(pressure_altitude_m, baros[:, 3].tolist())], np.float64),
        fixes=fixes,
        states=cells[has_group(cells, NAV)][:, NAV],
    )


def _track_of_cells(states: FloatArray) -> FlightTrack:
    """Make a track of cells of `NAV_COLUMNS`, with the values that their flags mark as valid."""
    at = {name.removeprefix("nav_"): k for k, name in enumerate(NAV_CODEC.columns)}
    track = FlightTrack(
        time_us=states[:, at["time_us"]].astype(np.int64),
        q_nb=states[:, at["q_w"] : at["q_z"] + 1],
        lat_deg=states[:, at["lat_deg"]],
        lon_deg=states[:, at["lon_deg"]],
        alt_amsl_m=states[:, at["alt_amsl_m"]],
        vel_n_mps=states[:, at["vel_north_mps"] : at["vel_down_mps"] + 1],
    )
    return track.where_valid(states[:, at["flags"]].astype(np.int64))


def judged_by(flight: Flight, blocks: Iterable[TableBlock], name: str) -> Flight:
    """Take the states of a recording as a flight's reference.

    Raises ValueError if the recording holds no state.
    """
    states = [block.cells[has_group(block.cells, NAV)][:, NAV] for block in blocks]
    if not sum(map(len, states)):
        raise ValueError(f"{name}: holds no states to judge by")
    track = at_times(_track_of_cells(np.concatenate(states)), flight.time_us)
    return replace(
        flight, reference=Reference(track, is_exact=False, story=f"the states in {name}")
    )


def at_times(track: FlightTrack, time_us: IntArray) -> FlightTrack:
    """Return the rows of a track that are nearest to given times.

    Parameters
    ----------
    track : FlightTrack
        In the order of time.
    time_us : ndarray, shape (N,)
        Without a row within `NEAR_US`, the result is NaN.

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
