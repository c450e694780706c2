"""Commands that help to set the gateway up: ports and settings."""

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from gateway.cli.support.terminal import console_of, refuse, table_of
from gateway.live.serial_port import (
    PortNotFoundError,
    SerialSettings,
    find_receiver,
    fitting_ports,
    list_serial_ports,
)


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command()(ports)
    app.command()(check_config)


def ports() -> None:
    """List the serial ports, and the one that `auto` selects.

    If several USB adapters fit, each is opened and asked for the receiver's frames.
    """
    found = list_serial_ports()
    table = table_of("device", "setting by USB id", "serial number", "description", left=4)
    for port in found:
        usb = f"usb:{port.usb_id}" if port.usb_id else ""
        table.add_row(port.device, usb, port.serial_number, port.description)
    console = console_of()
    if found:
        console.print(table)
    try:
        fitting = fitting_ports("auto", found)
        if len(fitting) > 1:
            console.print(f"asking {', '.join(fitting)} for the receiver's frames")
            fitting = [asyncio.run(find_receiver(SerialSettings()))]
        console.print(f'port = "auto" takes {fitting[0]}')
    except PortNotFoundError as error:
        console.print(f'port = "auto": {error}')


def check_config(
    file: Annotated[
        Path | None, typer.Argument(help="Settings file; without it, the defaults are printed.")
    ] = None,
) -> None:
    """Check the settings and those of the aircraft, or print all settings with their defaults.

    All errors are listed at once, each with the allowed values.
    """
    # Imported here: the settings import every stage, and `ports` must not wait for that.
    from gateway.config import (
        ConfigError,
        GatewaySettings,
        aircraft_folder,
        load,
        load_aircraft,
        render,
    )
    from gateway.hub.endpoint import LISTENING, parse_endpoint

    if file is None:
        print(render(GatewaySettings()), end="")
        return
    try:
        settings = load(file)
        aircraft = load_aircraft(settings)
    except ConfigError as error:
        refuse(str(error))
    for endpoint in map(parse_endpoint, settings.hub.endpoints):
        if endpoint.port == 0 and endpoint.kind in LISTENING:
            refuse(
                f"{file}: hub.endpoints: {endpoint.url!r} takes any free port, which no ground "
                "station can know; name one of 1 to 65535"
            )
    others = f", and of {len(aircraft)} aircraft in {aircraft_folder(settings)}" if aircraft else ""
    print(f"{file}: all settings are right{others}")
