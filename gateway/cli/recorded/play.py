"""`mavgate play`, and commands for a running player."""

import asyncio
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer
from rich.console import Group
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn
from rich.text import Text

from gateway.cli.live.run import is_set_within, refuse_conflicts, with_endpoints
from gateway.cli.support import shared_options as opt
from gateway.cli.support.options import argument, ask, option, read_options, read_settings
from gateway.cli.support.recordings import print_remarks, progress_of, read_range, recorded_files
from gateway.cli.support.terminal import NEGATIVE_NUMBERS, console_of
from gateway.live.other_gateways import log_other_gateways
from gateway.live.player_edge import PlayerStatus
from gateway.live.terminal import Keyboard, detached_output, on_end_signals, on_parent_gone
from gateway.player import PlayerDaemon, PlayPlan, endpoints_beyond, prepare
from gateway.recordings.files import FlightError
from gateway.recordings.opening import lay_out, open_flights
from gateway.recordings.play import (
    AS_FAST_AS_POSSIBLE,
    GREATEST_SPEED,
    LEAST_SPEED,
    PlayState,
    check_speed,
)
from gateway.recordings.table import SettingsChoice
from gateway.units import counted

app = typer.Typer()

VIEW_INTERVAL_S: Final = 0.25
FASTEST: Final = "max"
KEYS: Final = "space pause  ← → 10 s  ↓ ↑ 1 min  + − speed  . step  home begin  l loop  q quit"
LEAPS_S: Final = {"left": -10.0, "right": 10.0, "down": -60.0, "up": 60.0}
group = typer.Typer(help="Control the running player.", no_args_is_help=True)
app.add_typer(group, name="player")


@app.command()
def play(
    files: list[Path] = opt.FILES,
    *,
    speed: str = option("--speed", "0.1 to 100, or max.", "1"),
    begin: str | None = opt.FROM,
    end: str | None = opt.TO,
    loop: bool = option("--loop", "Restart at the end.", False),
    paused: bool = option("--paused", "Start paused.", False),
    skip_gaps: float | None = option("--skip-gaps", "Shorten gaps to this many seconds.", min=0),
    system: list[int] | None = option(
        "--id",
        "System id for each recording's first vehicle; its others get the next ids.",
        min=1,
        max=249,
    ),
    fuse: bool = option("--fuse", "For an autopilot's log: mavgate's states, not its own.", False),
    both: bool = opt.BOTH_ESTIMATES,
    fuse_with: SettingsChoice = opt.FUSE_WITH,
    columns: Path | None = opt.COLUMNS,
    with_commands: bool = option(
        "--with-commands", "Send the ground stations' messages too: live vehicles obey them.", False
    ),
    yes: bool = option("--yes -y", "Send commands to other machines without asking.", False),
    attached: bool = option("--attached", "", False, hidden=True),
    endpoint: list[str] | None = opt.ENDPOINT,
    duplicate_ids: bool = opt.DUPLICATE_IDS,
) -> None:
    """Play one or several recordings to the ground stations.

    Messages of the vehicles of a tlog are sent byte for byte, and requests are answered from the
    recording. A table is fused again while it plays, so what was recorded and what other settings
    make of it can be compared on one map. An autopilot's own log is played with its own estimates,
    parameters and mission, unless --fuse or --beside is given. The parts of a recording are one
    flight. `mavgate player` controls the running player.
    """
    gateway = with_endpoints(read_settings(), endpoint)
    if with_commands and not yes and (away := endpoints_beyond(gateway.hub)):
        typer.confirm(
            "Recorded commands (arming, steering, parameters, missions) would go to "
            f"{', '.join(away)}, and a vehicle there may obey them. Send them?",
            abort=True,
        )
    with ExitStack() as opened:
        plan = PlayPlan(
            *read_range(begin, end), _speed(speed), skip_gaps, loop, paused,
            with_commands, commands_anywhere=with_commands,
        )  # fmt: skip
        files = recorded_files(files, "tlogs")
        options = read_options(gateway, columns, choice=fuse_with)
        with progress_of(files) as advance:
            recorded = open_flights(
                files, replace(options, progress=advance), opened, fuse=fuse, both=both
            )
            flights = lay_out(recorded, system or [], with_commands=with_commands)
            prepare(flights, plan)
        played = [system for flight in flights for system in flight.system_ids.values()]
        refuse_conflicts(played, gateway, allowed=duplicate_ids)
        if not attached:
            log_other_gateways()
        print_remarks(remark for flight in recorded for remark in flight.remarks)
        names = [file.name for file in files]
        whom = ", ".join(gateway.hub.endpoints) or "no client: no endpoint is set"
        vehicles = f"vehicle{'s' * (len(played) != 1)} {', '.join(map(str, played))}"
        console_of().print(f"playing {', '.join(names)} as {vehicles} to {whom}")
        asyncio.run(_serve(lambda: PlayerDaemon(gateway, flights, plan, names), attached=attached))


@group.command(context_settings=NEGATIVE_NUMBERS)
def seek(
    to: str = argument("80 or 1:20 from the start, +10 or -0:30 from here, or a date.", ...),
) -> None:
    """Go to a moment."""
    _show(ask("seek", of="play", to=to))


def _add_verb(name: str, text: str) -> None:
    @group.command(name, help=text)
    def command() -> None:
        _show(ask(f"play.{name}", of="play"))


_add_verb("pause", "Pause.")
_add_verb("resume", "Resume.")
_add_verb("stop", "End the playback.")


@group.command()
def step(count: int = argument("Frames.", 1, min=1)) -> None:
    """Pause and play the next frames."""
    _show(ask("play.step", of="play", count=count))


@group.command("speed")
def set_speed(speed: str = argument("0.1 to 100, or max.", ...)) -> None:
    """Play faster or slower from now on."""
    value = _speed(speed)
    _show(ask("play.speed", of="play", speed=None if value == AS_FAST_AS_POSSIBLE else value))


@group.command("loop")
def set_loop(on: Annotated[Literal["on", "off"], typer.Argument()] = "on") -> None:
    """Set whether to restart at the end."""
    _show(ask("play.loop", of="play", on=on == "on"))


_add_verb("status", "Show the status of the player.")


async def _serve(daemon_of: Callable[[], PlayerDaemon], *, attached: bool) -> None:
    daemon = daemon_of()
    if attached:
        on_parent_gone(daemon.ended.set)
    on_end_signals(daemon.ended.set)
    with detached_output():
        try:
            await daemon.start()
            await _watch(daemon)
        finally:
            daemon.close()


def steer(daemon: PlayerDaemon, key: str) -> None:
    """Execute the command of a key; other keys have no effect."""
    edge = daemon.edge
    match key:
        case "q":
            daemon.ended.set()
        case "space" if edge.status().state == PlayState.PLAYING:
            edge.pause()
        case "space":
            edge.resume()
        case "+" | "=" | "-":
            edge.set_speed(_next_speed(edge.status().speed, faster=key != "-"))
        case ".":
            edge.step()
        case "l":
            edge.set_loop(not edge.status().loop)
        case "home":
            edge.seek("0")
        case _ if key in LEAPS_S:
            edge.seek(f"{LEAPS_S[key]:+g}")


def _next_speed(speed: float | None, *, faster: bool) -> float:
    """Return twice or half the speed, within its range; None means as fast as possible."""
    if speed is None:
        return AS_FAST_AS_POSSIBLE if faster else GREATEST_SPEED
    return min(max(speed * (2.0 if faster else 0.5), LEAST_SPEED), GREATEST_SPEED)


async def _watch(daemon: PlayerDaemon) -> None:
    console = console_of()
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[at]}")
    )
    task = progress.add_task("", total=1.0, at="")
    shown = Group(progress, Text(KEYS, style="dim"))
    keyboard = Keyboard(lambda key: steer(daemon, key))
    with (
        Live(shown, console=console, auto_refresh=False, transient=True) as live,
        closing(keyboard),
    ):
        keyboard.start()
        named = set[str]()
        while not daemon.ended.is_set():
            for trouble in sorted(daemon.troubles() - named):
                console.print(trouble, style="yellow")
            named |= daemon.troubles()
            status = daemon.edge.status()
            progress.update(
                task,
                description=status.state,
                completed=status.position_s,
                total=max(status.duration_s, 1e-3),
                at=_position(status),
            )
            if console.is_terminal:
                live.refresh()
            await is_set_within(daemon.ended, VIEW_INTERVAL_S)
    console.print(f"ended: {_position(daemon.edge.status())}")


def _speed(text: str) -> float:
    if text == FASTEST:
        return AS_FAST_AS_POSSIBLE
    try:
        return check_speed(float(text))
    except ValueError as error:
        raise FlightError(f"speed {text!r}: write 0.1 to 100, or {FASTEST}") from error


def _position(status: PlayerStatus) -> str:
    speed = FASTEST if status.speed is None else f"{status.speed:g}x"
    sent = counted(status.sent, "frame")
    return f"{status.position_s:.1f} of {status.duration_s:.1f} s, {speed}, {sent}"


def _show(status: dict[str, Any]) -> None:
    current = PlayerStatus(**{**status, "files": tuple(status["files"])})
    console_of().print(f"{current.state}: {_position(current)}")
    if current.remark:
        console_of().print(current.remark, style="yellow", markup=False)
