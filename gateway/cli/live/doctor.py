"""`mavgate doctor`: what is missing on this machine, and how to fix it."""

from typing import Final

import typer

from gateway.cli.support.checkup import Grade, check_machine
from gateway.cli.support.settings_options import ConfigOption, read_settings
from gateway.cli.support.terminal import console_of

STYLES: Final = {Grade.GOOD: "green", Grade.NOTE: "yellow", Grade.WRONG: "red"}


def register(app: typer.Typer) -> None:
    """Add the command of this file."""
    app.command()(doctor)


def doctor(*, config: ConfigOption = None) -> None:
    """Check this machine and suggest fixes: rights, ports, latency, cache, time, disk.

    It changes nothing. The exit code is 1 if something is wrong.
    """
    console = console_of()
    wrong = 0
    for finding in check_machine(read_settings(config)):
        wrong += finding.grade is Grade.WRONG
        console.print(f"{finding.grade:5} ", style=STYLES[finding.grade], end="")
        console.print(f"{finding.what}: {finding.text}")
    if wrong:
        raise typer.Exit(1)
