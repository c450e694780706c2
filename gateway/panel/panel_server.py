"""The panel's process: builds the parts, serves the page, shuts them down in order."""

import asyncio
import errno
import inspect
import logging
import socket
import ssl
import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import uvicorn
from fastapi import FastAPI
from fastapi.middleware.gzip import GZipMiddleware
from nicegui import app as pages
from nicegui import ui
from starlette.requests import Request
from starlette.responses import Response
from starlette.staticfiles import StaticFiles

from gateway.clock import GatewayClock
from gateway.hub.stats import LogRateLimiter
from gateway.live.terminal import on_end_signals, on_parent_gone
from gateway.panel.access import HOLDER, ROLE, AccessControl, ScriptNonces
from gateway.panel.connections import ConnectionLimits, LimitedProtocol, LimitedServer
from gateway.panel.dialogues import Dialogues
from gateway.panel.logins import Logins
from gateway.panel.map_tiles import MapTiles
from gateway.panel.open_pages import OpenPages
from gateway.panel.page import build_page
from gateway.panel.panel_settings import PanelSettings
from gateway.panel.pointing_api import pointing_router
from gateway.panel.push_api import push_router
from gateway.panel.recording_jobs import RecordingJobs
from gateway.panel.recording_transfer import add_recording_files
from gateway.panel.rest_api import RestApi
from gateway.panel.state.fleet import FleetState
from gateway.panel.telemetry_feed import PATH, TelemetryFeed, add_tracks
from gateway.panel.uplink import ControlClient, GatewayWatch, Uplink
from gateway.panel.view_context import WEB, PanelParts

log = logging.getLogger(__name__)

PAGE_ERRORS_IN_FULL: Final = 5
"""Failed events of pages that are logged one by one in a minute."""
MAX_PAGE_ERROR: Final = 300
WS_QUEUE: Final = 4
"""Maximum waiting messages of a WebSocket, of at most 1 MB each."""
RECONNECT_S: Final = 30.0
"""A browser that reconnects within this time keeps its page."""
LEAFLET: Final = Path(inspect.getfile(ui.leaflet)).parent / "dist" / "leaflet"
"""The style sheet of NiceGUI's map library."""

HEAD: Final = """<link rel="stylesheet" href="/web/panel.css">
<link rel="stylesheet" href="/web/tools.css"><link rel="stylesheet" href="/leaflet/leaflet.css">
<script src="/web/telemetry_bus.js"></script>"""


class PanelError(Exception):
    """The panel cannot be opened; the text gives the reason."""


def run_panel(
    settings: PanelSettings,
    recordings: Path,
    connect: str | None,
    control_socket: Path | None,
    on_link: Callable[[str], None],
    *,
    attached: bool,
) -> None:
    """Serve the page until interrupted.

    Raises PanelError if the port or the certificate cannot be used.
    """
    certificate, key = tls_files(settings)
    sock = _bound(settings, or_any=attached)
    parts = make_parts(settings, recordings, connect, control_socket)
    app = _make_app(parts)
    logging.getLogger("uvicorn.error").addFilter(without_traceback)
    logging.getLogger("nicegui").addFilter(PageErrors(parts.clock))
    limits = ConnectionLimits()
    config = uvicorn.Config(
        AccessControl(
            app, settings, parts.logins, limits.authenticate, limits.shut, parts.pages.end_session
        ),
        http=LimitedProtocol,
        log_config=None,  # the log is the one of every command
        log_level="warning",
        access_log=False,
        server_header=False,
        # Not trusted: behind a proxy of this machine a client could claim any address.
        proxy_headers=False,
        ws_max_size=1 << 20,
        ws_max_queue=WS_QUEUE,
        # Off: unpacking would take several times as long as sending.
        ws_per_message_deflate=False,
        timeout_graceful_shutdown=1,
        ssl_certfile=certificate,
        ssl_keyfile=key,
    )
    config.load()
    on_open = partial(on_link, _link(settings, sock))
    server = LimitedServer(config, limits)
    asyncio.run(_serve(server, sock, parts, on_open, attached=attached))


def tls_files(settings: PanelSettings) -> tuple[Path | None, Path | None]:
    """Return the files of certificate and key, both None for no TLS.

    Raises PanelError if they cannot be used.
    """
    if not settings.certificate:
        return None, None
    certificate = Path(settings.certificate).expanduser()
    key = Path(settings.certificate_key).expanduser() if settings.certificate_key else certificate
    try:
        for file in (certificate, key):
            # The error of the TLS library does not name the missing file.
            file.read_bytes()
        # Never ask for a password of the key: a service has no terminal.
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password="")
    except ssl.SSLError as error:
        why = f" ({error.reason.lower().replace('_', ' ')})" if error.reason else ""
        wanted = "a certificate and its key, in PEM, without a password"
        raise PanelError(f"{certificate} and {key} must be {wanted}{why}") from error
    except OSError as error:
        raise PanelError(f"{error.filename}: {error.strerror}") from error
    return certificate, key


def without_traceback(record: logging.LogRecord) -> bool:
    """Pass a log line, without its traceback if a browser has sent invalid text."""
    if record.exc_info and isinstance(record.exc_info[1], UnicodeDecodeError):
        record.exc_info = None
    return True


class PageErrors(logging.Filter):
    """Log the exceptions of events of pages in one line each, and only a few a minute.

    Whoever has a page can forge its events, and each traceback has some 30 lines.
    """

    def __init__(self, now_us: Callable[[], int]) -> None:
        super().__init__()
        self._now_us = now_us
        self._limit = LogRateLimiter(PAGE_ERRORS_IN_FULL, "more events of pages failed")

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether a line is written, which has no traceback."""
        error = record.exc_info[1] if record.exc_info else None
        if error is None:
            return True
        frames = traceback.extract_tb(error.__traceback__)
        where = f", {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
        text = f"an event of a page failed: {type(error).__name__}: {error}{where}"
        lines = self._limit.add(text[:MAX_PAGE_ERROR], self._now_us())
        record.msg, record.args = "; ".join(lines), None
        record.exc_info = record.exc_text = None
        return bool(lines)


def make_parts(
    settings: PanelSettings, recordings: Path, connect: str | None, control_socket: Path | None
) -> PanelParts:
    """Build the parts shared by all pages; see `run_panel`."""
    clock, fleet = GatewayClock(), FleetState()
    control = ControlClient(control_socket)
    uplink = Uplink(connect, fleet, control, clock)
    dialogues = Dialogues(fleet, uplink.send, clock)
    watch = GatewayWatch(control, fleet)
    logins = Logins(settings.password, settings.viewer_password)
    return PanelParts(
        settings, recordings, clock, fleet, control, uplink, dialogues, watch, RecordingJobs(),
        MapTiles(settings), OpenPages(), logins,
    )  # fmt: skip


def _make_app(parts: PanelParts) -> FastAPI:
    app = FastAPI(title="mavgate", docs_url=None, redoc_url=None, openapi_url="/docs.json")
    pointing = pointing_router(parts.fleet, parts.clock)
    push = push_router(parts.control, parts.logins.may_attempt)
    for router in (*RestApi(parts.uplink).routers(), pointing, push):
        app.include_router(router)
    app.add_api_websocket_route(PATH, TelemetryFeed(parts.fleet, parts.clock).serve)
    add_tracks(app, parts.fleet)
    parts.tiles.serve(app)
    add_recording_files(app, lambda: parts.recordings_folder)
    parts.jobs.serve(app)
    app.mount("/web", _CheckedFiles(directory=WEB))
    app.mount("/leaflet", _CheckedFiles(directory=LEAFLET))
    ui.add_head_html(HEAD, shared=True)
    parts.pages.guard_socket()

    @ui.page("/")
    def _page(request: Request) -> None:
        parts.pages.add(ui.context.client, request.scope[HOLDER])
        build_page(parts, request.scope[ROLE])

    # Nonces are inserted before the text is compressed: the middleware added last is outermost.
    pages.add_middleware(ScriptNonces)
    pages.add_middleware(GZipMiddleware)
    ui.run_with(
        app,
        title="mavgate",
        language="en-GB",
        dark=None,
        favicon=WEB / "icon.svg",
        show_welcome_message=False,
        binding_refresh_interval=None,
        reconnect_timeout=RECONNECT_S,
        tailwind=False,
        gzip_middleware_factory=None,
    )
    return app


async def _serve(
    server: LimitedServer,
    sock: socket.socket,
    parts: PanelParts,
    on_open: Callable[[], None],
    *,
    attached: bool,
) -> None:
    on_end_signals(partial(setattr, server, "should_exit", True))
    if attached:
        on_parent_gone(partial(setattr, server, "should_exit", True))
    parts.uplink.start()
    parts.dialogues.start()
    if parts.uplink.is_local:
        parts.watch.start()
    try:
        await server.serve_on(sock, on_open)
    finally:
        parts.dialogues.close()
        parts.watch.close()
        parts.jobs.close()
        parts.uplink.close()


class _CheckedFiles(StaticFiles):
    """Files that a browser may cache but must revalidate, so that it never uses outdated ones."""

    def file_response(self, *args: Any, **named: Any) -> Response:
        """Return the response of a file."""
        response = super().file_response(*args, **named)
        response.headers["cache-control"] = "no-cache"
        return response


def _bound(settings: PanelSettings, *, or_any: bool) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.address else socket.AF_INET
    sock = socket.socket(family, socket.SOCK_STREAM)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((settings.address, settings.port))
    except OSError as error:
        sock.close()
        address = f"{settings.address}:{settings.port}"
        if or_any and error.errno == errno.EADDRINUSE:
            log.warning("%s is in use; the panel takes another port", address)
            return _bound(msgspec.structs.replace(settings, port=0), or_any=False)
        reason = f"panel on {address}: {error.strerror}; --tcp-port takes another"
        raise PanelError(reason) from error
    return sock


def _link(settings: PanelSettings, sock: socket.socket) -> str:
    host, port = sock.getsockname()[:2]
    scheme = "https" if settings.certificate else "http"
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}/"
