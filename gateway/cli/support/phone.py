"""Set up a phone that posts its sensors to the panel: settings, then the URL as a QR code."""

import secrets
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

import typer
from msgspec.structs import replace

from gateway.cli.support.terminal import console_of, refuse
from gateway.config import ConfigError, GatewaySettings, save_values
from gateway.sources.settings import SourceSettings, parse_source

ANY_ADDRESS: Final = "0.0.0.0"
ELSEWHERE: Final = ("192.0.2.1", 9)
"""An address that no machine has; connecting a UDP socket to it sends nothing."""
KIND: Final = "phone:push"
Sources = tuple[SourceSettings, ...]
TOKEN_BYTES: Final = 24
NEXT: Final = (
    "In Sensor Logger (Android, iOS): settings, HTTP Push, paste this URL, shortest batch period.",
    "Record accelerometer, gravity, gyroscope, magnetometer, barometer and location.",
    "On an iPhone switch on Standardise Units & Frames.",
)


def own_address() -> str:
    """Return the address of this machine in its network; ends the command if it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(ELSEWHERE)
        except OSError:
            refuse("this machine is in no network: connect it to that of the phone")
        return str(probe.getsockname()[0])


def guide_phone(settings: GatewaySettings, file: Path, head: Callable[[str], None]) -> None:
    """Ask for what is missing, store it, and show the URL that the phone posts to."""
    import segno

    from gateway.panel.logins import hash_password

    head("1 of 3: network")
    address, panel = own_address(), settings.panel
    console = console_of()
    console.print(f"This machine is {address}; the phone must be in the same network.")
    head("2 of 3: access")
    if not panel.password:
        asked = "Password of the panel, which the network can reach then"
        chosen = typer.prompt(asked, hide_input=True, confirmation_prompt=True)
        panel = replace(panel, password=hash_password(chosen), enabled=True)
    if not (panel.certificate or panel.insecure):
        typer.confirm("Without a certificate the network can read all traffic. Go on?", abort=True)
        panel = replace(panel, insecure=True)
    if panel.address == settings.panel.address != ANY_ADDRESS:
        panel = replace(panel, address=ANY_ADDRESS)
    token, sources = _with_phone(settings.sources)
    _save(file, settings, replace(settings, panel=panel, sources=sources))
    head("3 of 3: phone")
    url = f"http{'s' if panel.certificate else ''}://{address}:{panel.port}/push/{token}"
    segno.make(url).terminal(sys.stdout, compact=True)
    console.print(url, *NEXT, "Then start `mavgate run`; restart one that runs.", sep="\n")


def _with_phone(sources: Sources) -> tuple[str, Sources]:
    """Keep the token of a phone in the settings, or add one; the app has stored its URL."""
    token = secrets.token_urlsafe(TOKEN_BYTES)
    for each in sources:
        if each.url.startswith(KIND):
            if known := parse_source(each.url).options.get("token"):
                return known, sources
            mark = "&" if "?" in each.url else "?"
            own = SourceSettings(url=f"{each.url}{mark}token={token}")
            return token, tuple(own if one is each else one for one in sources)
    return token, (*sources, SourceSettings(url=f"{KIND}?token={token}"))


def _save(file: Path, before: GatewaySettings, after: GatewaySettings) -> None:
    if before == after:
        return
    old, new = (
        {name: getattr(one.panel, name) for name in ("enabled", "address", "password", "insecure")}
        for one in (before, after)
    )
    panel = dict(new.items() - old.items())
    sources = [{"url": each.url} for each in after.sources]
    try:
        save_values(file, {"panel": panel, "sources": sources})
    except (ConfigError, OSError) as error:
        refuse(f"not saved: {error}")
    console_of().print(f"saved in {file}")
