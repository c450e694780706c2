"""`mavgate fleet`: the vehicles of many sites, their state, and their recordings."""

import asyncio
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

from gateway.cli.live.run import EndpointOption, with_endpoints
from gateway.cli.support.asking import AskingTyper, ask, socket_of, with_socket
from gateway.cli.support.fetching import FetchError, RecordingFetch
from gateway.cli.support.settings_options import ConfigOption, read_settings
from gateway.cli.support.terminal import (
    UNKNOWN,
    JsonOption,
    console_of,
    how_to_add,
    print_json,
    refuse,
    table_of,
)
from gateway.hub.endpoint import SITE_NAME
from gateway.live.control_socket import ControlError, request
from gateway.live.service import run_event_loop
from gateway.live.terminal import detached_output, on_end_signals
from gateway.recordings.index import NEWEST
from gateway.recordings.moment import civil_time
from gateway.units import US_PER_S, counted

log = logging.getLogger(__name__)

DISK_S: Final = 60.0
"""Longest wait for a file to be written: a worn card takes seconds for each step."""

group = AskingTyper(
    help="Show the vehicles of many sites here, through a Zenoh router.",
    invoke_without_command=True,
)

recordings_group = AskingTyper(
    help="List the recordings of the sites, and fetch them.", invoke_without_command=True
)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    group.add_typer(recordings_group, name="recordings")
    app.add_typer(group, name="fleet")


@group.callback()
def fleet(
    context: typer.Context,
    *,
    listen: Annotated[
        str | None,
        typer.Option("--listen", help="Be the router, as in tls/0.0.0.0:7447."),
    ] = None,
    connect: Annotated[
        str | None, typer.Option("--connect", help="Router to connect to: tls/HOST:7447.")
    ] = None,
    site: Annotated[
        list[str] | None, typer.Option("--site", help="Sites to show, such as 'field-*'.")
    ] = None,
    endpoint: EndpointOption = None,
    config: ConfigOption = None,
) -> None:
    """Show the vehicles of many sites here, through a Zenoh router."""
    if context.invoked_subcommand is not None:
        return
    settings = with_endpoints(read_settings(config), endpoint)
    wanted = settings.fleet
    if listen is not None:
        wanted = msgspec.structs.replace(wanted, listen=listen, router="")
    if connect is not None:
        wanted = msgspec.structs.replace(wanted, router=connect)
    if site:
        wanted = msgspec.structs.replace(wanted, sites=tuple(site))
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
    lost = "" if found["is_linked"] else ", which does not answer"
    console.print(f"{role} {found['router']}{lost}")
    table = table_of("site", "", "ms", "system", "id here", "Hz", "age s", "lost", left=2)
    for each in found["sites"]:
        _add_site(table, each)
    console.print(table)
    if found["unmapped"]:
        text = f"no id left for: {', '.join(found['unmapped'])}; give one by `mavgate fleet id`"
        console.print(text)
    if found["left_out"]:
        console.print(f"excluded: {', '.join(found['left_out'])}")
    if found["overflowed"]:
        console.print(f"{counted(found['overflowed'], 'message')} dropped: they arrived too fast")
    for text in _rejections(found["sites"]):
        console.print(text)
    loops = [
        f"{site['looped']} through {site['name']}" for site in found["sites"] if site["looped"]
    ]
    if found["looped"]:
        loops.append(f"{found['looped']} through clients here")
    if loops:
        console.print(f"looped frames dropped: {', '.join(loops)}")


def _rejections(sites: list[dict[str, Any]]) -> list[str]:
    """Describe the frames of each site that its passphrase has rejected."""
    found = []
    for site in sites:
        kinds = ("unsigned", "forged", "replayed")
        counts = [f"{site[kind]} {kind}" for kind in kinds if site[kind]]
        if counts:
            found.append(f"frames of {site['name']} dropped: {', '.join(counts)}")
    return found


@group.command("id")
def set_id(
    vehicle: Annotated[str, typer.Argument(help="SITE/SYSTEM, as in field-1/1.")],
    own_id: Annotated[int, typer.Argument(help="Its system id here; 0 excludes it.")],
) -> None:
    """Assign a system id to a vehicle of a site, or exclude it; the choice is saved."""
    name, _, system = vehicle.rpartition("/")
    if not name or not system.isdecimal():
        refuse(f"{vehicle!r} is not SITE/SYSTEM, as in field-1/1")
    params = {"site": name, "system_id": int(system), "own_id": own_id}
    for line in ask("fleet.id", params, of="fleet", wait_s=DISK_S):
        console_of().print(line)


def _add_site(table: Any, site: Mapping[str, Any]) -> None:
    state = "here" if site["is_here"] else "gone"
    if site["sessions"] > 1:
        state = f"{site['sessions']} of this name"
    trip_s = site["round_trip_s"]
    trip = "" if trip_s is None else f"{trip_s * 1000:.1f}"
    for vehicle in site["vehicles"] or [None]:
        cells = ["", "", "", "", ""]
        if vehicle is not None:
            cells = [
                str(vehicle["system_id"]),
                str(vehicle["id"] or "none"),
                f"{vehicle['rate_hz']:.1f}",
                f"{vehicle['age_s']:.1f}",
                str(vehicle["lost"]),
            ]
        table.add_row(site["name"], state, trip, *cells)


async def _serve(settings: Any, hub_settings: Any) -> None:
    from gateway.fleet.server import FleetServer
    from gateway.live.control_socket import ControlError

    stopped = asyncio.Event()
    on_end_signals(stopped.set)
    try:
        server = FleetServer(settings, hub_settings)
        await server.start()
    except ModuleNotFoundError:
        refuse(f"the fleet is an extra: {how_to_add('fleet')}")
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
@with_socket
def recordings(
    context: typer.Context,
    *,
    site: Annotated[str, typer.Option("--site", help="Only these sites, such as 'field-*'.")] = "",
    json: JsonOption = False,
) -> None:
    """List the recordings of the sites, the newest last."""
    if context.invoked_subcommand is not None:
        return
    found = ask("fleet.recordings", {"site": site}, of="fleet")
    if json:
        print_json(found)
        return
    grid = table_of("site", "recording", "files", "MB", "last written (UTC)", left=2)
    for name, listed in found.items():
        for each in listed:
            when = civil_time(each["modified_s"] * US_PER_S)
            grid.add_row(
                name,
                each["name"],
                str(len(each["files"])),
                f"{_size_of(each) / 1e6:.2f}",
                UNKNOWN if when is None else f"{when:%Y-%m-%d %H:%M:%S}",
            )
    console_of().print(grid)


@recordings_group.command()
def get(
    site: Annotated[str, typer.Argument(help="The site.")],
    name: Annotated[str, typer.Argument(help="Name of a recording, or last.")],
    *,
    to: Annotated[
        Path | None, typer.Option("--to", help="Folder; by default one called as the site.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that differ.")] = False,
) -> None:
    """Fetch a recording of a site; an interrupted fetch is continued."""
    if not SITE_NAME.fullmatch(site):
        refuse(f"site {site!r}: letters, digits, . _ and - only")
    listed = ask("fleet.recordings", {"site": site}, of="fleet").get(site)
    if listed is None:
        refuse(f"site {site} does not answer for recordings; see `mavgate fleet status`")
    recording = _find(listed, name)
    if recording is None:
        refuse(f"site {site} has no recording {name!r}; `mavgate fleet recordings` lists them")
    socket = socket_of("fleet")
    fetch = RecordingFetch(
        site,
        to or Path(site),
        lambda verb, params, wait_s: request(socket, verb, params, timeout_s=wait_s),
        force=force,
    )
    try:
        _fetch_all(fetch, recording, to or Path(site))
    except (FetchError, ControlError, OSError) as error:
        refuse(str(error))


def _fetch_all(fetch: RecordingFetch, recording: dict[str, Any], folder: Path) -> None:
    console = console_of(stderr=True)
    columns = (BarColumn(), DownloadColumn(), TransferSpeedColumn())
    lines = []
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(recording["name"], total=_size_of(recording))
        for file in recording["files"]:
            is_new = fetch.fetch(
                file["name"], file["size"], lambda count: progress.advance(task, count)
            )
            state = "fetched" if is_new else "already complete"
            lines.append(f"{folder / file['name']} {state}")
    for line in lines:
        console_of().print(line)


def _find(listed: list[dict[str, Any]], name: str) -> dict[str, Any] | None:
    found = next((each for each in listed if each["name"] == name), None)
    if found is None and name == NEWEST and listed:
        return listed[-1]
    return found


def _size_of(recording: dict[str, Any]) -> int:
    return sum(file["size"] for file in recording["files"])
