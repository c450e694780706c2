"""The live view in the terminal: link, aircraft and clients at a glance.

It is made for 80 columns and upwards. Where the rows do not suffice, the end is cut off; so what
matters most comes first, and last the rates of the messages.
"""

import logging
import math
from collections import deque
from typing import Final

from pymavlink.dialects.v20 import common as mavlink
from rich.columns import Columns
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from gateway.geometry.quaternion import to_euler
from gateway.records import LinkReport, NavFlags, NavState, NodeLink
from gateway.routing.client_table import ClientStats, ListenerStats
from gateway.status import Snapshot
from gateway.units import US_PER_S

SILENT_US: Final = 2 * US_PER_S
UNKNOWN: Final = "—"
LOG_LINES: Final = 5
RATE_SNAPSHOTS: Final = 11
"""Rates are told over so many views: a message of 1 Hz must not flicker between 0 and 2."""
RATE_NAME: Final = 22
"""Letters of the longest usual name, so that names and figures stand below each other."""

FLAG_WORDS: Final = (
    (NavFlags.ATTITUDE_VALID, "attitude", "green"),
    (NavFlags.HEADING_VALID, "heading", "green"),
    (NavFlags.POSITION_VALID, "position", "green"),
    (NavFlags.AT_REST, "at rest", "cyan"),
    (NavFlags.DEAD_RECKONING, "dead reckoning", "yellow"),
    (NavFlags.GPS_REJECTED, "GPS rejected", "yellow"),
    (NavFlags.MAG_DISTURBED, "magnetic disturbance", "yellow"),
    (NavFlags.SENSOR_FAULT, "sensor fault", "red"),
    (NavFlags.DEGRADED, "degraded", "red"),
)


class RecentLog(logging.Handler):
    """Keep the newest log lines: on the view's screen they have no other place."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
        self.lines: deque[tuple[str, str]] = deque(maxlen=LOG_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one line and its style."""
        style = "yellow" if record.levelno >= logging.WARNING else ""
        self.lines.append((self.format(record), style))


class LiveView:
    """Draw snapshots; keeps the last ones to tell rates."""

    def __init__(self) -> None:
        self.log = RecentLog()
        self.link = ""
        """Address of the panel; empty without one."""
        self._snapshots: deque[Snapshot] = deque(maxlen=RATE_SNAPSHOTS)

    def draw(self, snapshot: Snapshot) -> RenderableType:
        """Build the whole view of one moment.

        Parameters
        ----------
        snapshot : Snapshot
            The daemon's state now.

        Returns
        -------
        RenderableType
            To be shown by a rich `Live` or `Console`.
        """
        self._snapshots.append(snapshot)
        previous = self._snapshots[0]
        parts: list[RenderableType] = [_link_line(snapshot)]
        if self.link:
            parts.append(Text.assemble("panel  ", (self.link, "bold cyan")))
        parts.append(Text())
        if snapshot.report.nodes:
            parts.append(_nodes(snapshot.report))
        for vehicle_id, state in snapshot.states:
            parts += [Text(), _aircraft(vehicle_id, state), _flags(state)]
        if not snapshot.states:
            parts.append(Text("No aircraft heard yet.", style="dim"))
        parts += [Text(), _clients(snapshot), *_ports(snapshot), *_troubles(snapshot), Text()]
        parts += [Text(line, style=style) for line, style in self.log.lines]
        if snapshot.sent:
            parts += [Text("MAVLink sent, Hz", style="bold italic"), _rates(snapshot, previous)]
        return Group(*parts)


def summary_line(snapshot: Snapshot) -> str:
    """Sum up a moment in one line for a log."""
    report = snapshot.report
    parts = [f"receiver {report.port} {'connected' if report.connected else 'not connected'}"]
    parts += [
        f"node {node.node.vehicle_id}.{node.node.node_id} {node.rate_hz:.0f} Hz {node.lost} lost"
        for node in report.nodes
    ]
    for vehicle_id, state in snapshot.states:
        roll, pitch, yaw = (math.degrees(angle) for angle in to_euler(state.q_nb))
        place = f"{_figure(state.lat_deg, '.6f')} {_figure(state.lon_deg, '.6f')}"
        parts.append(
            f"aircraft {vehicle_id} at {place} {_figure(state.alt_amsl_m, '.1f')} m, "
            f"roll {roll:+.0f} pitch {pitch:+.0f} yaw {yaw % 360.0:.0f}"
        )
    parts.append(f"{len(snapshot.clients)} clients")
    return "; ".join(parts)


def _table(title: str, *columns: str) -> Table:
    """Begin a table whose first column has the table's own name at its head."""
    table = Table(box=None, pad_edge=False)
    for number, column in enumerate((title, *columns)):
        table.add_column(column, justify="left" if number == 0 else "right")
    return table


def _link_line(snapshot: Snapshot) -> Text:
    report = snapshot.report
    up = f"{snapshot.time_us // US_PER_S // 60}:{snapshot.time_us // US_PER_S % 60:02d}"
    line = Text(f"mavgate  up {up}  receiver ")
    state = ("connected", "green") if report.connected else ("not connected", "red")
    line.append(f"{report.port} {state[0]}", style=state[1])
    line.append(f"  {report.frames} frames, {report.frames_lost} lost on the line")
    for kind, count in report.faults:
        line.append(f", {count} {kind} faults", style="yellow")
    if report.receiver is not None:
        line.append(f"  channel {report.receiver.channel}")
        line.append(f", noise {report.receiver.noise_percent} %")
    return line


def _nodes(report: LinkReport) -> Table:
    columns = ("pipe", "rate Hz", "received", "lost", "lost %", "dup", "restarts", "ppm")
    table = _table("node", *columns, "age s")
    for node in report.nodes:
        table.add_row(*_node_cells(node), _age(report.time_us, node.last_time_us))
    return table


def _node_cells(node: NodeLink) -> tuple[str, ...]:
    total = node.received + node.lost
    return (
        f"{node.node.vehicle_id}.{node.node.node_id}",
        str(node.pipe),
        f"{node.rate_hz:.0f}",
        str(node.received),
        str(node.lost),
        f"{100 * node.lost / total:.2f}" if total else UNKNOWN,
        str(node.duplicates),
        str(node.restarts),
        f"{node.clock_skew_ppm:+.0f}",
    )


def _age(now_us: int, then_us: int) -> Text:
    age_us = max(0, now_us - then_us)
    return Text(f"{age_us / US_PER_S:.1f}", style="red" if age_us > SILENT_US else "")


def _aircraft(vehicle_id: int, state: NavState) -> Table:
    roll, pitch, yaw = (math.degrees(angle) for angle in to_euler(state.q_nb))
    north, east, down = state.vel_n_mps
    table = _table(
        "aircraft",
        *("roll°", "pitch°", "yaw°", "latitude°", "longitude°", "AMSL m", "m/s", "climb"),
    )
    table.add_row(
        str(vehicle_id),
        _figure(roll, "+.1f"),
        _figure(pitch, "+.1f"),
        _figure(yaw % 360.0, ".1f"),
        _figure(state.lat_deg, ".6f"),
        _figure(state.lon_deg, ".6f"),
        _figure(state.alt_amsl_m, ".1f"),
        _figure(math.hypot(north, east), ".1f"),
        _figure(-down, "+.1f"),
    )
    return table


def _flags(state: NavState) -> Text:
    words = [Text(word, style=style) for flag, word, style in FLAG_WORDS if flag in state.flags]
    return Text("  ").join(words)


def _figure(value: float, spec: str) -> str:
    return format(value, spec) if math.isfinite(value) else UNKNOWN


def _rates(snapshot: Snapshot, previous: Snapshot) -> Columns:
    span_s = (snapshot.time_us - previous.time_us) / US_PER_S
    before = dict(previous.sent)
    rates = [
        (_message_name(key), f"{(count - before.get(key, 0)) / span_s:.1f}" if span_s else UNKNOWN)
        for key, count in snapshot.sent
    ]
    return Columns([f"{name:<{RATE_NAME}}{rate:>6}" for name, rate in rates], padding=(0, 3))


def _message_name(message_id: int) -> str:
    kind = mavlink.mavlink_map.get(message_id)
    return str(message_id) if kind is None else str(kind.msgname)


def _clients(snapshot: Snapshot) -> Table:
    table = _table("client", "state", "sent", "dropped", "received", "heard s ago")
    for client in snapshot.clients:
        table.add_row(*_client_cells(client), _heard(snapshot.time_us, client))
    return table


def _ports(snapshot: Snapshot) -> list[Text]:
    names = [port.name for port in snapshot.listeners if port.state == "open"]
    return [Text(f"open to others: {', '.join(names)}", style="dim")] if names else []


def _troubles(snapshot: Snapshot) -> list[Text]:
    found: list[ListenerStats | ClientStats] = [*snapshot.listeners, *snapshot.clients]
    return [Text(f"{one.name}: {one.reason}", style="red") for one in found if one.reason]


def _client_cells(client: ClientStats) -> tuple[str, ...]:
    figures = (client.sent, client.dropped, client.received)
    name = client.name if client.remote in client.name else f"{client.name} {client.remote}"
    return (name, client.state, *(str(figure) for figure in figures))


def _heard(now_us: int, client: ClientStats) -> str:
    if client.heard_us is None:
        return "never"
    return f"{max(0, now_us - client.heard_us) / US_PER_S:.1f}"
