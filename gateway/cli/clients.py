"""`mavgate status` and `mavgate clients …`: a gateway that runs, seen and changed from outside."""

from typing import Annotated

import msgspec
import typer
from rich import box
from rich.console import Console
from rich.table import Table

from gateway.cli.record import JsonOption, ask
from gateway.routing.clients import ClientStats

group = typer.Typer(help="List, add and remove clients.", no_args_is_help=True)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(status)
    app.add_typer(group, name="clients")


def status(*, json: JsonOption = False) -> None:
    """Tell what the gateway does: link, aircraft, clients."""
    found = ask("status")
    if json:
        print(msgspec.json.encode(found["snapshot"]).decode())
        return
    Console(highlight=False).print(found["summary"], markup=False)


@group.command("list")
def list_all(*, json: JsonOption = False) -> None:
    """List the clients with what they were sent."""
    found = ask("clients.list")
    if json:
        print(msgspec.json.encode(found).decode())
        return
    grid = Table(box=box.SIMPLE_HEAD)
    for column in ("client", "name", "place", "sent", "dropped", "received"):
        grid.add_column(column)
    for client in msgspec.convert(found, tuple[ClientStats, ...]):
        grid.add_row(
            *(str(client.client_id), client.name, client.remote),
            *(str(client.sent), str(client.dropped), str(client.received)),
        )
    Console(highlight=False).print(grid)


@group.command()
def add(url: Annotated[str, typer.Argument(help="Endpoint, as in the settings.")]) -> None:
    """Add an endpoint until the gateway ends."""
    _show(ask("clients.add", {"url": url}))


@group.command()
def remove(name: Annotated[str, typer.Argument(help="Its name or URL.")]) -> None:
    """Remove an endpoint and its clients."""
    _show(ask("clients.remove", {"name": name}))


def _show(endpoints: list[str]) -> None:
    for endpoint in endpoints:
        Console(highlight=False).print(endpoint, markup=False)
