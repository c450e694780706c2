"""`mavgate panel`: the page in a browser."""

import logging
import os
import sys
from pathlib import Path
from types import TracebackType
from typing import Annotated, Final

import typer
from msgspec.structs import replace

from gateway.cli.support.asking import SocketOption
from gateway.cli.support.panel_process import LINK, OneLineFormatter
from gateway.cli.support.settings_options import (
    ConfigOption,
    folder_of,
    read_settings,
)
from gateway.cli.support.terminal import how_to_add, refuse
from gateway.hub.endpoint import parse_endpoint

log = logging.getLogger(__name__)

NICENESS: Final = 5
"""The gateway has priority over the panel, from the panel's imports on."""


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command("panel")(panel)


def panel(
    *,
    connect: Annotated[
        str | None,
        typer.Option(
            "--connect",
            help="A vehicle's MAVLink, such as tcp:HOST:5760 or udp-listen:0.0.0.0:14550.",
        ),
    ] = None,
    port: Annotated[int | None, typer.Option("--port", "-p", min=0, max=65535)] = None,
    config: ConfigOption = None,
    hash_password: Annotated[
        bool, typer.Option("--hash-password", help="Ask for a password and print its hash.")
    ] = False,
    socket: SocketOption = None,
    attached: Annotated[bool, typer.Option("--attached", hidden=True)] = False,
) -> None:
    """Show the aircraft in a browser: instruments, map, link, recordings, calibration, tuning.

    Without --connect it shows the gateway that runs on this machine, and reconnects whenever that
    is restarted.
    """
    if not (attached or hash_password):
        log.info("the panel is loading; its address follows")
    os.nice(NICENESS)
    try:
        from gateway.panel.panel_server import PanelError, run_panel
    except ModuleNotFoundError as error:
        refuse(f"the panel is an extra, and {error.name} is missing: {how_to_add('panel')}")
    if hash_password:
        from gateway.panel.access import hash_password as hashed

        print(f'password = "{hashed(typer.prompt("Password", hide_input=True))}"')
        return
    if attached:
        # Its important lines come into the gateway's own log, which stamps them; so does the
        # traceback of what ends it.
        sys.excepthook = _log_uncaught
        logging.getLogger().setLevel(logging.WARNING)
        for handler in logging.getLogger().handlers:
            handler.setFormatter(OneLineFormatter("%(message)s"))
        # The gateway sends the path once its socket listens, later than this process starts.
        line = sys.stdin.buffer.readline()
        if not line:
            return
        socket = Path(os.fsdecode(line.removesuffix(b"\n")))
    settings = read_settings(config)
    wanted = settings.panel if port is None else replace(settings.panel, port=port)
    folder = folder_of(settings)
    try:
        if connect is not None:
            parse_endpoint(connect)
        run_panel(wanted, folder, connect, socket, _show_link, attached=attached)
    except (PanelError, ValueError) as error:
        refuse(str(error))


def _log_uncaught(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    log.critical("the panel failed", exc_info=(kind, error, trace))


def _show_link(link: str) -> None:
    print(f"{LINK}{link}", flush=True)
