"""Status of the daemon at one moment, for live view, status command and metrics."""

import math
from dataclasses import dataclass, field

from msgspec.structs import asdict

from gateway.aircraft import Aircraft
from gateway.geometry.quaternion import to_euler
from gateway.hub.stats import ClientStats, HubCounters, ListenerStats
from gateway.printable import figure, receiver_state, source_state
from gateway.records import GpsFix, LinkReport, LoggedRequest, NavState, NodeStatus, board_name
from gateway.units import counted
from gateway.vehicle.plan import Location, distance_and_bearing
from gateway.vehicle_row import VehicleRow, vehicle_text


@dataclass(frozen=True, slots=True)
class RecorderStatus:
    """Status of the recorder."""

    state: str
    name: str
    part: int
    duration_s: float
    """Duration of the recording so far, or of the last one."""
    part_bytes: int
    free_bytes: int
    reason: str
    folder: str
    mode: str = "in_flight"
    held_s: float = 0.0
    """Time before arming that is held in memory, in the mode `armed`."""


@dataclass(frozen=True, slots=True)
class RelativeLocation:
    """A location, with its distance and bearing from the aircraft."""

    lat_deg: float
    lon_deg: float
    alt_amsl_m: float
    distance_m: float | None
    """Distance over ground; None if the aircraft's position is unknown."""
    bearing_deg: float | None


@dataclass(frozen=True, slots=True)
class AircraftStatus:
    """Status of one aircraft, without its navigation state."""

    vehicle_id: int
    fix: GpsFix | None
    """The newest fix, valid or not."""
    home: RelativeLocation | None
    mark: RelativeLocation | None
    boards: tuple[NodeStatus, ...]
    """The newest report of each node."""
    origins: dict[str, str] = field(default_factory=dict)
    """Origin of attitude and position: the samples, the vehicle's own autopilot, its fixes."""
    troubles: dict[str, str] = field(default_factory=dict)
    """Texts of the severe states that it has announced and that last, by topic."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Status of the daemon at one moment."""

    time_us: int
    report: LinkReport
    states: tuple[tuple[int, NavState], ...]
    """Newest state by vehicle id; an aircraft without IMU samples so far is left out."""
    clients: tuple[ClientStats, ...]
    sent: tuple[tuple[int, int], ...]
    """MAVLink message id, and the number of messages sent since the start."""
    hub: HubCounters
    listeners: tuple[ListenerStats, ...] = ()
    places_not_kept: int = 0
    """Changes of missions, marks and home positions since the start that could not be written."""
    refused: int = 0
    """Number of requests to change something from clients without permission."""
    forged: int = 0
    """Number of requests with a wrong, old or repeated signature."""
    simulated: bool = False
    """Whether the receiver is simulated."""
    aircraft: tuple[AircraftStatus, ...] = ()
    recorder: RecorderStatus | None = None
    slow_s: float = 0.0
    """Greatest delay of the event loop while the computer is too slow; 0 otherwise."""
    vehicles: tuple[VehicleRow, ...] = ()
    """All vehicles of the hub, own and foreign, by system id."""
    requests: tuple[LoggedRequest, ...] = ()
    """Requests of clients that were refused, failed or not answered."""


def status_of(aircraft: Aircraft, now_us: int) -> AircraftStatus:
    """Return the present status of an aircraft."""
    vehicle, state = aircraft.vehicle, aircraft.state
    home, here = vehicle.telemetry.home, None
    if state is not None and math.isfinite(state.lat_deg + state.lon_deg):
        here = Location(state.lat_deg, state.lon_deg, state.alt_amsl_m)
    return AircraftStatus(
        aircraft.vehicle_id,
        vehicle.telemetry.fix,
        _seen_from(here, None if home is None else home.location),
        _seen_from(here, vehicle.plan.mark.location),
        vehicle.health.statuses,
        vehicle.telemetry.origins(now_us),
        vehicle.troubles,
    )


def _seen_from(here: Location | None, there: Location | None) -> RelativeLocation | None:
    if there is None:
        return None
    location = (there.lat_deg, there.lon_deg, there.alt_amsl_m)
    if here is None:
        return RelativeLocation(*location, None, None)
    distance_m, bearing_rad = distance_and_bearing(here, there)
    return RelativeLocation(*location, distance_m, math.degrees(bearing_rad) % 360.0)


def summary_line(snapshot: Snapshot) -> str:
    """Summarise a snapshot in one line for the log."""
    report = snapshot.report
    received = report.bytes_received, report.frames
    parts = [receiver_state(report.port, report.connected, *received)]
    parts += [source_state(asdict(source), snapshot.time_us) for source in report.sources]
    sensors = {board.node: board.sensors_present for a in snapshot.aircraft for board in a.boards}
    parts += [
        f"aircraft {board_name(node.node, sensors.get(node.node, 0))} board "
        f"{node.rate_hz:.0f} Hz {node.lost} lost"
        for node in report.nodes
    ]
    for vehicle_id, state in snapshot.states:
        roll, pitch, yaw = (math.degrees(angle) for angle in to_euler(state.q_nb))
        position = f"{figure(state.lat_deg, '.6f')} {figure(state.lon_deg, '.6f')}"
        parts.append(
            f"aircraft {vehicle_id} at {position} {figure(state.alt_amsl_m, '.1f')} m, "
            f"roll {figure(roll, '+.0f')} pitch {figure(pitch, '+.0f')} "
            f"yaw {figure(yaw % 360.0, '.0f')}"
        )
    own = {one.vehicle_id for one in snapshot.aircraft}
    parts += [vehicle_text(row) for row in snapshot.vehicles if row.system_id not in own]
    parts.append(counted(len(snapshot.clients), "client"))
    return "; ".join(filter(None, parts))
