"""`mavgate status` and `clients …`: the status and the clients of a running gateway."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import typer
from rich.console import Console
from rich.table import Table

from gateway.cli.support.options import SOCKET, argument, ask, option, settings_file
from gateway.cli.support.terminal import (
    NEGATIVE_NUMBERS,
    JsonOption,
    console_of,
    duration_text,
    print_json,
    refuse,
    table_of,
)
from gateway.live.other_gateways import Gateway, other_gateways
from gateway.printable import UNKNOWN, figure, printable, receiver_state, source_state
from gateway.records import NodeId, RadioState, board_name
from gateway.units import MV_PER_V, US_PER_S, counted
from gateway.vehicle_row import VEHICLE_HEADS, VehicleRow, vehicle_cells

US_PER_MS: Final = 1000

Record = Mapping[str, Any]
"""A dataclass, as decoded from the control socket."""

app = typer.Typer()
group = typer.Typer(
    help="List, add and remove clients and sources, and mark a location for them.",
    no_args_is_help=True,
)
app.add_typer(group, name="clients")
MOST_SYSTEMS: Final = 8
"""Systems shown per client; a client that floods may send as thousands."""


@app.command()
def status(
    *,
    requests: bool = option(
        "--requests", "Show the requests of clients that were refused or had no answer.", False
    ),
    json: JsonOption = False,
) -> None:
    """Show the status of the gateway: receiver, nodes, vehicles, clients.

    If several gateways, players or fleets run here, all are listed; `--socket` chooses one.
    """
    found = [] if json or SOCKET.get() else other_gateways()
    runs = [one for one in found if one.command == "run"]
    if len(found) > 1 or (found and not runs):
        console_of().print(_gateways(found))
        if len(runs) != 1:
            return
    snapshot = ask("status")
    if json:
        print_json(snapshot["requests"] if requests else snapshot)
        return
    console = console_of()
    if requests:
        found = snapshot["requests"]
        console.print(_requests(found, snapshot["time_us"]) if found else "no failed requests")
        return
    console.print(_summary(snapshot))
    if nodes := snapshot["report"]["nodes"]:
        console.print("", _nodes(nodes, snapshot), sep="\n")
    if snapshot["vehicles"]:
        console.print("", _vehicles(snapshot["vehicles"]), sep="\n")
    _print_clients(console, snapshot)


@group.command("list")
def list_clients(*, json: JsonOption = False) -> None:
    """List the clients, with the frames sent to them and dropped by the gateway."""
    print_json(ask("clients.list")) if json else _print_clients(console_of(), ask("status"))


@group.command()
def add(
    url: str = argument("As in the settings: udp:192.168.1.7:14550?name=…", ...),
    *,
    save: bool = option("--save", "Save it in the settings file too, for the next start.", False),
) -> None:
    """Add a client or a source, until the gateway ends or permanently."""
    ask("clients.add", url=url)
    if save:
        _save(settings_file(), url)
    snapshot = ask("status")
    every = (*snapshot["listeners"], *snapshot["clients"])
    added = next((one for one in every if one["endpoint"] == url), {"name": url, "reason": ""})
    waits = f": {added['reason']}; trying again until it works" if added["reason"] else ""
    console_of().print(f"added {added['name']}{waits}")


def _save(file: Path, url: str) -> None:
    # Imported here: the settings import all stages.
    from gateway.config import ConfigError, save_endpoint

    try:
        save_endpoint(file, url)
    except (ConfigError, OSError) as error:
        refuse(f"added, but not saved: {error}")
    print(f"saved in {file}")


@group.command()
def remove(name: str = argument("Name or URL of the client.", ...)) -> None:
    """Remove a client, a source or a listening port."""
    ask("clients.remove", name=name)
    print(f"removed {name}")


@group.command(context_settings=NEGATIVE_NUMBERS)
def mark(
    lat_deg: float | None = argument("Latitude; south is negative."),
    lon_deg: float | None = argument("Longitude; west is negative."),
    alt_amsl_m: float | None = argument("Height AMSL in m."),
    *,
    vehicle: int | None = option("--vehicle", "For this vehicle only; by default all."),
) -> None:
    """Mark a location: clients show distance and bearing to it. Without one, clear the mark."""
    for name, value in (("LAT_DEG", lat_deg), ("LON_DEG", lon_deg), ("ALT_AMSL_M", alt_amsl_m)):
        if value is not None and not math.isfinite(value):
            refuse(
                f"{name} {value}: write a number; without LAT_DEG and LON_DEG the mark is cleared"
            )
    location: dict[str, Any] = {"lat_deg": lat_deg, "lon_deg": lon_deg, "alt_amsl_m": alt_amsl_m}
    print(ask("mark", vehicle_id=vehicle, **location))


@group.command()
def reload() -> None:
    """Apply changed settings of the hub and of signing; the other clients stay connected."""
    print(ask("reload"))


def _gateways(found: Sequence[Gateway]) -> Table:
    rows = (
        (
            *(one.command, UNKNOWN if one.pid is None else str(one.pid), one.since),
            *(", ".join(map(str, one.systems)) or UNKNOWN, "\n".join(one.endpoints) or UNKNOWN),
            one.socket,
        )
        for one in found
    )
    columns = ("running", "pid", "since", "vehicles", "endpoints", "socket")
    return table_of(*columns, left=6, rows=rows)


def _summary(snapshot: Record) -> str:
    report = snapshot["report"]
    keys = ("port", "connected", "bytes_received", "frames")
    receiver = receiver_state(*(report[key] for key in keys))
    up = f"up {duration_text(snapshot['time_us'] // US_PER_S)}"
    lines = [", ".join(filter(None, [up, receiver]))]
    if receiver:
        payloads, lost = (
            sum(node[key] for node in report["nodes"]) for key in ("received", "lost")
        )
        serial = f"serial: {counted(report['frames'], 'frame')}, {report['frames_lost']} lost"
        lines.append(f"{serial}; radio: {counted(payloads, 'payload')}, {lost} lost")
    for source in report["sources"]:
        newest = f" (last: {printable(source['newest_fault'])})" if source["newest_fault"] else ""
        lines.append(source_state(source, snapshot["time_us"]) + newest)
    if report["receiver"] and (problem := RadioState(report["receiver"]["radio"]).problem):
        lines.append(f"receiver: {problem}")
    lines += [
        f"aircraft {_name_of(board, board)} board: {', '.join(board['chips'])}"
        for one in snapshot["aircraft"]
        for board in one["boards"]
        if board["chips"]
    ]
    if snapshot["slow_s"]:
        lines.append(
            f"this computer is too slow: up to {snapshot['slow_s']:.1f} s late, samples are lost"
        )
    lines += _aircraft_lines(snapshot)
    hub = snapshot["hub"]
    counts = [f"{hub[key]} {key}" for key in hub if hub[key] or key == "published"]
    lines.append("MAVLink frames: " + ", ".join(counts))
    if requests := [f"{snapshot[key]} {key}" for key in ("refused", "forged") if snapshot[key]]:
        lines.append("requests: " + ", ".join(requests) + "; see mavgate status --requests")
    return "\n".join(lines)


def _aircraft_lines(snapshot: Record) -> list[str]:
    """Describe where each aircraft is, and with sources the origin of its attitude and position."""
    lines = [
        f"aircraft {vehicle_id}: {figure(state['lat_deg'], '.6f')} "
        f"{figure(state['lon_deg'], '.6f')}, {figure(state['alt_amsl_m'], '.1f')} m"
        for vehicle_id, state in snapshot["states"]
    ]
    lines += [
        f"aircraft {one['vehicle_id']}: "
        + "; ".join(f"{what}: {origin}" for what, origin in one["origins"].items())
        for one in snapshot["aircraft"]
        if snapshot["report"]["sources"]
    ]
    lines += [
        f"aircraft {one['vehicle_id']}: {what} {way['distance_m']:.0f} m, {way['bearing_deg']:.0f}°"
        for one in snapshot["aircraft"]
        for what in ("home", "mark")
        if (way := one[what]) is not None and way["distance_m"] is not None
    ]
    return lines


def _requests(found: Sequence[Record], now_us: int) -> Table:
    rows = (
        (
            *(str(entry["vehicle_id"]), f"{entry['system_id']}.{entry['component_id']}"),
            *(entry["request"], entry["outcome"], str(entry["count"])),
            f"{(now_us - entry['time_us']) / US_PER_S:.1f}",
        )
        for entry in reversed(found)
    )
    columns = ("aircraft", "sender", "request", "outcome", "count", "age s")
    return table_of(*columns, left=4, rows=rows)


def _vehicles(rows: Sequence[Record]) -> Table:
    return table_of(*VEHICLE_HEADS, left=8, rows=(vehicle_cells(VehicleRow(**row)) for row in rows))


def _nodes(nodes: Sequence[Record], snapshot: Record) -> Table:
    heads = ("supply V", "bus errors", "TX failed", "retries", "overruns", "firmware")
    table = table_of("board", "rate Hz", "received", "lost", "restarts", *heads)
    boards = {_name_of(b): b for one in snapshot["aircraft"] for b in one["boards"]}
    receiver = snapshot["report"]["receiver"]
    for node in nodes:
        overruns = UNKNOWN if receiver is None else receiver["pipes"][node["pipe"]]["overruns"]
        board = boards.get(_name_of(node))
        table.add_row(
            _name_of(node, board),
            figure(node["rate_hz"], ".0f"),
            *(str(node[key]) for key in ("received", "lost", "restarts")),
            *_board(board, str(overruns)),
        )
    return table


def _name_of(record: Record, board: Record | None = None) -> str:
    return board_name(NodeId(**record["node"]), board["sensors_present"] if board else 0)


def _board(board: Record | None, overruns: str) -> tuple[str, ...]:
    if board is None:
        return (*(UNKNOWN,) * 4, overruns, UNKNOWN)
    counts = (str(board[key]) for key in ("bus_errors", "radio_failed", "radio_retries"))
    supply = figure(board["supply_mv"] / MV_PER_V if board["supply_mv"] else None, ".2f")
    return (supply, *counts, overruns, ".".join(map(str, board["firmware_version"])))


def _print_clients(console: Console, snapshot: Record) -> None:
    if listeners := snapshot["listeners"]:
        counts = ("clients", "turned_away")
        rows = (
            (port["name"], port["reason"] or port["state"], *(str(port[key]) for key in counts))
            for port in listeners
        )
        table = table_of("listening", "state", "clients", "rejected", rows=rows)
        console.print("", table, sep="\n")
    console.print("", _clients(snapshot["clients"], snapshot["time_us"]), sep="\n")
    for client in snapshot["clients"]:
        for text in filter(None, (client["reason"], client["note"], client["hint"])):
            console.print(f"{client['name']}: {text}", style="yellow", soft_wrap=True)
        for text in client["cached"]:
            console.print(f"{client['name']}: cached answers of {text}", soft_wrap=True)


def _clients(clients: Sequence[Record], now_us: int) -> Table:
    table = table_of("client", "state", "sent", "dropped", "queued", "received", "age s", "RTT ms")
    for client in clients:
        heard_us, trip_us = client["heard_us"], client["round_trip_us"]
        table.add_row(
            " ".join([client["name"], *_first_systems(client["systems"])]),
            client["state"],
            *(str(client[key]) for key in ("sent", "dropped", "queued", "received")),
            figure(None if heard_us is None else (now_us - heard_us) / US_PER_S, ".1f"),
            figure(None if trip_us is None else trip_us / US_PER_MS, ".1f"),
        )
    return table


def _first_systems(systems: Sequence[tuple[int, int]]) -> list[str]:
    named = [f"{system}.{component}" for system, component in systems[:MOST_SYSTEMS]]
    more = len(systems) - len(named)
    return [*named, f"and {more} more"] if more else named
