"""`mavgate fleet`: many sites as one picture, and what is to be known of them."""

import asyncio
import logging
import signal
from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import typer

from gateway.cli.live.run import EndpointOption, with_endpoints
from gateway.cli.support.asking import AskingTyper, ask
from gateway.cli.support.errors import refuse
from gateway.cli.support.settings_options import ConfigOption, read_settings
from gateway.cli.support.terminal import JsonOption, console_of, table_of

log = logging.getLogger(__name__)

group = AskingTyper(
    help="Show the vehicles of many sites here, through a Zenoh router.",
    invoke_without_command=True,
)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.add_typer(group, name="fleet")


@group.callback()
def fleet(
    context: typer.Context,
    *,
    listen: Annotated[
        str | None,
        typer.Option("--listen", help="Be the router, at a place such as tcp/0.0.0.0:7447."),
    ] = None,
    connect: Annotated[
        str | None, typer.Option("--connect", help="Router to connect to: tcp/HOST:7447.")
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
    asyncio.run(_serve(wanted, settings.hub))


@group.command()
def status(*, json: JsonOption = False) -> None:
    """Show sites and vehicles: ids, rates, age, loss."""
    found = ask("fleet.status", of="fleet")
    if json:
        print(msgspec.json.encode(found).decode())
        return
    console = console_of()
    role = "router at" if found["is_router"] else "connected to"
    lost = "" if found["is_linked"] else ", which is not there"
    console.print(f"{role} {found['router']}{lost}", markup=False)
    table = table_of("site", "", "system", "id here", "Hz", "age s", "lost")
    for each in found["sites"]:
        _add_site(table, each)
    console.print(table)
    if found["unmapped"]:
        console.print(f"no id left for: {', '.join(found['unmapped'])}", markup=False)


@group.command("id")
def set_id(
    vehicle: Annotated[str, typer.Argument(help="SITE/SYSTEM, as in field-1/1.")],
    own_id: Annotated[int, typer.Argument(help="System id that it shall have here.")],
) -> None:
    """Give a vehicle of a site a system id by hand; it is kept."""
    name, _, system = vehicle.rpartition("/")
    if not name or not system.isdecimal():
        refuse(f"{vehicle!r} is not SITE/SYSTEM, as in field-1/1")
    params = {"site": name, "system_id": int(system), "own_id": own_id}
    for line in ask("fleet.id", params, of="fleet"):
        print(line)


def _add_site(table: Any, site: Mapping[str, Any]) -> None:
    state = "here" if site["is_here"] else "gone"
    if site["sessions"] > 1:
        state = f"{site['sessions']} of this name"
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
        table.add_row(site["name"], state, *cells)


async def _serve(settings: Any, hub_settings: Any) -> None:
    from gateway.edges.hub.fleet_link.zenoh_session import HOW_TO_ADD
    from gateway.edges.operator.control_socket import ControlError
    from gateway.fleet.fleet_server import FleetServer

    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    try:
        server = FleetServer(settings, hub_settings)
        await server.start()
    except ModuleNotFoundError:
        refuse(HOW_TO_ADD)
    except (ValueError, ControlError) as error:
        refuse(str(error))
    try:
        await stopped.wait()
    finally:
        await server.close()
