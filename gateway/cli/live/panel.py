"""`mavgate panel`: run the panel, also as a child process of the gateway."""

import asyncio
import logging
import os
import subprocess
import sys
from collections.abc import Awaitable, Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

import typer
from msgspec.structs import replace

from gateway.cli.support.options import CONFIG, SOCKET, folder_of, option, read_settings
from gateway.cli.support.terminal import refuse
from gateway.extras import how_to_add, missing, require
from gateway.hub.endpoint import parse_endpoint
from gateway.live.terminal import own_command
from gateway.printable import LONGEST, PrintableFormatter

log = logging.getLogger(__name__)
app = typer.Typer()

NICENESS: Final = 5
"""Niceness of the panel, set before its imports, so that the gateway has priority."""
LINK: Final = "panel: "
RESTART_S: Final = 5.0
LONGEST_RESTART_S: Final = 300.0
"""Longest pause between restarts, so that repeated failures do not fill the log."""
LINE_BREAK: Final = "\x1e"
"""Separator of the lines of a record in the panel's log; control characters in it are escaped."""
LONGEST_RECORD: Final = 15_000
"""Characters of a record, to fit in a line of 64 kB; of a longer one the end is kept."""
END_S: Final = 3.0
"""Timeout for the panel to end by itself; the loop must not close before that."""


@app.command()
def panel(
    *,
    connect: str | None = option(
        "--connect", "A vehicle's MAVLink, such as tcp:HOST:5760 or udp-listen:0.0.0.0:14550."
    ),
    tcp_port: int | None = option("--tcp-port", "Instead of the settings'.", min=0, max=65535),
    hash_password: bool = option(
        "--hash-password", "Prompt for a password and print its hash.", False
    ),
    attached: bool = option("--attached", "", False, hidden=True),
) -> None:
    """Show the aircraft in a browser: instruments, map, link, recordings, calibration, tuning.

    Without --connect it shows the gateway that runs on this machine, and reconnects whenever that
    is restarted.
    """
    require("the panel", "panel")
    if not (attached or hash_password):
        log.info("the panel is loading; its address follows")
    os.nice(NICENESS)
    from gateway.panel.panel_server import PanelError, run_panel

    if hash_password:
        from gateway.panel.logins import hash_password as hashed

        print(f'password = "{hashed(typer.prompt("Password", hide_input=True))}"')
        return
    if attached:
        # Warnings are passed to the gateway's log, which adds timestamps; so is the traceback of
        # an exception that ends the panel.
        sys.excepthook = lambda *failed: log.critical("the panel failed", exc_info=failed)
        logging.getLogger().setLevel(logging.WARNING)
        for handler in logging.getLogger().handlers:
            handler.setFormatter(OneLineFormatter("%(message)s"))
        # The gateway sends the path once its socket listens, after this process has started.
        line = sys.stdin.buffer.readline()
        if not line:
            return
        SOCKET.set(Path(os.fsdecode(line.removesuffix(b"\n"))))
    settings = read_settings()
    wanted = settings.panel if tcp_port is None else replace(settings.panel, port=tcp_port)
    folder = folder_of(settings)

    def show_link(link: str) -> None:
        print(f"{LINK}{link}", flush=True)

    try:
        if connect is not None:
            parse_endpoint(connect)
        run_panel(wanted, folder, connect, SOCKET.get(), show_link, attached=attached)
    except (PanelError, ValueError) as error:
        refuse(str(error))


def launched_panel(*, wanted: bool) -> "PanelProcess | None":
    """Return the panel while it loads; None if it is not wanted or not installed."""
    if not wanted:
        return None
    if missing("panel"):
        log.warning("no panel here: %s", how_to_add("it", "panel"))
        return None
    panel = PanelProcess()
    panel.launch()
    return panel


class OneLineFormatter(PrintableFormatter):
    """Formatter of a record as one line, so that the gateway logs a traceback as one record."""

    def format(self, record: logging.LogRecord) -> str:
        """Join the lines by `LINE_BREAK`; the middle of a long record is left out."""
        text = super().format(record)
        if len(text) > LONGEST_RECORD:
            head = text.partition("\n")[0][:LONGEST]
            text = f"{head}\n…\n{text[-LONGEST_RECORD:]}"
        return text.replace("\n", LINE_BREAK)


class PanelProcess:
    """The panel as a child process of the gateway; it is restarted if it dies."""

    def __init__(self) -> None:
        self.link = ""
        """Address of the page; empty before it is known."""
        self._command = own_command("panel", "--attached")
        if (config := CONFIG.get()) is not None:
            self._command += ["--config", str(config)]
        self._task: asyncio.Task[None] | None = None
        self._child: subprocess.Popen[bytes] | None = None

    def launch(self) -> None:
        """Start the process, which loads its libraries and waits for the control socket's path."""
        log.info("the panel is loading; its address follows")
        pipe = subprocess.PIPE
        self._child = subprocess.Popen(
            self._command, bufsize=0, stdin=pipe, stdout=pipe, stderr=subprocess.STDOUT
        )

    def start(self, control_socket: Callable[[], Awaitable[Path]]) -> None:
        """Connect it to the gateway, and restart it when it ends; requires a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._keep(control_socket))

    async def close(self) -> None:
        """End the process, and wait for its end."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.wait([self._task])
        child = self._child
        if child is None:
            return
        with child:
            child.terminate()
            try:
                await asyncio.to_thread(child.wait, END_S)
            except subprocess.TimeoutExpired:
                child.kill()
                await asyncio.to_thread(child.wait)

    async def _keep(self, control_socket: Callable[[], Awaitable[Path]]) -> None:
        path = os.fsencode(await control_socket())
        wait_s = RESTART_S
        while True:
            if self._child is None:
                self.launch()
            assert self._child is not None
            code = await self._attend(self._child, path)
            wait_s = RESTART_S if self.link else min(2 * wait_s, LONGEST_RESTART_S)
            self.link, self._child = "", None
            log.warning("the panel has ended (%d); starting it again in %.0f s", code, wait_s)
            await asyncio.sleep(wait_s)

    async def _attend(self, child: subprocess.Popen[bytes], path: bytes) -> int:
        """Pass the path of the control socket, read all output, and return the exit code."""
        assert child.stdin is not None
        with suppress(BrokenPipeError):
            child.stdin.write(path + b"\n")
        output = asyncio.StreamReader()
        transport, _ = await asyncio.get_running_loop().connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(output), child.stdout
        )
        try:
            await self._read(output)
        finally:
            transport.close()
        code = await asyncio.to_thread(child.wait)
        child.stdin.close()
        return code

    async def _read(self, output: asyncio.StreamReader) -> None:
        while not output.at_eof():
            try:
                line = await output.readline()
            except ValueError:
                continue  # The line exceeded the limit, and was discarded.
            text = line.decode(errors="replace").rstrip()
            if text.startswith(LINK):
                self.link = text.removeprefix(LINK)
                log.info("panel: %s", self.link)
            elif text:
                log.warning("panel: %s", text.replace(LINE_BREAK, "\n"))
