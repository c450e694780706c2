"""The command `mavgate`: its options, and its commands with their files.

A file is imported only when one of its commands is called, since imports are slow: listing all
commands or running a small one must not cost that. The summaries are here for the list, and again
in the first line of each command's docstring.
"""

import gc
import io
import logging
import os
import subprocess
import sys
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import IO, Any, Final, cast

import typer
from typer.core import TyperCommand, TyperGroup

from gateway import __version__
from gateway.cli.support.options import CONFIG, SOCKET, USER_CONFIG, extend, option
from gateway.cli.support.terminal import in_words, refusing
from gateway.live.log_limit import LogLimit
from gateway.printable import PrintableFormatter, printable, reason_of

log = logging.getLogger(__name__)

HELP: Final = {"help_option_names": ["-h", "--help"]}
GROUPS: Final = {
    "Fly": {
        "run": "Run the gateway: for receiver, trackers or a router, until interrupted.",
        "demo": "Fly the simulated tracker repeatedly until interrupted.",
        "panel": "Show the aircraft in a browser: instruments, map, link, recordings, calibration, "
        "tuning.",
        "status": "Show the status of the gateway: receiver, nodes, vehicles, clients.",
        "clients": "List, add and remove clients and sources, and mark a location for them.",
        "fleet": "Show the vehicles of many sites here, through a Zenoh router.",
    },
    "Recordings": {
        "record": "Start, stop, name and delete recordings, and add remarks.",
        "play": "Play one or several recordings to the ground stations.",
        "player": "Control the running player.",
        "info": "Show duration, vehicles, rates, gaps, distance and damage of recordings; "
        "or list all.",
        "report": "Make figures and tables of flights, or one HTML file of a flight.",
        "convert": "Convert, trim, join, merge and edit recordings.",
        "diff": "Compare recordings, parameter files or running vehicles: parameters, missions, "
        "texts.",
        "extract": "Extract parameters, missions, texts, subtitles and geotags from a recording.",
        "recover": "Write the intact part of a damaged recording to a new file, and list the "
        "damage.",
        "fuse": "Re-run the estimator on recordings, and write them with the new states in any "
        "format.",
        "sweep": "Try settings on one flight or many, and write the best as a settings file.",
    },
    "Set-up": {
        "setup": "Guide through the first start: receiver, sensors, radio, GPS, calibration.",
        "calibrate": "Calibrate an aircraft's sensors and save the result with its residuals.",
        "flash": "Write a ready-made program with its settings to a board, or read them back.",
        "doctor": "Check settings and machine and suggest fixes: rights, ports, latency, kernels, "
        "time, disk.",
        "map": "Fetch an area of a map for the panel, for use without a network.",
        "source": "Test a tracker: show its data, its rates, and data missing for attitude and "
        "position.",
    },
}
"""Summaries of the commands, under the headings of the list."""
MODULES: Final = {
    "setup": "live.first_start", "record": "live.record", "status": "live.clients",
    "player": "recorded.play", "fuse": "recorded.convert", "recover": "recorded.info",
}  # fmt: skip
"""Modules below `gateway.cli` that are not named after the command and its group."""
COMMANDS: Final = {name: text for below in GROUPS.values() for name, text in below.items()}
ALSO: Final = {
    "route": "run", "router": "run", "start": "run", "replay": "play", "log": "record",
    "export": "convert", "cut": "convert", "merge": "convert", "list": "info", "check": "doctor",
}  # fmt: skip
"""Other words for commands, for the suggestion after an unknown name."""
HOISTED: Final = frozenset({"--config", "-c", "--socket"})
"""Options of `mavgate` itself that may also follow the command."""
EPILOG: Final = "`mavgate --help` lists the options of all commands: --config, --socket, --verbose."
SMALL: Final = frozenset({"flash", "record", "status", "clients"})
"""Commands that mostly send requests to a gateway; extensions are loaded only with settings."""
ISO: Final = "%Y-%m-%d %H:%M:%S"
GIT_S: Final = 5.0


def load_command(name: str) -> Any:
    """Import the file of a command, and return the command."""
    if name not in SMALL:
        extend()
    folder = "recorded" if name in GROUPS["Recordings"] else "live"
    module = import_module(f"gateway.cli.{MODULES.get(name, f'{folder}.{name}')}")
    group = typer.main.get_group(module.app)
    gc.enable()
    return tidied(group.commands[name])


def tidied(command: Any, *, is_root: bool = False) -> Any:
    """Return a command whose help is reflowed, with no metavar for flags."""
    if command.help:
        paragraphs = command.help.split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
    # A context without parsing, since parsing imports half of what `--help` takes to load.
    for parameter in command.get_params(command.context_class(command, **HELP)):
        if getattr(parameter, "is_flag", False):
            parameter.metavar = ""
    if not is_root:
        command.epilog = EPILOG
    for each in getattr(command, "commands", {}).values():
        tidied(each)
    return command


def hoisted(words: list[str]) -> list[str]:
    """Move the options of `mavgate` itself from after the command to before it."""
    end = words.index("--") if "--" in words else len(words)
    moved, left, at = list[str](), list[str](), 0
    while at < end:
        name, equals, _ = words[at].partition("=")
        size = 1 if name not in HOISTED or equals else 2
        if at + size > end:
            return [name]  # The value is missing, which will be reported.
        (moved if name in HOISTED else left).extend(words[at : at + size])
        at += size
    return [*moved, *left, *words[end:]]


class LazyGroup(TyperGroup):
    """Group of the commands in `COMMANDS`, each of which is imported when it is called."""

    _listing = False

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002
        """Return all names in the order of the table."""
        return [*COMMANDS]

    def invoke(self, ctx: Any) -> Any:
        """Run a command; a user error ends it with its text."""
        with refusing():
            try:
                return super().invoke(ctx)
            except typer.BadParameter as error:
                error.message = in_words(error)
                raise

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options of `mavgate` itself, before or after the command."""
        return super().parse_args(ctx, hoisted(args))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find a command; the error for an unknown name suggests the nearest one."""
        if (name := args[0]) not in COMMANDS:
            near = get_close_matches(name, [*COMMANDS, *ALSO], n=1)
            hint = f" Did you mean '{ALSO.get(near[0], near[0])}'?" if near else ""
            ctx.fail(f"No such command {name!r}.{hint}")
        return super().resolve_command(ctx, args)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ARG002
        """Return a command; only its summary while the list is written."""
        summary = COMMANDS.get(cmd_name)
        if summary is None:
            return None
        if self._listing:
            heading = next(group for group, below in GROUPS.items() if cmd_name in below)
            return TyperCommand(cmd_name, help=summary, rich_help_panel=heading)
        return load_command(cmd_name)

    def format_help(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands without importing them."""
        self._listing = True
        tidied(self, is_root=True)
        super().format_help(ctx, formatter)
        self._listing = False

    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Complete a name without importing its command."""
        self._listing = True
        found = super().shell_complete(ctx, incomplete)
        self._listing = False
        return found


app = typer.Typer(
    name="mavgate",
    cls=LazyGroup,
    help="A MAVLink telemetry gateway: shows a home-made UAV tracker on every ground station.",
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
    rich_markup_mode="rich",
    context_settings={**HELP},
)


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"mavgate {__version__}{_commit()}")
        raise typer.Exit


def _commit() -> str:
    """Return the commit of the clone from which this runs; empty if it is installed."""
    clone = Path(__file__).resolve().parents[2]
    if not (clone / ".git").exists():
        return ""
    words = ["git", "-C", str(clone), "describe", "--always", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=GIT_S)
    except (OSError, subprocess.SubprocessError):
        return " (of a clone)"
    return f" (commit {done.stdout.strip()})"


@app.callback()
def _options(
    context: typer.Context,
    *,
    config: Path | None = option(
        "--config -c", f"Settings file; by default gateway.toml in {USER_CONFIG.parent}."
    ),
    socket: Path | None = option(
        "--socket", "Control socket of the gateway to use, if several run.", envvar="MAVGATE_SOCKET"
    ),
    verbose: bool = option("--verbose -v", "Log details too.", False),
    _version: bool = option(
        "--version", "Show version.", False, callback=_show_version, is_eager=True
    ),
) -> None:
    for chosen, value in ((CONFIG, config), (SOCKET, socket)):
        context.call_on_close(partial(chosen.reset, chosen.set(value)))
    _begin_logging(verbose=verbose)
    _settle_home()


def _settle_home() -> None:
    """Use / as the home of a user without one, such as an unknown uid in a container."""
    try:
        Path.home()
    except RuntimeError:
        os.environ["HOME"] = "/"
        log.warning("HOME is not set, and uid %d has no home; settings are below /", os.getuid())


def _begin_logging(*, verbose: bool) -> None:
    level = logging.DEBUG if verbose else logging.INFO
    form = "%(asctime)s %(levelname)s %(message)s"
    handler: logging.Handler = logging.StreamHandler()
    if sys.stderr.isatty():
        from rich.console import Console
        from rich.logging import RichHandler

        form = "%(message)s"
        shown = Console(file=cast(IO[str], _CurrentStderr()))
        handler = RichHandler(console=shown, show_path=False, log_time_format=ISO)
    handler.addFilter(LogLimit())
    handler.setFormatter(PrintableFormatter(form))
    logging.basicConfig(level=level, handlers=[handler])
    # matplotlib logs each font that it finds.
    logging.getLogger("matplotlib").setLevel(logging.WARNING)


class _CurrentStderr:
    """The present `sys.stderr`: a progress bar replaces it, so that log lines appear above it."""

    def __getattr__(self, name: str) -> Any:
        return getattr(sys.stderr, name)


def _prepare_streams() -> None:
    """Ensure that printing cannot fail, and that no file is opened under a stream's descriptor."""
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            # The stream was closed: the next file that is opened would get its descriptor.
            setattr(sys, name, Path(os.devnull).open("r+"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # File names may not be text, and terminals may lack characters.
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Run the command line."""
    _prepare_streams()
    try:
        app()
    except OSError as error:
        log.debug("Ended by %r", error, exc_info=error)
        sys.exit(printable(f"{error.filename or 'output'}: {reason_of(error)}"))
