"""The command `mavgate`: one file per group of commands."""

import logging
import sys
from typing import Annotated

import typer

from gateway import __version__
from gateway.cli.command_table import LazyGroup
from gateway.edges.operator.log_limit import LogLimit

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
        handler = RichHandler(console=Console(stderr=True), show_path=False)
    handler.addFilter(LogLimit())
    logging.basicConfig(level=level, format=form, handlers=[handler])


def main() -> None:
    """Run the command line."""
    app()
