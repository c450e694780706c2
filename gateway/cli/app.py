"""The command `mavgate`: one file per group of commands."""

import io
import logging
import os
import sys
from pathlib import Path
from typing import IO, Annotated, cast

import typer

from gateway import __version__
from gateway.cli.command_table import LazyGroup
from gateway.live.log_limit import LogLimit
from gateway.printable import PrintableFormatter, printable
from gateway.reasons import reason_of

log = logging.getLogger(__name__)
app = typer.Typer(
    name="mavgate",
    cls=LazyGroup,
    help="A MAVLink telemetry gateway: shows a home-made UAV tracker on every ground station.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"mavgate {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    *,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Log details too.")] = False,
    _version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show version.")
    ] = False,
) -> None:
    level = logging.DEBUG if verbose else logging.INFO
    form = "%(asctime)s %(levelname)s %(message)s"
    handler: logging.Handler = logging.StreamHandler()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.logging import RichHandler

        form = "%(message)s"
        shown = Console(file=cast(IO[str], _StderrNow()))
        handler = RichHandler(console=shown, show_path=False)
    handler.addFilter(LogLimit())
    handler.setFormatter(PrintableFormatter(form))
    logging.basicConfig(level=level, handlers=[handler])
    # It logs each font that it finds.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)


class _StderrNow:
    """`sys.stderr` as it is at each moment: a progress bar replaces it, to stay below the lines."""

    def write(self, text: str) -> int:
        return sys.stderr.write(text)

    def flush(self) -> None:
        sys.stderr.flush()

    def isatty(self) -> bool:
        return sys.stderr.isatty()

    def fileno(self) -> int:
        return sys.stderr.fileno()


def _prepare_streams() -> None:
    """Make sure that what is printed never ends a command, and no file takes a stream's place."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            # It was closed: the next file that is opened would get its number.
            setattr(sys, name, Path(os.devnull).open("r+"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # Names of files need not be text, and not every terminal has all signs.
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the command line."""
    _prepare_streams()
    try:
        app()
    except OSError as error:
        log.debug("Ended by %r", error, exc_info=error)
        sys.exit(printable(f"{error.filename or 'output'}: {reason_of(error)}"))
