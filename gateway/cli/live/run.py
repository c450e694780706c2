"""Run the gateway, on a real receiver or on a simulated one."""

import asyncio
import gc
import logging
import signal
import sys
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import msgspec
import typer

from gateway.cli.live.panel import PanelProcess, launched_panel
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import CONFIG, option, read_settings, settings_file
from gateway.cli.support.terminal import refuse
from gateway.compiled.entry_point import load_entry_points
from gateway.config import ConfigError, GatewaySettings, load_aircraft
from gateway.extras import require
from gateway.live.daemon import Daemon
from gateway.live.other_gateways import conflicts
from gateway.live.service import run_event_loop
from gateway.live.terminal import Keyboard, detached_output, on_end_signals
from gateway.printable import NO_RECEIVER
from gateway.sources.settings import SourceSettings
from gateway.status import summary_line

if TYPE_CHECKING:
    from gateway.live.console import LiveView

log = logging.getLogger(__name__)
app = typer.Typer()

VIEW_INTERVAL_S: Final = 0.5
"""Interval of the live view: drawing takes some milliseconds, in which no frame is sent."""
LOG_INTERVAL_S: Final = 10.0
SWITCH_S: Final = 0.0001


@app.command("run")
def run_gateway(
    *,
    port: str | None = opt.PORT,
    source: list[str] | None = option(
        "--source -s",
        "A tracker, radio or phone, such as crsf:/dev/ttyACM0, instead of the settings'.",
    ),
    endpoint: list[str] | None = opt.ENDPOINT,
    plain: bool = opt.PLAIN,
    panel: bool = option("--panel", "Start the panel too, whatever the settings.", False),
) -> None:
    """Run the gateway: for receiver, trackers or a router, until interrupted.

    Our boards: `mavgate run` reads the receiver that is on USB.

    Another tracker: `mavgate run --source crsf:/dev/ttyACM0` makes a vehicle of a radio, a
    phone or a microcontroller.

    A router: `mavgate run -e serial:/dev/ttyACM0:57600 -e udp:192.168.1.20:14550` passes MAVLink of
    an autopilot to ground stations.
    """
    # Read here: a reload runs in another thread, without the context.
    file = CONFIG.get()

    def read() -> GatewaySettings:
        settings = with_endpoints(read_settings(file), endpoint, source)
        if port is None:
            return settings
        serial = msgspec.structs.replace(settings.serial, port=port)
        return msgspec.structs.replace(settings, serial=serial)

    settings = read()
    if panel:
        require("--panel", "panel")
    aircraft = load_aircraft(settings)
    page = launched_panel(wanted=panel or settings.panel.enabled)
    if settings.serial.port != NO_RECEIVER or settings.sources:
        # A router has no estimator, and its hub also forwards without compiled functions.
        load_entry_points()
    folder = settings_file().parent
    daemon = serve(lambda: Daemon(settings, aircraft, read, folder=folder), plain=plain, panel=page)
    run_event_loop(daemon, settings.hub.event_loop)


def with_endpoints(
    settings: GatewaySettings, endpoints: list[str] | None, sources: list[str] | None = None
) -> GatewaySettings:
    """Replace the endpoints and sources in the settings by those of the command line."""
    option, hub = "--endpoint", settings.hub
    try:
        hub = msgspec.structs.replace(hub, endpoints=tuple(endpoints or hub.endpoints))
        settings = msgspec.structs.replace(settings, hub=hub)
        option = "--source"
        found = tuple(SourceSettings(url=url) for url in sources or ())
        return msgspec.structs.replace(settings, sources=found or settings.sources)
    except ValueError as error:
        refuse(f"{option}: {error}")


def refuse_conflicts(systems: Collection[int], settings: GatewaySettings, *, allowed: bool) -> None:
    """End the command if another gateway sends one of its vehicle ids to the same endpoint."""
    for text in conflicts(systems, settings.hub.endpoints):
        if not allowed:
            refuse(f"{text}; choose another id or endpoint, or --duplicate-ids")
        log.warning("%s", text)


async def serve(
    daemon_of: Callable[[], Daemon],
    *,
    plain: bool,
    panel: PanelProcess | None = None,
) -> None:
    """Run a daemon until SIGINT or SIGTERM, showing its status.

    SIGHUP means that the terminal was closed, and ends the daemon as well; without a terminal, as
    in a service, it reloads the settings.
    """
    stopped = asyncio.Event()
    on_end_signals(stopped.set)
    view = None if plain or not sys.stdout.isatty() else _open_view()
    daemon = daemon_of()
    if not sys.stdin.isatty():
        _reload_on_hangup(daemon)
    with loop_comes_first(daemon.start):
        if panel is not None:
            panel.start(daemon.control_socket)
        try:
            if view is None:
                await _log_lines(daemon, stopped)
            else:
                await _live_view(daemon, view, stopped, panel)
        finally:
            daemon.close()
            if panel is not None:
                await panel.close()


@contextmanager
def loop_comes_first(start: Callable[[], None]) -> Iterator[None]:
    """Start something on the event loop, and prevent delays of the loop afterwards."""
    # Whenever the loop releases the interpreter, as for every frame that it sends, file threads
    # may hold it for this interval; the default is 5 ms.
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    try:
        with detached_output():
            start()
            # Objects that exist now, such as the metrics library, are permanent: a full garbage
            # collection of them would stop telemetry for 0.1 s.
            gc.collect()
            gc.freeze()
            yield
    finally:
        sys.setswitchinterval(before)


def _open_view() -> "LiveView":
    # Imported here: a service has no live view.
    from gateway.live.console import LiveView

    view = LiveView()
    logging.getLogger().handlers[:] = [view.log]
    return view


def _reload_on_hangup(daemon: Daemon) -> None:
    loop, running = asyncio.get_running_loop(), set[asyncio.Task[None]]()

    def begin() -> None:
        task = loop.create_task(_reload(daemon))
        running.add(task)
        task.add_done_callback(running.discard)

    loop.add_signal_handler(signal.SIGHUP, begin)


async def _reload(daemon: Daemon) -> None:
    try:
        await daemon.reload()
    except ConfigError as error:
        log.warning("settings not reloaded: %s", error)


async def _live_view(
    daemon: Daemon, view: "LiveView", stopped: asyncio.Event, panel: PanelProcess | None
) -> None:
    from rich.live import Live

    held = False

    def on_key(key: str) -> None:
        nonlocal held
        if key == "q":
            stopped.set()
        elif key == "r":
            daemon.toggle_recording()
        elif key == "space":
            held = not held

    keyboard = Keyboard(on_key)
    # Without rich's own thread: it draws when requested, between two samples.
    with Live(screen=True, auto_refresh=False) as live:
        keyboard.start()
        try:
            while not await is_set_within(stopped, VIEW_INTERVAL_S):
                view.link = "" if panel is None else panel.link or "loading; its address follows"
                if not held:
                    live.update(view.draw(daemon.snapshot()), refresh=True)
        finally:
            keyboard.close()


async def _log_lines(daemon: Daemon, stopped: asyncio.Event) -> None:
    while not await is_set_within(stopped, LOG_INTERVAL_S):
        log.info(summary_line(daemon.snapshot()))


async def is_set_within(event: asyncio.Event, seconds: float) -> bool:
    """Wait for an event; return False if it is not set in time."""
    try:
        async with asyncio.timeout(seconds):
            return await event.wait()
    except TimeoutError:
        return False
