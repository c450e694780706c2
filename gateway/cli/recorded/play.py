"""`mavgate play` and the orders to a player that runs."""

import asyncio
import contextlib
import signal
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.live import Live
from rich.progress import BarColumn, Progress, TextColumn

from gateway.cli.live.record import ask
from gateway.cli.live.run import (
    ConfigOption,
    EndpointOption,
    pipeline_settings,
    read_settings,
    with_endpoints,
)
from gateway.cli.support.errors import refuse
from gateway.cli.support.recording_options import (
    PANEL,
    ColumnsOption,
    Files,
    FromOption,
    PositionOption,
    SettingsOption,
    ToOption,
    progress_of,
    read_column_map,
    read_moment,
    refusing,
)
from gateway.cli.support.terminal import NEGATIVE_NUMBERS, console_of
from gateway.config import GatewaySettings
from gateway.edges.clock import GatewayClock
from gateway.edges.disk.fused_tlog import FusedTlog
from gateway.edges.disk.player import PlayerEdge, PlayerStatus, TlogFile
from gateway.edges.disk.recording_streams import FileKind, kind_of
from gateway.edges.disk.recordings import parts_together
from gateway.edges.hub.hub import Hub
from gateway.edges.operator.control_socket import ControlError, ControlServer, socket_path
from gateway.edges.operator.control_verbs import PlayerVerbs
from gateway.flightlog.moment import Moment, place_in
from gateway.flightlog.playback import AS_FAST_AS_POSSIBLE, Player, check_speed
from gateway.flightlog.track import Source, Track
from gateway.flights.reading import NO_RECORDING, FlightError, ReadOptions
from gateway.flights.refusion import Refusion, end_of
from gateway.records import Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.vehicle import Vehicle
from gateway.wire.mavlink_splitter import message_id_of

VIEW_INTERVAL_S: Final = 0.25
READY_S: Final = 3.0
"""A name that takes longer to be resolved is not waited for."""
READY_STEP_S: Final = 0.01
RESOLVING: Final = "resolving"
FIRST_GROUND_STATION: Final = 250
"""System ids from here on are by custom ground stations, which keep their id."""
FASTEST: Final = "max"


@dataclass(frozen=True, slots=True)
class PlayPlan:
    """How to play: range, speed, silences."""

    begin: Moment | None
    end: Moment | None
    speed: float
    max_gap_s: float | None
    loop: bool
    paused: bool


def register(app: typer.Typer) -> None:
    """Add the commands of this file."""
    app.command("play", rich_help_panel=PANEL)(play)
    app.command("seek", rich_help_panel=PANEL, context_settings=NEGATIVE_NUMBERS)(seek)
    app.add_typer(group, name="player", rich_help_panel=PANEL)


def play(
    files: Files,
    *,
    speed: Annotated[str, typer.Option("--speed", "-s", help="0.1 to 100, or max.")] = "1",
    begin: FromOption = None,
    end: ToOption = None,
    loop: Annotated[bool, typer.Option("--loop", help="Start anew at the end.")] = False,
    paused: Annotated[bool, typer.Option("--paused", help="Wait at the begin.")] = False,
    skip_gaps: Annotated[
        float | None, typer.Option("--skip-gaps", min=0, help="Shorten silences to so many s.")
    ] = None,
    system: Annotated[
        list[int] | None,
        typer.Option("--as", min=1, max=249, help="System id for the vehicle of each recording."),
    ] = None,
    settings: SettingsOption = "recorded",
    position: PositionOption = "causal",
    columns: ColumnsOption = None,
    endpoint: EndpointOption = None,
    config: ConfigOption = None,
) -> None:
    """Play recordings to the ground stations, several at once if you like.

    A tlog is sent byte for byte. A table is fused again while it plays, so the recorded flight and
    its re-fused twin can fly on one map; the parts of a recording are one flight. `mavgate seek`
    and `mavgate player` steer it meanwhile.
    """
    gateway = with_endpoints(read_settings(config), endpoint)
    with ExitStack() as opened, refusing():
        plan = PlayPlan(
            read_moment(begin), read_moment(end), _speed(speed), skip_gaps, loop, paused
        )
        today = pipeline_settings(read_settings(config))
        options = ReadOptions(today, settings, position, read_column_map(columns))
        with progress_of(files) as advance:
            flights = _open_all(files, replace(options, progress=advance), opened)
            tracks = _lay_out(flights, system or [])
            _prepare(tracks, plan)
        try:
            asyncio.run(_serve(gateway, tracks, plan, [file.name for file in files]))
        except ControlError as error:
            refuse(str(error))


group = typer.Typer(help="Steer the player that runs.", no_args_is_help=True)


def seek(
    to: Annotated[
        str, typer.Argument(help="80 or 1:20 from the begin, +10 or -0:30 from here, or a date.")
    ],
) -> None:
    """Move the player to a moment."""
    _show(ask("seek", {"to": to}, of="play"))


@group.command()
def pause() -> None:
    """Hold."""
    _show(ask("play.pause", of="play"))


@group.command()
def resume() -> None:
    """Go on."""
    _show(ask("play.resume", of="play"))


@group.command()
def step(count: Annotated[int, typer.Argument(min=1, help="Frames.")] = 1) -> None:
    """Pause and play the next frames."""
    _show(ask("play.step", {"count": count}, of="play"))


@group.command("speed")
def set_speed(speed: Annotated[str, typer.Argument(help="0.1 to 100, or max.")]) -> None:
    """Go on at another speed."""
    with refusing():
        value = _speed(speed)
    wanted = None if value == AS_FAST_AS_POSSIBLE else value
    _show(ask("play.speed", {"speed": wanted}, of="play"))


@group.command("loop")
def set_loop(
    *, on: Annotated[bool, typer.Option("--on/--off", help="Start anew at the end.")] = True
) -> None:
    """Start anew at the end, or not."""
    _show(ask("play.loop", {"on": on}, of="play"))


@group.command()
def status() -> None:
    """Tell what the player does."""
    _show(ask("play.status", of="play"))


class PlayerDaemon:
    """A player with its clients: frames of recordings out, answers to what clients ask.

    Parameters
    ----------
    settings : GatewaySettings
        The hub's and the vehicles'.
    player : Player
        What is due when.
    systems : iterable of int
        Ids of all that send in the recordings.
    files : sequence of str
        Names to show.
    now_us : GatewayClock
        The clock that the player was built on.
    """

    def __init__(
        self,
        settings: GatewaySettings,
        player: Player,
        systems: Iterable[int],
        files: Sequence[str],
        now_us: GatewayClock,
    ) -> None:
        self._now_us = now_us
        self._hub = Hub(settings.hub, self._on_frame, now_us)
        # A recording answers nothing, and ground stations wait for answers: parameters, mission.
        self._vehicles = [
            Vehicle(settings.vehicle, system_id)
            for system_id in systems
            if system_id < FIRST_GROUND_STATION
        ]
        self.ended = asyncio.Event()
        self.edge = PlayerEdge(player, self._send, now_us, files=files, on_end=self.ended.set)
        self._control = ControlServer(socket_path("play"))
        PlayerVerbs(self.edge).register(self._control)

    async def start(self) -> None:
        """Open everything; raises ControlError if another player runs."""
        await self._control.start()
        self._hub.start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(READY_S):
                while any(client.state == RESOLVING for client in self._hub.clients()):
                    await asyncio.sleep(READY_STEP_S)
        self.edge.start()

    def close(self) -> None:
        """End everything."""
        self.edge.close()
        self._control.close()
        self._hub.close()

    def _send(self, frames: Iterable[bytes]) -> None:
        for frame in frames:
            self._hub.send(Outgoing(frame, message_id_of(frame)))

    def _on_frame(self, incoming: Incoming) -> None:
        # What is over cannot be changed, whoever asks.
        harmless = replace(incoming, trusted=False)
        for vehicle in self._vehicles:
            for action in vehicle.handle(harmless, self._now_us()):
                if isinstance(action, Outgoing):
                    self._hub.send(action)


async def _serve(
    settings: GatewaySettings,
    tracks: Sequence[Track],
    plan: PlayPlan,
    files: Sequence[str],
) -> None:
    now_us = GatewayClock()
    first_us = min(track.first_us for track in tracks)
    player = Player(
        tracks,
        now_us(),
        speed=plan.speed,
        begin_us=None if plan.begin is None else place_in(plan.begin, first_us),
        end_us=None if plan.end is None else place_in(plan.end, first_us),
        max_gap_us=None if plan.max_gap_s is None else round(plan.max_gap_s * US_PER_S),
        loop=plan.loop,
    )
    # It waits for the network, and then if the user wants it to.
    player.pause(now_us())
    systems = sorted({system_id for track in tracks for system_id in track.systems})
    daemon = PlayerDaemon(settings, player, systems, files, now_us)
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, daemon.ended.set)
    try:
        await daemon.start()
        if not plan.paused:
            daemon.edge.resume()
        await _watch(daemon)
    finally:
        daemon.close()


async def _watch(daemon: PlayerDaemon) -> None:
    """Show the place until the end."""
    console = console_of()
    progress = Progress(
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[at]}")
    )
    task = progress.add_task("", total=1.0, at="")
    with Live(progress, console=console, auto_refresh=False, transient=True) as live:
        while not daemon.ended.is_set():
            status = daemon.edge.status()
            progress.update(
                task,
                description=status.state,
                completed=status.position_s,
                total=max(status.duration_s, 1e-3),
                at=_place(status),
            )
            if console.is_terminal:
                live.refresh()
            try:
                async with asyncio.timeout(VIEW_INTERVAL_S):
                    await daemon.ended.wait()
            except TimeoutError:
                continue
    console.print(f"ended: {_place(daemon.edge.status())}")


def _open_all(files: Sequence[Path], options: ReadOptions, opened: ExitStack) -> list[list[Source]]:
    """Index the tlogs, and begin to fuse what is none; the parts of a recording together."""
    flights: list[list[Source]] = []
    for parts in parts_together(files):
        sources: list[TlogFile | FusedTlog] = []
        if kind_of(parts[0]) is FileKind.TLOG:
            for file in parts:
                sources.append(TlogFile(file, options.progress))
                opened.callback(sources[-1].close)
        else:
            refusion = Refusion(parts, options)
            sources.append(FusedTlog(refusion.frames(), end_of(parts[-1], options)))
            opened.callback(sources[-1].close)
            for remark in refusion.remarks:
                console_of(stderr=True).print(f"{parts[0]}: {remark}", markup=False)
        for source, file in zip(sources, parts, strict=False):
            if not source.index.count:
                raise FlightError(f"{file}: {NO_RECORDING}")
        flights.append([*sources])
    return flights


def _prepare(tracks: Sequence[Track], plan: PlayPlan) -> None:
    """Fuse tables up to the begin that the user wants."""
    if plan.begin is not None:
        begin_us = place_in(plan.begin, min(track.first_us for track in tracks))
        while not all(track.prepare(begin_us) for track in tracks):
            pass


def _lay_out(flights: Sequence[Sequence[Source]], wished: Sequence[int]) -> list[Track]:
    """Give each vehicle its own system id, and recordings of other days the same begin."""
    begin_us, end_us = _span(flights[0])
    used: set[int] = set()
    tracks = []
    for number, sources in enumerate(flights):
        first_us, last_us = _span(sources)
        shift_us = 0 if first_us <= end_us and begin_us <= last_us else begin_us - first_us
        senders = {sender for source in sources for sender in source.index.systems}
        vehicles = sorted(sender for sender in senders if sender < FIRST_GROUND_STATION)
        system_ids: dict[int, int] = {}
        for place, system_id in enumerate(vehicles):
            wanted = wished[number] if place == 0 and number < len(wished) else system_id
            while wanted in used:
                wanted = wanted % (FIRST_GROUND_STATION - 1) + 1
            used.add(wanted)
            if wanted != system_id:
                system_ids[system_id] = wanted
        tracks += [Track(s, shift_us=shift_us, system_ids=system_ids) for s in sources]
    return tracks


def _span(sources: Sequence[Source]) -> tuple[int, int]:
    """Tell begin and end of a recording of several parts."""
    return (
        min(source.index.first_us or 0 for source in sources),
        max(source.last_us for source in sources),
    )


def _speed(text: str) -> float:
    if text == FASTEST:
        return AS_FAST_AS_POSSIBLE
    try:
        return check_speed(float(text))
    except ValueError as error:
        raise FlightError(f"--speed {text}: 0.1 to 100, or {FASTEST}") from error


def _place(status: PlayerStatus) -> str:
    speed = FASTEST if status.speed is None else f"{status.speed:g}x"
    return f"{status.position_s:.1f} of {status.duration_s:.1f} s, {speed}, {status.sent} frames"


def _show(status: dict[str, Any]) -> None:
    place = PlayerStatus(**{**status, "files": tuple(status["files"])})
    console_of().print(f"{place.state}: {_place(place)}", markup=False)
