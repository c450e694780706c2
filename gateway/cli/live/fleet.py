"""`mavgate fleet`: the vehicles of many sites, their state, and their recordings."""

import asyncio
import logging
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

import msgspec
import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

from gateway.cli.live.run import with_endpoints
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import argument, ask, option, read_settings, socket_of
from gateway.cli.support.terminal import JsonOption, console_of, print_json, refuse, table_of
from gateway.extras import require
from gateway.fleet.recording_fetch import FetchError, RecordingFetch
from gateway.hub.endpoint import SITE_NAME
from gateway.live.control_socket import ControlError, request
from gateway.live.service import run_event_loop
from gateway.live.terminal import detached_output, on_end_signals
from gateway.printable import UNKNOWN
from gateway.recordings.index import NEWEST
from gateway.recordings.moment import civil_time
from gateway.units import US_PER_S, counted

log = logging.getLogger(__name__)

DISK_S: Final = 60.0
"""Timeout for writing a file: a worn memory card takes seconds per step."""

app = typer.Typer()
group = typer.Typer(
    help="Show the vehicles of many sites here, through a Zenoh router.",
    invoke_without_command=True,
)
app.add_typer(group, name="fleet")

recordings_group = typer.Typer(
    help="List the recordings of the sites, and fetch them.", invoke_without_command=True
)
group.add_typer(recordings_group, name="recordings")


@group.callback()
def fleet(
    context: typer.Context,
    *,
    listen: str | None = option("--listen", "Run the router here, e.g. tls/0.0.0.0:7447."),
    connect: str | None = option("--connect", "Router to connect to: tls/HOST:7447."),
    site: list[str] | None = option("--site", "Sites to show, such as 'field-*'."),
    endpoint: list[str] | None = opt.ENDPOINT,
) -> None:
    """Show the vehicles of many sites here, through a Zenoh router."""
    if context.invoked_subcommand is not None:
        return
    require("the fleet", "fleet")
    settings = with_endpoints(read_settings(), endpoint)
    changes = {
        **({} if listen is None else {"listen": listen, "router": ""}),
        **({} if connect is None else {"router": connect}),
        **({"sites": tuple(site)} if site else {}),
    }
    wanted = msgspec.structs.replace(settings.fleet, **changes)
    run_event_loop(_serve(wanted, settings.hub), settings.hub.event_loop)


@group.command()
def status(*, json: JsonOption = False) -> None:
    """Show sites and vehicles: ids, rates, age, loss, round trip."""
    found = ask("fleet.status", of="fleet")
    if json:
        print_json(found)
        return
    console = console_of()
    role = "router at" if found["is_router"] else "connected to"
    lost = "" if found["is_linked"] else ", which does not respond"
    console.print(f"{role} {found['router']}{lost}")
    columns = ("site", "", "RTT ms", "system", "id here", "Hz", "age s", "lost")
    console.print(table_of(*columns, left=2, rows=chain.from_iterable(map(_rows, found["sites"]))))
    if names := ", ".join(found["unmapped"]):
        console.print(f"no id left for: {names}; give one by `mavgate fleet id`")
    if names := ", ".join(found["without_session"]):
        console.print(f"without a session of their own, sharing the ids of one site: {names}")
    if found["left_out"]:
        console.print(f"excluded: {', '.join(found['left_out'])}")
    if found["overflowed"]:
        console.print(f"{counted(found['overflowed'], 'message')} dropped: they arrived too fast")
    for site in found["sites"]:
        # Frames rejected because of their signature.
        if counts := [f"{site[k]} {k}" for k in ("unsigned", "forged", "replayed") if site[k]]:
            console.print(f"frames of {site['name']} dropped: {', '.join(counts)}")
    ways = [*found["sites"], {"name": "clients here", "looped": found["looped"]}]
    if loops := [f"{way['looped']} through {way['name']}" for way in ways if way["looped"]]:
        console.print(f"looped frames dropped: {', '.join(loops)}")


@group.command("id")
def set_id(
    vehicle: str = argument("SITE/SYSTEM, as in field-1/1.", ...),
    own_id: int = argument("Its system id here; 0 excludes it.", ...),
) -> None:
    """Assign a system id to a vehicle of a site, or exclude it; the choice is saved."""
    name, _, system = vehicle.rpartition("/")
    if not name or not system.isdecimal():
        refuse(f"{vehicle!r} is not SITE/SYSTEM, as in field-1/1")
    params = {"site": name, "system_id": int(system), "own_id": own_id}
    for line in ask("fleet.id", of="fleet", wait_s=DISK_S, **params):
        console_of().print(line)


def _rows(site: Mapping[str, Any]) -> list[tuple[str, ...]]:
    state = "here" if site["is_here"] else "gone"
    if site["sessions"] > 1:
        state = f"{site['sessions']} of this name"
    trip_s = site["round_trip_s"]
    head = (site["name"], state, "" if trip_s is None else f"{trip_s * 1000:.1f}")
    return [
        (
            *(*head, str(vehicle["system_id"]), str(vehicle["id"] or "none")),
            *(f"{vehicle['rate_hz']:.1f}", f"{vehicle['age_s']:.1f}", str(vehicle["lost"])),
        )
        for vehicle in site["vehicles"]
    ] or [head]


async def _serve(settings: Any, hub_settings: Any) -> None:
    from gateway.fleet.server import FleetServer

    stopped = asyncio.Event()
    on_end_signals(stopped.set)
    try:
        server = FleetServer(settings, hub_settings)
        await server.start()
    except (ValueError, ControlError) as error:
        refuse(str(error))
    stations = ", ".join(hub_settings.endpoints)
    log.info("sites at %s, ground stations at %s", server.locator, stations)
    with detached_output():
        try:
            await stopped.wait()
        finally:
            server.close()


@recordings_group.callback()
def recordings(
    context: typer.Context,
    *,
    site: str = option("--site", "Only these sites, such as 'field-*'.", ""),
    json: JsonOption = False,
) -> None:
    """List the recordings of the sites, the newest last."""
    if context.invoked_subcommand is not None:
        return
    found = ask("fleet.recordings", of="fleet", site=site)
    if json:
        print_json(found)
        return
    rows = (
        (name, each["name"], str(len(each["files"])), f"{_size_of(each) / 1e6:.2f}", _when(each))
        for name, listed in found.items()
        for each in listed
    )
    columns = ("site", "recording", "files", "MB", "last written (UTC)")
    console_of().print(table_of(*columns, left=2, rows=rows))


def _when(recording: Mapping[str, Any]) -> str:
    when = civil_time(recording["modified_s"] * US_PER_S)
    return UNKNOWN if when is None else f"{when:%Y-%m-%d %H:%M:%S}"


@recordings_group.command()
def get(
    site: str = argument("The site.", ...),
    name: str = argument("Name of a recording, or last.", ...),
    *,
    output: Path | None = option("--output -o", "Folder; by default one named after the site."),
    force: bool = option("--force", "Replace files that differ.", False),
) -> None:
    """Fetch a recording of a site; an interrupted fetch is continued."""
    if not SITE_NAME.fullmatch(site):
        refuse(f"site {site!r}: letters, digits, . _ and - only")
    listed = ask("fleet.recordings", of="fleet", site=site).get(site)
    if listed is None:
        refuse(f"site {site} does not serve recordings; see `mavgate fleet status`")
    recording = next((each for each in listed if each["name"] == name), None)
    if recording is None and name == NEWEST and listed:
        recording = listed[-1]
    if recording is None:
        refuse(f"site {site} has no recording {name!r}; `mavgate fleet recordings` lists them")
    socket, folder = socket_of("fleet"), output or Path(site)

    def send(verb: str, params: dict[str, Any], wait_s: float) -> Any:
        return request(socket, verb, params, timeout_s=wait_s)

    try:
        _fetch_all(RecordingFetch(site, folder, send, force=force), recording, folder)
    except (FetchError, ControlError, OSError) as error:
        refuse(str(error))


def _fetch_all(fetch: RecordingFetch, recording: dict[str, Any], folder: Path) -> None:
    console = console_of(stderr=True)
    lines, columns = list[str](), (BarColumn(), DownloadColumn(), TransferSpeedColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(recording["name"], total=_size_of(recording))
        for file in recording["files"]:
            size = file["size"]
            is_new = fetch.fetch(file["name"], size, lambda count: progress.advance(task, count))
            lines.append(f"{folder / file['name']} {'fetched' if is_new else 'already complete'}")
    console_of().print(*lines, sep="\n")


def _size_of(recording: dict[str, Any]) -> int:
    return sum(file["size"] for file in recording["files"])
