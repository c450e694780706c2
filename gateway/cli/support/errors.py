"""How a command says that it cannot do what was asked."""

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
    console.print(text, style="red", markup=False, emoji=False)
    raise typer.Exit(2)
