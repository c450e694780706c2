"""Errors of a command."""

import sys
from typing import NoReturn

import typer

from gateway.cli.support.terminal import console_of


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
    """Return the command line that installs an optional part."""
    return f"{sys.executable} -m pip install 'mavgate[{extra}]'"
