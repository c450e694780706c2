"""A recording played beside the live aircraft: a `mavgate play` of the panel's own.

It is a process with a control socket of its own, sends its frames to a loopback port of the panel
and to nobody else, and its aircraft have system ids that no gateway gives out.
"""

import asyncio
import logging
import os
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from gateway.edges.disk.recordings import RecordingError, find_recording
from gateway.edges.operator.control_socket import ControlError
from gateway.flightlog.mapshape import thin_out
from gateway.flights.map_tracks import points_of_frames
from gateway.flights.reading import FlightError, recorded_frames
from gateway.panel.control_client import ControlClient
from gateway.panel.state.fleet_picture import FleetPicture
from gateway.panel.uplink import Uplink
from gateway.units import US_PER_S

log = logging.getLogger(__name__)

RECORDED_ID: Final = 201
TWIN_ID: Final = 202
"""Beyond the 31 of a gateway's aircraft, below the ground stations'."""
READY_S: Final = 120.0
"""A table of hours is opened in some seconds; a first start compiles."""
STEP_S: Final = 0.1
WATCH_S: Final = 0.25
PROFILE_POINTS: Final = 400
SPEEDS: Final = (0.25, 0.5, 1, 2, 5, 10, 50)


class PlaybackError(Exception):
    """A recording cannot be played; the text says why."""


@dataclass(frozen=True, slots=True)
class Profile:
    """The height over the time of a recording."""

    time_s: tuple[float, ...]
    """Since its begin."""
    alt_amsl_m: tuple[float, ...]


class Playback:
    """The recording that is played, for all pages.

    Parameters
    ----------
    uplink : Uplink
        Takes its frames.
    fleet : FleetPicture
        Where its aircraft appear.
    """

    def __init__(self, uplink: Uplink, fleet: FleetPicture) -> None:
        self.name = ""
        """Of the recording; empty while none is open."""
        self.has_twin = False
        self.profile = Profile((), ())
        self.status: dict[str, Any] | None = None
        """As `play.status` answers."""
        self._uplink = uplink
        self._fleet = fleet
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._child: asyncio.subprocess.Process | None = None
        self._control: ControlClient | None = None
        self._watching: asyncio.Task[None] | None = None

    async def open(self, folder: Path, name: str, *, twin: bool) -> None:
        """Open a recording, in place of the one that is open.

        Parameters
        ----------
        folder : Path
            Of the recordings.
        name : str
            Of one that is there.
        twin : bool
            Whether it is fused again too, and flies beside itself.

        Raises
        ------
        PlaybackError
            If it cannot be played.
        """
        self.close()
        try:
            files = find_recording(folder, name).files
        except RecordingError as error:
            raise PlaybackError(str(error)) from error
        tlogs = [file for file in files if file.suffix == ".tlog"]
        tables = [file for file in files if file.suffix == ".csv"]
        played = [*tlogs, *(tables if twin or not tlogs else [])]
        ids = [RECORDED_ID] * bool(tlogs) + [TWIN_ID] * (len(played) > len(tlogs))
        self.name, self.has_twin = name, len(ids) > 1
        self._name_aircraft(ids)
        self.profile = await asyncio.to_thread(_profile_of, tlogs or tables)
        await self._start(played, ids)

    def close(self) -> None:
        """End the playback; its aircraft go."""
        if self._watching is not None and self._watching is not asyncio.current_task():
            self._watching.cancel()
        if self._child is not None and self._child.returncode is None:
            with suppress(ProcessLookupError):
                self._child.terminate()
        if self._folder is not None:
            self._folder.cleanup()
        self._child = self._folder = self._control = self._watching = self.status = None
        self.name, self.profile = "", Profile((), ())
        for system_id in (RECORDED_ID, TWIN_ID):
            self._fleet.forget(system_id)

    async def order(self, verb: str, **params: Any) -> None:
        """Give the player an order; see docs/control.md.

        Raises
        ------
        PlaybackError
            If none plays, or it refuses.
        """
        if self._control is None:
            raise PlaybackError("no recording is open")
        try:
            self.status = await self._control.ask(verb, **params)
        except ControlError as error:
            raise PlaybackError(str(error)) from error
        if verb == "seek":
            # The way to another moment was never flown.
            for system_id in (RECORDED_ID, TWIN_ID):
                if vehicle := self._fleet.vehicles.get(system_id):
                    vehicle.begin_anew()

    async def refresh(self) -> None:
        """Ask the player where it is; a player that has ended is closed."""
        if self._child is not None and self._child.returncode is not None:
            self.close()
        elif self._control is not None:
            with suppress(PlaybackError):
                await self.order("play.status")

    def _name_aircraft(self, ids: Sequence[int]) -> None:
        origins = {RECORDED_ID: "recorded", TWIN_ID: "re-fused"}
        self._fleet.origins.update({key: origins[key] for key in ids})

    async def _start(self, files: Sequence[Path], ids: Sequence[int]) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="mavgate-playback-")
        socket = Path(self._folder.name) / "mavgate" / "play.sock"
        arguments = ["play", *map(str, files), "--loop"]
        arguments += ["--endpoint", f"udp:127.0.0.1:{self._uplink.playback_port}"]
        for system_id in ids:
            arguments += ["--as", str(system_id)]
        self._child = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "gateway.cli", *arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=asyncio.subprocess.DEVNULL,
            stderr=asyncio.subprocess.PIPE,
            env=os.environ | {"XDG_RUNTIME_DIR": self._folder.name},
        )
        self._control = ControlClient(socket)
        try:
            async with asyncio.timeout(READY_S):
                while not socket.exists() and self._child.returncode is None:
                    await asyncio.sleep(STEP_S)
        except TimeoutError:
            log.warning("the player does not begin in %.0f s", READY_S)
        if self._child.returncode is not None or not socket.exists():
            text = await self._complaint()
            self.close()
            raise PlaybackError(text)
        await self.order("play.status")
        self._watching = asyncio.create_task(self._watch())

    async def _watch(self) -> None:
        """Follow the player until it has ended."""
        while self._child is not None:
            await self.refresh()
            await asyncio.sleep(WATCH_S)

    async def _complaint(self) -> str:
        """Read why the player ended."""
        if self._child is None or self._child.stderr is None or self._child.returncode is None:
            return "the player does not begin"
        text = (await self._child.stderr.read()).decode(errors="replace").strip()
        return text.splitlines()[-1] if text else "the player ended"


def _profile_of(files: Sequence[Path]) -> Profile:
    """Read the heights of a recording; none where it has no positions."""
    if not files or files[0].suffix != ".tlog":
        return Profile((), ())
    try:
        first_us, points = None, []
        for record in recorded_frames(files[:1], None):
            first_us = record.time_us
            break
        points = list(thin_out(points_of_frames(recorded_frames(files, None), None)))
    except (OSError, FlightError):
        return Profile((), ())
    if first_us is None or not points:
        return Profile((), ())
    every = max(1, len(points) // PROFILE_POINTS)
    kept = points[::every]
    return Profile(
        tuple((point.time_us - first_us) / US_PER_S for point in kept),
        tuple(point.alt_amsl_m for point in kept),
    )
