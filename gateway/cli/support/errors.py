"""Errors of a command."""

import sys
from pathlib import Path
from typing import Final, NoReturn

import typer

from gateway.cli.support.terminal import console_of

DEBIAN_PACKAGE: Final = Path("/usr/lib/mavgate")
"""Where `make deb` puts all; what is installed by pip is not found from there."""


def refuse(text: str) -> NoReturn:
    """End the command with an error.

    Parameters
    ----------
    text : str
        What was wrong, where, and what to do; one or more lines.
    """
    console = console_of(stderr=True)
    console.print(text, style="red")
    raise typer.Exit(2)


def how_to_add(extra: str) -> str:
    """Return the command line that installs an optional part, if one can."""
    if Path(__file__).is_relative_to(DEBIAN_PACKAGE):
        return "the Debian package does not have it: /usr/share/doc/mavgate/service.md, Elsewhere"
    return f"{sys.executable} -m pip install 'mavgate[{extra}]'"
