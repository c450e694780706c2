"""`mavgate fleet`: the vehicles of many sites, their state, and their recordings.

A recording is fetched in pieces through the running fleet. A partial file is kept next to the
target as `.NAME.part` until it is complete and its SHA-256 is that of the site's file: an
incomplete file never looks complete. An existing partial file is continued, if it is the beginning
of the site's file.
"""

import asyncio
import base64
import fcntl
import hashlib
import logging
import os
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, BinaryIO, Final

import msgspec
import typer
from rich.progress import BarColumn, DownloadColumn, Progress, TransferSpeedColumn

from gateway.cli.live.run import EndpointOption, with_endpoints
from gateway.cli.support.control import ask, socket_of
from gateway.cli.support.options import read_settings
from gateway.cli.support.terminal import JsonOption, console_of, print_json, refuse, table_of
from gateway.extras import require
from gateway.hub.endpoint import SITE_NAME
from gateway.live.control_socket import ControlError, request
from gateway.live.service import run_event_loop
from gateway.live.terminal import detached_output, on_end_signals
from gateway.output import sync_folder
from gateway.printable import UNKNOWN
from gateway.recordings.index import NEWEST, is_file_name
from gateway.recordings.moment import civil_time
from gateway.units import US_PER_S, counted

log = logging.getLogger(__name__)

DISK_S: Final = 60.0
"""Longest wait for a file to be written: a worn card takes seconds for each step."""

SMALLEST: Final = 4 << 10
LARGEST: Final = 128 << 10
"""Largest piece of one answer."""
FAST_S: Final = 0.05
SLOW_S: Final = 0.2
RETRY_S: Final = 1.0
SITE_TIMEOUT_S: Final = 60.0
"""Longest wait for a disconnected site."""
DIGEST_WAIT_S: Final = 330.0
PIECE_WAIT_S: Final = 20.0
READ_SIZE: Final = 1 << 20

Ask = Callable[[str, dict[str, Any], float], Any]
"""Asks a fleet: the verb, its parameters, the longest wait in seconds."""


class FetchError(Exception):
    """A file that cannot be fetched; the text says why, and what to do."""


class RecordingFetch:
    """Fetch files of one site into a folder."""

    def __init__(
        self,
        site: str,
        folder: Path,
        ask: Ask,
        *,
        force: bool = False,
        wait: Callable[[float], None] = time.sleep,
    ) -> None:
        self._site = site
        self._folder = folder
        self._ask = ask
        self._force = force
        self._wait = wait
        self.piece_size = SMALLEST
        """Adapted so that a piece takes about a tenth of a second: telemetry waits behind it."""

    def fetch(self, name: str, size: int, advance: Callable[[int], None]) -> bool:
        """Fetch one file, or the rest of it; return whether anything had to be fetched."""
        if not is_file_name(name):
            raise FetchError(f"the site lists {name!r}, which is not a file of a recording")
        target, part = self._folder / name, self._folder / f".{name}.part"
        if target.exists():
            is_beginning = target.stat().st_size <= size and self._is_beginning(target, name)
            if is_beginning and target.stat().st_size == size:
                advance(size)
                return False
            if not (self._force or is_beginning):
                raise FetchError(f"{target} exists and differs; use --force to replace it")
        self._folder.mkdir(parents=True, exist_ok=True)
        with part.open("a+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise FetchError(f"{target} is being fetched by another program") from error
            if target.exists() and not file.seek(0, os.SEEK_END):
                # The existing file may be the beginning; otherwise the fetch starts from zero.
                with target.open("rb") as known:
                    shutil.copyfileobj(known, file)
            self._fill(file, name, size, advance)
            file.flush()
            os.fsync(file.fileno())
            part.replace(target)
        sync_folder(self._folder)
        return True

    def _is_beginning(self, target: Path, name: str) -> bool:
        with target.open("rb") as file:
            digest = _digest_of(file).hexdigest()
            return self._digest(name, file.tell()) == digest

    def _fill(self, file: BinaryIO, name: str, size: int, advance: Callable[[int], None]) -> None:
        """Fetch until the file is whole and is the site's."""
        digest = _digest_of(file)
        have = file.seek(0, os.SEEK_END)
        if have and (have > size or digest.hexdigest() != self._digest(name, have)):
            file.truncate(0)
            digest, have = hashlib.sha256(), 0
        advance(have)
        while have < size:
            piece = self._piece(name, have, min(self.piece_size, size - have))
            if not piece:
                raise FetchError(f"{name} has become shorter at the site; fetch it again")
            file.write(piece)
            digest.update(piece)
            have += len(piece)
            advance(len(piece))
        if digest.hexdigest() != self._digest(name, size):
            file.truncate(0)
            raise FetchError(f"{name} has changed at the site meanwhile; fetch it again")

    def _piece(self, name: str, offset: int, size: int) -> bytes:
        params = {"file": name, "offset": offset, "size": size}
        begin_s = time.monotonic()
        data = base64.b64decode(self._persist("fleet.piece", params, "data", PIECE_WAIT_S))
        took_s = time.monotonic() - begin_s
        if took_s < FAST_S:
            self.piece_size = min(self.piece_size * 2, LARGEST)
        elif took_s > SLOW_S:
            self.piece_size = max(self.piece_size // 2, SMALLEST)
        # Leave the other half of the time to telemetry.
        self._wait(min(took_s, SLOW_S))
        return data

    def _digest(self, name: str, size: int) -> str:
        params = {"file": name, "size": size}
        return self._persist("fleet.digest", params, "sha256", DIGEST_WAIT_S)

    def _persist(self, verb: str, params: dict[str, Any], key: str, wait_s: float) -> str:
        """Retry until there is an answer: links break and come back."""
        end_s = time.monotonic() + SITE_TIMEOUT_S
        while True:
            answer: str | None = self._ask(verb, {"site": self._site, **params}, wait_s)[key]
            if answer is not None:
                return answer
            if time.monotonic() > end_s:
                raise FetchError(
                    f"site {self._site} does not answer; the same command continues from here"
                )
            self._wait(RETRY_S)


def _digest_of(file: BinaryIO) -> "hashlib._Hash":
    digest = hashlib.sha256()
    file.seek(0)
    while piece := file.read(READ_SIZE):
        digest.update(piece)
    return digest


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
    lost = "" if found["is_linked"] else ", which does not answer"
    console.print(f"{role} {found['router']}{lost}")
    table = table_of("site", "", "RTT ms", "system", "id here", "Hz", "age s", "lost", left=2)
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
    for site in found["sites"]:
        # Those that its passphrase has rejected.
        counts = [f"{site[k]} {k}" for k in ("unsigned", "forged", "replayed") if site[k]]
        if counts:
            console.print(f"frames of {site['name']} dropped: {', '.join(counts)}")
    ways = [*found["sites"], {"name": "clients here", "looped": found["looped"]}]
    loops = [f"{way['looped']} through {way['name']}" for way in ways if way["looped"]]
    if loops:
        console.print(f"looped frames dropped: {', '.join(loops)}")


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
    if not site["vehicles"]:
        table.add_row(site["name"], state, trip)
    for vehicle in site["vehicles"]:
        table.add_row(
            site["name"], state, trip, str(vehicle["system_id"]), str(vehicle["id"] or "none"),
            f"{vehicle['rate_hz']:.1f}", f"{vehicle['age_s']:.1f}", str(vehicle["lost"]),
        )  # fmt: skip


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
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder; by default one called as the site."),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace files that differ.")] = False,
) -> None:
    """Fetch a recording of a site; an interrupted fetch is continued."""
    if not SITE_NAME.fullmatch(site):
        refuse(f"site {site!r}: letters, digits, . _ and - only")
    listed = ask("fleet.recordings", {"site": site}, of="fleet").get(site)
    if listed is None:
        refuse(f"site {site} does not answer for recordings; see `mavgate fleet status`")
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


def _size_of(recording: dict[str, Any]) -> int:
    return sum(file["size"] for file in recording["files"])
