"""Composition root of the player: opens recordings and plays their vehicles to a hub.

It corresponds to `daemon.py`, for playback from the command line, the panel, or a test.
"""

import asyncio
import contextlib
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from gateway.aircraft import Aircraft
from gateway.answers.log_answers import VehicleAnswers
from gateway.clock import GatewayClock
from gateway.config import GatewaySettings
from gateway.hub.endpoint import parse_endpoint, stays_here
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.live.control_socket import ControlServer, socket_path
from gateway.live.other_gateways import identity_verb
from gateway.live.player_edge import PlayerEdge
from gateway.recordings.files import FlightError
from gateway.recordings.moment import Moment, time_us_of
from gateway.recordings.opening import PlayedFlight
from gateway.recordings.play import Player
from gateway.recordings.workshop.selection import NOTHING_WITHIN
from gateway.records import ClientInterval, Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.recorded_vehicle import RecordedAction, RecordedVehicle
from gateway.vehicle.request_reader import BROADCAST
from gateway.vehicle.services.parameters import Metadata
from gateway.vehicle_state.senders import AUTOPILOT
from gateway.wire.frame_editing import renumbered
from gateway.wire.mavlink_splitter import frame_of, message_id_of

READY_S: Final = 3.0
"""Maximum time to wait for names to be resolved."""
READY_STEP_S: Final = 0.01
MAX_COMPONENTS: Final = 32
"""Maximum number of components that answer in addition to the vehicles."""
RESOLVING: Final = "resolving"
REFUSED: Final = "refused"


@dataclass(frozen=True, slots=True)
class PlayPlan:
    """Options of a playback: range, speed, gaps, and messages to play."""

    begin: Moment | None = None
    end: Moment | None = None
    speed: float = 1.0
    max_gap_s: float | None = None
    loop: bool = False
    paused: bool = False
    with_commands: bool = False
    """Also play messages of ground stations, and other requests to a vehicle."""
    commands_anywhere: bool = False
    """Allow recorded commands to leave this machine; the user has confirmed it."""


def prepare(flights: Sequence[PlayedFlight], plan: PlayPlan) -> None:
    """Fuse tables up to the requested start; raises FlightError if nothing is to be played."""
    tracks = [track for flight in flights for track in flight.tracks]
    first_us = begin_us = min(track.first_us for track in tracks)
    if plan.begin is not None:
        begin_us = max(time_us_of(plan.begin, first_us), first_us)
        while not all(track.prepare(begin_us) for track in tracks):
            pass
        if begin_us > (end_us := max(track.last_us for track in tracks)):
            raise FlightError(
                f"it ends after {(end_us - first_us) / US_PER_S:.1f} s, before --from"
            )
    if plan.end is not None and time_us_of(plan.end, first_us) < begin_us:
        raise FlightError(NOTHING_WITHIN)


def endpoints_beyond(settings: HubSettings) -> list[str]:
    """Return the endpoints on other machines."""
    return [url for url in settings.endpoints if not stays_here(parse_endpoint(url))]


class PlayerDaemon:
    """A player with its clients: sends frames of recordings, and answers clients' requests.

    Raises ValueError if recorded commands would leave this machine without the user's consent.
    """

    def __init__(
        self,
        settings: GatewaySettings,
        flights: Sequence[PlayedFlight],
        plan: PlayPlan,
        files: Sequence[str],
    ) -> None:
        if plan.with_commands and not plan.commands_anywhere and endpoints_beyond(settings.hub):
            raise ValueError("recorded commands stay on this machine unless the user confirms")
        self._now_us = GatewayClock()
        self._plan = plan
        self._player = self._make_player(flights)
        self._hub = Hub(
            settings.hub, self._on_frame, self._now_us, on_gone=self._on_gone, keeps_order=True
        )
        self._numbering = _Numbering()
        metadata = Aircraft(1, settings.default_aircraft).vehicle.metadata
        self._vehicles = self._make_vehicles(flights, metadata)
        self._timer: asyncio.TimerHandle | None = None
        self.ended = asyncio.Event()
        self.edge = PlayerEdge(
            self._player,
            self._send,
            self._now_us,
            repeat=self._repeat,
            files=files,
            on_end=self.ended.set,
        )
        played = sorted({vehicle.system_id for vehicle in self._vehicles})
        identity = identity_verb(lambda: played, self._hub.endpoints)
        self._control = ControlServer(socket_path("play"), identity, self.edge.verbs())

    async def start(self) -> None:
        """Open everything and start.

        Raises ControlError without a control socket, FlightError if no name can be resolved.
        """
        await self._control.start()
        asyncio.get_running_loop().set_default_executor(_LookUps())
        self._hub.start()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(READY_S):
                while any(c.state == RESOLVING and not c.reason for c in self._hub.clients()):
                    await asyncio.sleep(READY_STEP_S)
        unknown = [client for client in self._hub.clients() if client.state == RESOLVING]
        if unknown and len(unknown) == len(self._hub.endpoints()):
            reasons = {client.reason or "its address is not known yet" for client in unknown}
            names = ", ".join(client.name for client in unknown)
            raise FlightError(f"nothing can be sent to {names}: {'; '.join(sorted(reasons))}")
        self.edge.start()
        if not self._plan.paused:
            self.edge.resume()

    def troubles(self) -> set[str]:
        """Describe the clients that do not receive, such as those of a port without a listener."""
        found = ((one.name, one.reason, one.state) for one in self._hub.clients())
        return {
            f"{name}: {reason or state}" for name, reason, state in found
            if reason or state == REFUSED
        }  # fmt: skip

    def close(self) -> None:
        """Close everything."""
        if self._timer is not None:
            self._timer.cancel()
        self.edge.close()
        self._control.close()
        self._hub.close()

    def _make_player(self, flights: Sequence[PlayedFlight]) -> Player:
        plan = self._plan
        tracks = [track for flight in flights for track in flight.tracks]
        first_us = min(track.first_us for track in tracks)
        player = Player(
            tracks,
            self._now_us(),
            speed=plan.speed,
            begin_us=None if plan.begin is None else time_us_of(plan.begin, first_us),
            end_us=None if plan.end is None else time_us_of(plan.end, first_us),
            max_gap_us=None if plan.max_gap_s is None else round(plan.max_gap_s * US_PER_S),
            loop=plan.loop,
        )
        # Pause until the network is ready, and longer if the user wants to start paused.
        player.pause(self._now_us())
        return player

    def _make_vehicles(
        self, flights: Sequence[PlayedFlight], metadata: Metadata
    ) -> list[RecordedVehicle]:
        """Build the components that answer, up to a limit: first the vehicles of all systems."""
        systems = [(flight, *ids) for flight in flights for ids in flight.system_ids.items()]
        vehicles: list[RecordedVehicle] = []
        others: list[RecordedVehicle] = []
        for flight, system_id, played_as in systems:
            vehicle, *rest = flight.answers.components(system_id)
            answers = partial(self._answers_of, flight, system_id, played_as)
            others += [
                RecordedVehicle(played_as, answers(component), components=(component,))
                for component in rest[: MAX_COMPONENTS - len(others)]
            ]
            shared = (BROADCAST, *({AUTOPILOT} - {vehicle, *rest}))
            own, ids = metadata.of(played_as), (vehicle, *shared)
            vehicles.append(RecordedVehicle(played_as, answers(vehicle), own, components=ids))
        return vehicles + others

    def _answers_of(
        self, flight: PlayedFlight, system_id: int, played_as: int, component: int
    ) -> VehicleAnswers:
        return VehicleAnswers(
            flight.answers,
            system_id,
            played_as,
            lambda: self._player.position_us - flight.shift_us,
            component,
            self._player.newest,
        )

    def _send(self, frames: Iterable[bytes]) -> None:
        self._hub.send_all(
            Outgoing(self._numbering.played(frame), message_id_of(frame)) for frame in frames
        )

    def _repeat(self, frames: Iterable[bytes]) -> None:
        self._hub.send_all(
            Outgoing(self._numbering.inserted(frame), message_id_of(frame)) for frame in frames
        )

    def _on_frame(self, incoming: Incoming) -> None:
        for vehicle in self._vehicles:
            self._perform(vehicle.handle(incoming, self._now_us()))
        self._poll()

    def _on_gone(self, client_id: int) -> None:
        for vehicle in self._vehicles:
            vehicle.remove_client(client_id)

    def _perform(self, actions: Iterable[RecordedAction]) -> None:
        answers: list[Outgoing] = []
        for action in actions:
            if isinstance(action, ClientInterval):
                self._hub.set_interval(action)
            else:
                frame = self._numbering.inserted(action.frame)
                answers.append(Outgoing(frame, action.message_id, action.client_id))
        self._hub.send_all(answers)

    def _poll(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        for vehicle in self._vehicles:
            self._perform(vehicle.poll(self._now_us()))
        due_us = min(
            (due for vehicle in self._vehicles if (due := vehicle.next_due_us()) is not None),
            default=None,
        )
        if due_us is not None:
            wait_s = max(due_us - self._now_us(), 0) / US_PER_S
            self._timer = asyncio.get_running_loop().call_later(wait_s, self._poll)


class _LookUps(ThreadPoolExecutor):
    """Resolve names in daemon threads, so that the process can exit while a resolver is waiting."""

    def submit(self, work: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Start a job in its own thread; each client has at most one."""
        job: Future[Any] = Future()
        job.set_running_or_notify_cancel()

        def run() -> None:
            try:
                job.set_result(work(*args, **kwargs))
            except OSError as error:
                job.set_exception(error)

        threading.Thread(target=run, daemon=True).start()
        return job


class _Numbering:
    """Renumber frames, so that inserted frames do not appear as losses.

    Frames of a sender are played byte for byte until its first inserted frame.
    """

    def __init__(self) -> None:
        self._last: dict[tuple[int, int], int] = {}
        self._added: dict[tuple[int, int], int] = {}

    def played(self, frame: bytes) -> bytes:
        """Return a recorded frame, renumbered after inserted answers."""
        read = frame_of(frame)
        added = self._added.get(read.origin, 0)
        sequence = self._last[read.origin] = read.sequence + added & 0xFF
        return renumbered(read, sequence).data if added else frame

    def inserted(self, frame: bytes) -> bytes:
        """Return an answer or a repeated frame, numbered to fit between the recorded frames."""
        read = frame_of(frame)
        sequence = self._last[read.origin] = self._last.get(read.origin, 0xFF) + 1 & 0xFF
        self._added[read.origin] = self._added.get(read.origin, 0) + 1
        return renumbered(read, sequence).data
