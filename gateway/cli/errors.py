"""How a command says that it cannot do what was asked."""

from typing import NoReturn

import typer
from rich.console import Console


def refuse(text: str) -> NoReturn:
    """End the command with an error.

    Parameters
    ----------
    text : str
        What was wrong, where, and what to do; one or more lines.
    """
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    console.print(text, style="red", markup=False, emoji=False)
    raise typer.Exit(2)
