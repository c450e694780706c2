"""The command `mavgate`: one group of commands a file."""

import logging
import sys
from typing import Annotated

import typer
from rich.console import Console
from rich.logging import RichHandler

from gateway import __version__
from gateway.cli.live import calibrate, clients, demo, panel, record, run, setup
from gateway.cli.recorded import convert, fuse, info, play, report, sweep
from gateway.edges.operator.log_limit import LogLimit
from gateway.extensions import ExtensionError, load_extensions

app = typer.Typer(
    name="mavgate",
    help="A MAVLink telemetry gateway: shows a home-made UAV tracker on every ground station.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
run.register(app)
demo.register(app)
panel.register(app)
record.register(app)
play.register(app)
convert.register(app)
fuse.register(app)
calibrate.register(app)
info.register(app)
clients.register(app)
setup.register(app)
report.register(app)
sweep.register(app)


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
        form = "%(message)s"
        handler = RichHandler(console=Console(stderr=True), show_path=False)
    handler.addFilter(LogLimit())
    logging.basicConfig(level=level, format=form, handlers=[handler])


def main() -> None:
    """Run the command line."""
    try:
        load_extensions()
    except ExtensionError as error:
        sys.exit(f"mavgate: {error}")
    app()
