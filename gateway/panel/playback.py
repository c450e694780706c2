"""Playback of a recording next to the live aircraft, by a separate `mavgate play`.

The player is a process with its own control socket, sends its frames only to a loopback port of the
panel, and its aircraft get system ids that no live one has.
"""

import asyncio
import logging
import os
import tempfile
from collections import defaultdict
from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from gateway.live.control_socket import ControlError
from gateway.live.terminal import own_command
from gateway.panel.state.fleet import FleetState, Origin
from gateway.panel.uplink import ControlClient, Uplink
from gateway.recordings.files import FlightError
from gateway.recordings.flight_facts import FlightTrackPoints
from gateway.recordings.index import RecordingError, find_recording, parts_together
from gateway.recordings.recording import open_recordings
from gateway.recordings.summary import read_summary
from gateway.units import US_PER_S
from gateway.vehicle_state.senders import FIRST_GROUND_STATION

log = logging.getLogger(__name__)

PROFILE_POINTS: Final = 400
RECORDED: Final = "recorded"
FUSED_AGAIN: Final = "fused again"
READY_S: Final = 120.0
"""Timeout of the start of a player: a table of hours takes some seconds. A failing player ends
earlier."""
STEP_S: Final = 0.1
WATCH_S: Final = 0.25
LEAP_S: Final = 0.5
"""A larger backward step is not jitter of the player's clock, but a loop or a seek."""
MAX_PLAYERS: Final = 4
"""Maximum players, each of which is a process."""
SPEEDS: Final = (0.25, 0.5, 1, 2, 5, 10, 50)


@dataclass(frozen=True, slots=True)
class Profile:
    """Height over time."""

    time_s: tuple[float, ...] = ()
    """Time since the begin of the recording."""
    alt_amsl_m: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class RecordedAircraft:
    """One aircraft of a recording."""

    recorded_id: int
    origin: str
    """`RECORDED`, or `FUSED_AGAIN` if it is fused again during playback."""
    profile: Profile
    """Its height; empty if none was recorded."""


def recorded_aircraft(files: Sequence[Path]) -> list[list[RecordedAircraft]]:
    """Read the aircraft of the files: a list for each flight that a player makes of them.

    Raises OSError or FlightError if a file cannot be read.
    """
    return [_aircraft_of(parts) for parts in parts_together(files)]


def free_ids(count: int, taken: Collection[int]) -> range:
    """Find the highest consecutive free system ids.

    Raises ValueError if there are not enough.
    """
    for first in range(FIRST_GROUND_STATION - count, 0, -1):
        wanted = range(first, first + count)
        if not any(system_id in wanted for system_id in taken):
            return wanted
    raise ValueError(f"{count} more aircraft do not fit next to those that are shown")


def _aircraft_of(parts: Sequence[Path]) -> list[RecordedAircraft]:
    recordings = open_recordings(parts)
    found = [*map(read_summary, recordings)]
    begin_us = next((one.info.first_us for one in found if one.info.first_us is not None), 0)
    origin = FUSED_AGAIN if recordings[0].is_own else RECORDED
    points: defaultdict[int, list[FlightTrackPoints]] = defaultdict(list)
    for one in found:
        for system_id, tally in one.tallies.items():
            points[system_id].append(tally.points())
    return [
        RecordedAircraft(system_id, origin, _profile(some, begin_us))
        for system_id, some in sorted(points.items())
    ]


def _profile(parts: Sequence[FlightTrackPoints], begin_us: int) -> Profile:
    time_us = np.concatenate([part.time_us for part in parts])
    alt_m = np.concatenate([part.alt_amsl_m for part in parts])
    known = np.flatnonzero(np.isfinite(alt_m))
    known = known[:: max(1, len(known) // PROFILE_POINTS)]
    seconds = (time_us[known] - begin_us) / US_PER_S
    return Profile(tuple(seconds.tolist()), tuple(alt_m[known].tolist()))


class PlaybackError(Exception):
    """A recording cannot be played; the text gives the reason."""


class Playback:
    """The recording that one page plays."""

    def __init__(self, uplink: Uplink, fleet: FleetState, page: str) -> None:
        self._page = page
        self.name = ""
        """Name of the recording; empty while none is open."""
        self.aircraft: dict[int, RecordedAircraft] = {}
        """The played aircraft by their played system ids."""
        self.status: dict[str, Any] | None = None
        """Result of `play.status`."""
        self._uplink = uplink
        self._fleet = fleet
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._child: asyncio.subprocess.Process | None = None
        self._control: ControlClient | None = None
        self._watching: asyncio.Task[None] | None = None
        self._opening, self._ordering = asyncio.Lock(), asyncio.Lock()

    @property
    def has_fused_again(self) -> bool:
        """Whether an aircraft is fused again."""
        return any(one.origin == FUSED_AGAIN for one in self.aircraft.values())

    async def open(self, folder: Path, name: str, *, fused_again: bool) -> None:
        """Open a recording, instead of the present one.

        Raises PlaybackError if it cannot be played.
        """
        async with self._opening:
            self.close()
            players = {origin.page for origin in self._fleet.origins.values()}
            if len(players) >= MAX_PLAYERS:
                raise PlaybackError(
                    f"{len(players)} other pages play recordings; close one of them first"
                )
            await self._open(folder, name, fused_again=fused_again)

    async def _open(self, folder: Path, name: str, *, fused_again: bool) -> None:
        try:
            files = find_recording(folder, name).files
        except RecordingError as error:
            raise PlaybackError(str(error)) from error
        tlogs = [file for file in files if file.suffix == ".tlog"]
        tables = [file for file in files if file.suffix == ".csv"]
        played = [*tlogs, *(tables if fused_again or not tlogs else [])]
        try:
            flights = await asyncio.to_thread(recorded_aircraft, played)
            firsts = self._number(flights)
        except (FlightError, OSError, ValueError) as error:
            raise PlaybackError(f"{name}: {error}") from error
        self.name = name
        await self._start(played, firsts)

    def close(self) -> None:
        """End the playback and remove its aircraft."""
        if self._watching is not None and self._watching is not asyncio.current_task():
            self._watching.cancel()
        if self._child is not None and self._child.returncode is None:
            with suppress(ProcessLookupError):
                self._child.terminate()
        if self._folder is not None:
            self._folder.cleanup()
        self._child = self._folder = self._control = self._watching = self.status = None
        self.name = ""
        for system_id in self.aircraft:
            self._fleet.discard(system_id)
        self.aircraft = {}

    async def order(self, verb: str, **params: Any) -> None:
        """Send the player a request; see docs/control.md.

        Raises PlaybackError if no player runs, or it refuses the request.
        """
        async with self._ordering:
            await self._order(verb, params)

    async def toggle(self) -> None:
        """Pause or resume; raises as `order`."""
        async with self._ordering:
            playing = (self.status or {}).get("state") == "playing"
            await self._order("play.pause" if playing else "play.resume", {})

    async def _order(self, verb: str, params: dict[str, Any]) -> None:
        """Send one request, and store its answer as the player's present state.

        One request at a time: otherwise an earlier answer could arrive after a later one.
        """
        control, before = self._control, self.status
        if control is None:
            raise PlaybackError("no recording is open")
        try:
            status = await control.ask(verb, **params)
        except ControlError as error:
            raise PlaybackError(str(error)) from error
        if control is not self._control:
            # Closed during the request.
            return
        self.status = status
        went_back = before is not None and (status["position_s"] < before["position_s"] - LEAP_S)
        if verb == "seek" or went_back:
            # A seek must not be drawn as a path.
            for system_id in self.aircraft:
                if vehicle := self._fleet.vehicles.get(system_id):
                    vehicle.restart_path()

    async def refresh(self) -> None:
        """Poll the player's status; a player that has ended is closed."""
        if self._child is not None and self._child.returncode is not None:
            self.close()
        elif self._control is not None:
            with suppress(PlaybackError):
                await self.order("play.status")

    def _number(self, flights: Sequence[Sequence[RecordedAircraft]]) -> list[int]:
        """Assign free system ids to the aircraft; return the first id of each flight."""
        firsts = []
        for flight in flights:
            ids = free_ids(
                len(flight), {*self._fleet.vehicles, *self._fleet.origins, *self.aircraft}
            )
            firsts.append(ids.start)
            self.aircraft.update(zip(ids, flight, strict=True))
        self._fleet.origins.update(
            {
                key: Origin(one.origin, one.recorded_id, self._page)
                for key, one in self.aircraft.items()
            }
        )
        return firsts

    async def _start(self, files: Sequence[Path], firsts: Sequence[int]) -> None:
        self._folder = tempfile.TemporaryDirectory(
            prefix="mavgate-playback-", ignore_cleanup_errors=True
        )
        socket = Path(self._folder.name) / "mavgate" / "play.sock"
        arguments = ["play", *map(str, files), "--loop", "--attached"]
        arguments += ["--endpoint", f"udp:127.0.0.1:{self._uplink.playback_port}"]
        for system_id in firsts:
            arguments += ["--id", str(system_id)]
        child = self._child = await asyncio.create_subprocess_exec(
            *own_command(*arguments),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env=os.environ | {"XDG_RUNTIME_DIR": self._folder.name},
        )
        self._control = ControlClient(socket)
        try:
            async with asyncio.timeout(READY_S):
                while self.status is None and child.returncode is None:
                    await asyncio.sleep(STEP_S)
                    # The socket exists shortly before the player answers.
                    with suppress(PlaybackError):
                        await self.order("play.status")
        except TimeoutError:
            log.warning("the player does not start in %.0f s", READY_S)
        if self._child is not child:
            # Closed during the start.
            return
        if self.status is None:
            text = await self._failure()
            self.close()
            raise PlaybackError(text)
        self._watching = asyncio.create_task(self._watch())

    async def _watch(self) -> None:
        while self._child is not None:
            await self.refresh()
            await asyncio.sleep(WATCH_S)

    async def _failure(self) -> str:
        if self._child is None or self._child.stderr is None or self._child.returncode is None:
            return "the player does not start"
        text = (await self._child.stderr.read()).decode(errors="replace").strip()
        return text.splitlines()[-1] if text else "the player ended"
