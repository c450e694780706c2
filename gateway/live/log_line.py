"""The summary line that a gateway logs periodically."""

import math
from typing import Final

from gateway.geometry.quaternion import to_euler
from gateway.reasons import receiver_state
from gateway.status import Snapshot
from gateway.units import counted

UNKNOWN: Final = "—"


def summary_line(snapshot: Snapshot) -> str:
    """Summarise a snapshot in one line for a log."""
    report = snapshot.report
    receiver = receiver_state(report.connected, report.bytes_received, report.frames)
    parts = [f"receiver {report.port} {receiver}"]
    parts += [
        f"node {node.node.vehicle_id}.{node.node.node_id} {node.rate_hz:.0f} Hz {node.lost} lost"
        for node in report.nodes
    ]
    for vehicle_id, state in snapshot.states:
        roll, pitch, yaw = (math.degrees(angle) for angle in to_euler(state.q_nb))
        place = f"{figure_of(state.lat_deg, '.6f')} {figure_of(state.lon_deg, '.6f')}"
        parts.append(
            f"aircraft {vehicle_id} at {place} {figure_of(state.alt_amsl_m, '.1f')} m, "
            f"roll {roll:+.0f} pitch {pitch:+.0f} yaw {yaw % 360.0:.0f}"
        )
    count = len(snapshot.clients)
    parts.append(counted(count, "client"))
    return "; ".join(parts)


def figure_of(value: float, spec: str) -> str:
    """Format a number, or a dash for one that is not known."""
    return format(value, spec) if math.isfinite(value) else UNKNOWN
