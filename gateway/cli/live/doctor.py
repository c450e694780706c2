"""`mavgate doctor`: check the installation, settings, ports and disk; print a settings file."""

import grp
import os
import pwd
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Final, Literal, NamedTuple

import typer

from gateway import config
from gateway.cli.support.options import (
    CONFIG,
    argument,
    folder_of,
    option,
    read_settings,
    settings_file,
)
from gateway.cli.support.terminal import console_of, refuse
from gateway.compiled.entry_point import LibraryError, load_entry_points
from gateway.extras import how_to_add, missing
from gateway.hub.endpoint import LISTENING, Endpoint, EndpointKind, parse_endpoint
from gateway.hub.transports.tls import valid_until_s
from gateway.live.control_socket import live_sockets
from gateway.live.part_files import free_bytes_near
from gateway.live.serial_port import AUTO, PortNotFoundError, fitting_ports, list_serial_ports
from gateway.output import PRIVATE, write_new
from gateway.printable import NO_RECEIVER, reason_of

app = typer.Typer()

TTY: Final = Path("/sys/class/tty")
SLOW_LATENCY_MS: Final = 4
"""Greatest acceptable latency timer of an FTDI adapter, which delays bytes; its default is 16."""
EXTRA_USES: Final = {
    "plot": "`mavgate report` with figures",
    "panel": "`mavgate panel`, and `report` as one HTML file",
    "fleet": "`mavgate fleet`",
    "formats": "reading and writing of ULog, MCAP and Parquet",
    "batch": "many recordings on a cluster or behind URLs",
    "fast": "hub.event_loop = uvloop",
    "mqtt": "an endpoint mqtt:",
}
ENOUGH_HOURS: Final = 4.0
MB_PER_HOUR: Final = 100.0
"""Size of recordings of one aircraft, tlog and table together."""
SOON_S: Final = 14 * 86_400
"""Remaining time at which a certificate should have been renewed."""


STYLES: Final = {"OK": "green", "INFO": "yellow", "FAIL": "red"}


class Diagnosis(NamedTuple):
    """One check and its result, with its remedy."""

    grade: str
    what: str
    text: str


ok, info, fail = (partial(Diagnosis, grade) for grade in STYLES)

Check = Callable[[config.GatewaySettings], Iterator[Diagnosis]]


def _check_settings(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    """Check the aircraft's files, the rights of secrets, and what no single setting shows."""
    file = settings_file()
    try:
        found = config.load_aircraft(settings)
    except config.ConfigError as error:
        yield from (fail("settings", line) for line in str(error).splitlines())
        return
    for warning in config.exposed_secrets(file, settings, found):
        yield fail("secrets", warning)
    for endpoint in map(parse_endpoint, settings.hub.endpoints):
        if endpoint.port == 0 and endpoint.kind in LISTENING:
            yield fail(
                "settings",
                f"hub.endpoints: {endpoint.url!r} uses any free port, which no ground station can "
                "know in advance; set one of 1 to 65535",
            )
    text = f"{file}: all settings are valid" if file.exists() else f"no {file}: the defaults"
    others = (
        f", and of {len(found)} aircraft in {config.aircraft_folder(settings)}" if found else ""
    )
    yield ok("settings", f"{text}{others}")


def _check_aircraft(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    folder = config.aircraft_folder(settings)
    yield _writable("aircraft", folder, f"calibrations and parameters are stored in {folder}")


def _check_receiver(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    """List the USB adapters, and check the receiver's port and access to it."""
    wanted, found = settings.serial.port, list_serial_ports()
    for port in found:
        if port.usb_id:
            usb = f"usb:{port.usb_id}" + (f":{port.serial_number}" * bool(port.serial_number))
            yield info("port", f"{port.device}, {usb}, {port.description}")
    if wanted == NO_RECEIVER:
        return
    try:
        fitting = fitting_ports(wanted, found)
    except PortNotFoundError as error:
        if wanted == AUTO:
            text = "none is connected; a router, and sources other than our boards, need none"
            yield info("receiver", text)
        else:
            yield fail("receiver", f"{error}; plug it in, or set serial.port")
        return
    if len(fitting) > 1:
        text = f"several adapters match, the gateway tries each: {', '.join(fitting)}"
        yield info("receiver", text)
    for device in fitting:
        yield from _check_port(device)


def _check_port(device: str) -> Iterator[Diagnosis]:
    path = Path(device)
    if not path.exists():
        yield fail("receiver", f"{device} does not exist; the ports above do")
    elif not os.access(path, os.R_OK | os.W_OK):
        yield fail("receiver", f"{device} may not be opened: {_membership(path)}")
    else:
        yield ok("receiver", device)
    yield from _latency(path)


def _membership(path: Path) -> str:
    owner = path.stat().st_gid
    try:
        group, user = grp.getgrgid(owner), pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        # In a container, groups and users often have no name.
        return f"it is accessible to the group {owner}"
    if user in group.gr_mem:
        return f"{user} is in the group {group.gr_name} only from the next log-in on"
    return f"`sudo usermod -aG {group.gr_name} {user}`, then log in again"


def _latency(device: Path) -> Iterator[Diagnosis]:
    timer = TTY / device.resolve().name / "device" / "latency_timer"
    try:
        latency_ms = int(timer.read_text())
    except (OSError, ValueError):
        return
    if latency_ms <= SLOW_LATENCY_MS:
        yield ok("latency timer", f"{latency_ms} ms")
    else:
        yield fail(
            "latency timer",
            f"the adapter delays bytes by {latency_ms} ms: `echo 1 | sudo tee {timer}`, and "
            "permanently by the rule tools/debian/60-mavgate.rules",
        )


def _check_kernels(_: config.GatewaySettings) -> Iterator[Diagnosis]:
    try:
        load_entry_points()
    except LibraryError as error:
        yield fail("kernels", str(error))
    else:
        yield ok("kernels", "compiled")


def _check_clock(_: config.GatewaySettings) -> Iterator[Diagnosis]:
    """Check whether the system time is synchronised, as recordings are named by it."""
    if not shutil.which("timedatectl"):
        yield info("clock", "synchronisation unknown")
        return
    asked = ["timedatectl", "show", "--property=NTPSynchronized", "--value"]
    said = subprocess.run(asked, capture_output=True, text=True, check=False, timeout=10)
    if said.stdout.strip() == "yes":
        yield ok("clock", "synchronised")
    else:
        yield info("clock", "not synchronised: recordings get their right times from GPS")


def _check_disk(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    folder = folder_of(settings)
    try:
        free_mb = free_bytes_near(folder) / 1e6
    except OSError as error:
        yield fail("recordings", f"{folder}: {reason_of(error)}")
        return
    room = free_mb - settings.recording.free_floor_mb
    if room < ENOUGH_HOURS * MB_PER_HOUR:
        text = f"{folder}: {max(room, 0.0):.0f} MB free, for {max(room, 0.0) / MB_PER_HOUR:.1f} h"
        yield fail("recordings", f"{text}; delete old ones or set recording.folder")
    else:
        yield _writable("recordings", folder, f"{folder}: {room / 1e3:.1f} GB free")


def _writable(what: str, folder: Path, text: str) -> Diagnosis:
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    if not existing.is_dir():
        return fail(what, f"{existing} is not a folder")
    if os.access(existing, os.W_OK):
        return ok(what, text)
    return fail(what, f"{folder} cannot be written by {os.environ.get('USER', 'us')}")


def _check_ports(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    """Check whether a gateway runs, otherwise whether its ports are free."""
    if running := live_sockets("run"):
        yield ok("gateway", f"runs, and listens at {', '.join(map(str, running))}")
        return
    taken = False
    for endpoint in map(parse_endpoint, settings.hub.endpoints):
        if reason := _trouble_of(endpoint):
            taken = True
            yield fail("ports", f"{endpoint.location}: {reason}")
    if not taken:
        yield ok("ports", "free")


def _trouble_of(endpoint: Endpoint) -> str:
    """Return the reason why a listening endpoint could not be bound now."""
    if endpoint.kind is EndpointKind.SERIAL:
        allowed = os.access(endpoint.host, os.R_OK | os.W_OK)
        there = Path(endpoint.host).exists()
        return "" if allowed else _membership(Path(endpoint.host)) if there else "does not exist"
    kinds: dict[str, socket.SocketKind] = {
        EndpointKind.UDP_LISTEN: socket.SOCK_DGRAM,
        EndpointKind.TCP_LISTEN: socket.SOCK_STREAM,
    }
    if endpoint.kind not in kinds:
        return ""
    family = socket.AF_INET6 if ":" in endpoint.host else socket.AF_INET
    with socket.socket(family, kinds[endpoint.kind]) as probe:
        if endpoint.kind is EndpointKind.TCP_LISTEN:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((endpoint.host, endpoint.port))
        except OSError as error:
            return reason_of(error)
    return ""


def _check_certificates(settings: config.GatewaySettings) -> Iterator[Diagnosis]:
    hub, panel = settings.hub, settings.panel
    for what, certificate, key in (
        ("hub.tls_certificate", hub.tls_certificate, hub.tls_key),
        ("panel.certificate", panel.certificate, panel.certificate_key),
    ):
        if not certificate:
            continue
        file = Path(certificate).expanduser()
        try:
            end_s = valid_until_s(file, Path(key).expanduser() if key else file)
        except ssl.SSLCertVerificationError as error:
            yield fail(what, f"{file}: {error.verify_message}")
        except OSError as error:
            yield fail(what, f"{file}: {reason_of(error)}")
        else:
            made = ok if end_s - time.time() > SOON_S else info
            until = datetime.fromtimestamp(end_s, UTC)
            yield made(what, f"{file}, valid until {until:%Y-%m-%d}")


def _check_extras(_: config.GatewaySettings) -> Iterator[Diagnosis]:
    """Name the missing extras, their use, and the command that installs each."""
    for extra, use in EXTRA_USES.items():
        if missing(extra):
            yield info("extra", how_to_add(use, extra))


def _write_template(text: str) -> None:
    file = settings_file()
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        write_new(file, [text.encode()], rights=PRIVATE)
    except FileExistsError:
        refuse(f"{file}: exists, and is not overwritten; `mavgate doctor {file}` checks it")
    print(f"wrote {file}")


CHECKS: Final[tuple[Check, ...]] = (
    _check_settings,
    _check_receiver,
    _check_ports,
    _check_aircraft,
    _check_disk,
    _check_kernels,
    _check_clock,
    _check_certificates,
    _check_extras,
)


@app.command()
def doctor(
    file: Path | None = argument(
        "Settings file to check alone; without it, this machine is checked."
    ),
    *,
    template: Literal["usual", "all"] | None = option(
        "--template",
        "Print a settings file instead, with the defaults of the settings that are "
        "changed most, or of all.",
    ),
    write: bool = option("--write", "Write that file as the settings, if there are none.", False),
) -> None:
    """Check settings and machine and suggest fixes: rights, ports, latency, kernels, time, disk.

    Each error in the settings is listed with the allowed values. The exit code is 1 if a check
    fails.
    """
    if template or write:
        text = config.render(config.GatewaySettings(), ("",) if template == "all" else config.USUAL)
        _write_template(text) if write else print(text, end="")
        return
    console = console_of()
    failed = False
    for finding in _findings(file):
        failed |= finding.grade == "FAIL"
        console.print(f"{finding.grade:4}  ", style=STYLES[finding.grade], end="")
        console.print(f"{finding.what}: {finding.text}")
    if failed:
        raise typer.Exit(1)


def _findings(file: Path | None) -> Iterator[Diagnosis]:
    if file is not None:
        CONFIG.set(file)
    try:
        settings = read_settings()
    except config.ConfigError as error:
        yield from (fail("settings", line) for line in str(error).splitlines())
        return
    yield from chain.from_iterable(check(settings) for check in CHECKS[: 1 if file else None])
