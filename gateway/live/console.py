"""The live view in the terminal: link, aircraft and clients at a glance.

Tables that are wider than the terminal are split into several below each other, so that everything
is legible at 40 columns; from `SIDE_BY_SIDE` columns on, clients and rates are next to the
aircraft. With too few rows the end is cut off; so the message rates come last.
"""

import logging
import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import Final

from msgspec.structs import asdict
from rich.cells import cell_len
from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from gateway.geometry.quaternion import to_euler
from gateway.hub.stats import ClientStats, ListenerStats, name_with_remote
from gateway.printable import UNKNOWN, PrintableFormatter, figure, receiver_state, source_state
from gateway.records import (
    LinkReport,
    NavFlags,
    NavState,
    NodeId,
    NodeStatus,
    board_name,
    channel_name,
)
from gateway.status import AircraftStatus, RecorderStatus, Snapshot
from gateway.units import MV_PER_V, US_PER_S, counted
from gateway.vehicle_row import VEHICLE_HEADS, vehicle_cells
from gateway.wire.mavlink_messages import MESSAGE_NAMES

OUTAGE_US: Final = 2 * US_PER_S
LOG_LINES: Final = 5
RATE_SNAPSHOTS: Final = 11
"""Rates are averaged over this many views: a message of 1 Hz must not flicker between 0 and 2."""
RATE_NAME: Final = 22
"""Characters of the longest usual name, so that names and figures are aligned."""

SIDE_BY_SIDE: Final = 150
"""Columns of a terminal that is wide enough for two halves."""
GAP: Final = 2
KEYS: Final = "q quit   r record or stop   space pause the view"
FIX_NAMES: Final = ("none", "dead reckoning", "2D", "3D", "3D", "time only")
MB: Final = 1e6
GB: Final = 1e9

Cell = str | Text
FLAG_WORDS: Final = (
    (NavFlags.ATTITUDE_VALID, "attitude", "green"),
    (NavFlags.HEADING_VALID, "heading", "green"),
    (NavFlags.POSITION_VALID, "position", "green"),
    (NavFlags.AT_REST, "at rest", "cyan"),
    (NavFlags.DEAD_RECKONING, "dead reckoning", "yellow"),
    (NavFlags.GPS_REJECTED, "GPS rejected", "yellow"),
    (NavFlags.MAG_DISTURBED, "magnetic disturbance", "yellow"),
    (NavFlags.MAG_MISPLACED, "compass axes wrong", "red"),
    (NavFlags.SENSOR_FAULT, "sensor fault", "red"),
    (NavFlags.DEGRADED, "degraded", "red"),
)


class RecentLog(logging.Handler):
    """Keep the newest log lines, to show them in the view."""

    def __init__(self) -> None:
        super().__init__()
        self.setFormatter(PrintableFormatter("%(asctime)s %(message)s", "%H:%M:%S"))
        self.lines: deque[tuple[str, str]] = deque(maxlen=LOG_LINES)

    def emit(self, record: logging.LogRecord) -> None:
        """Keep one line and its style."""
        style = "yellow" if record.levelno >= logging.WARNING else ""
        self.lines.append((self.format(record), style))


class LiveView:
    """Draw snapshots; keeps the last ones to compute rates."""

    def __init__(self) -> None:
        self.log = RecentLog()
        self.link = ""
        """Address of the panel; empty without one."""
        self._snapshots: deque[Snapshot] = deque(maxlen=RATE_SNAPSHOTS)

    def draw(self, snapshot: Snapshot) -> RenderableType:
        """Lay out one snapshot for the size of the terminal; takes some milliseconds."""
        self._snapshots.append(snapshot)
        top: list[RenderableType] = [_link_line(snapshot), *_recorder_line(snapshot.recorder)]
        if self.link:
            top.append(Text.assemble("panel  ", (self.link, "bold cyan")))
        flying: list[RenderableType] = []
        boards = {s.node: s for one in snapshot.aircraft for s in one.boards}
        if snapshot.report.nodes:
            flying.append(_nodes(snapshot.report, boards))
        status = {one.vehicle_id: one for one in snapshot.aircraft}
        for vehicle_id, state in snapshot.states:
            flying += [Text(), _aircraft(vehicle_id, state, status.get(vehicle_id)), _flags(state)]
        if snapshot.vehicles:
            flying += [Text(), _Grid(VEHICLE_HEADS, map(vehicle_cells, snapshot.vehicles))]
        if not snapshot.states and not snapshot.vehicles:
            flying.append(Text("No aircraft yet.", style="dim"))
        others: list[RenderableType] = [_clients(snapshot)]
        others += [*_ports(snapshot), *_troubles(snapshot), Text()]
        others += [Text(line, style=style) for line, style in self.log.lines]
        if snapshot.sent:
            rates = _rates(snapshot, self._snapshots[0])
            others += [Text("MAVLink sent, Hz", style="bold italic"), rates]
        keys = Text(KEYS, style="dim")
        return Group(*top, keys, _Halves(Group(*flying), Group(*others)))


class _Halves:
    """Two parts side by side in a wide terminal, below each other otherwise."""

    def __init__(self, left: RenderableType, right: RenderableType) -> None:
        self._left, self._right = left, right

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        if options.max_width < SIDE_BY_SIDE:
            yield Group(self._left, Text(), self._right)
            return
        grid = Table.grid(expand=True, padding=(0, 2 * GAP, 0, 0))
        grid.add_column(ratio=1)
        grid.add_column(ratio=1)
        grid.add_row(self._left, self._right)
        yield grid


class _Grid:
    """A table that is split into several below each other if it is too wide.

    The first column has the table's name as its heading, and is repeated in each of them.
    """

    def __init__(self, heads: Iterable[str], rows: Iterable[Iterable[Cell]]) -> None:
        self._heads, self._rows = [*heads], [[*row] for row in rows]

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        widths = [
            max(cell_len(str(text)) for text in column)
            for column in zip(self._heads, *self._rows, strict=True)
        ]
        begin = 1
        while begin < len(widths):
            end, room = begin + 1, options.max_width - widths[0] - GAP - widths[begin]
            while end < len(widths) and room >= GAP + widths[end]:
                room -= GAP + widths[end]
                end += 1
            yield self._table([0, *range(begin, end)])
            begin = end

    def _table(self, columns: list[int]) -> Table:
        table = Table(box=None, pad_edge=False, padding=(0, GAP, 0, 0))
        for column in columns:
            table.add_column(self._heads[column], justify="right" if column else "left")
        for row in self._rows:
            table.add_row(*(row[column] for column in columns))
        return table


def _link_line(snapshot: Snapshot) -> Text:
    report = snapshot.report
    up = f"{snapshot.time_us // US_PER_S // 60}:{snapshot.time_us // US_PER_S % 60:02d}"
    line = Text(f"up {up}  ")
    state = receiver_state(report.port, report.connected, report.bytes_received, report.frames)
    if state:
        line.append(state, style="green" if report.connected else "red")
        line.append(f"  serial {counted(report.frames, 'frame')}, {report.frames_lost} lost")
    for kind, count in report.faults:
        line.append(f", {counted(count, f'{kind} fault')}", style="yellow")
    for source in report.sources:
        state = source_state(asdict(source), snapshot.time_us)
        line.append(f"\n{state}", style="green" if source.connected else "red")
    if report.receiver is not None:
        line.append(f"  radio {sum(node.lost for node in report.nodes)} lost")
        line.append(f", {channel_name(report.receiver.channel)}")
        line.append(f", noise {report.receiver.noise_percent} %")
        if problem := report.receiver.radio.problem:
            line.append(f", {problem}", style="red")
    return line


def _recorder_line(recorder: RecorderStatus | None) -> list[Text]:
    if recorder is None:
        return []
    free = f"{recorder.free_bytes / GB:.1f} GB free"
    if recorder.reason:
        return [Text(f"not recorded: {recorder.reason}", style="red")]
    if recorder.held_s and recorder.state == "idle":
        held = f"recorder waits for arming, {recorder.held_s:.0f} s in memory, {free}"
        return [Text(held, style="dim")]
    if recorder.state != "recording":
        return [Text(f"recorder {recorder.state}, {free}", style="dim")]
    size = f"{recorder.part_bytes / MB:.1f} MB, {free}"
    return [Text(f"recording {recorder.name}, part {recorder.part}: {size}", style="green")]


def _nodes(report: LinkReport, boards: Mapping[NodeId, NodeStatus]) -> _Grid:
    """Show radio, supply in V, bus errors, failed and repeated sends, overruns, firmware.

    A radio that measures its signal has two more columns.
    """
    rows: list[dict[str, Cell]] = []
    pipes = () if report.receiver is None else report.receiver.pipes
    has_signals = any(node.signal is not None for node in report.nodes)
    for node in report.nodes:
        total, board, signal = node.received + node.lost, boards.get(node.node), node.signal
        signals = {"dBm": _known(signal, "rssi_dbm"), "SNR": _known(signal, "snr_db")}
        row: dict[str, Cell] = {
            "board": board_name(node.node, board.sensors_present if board else 0),
            "Hz": f"{node.rate_hz:.0f}",
            "lost %": figure(100 * node.lost / total if total else None, ".2f"),
            "age s": _age(report.time_us, node.last_time_us),
            **(signals if has_signals else {}),
            "V": figure(board.supply_mv / MV_PER_V if board and board.supply_mv else None, ".2f"),
            "bus": _known(board, "bus_errors"),
            "TX failed": _known(board, "radio_failed"),
            "retries": _known(board, "radio_retries"),
            "overruns": _known(pipes[node.pipe] if node.pipe < len(pipes) else None, "overruns"),
            "restarts": str(node.restarts),
            "fw": ".".join(map(str, board.firmware_version)) if board else UNKNOWN,
        }
        rows.append(row)
    return _Grid(rows[0], (row.values() for row in rows))


def _known(of: object, name: str, form: str = ".0f") -> str:
    """Return an attribute; a dash if it is unknown, or what has it."""
    return figure(getattr(of, name, None), form)


def _age(now_us: int, then_us: int) -> Text:
    age_us = max(0, now_us - then_us)
    return Text(f"{age_us / US_PER_S:.1f}", style="red" if age_us > OUTAGE_US else "")


def _aircraft(vehicle_id: int, state: NavState, known: AircraftStatus | None) -> _Grid:
    roll, pitch, yaw = (math.degrees(angle) for angle in to_euler(state.q_nb))
    north, east, down = state.vel_n_mps
    fix, home, mark = (known.fix, known.home, known.mark) if known else (None,) * 3
    name = FIX_NAMES[fix.fix_type if fix.fix_ok else 0] if fix else UNKNOWN
    row: dict[str, Cell] = {
        "aircraft": str(vehicle_id),
        "roll°": figure(roll, "+.1f"),
        "pitch°": figure(pitch, "+.1f"),
        "yaw°": figure(yaw % 360.0, ".1f"),
        "latitude°": figure(state.lat_deg, ".6f"),
        "longitude°": figure(state.lon_deg, ".6f"),
        "AMSL m": figure(state.alt_amsl_m, ".1f"),
        "m/s": figure(math.hypot(north, east), ".1f"),
        "climb": figure(-down, "+.1f"),
        "fix": Text(name, style="red" if fix and not fix.fix_ok else ""),
        "satellites": _known(fix, "satellites"),
        "±h m": _known(fix, "h_acc_m", ".1f"),
        "±v m": _known(fix, "v_acc_m", ".1f"),
        "home m": _known(home, "distance_m"),
        "home at°": _known(home, "bearing_deg"),
        "mark m": _known(mark, "distance_m"),
        "mark at°": _known(mark, "bearing_deg"),
    }
    return _Grid(row, [row.values()])


def _flags(state: NavState) -> Text:
    words = [Text(word, style=style) for flag, word, style in FLAG_WORDS if flag in state.flags]
    return Text("  ").join(words)


def _rates(snapshot: Snapshot, previous: Snapshot) -> Columns:
    span_s = (snapshot.time_us - previous.time_us) / US_PER_S
    before = dict(previous.sent)
    texts = []
    for key, count in snapshot.sent:
        name = MESSAGE_NAMES.get(key, str(key))
        rate = figure((count - before.get(key, 0)) / span_s if span_s else None, ".1f")
        texts.append(f"{name:<{RATE_NAME}}{rate:>6}")
    return Columns(texts, padding=(0, 3))


def _clients(snapshot: Snapshot) -> _Grid:
    heads = ("client", "state", "sent", "dropped", "received", "received s ago")
    return _Grid(heads, (_client_cells(snapshot.time_us, client) for client in snapshot.clients))


def _ports(snapshot: Snapshot) -> list[Text]:
    names = [port.name for port in snapshot.listeners if port.state == "open"]
    return [Text(f"open to others: {', '.join(names)}", style="dim")] if names else []


def _troubles(snapshot: Snapshot) -> list[Text]:
    found: list[ListenerStats | ClientStats] = [*snapshot.listeners, *snapshot.clients]
    notes = [Text(f"{one.name}: {one.note}", style="red") for one in snapshot.clients if one.note]
    return [Text(f"{one.name}: {one.reason}", style="red") for one in found if one.reason] + notes


def _client_cells(now_us: int, client: ClientStats) -> tuple[str, ...]:
    age_s = None if client.heard_us is None else max(0, now_us - client.heard_us) / US_PER_S
    return (
        name_with_remote(client.name, client.remote),
        client.state,
        *map(str, (client.sent, client.dropped, client.received)),
        "never" if age_s is None else f"{age_s:.1f}",
    )
