"""The recorder: records the traffic of the gateway without delaying it.

Linux has no way to write to a disk without waiting for it: a card that cleans up, or a network
folder, blocks for seconds. So two other threads do all disk work, with immutable values, and the
event loop buffers the next bytes meanwhile, up to a limit.

Every `flush_s` one thread gives the buffered bytes to the kernel, where they survive a crash of the
gateway; every `sync_s` the other has the kernel write them to the disk, where they survive a power
loss, and it closes, renames and copies finished files. So no write waits for a slow sync, and the
next sync begins once the last has ended.
"""

import asyncio
import contextlib
import logging
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Final

import msgspec

from gateway.hub.forwarding import Forwarding
from gateway.live.kept_files import begin_worker, done_by
from gateway.live.part import PENDING_LIMIT, Part
from gateway.live.part_files import DiskState, PartFiles, close_behind, free_bytes_near, reason_of
from gateway.live.restamper import clear_copies, shift_times
from gateway.live.session import (
    Announce,
    ClosePart,
    CorrectTimes,
    OpenPart,
    RecordingSettings,
    Session,
    SessionAction,
    SessionState,
    VehicleLocations,
    label_of,
    session_name,
)
from gateway.output import sync_folder
from gateway.printable import without_folders
from gateway.recordings.index import RecordingError, find_recording, move_recording, part_of
from gateway.recordings.recorded_clock import CivilClock
from gateway.recordings.table import NOTE, TableHeader, TableNote
from gateway.records import BaroRaw, FusedSample, FusionState, GpsFix, NodeStatus
from gateway.status import RecorderStatus
from gateway.units import US_PER_S

log = logging.getLogger(__name__)
HELD_US: Final = 30 * US_PER_S
"""In the mode `armed`, the least time before arming that is recorded, and half the most."""
HELD_BYTES: Final = PENDING_LIMIT // 4
"""Maximum bytes held of a stretch, plus one turn's: faster telemetry is held for less time."""


class Recorder:
    """Record MAVLink and flights.

    `now_us` and `unix_us` return the gateway clock and the machine's civil time; `header_of` the
    head of a vehicle's table, which gets its session, part and start here; `state_of` the state of
    a vehicle's fusion after all records passed to `flight`; `introduction_of` the frames of a
    vehicle that every part begins with: version, modes, parameters, missions, home; `vehicles_of`
    latitude and longitude of the homes of own aircraft, or None, by id; `armed_of` those of all
    vehicles that report to be armed. `announce` is called with whether it is a problem, and a text
    for the user, `on_change` when `takes_frames` may have changed. Without `gps_time`, the time of
    GPS is ignored and the machine's is used.
    """

    def __init__(
        self,
        settings: RecordingSettings,
        now_us: Callable[[], int],
        unix_us: Callable[[], int],
        header_of: Callable[[int], TableHeader],
        announce: Callable[[bool, str], None],
        state_of: Callable[[int], FusionState | None] = lambda _: None,
        introduction_of: Callable[[int], list[bytes]] = lambda _: [],
        vehicles_of: Callable[[], VehicleLocations] = dict,
        armed_of: Callable[[], VehicleLocations] = dict,
        on_change: Callable[[], None] = lambda: None,
        *,
        gps_time: bool = True,
    ) -> None:
        self._settings = settings
        self._clock, self._machine_us = now_us, unix_us
        self._header_of = header_of
        self._announce = announce
        self._state_of, self._introduction_of = state_of, introduction_of
        self._vehicles_of, self._armed_of, self._on_change = vehicles_of, armed_of, on_change
        self._gps_time = gps_time
        self._session = Session(settings)
        self._civil = CivilClock()
        self._seen: set[int] = set()
        self._present: Part | None = None
        self._memory: deque[Part] = deque()
        """The data before arming, in two parts whose begins differ by half its length."""
        self._holds = settings.mode == "armed"
        self._files: PartFiles | None = None
        self._disk = DiskState(0, 0)
        self._sync_due_us = 0
        self._syncing: Future[None] | None = None
        """The sync that is running, or has ended since the last flush."""
        self._writer, self._syncer = begin_worker("recorder"), begin_worker("syncer")
        self._wake = asyncio.Event()
        self._turned = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self._offsets: dict[int, int] = {}
        """Civil time of gateway time zero used in each part of the session."""
        self._restamper = begin_worker("restamper")
        self._restamping: list[Future[None]] = []
        self._closing: Future[None] | None = None
        self.folder = Path(settings.folder).expanduser()
        """Folder of the recordings."""

    def start(self) -> None:
        """Start; needs a running event loop."""
        clear_copies(self.folder)
        self._civil.update_machine(self._machine_us(), self._clock())
        self._hold()
        if self._session.wanted:
            # Called directly: nothing can be delayed yet, and a table should begin with the first
            # sample of the estimator.
            self._open_at_once()
        self._task = asyncio.get_running_loop().create_task(self._run())

    def close(self) -> None:
        """Write the pending data and end; waits for the disk."""
        if self._task is not None:
            self._task.cancel()
        self._writer.shutdown(wait=True)
        self._syncer.shutdown(wait=True)
        files, self._files = self._files, None
        try:
            if files is not None and self._part is not None:
                self._part.flush_rows()
                files.close(self._part.take())
            self._check_sync()
        except OSError as error:
            log.warning("Recording: the last bytes are lost: %s", reason_of(error))
        self._restamper.shutdown(wait=True)

    async def settle(self) -> None:
        """Wait until all requests so far have been carried out."""
        # The present turn may have begun before the request.
        for _ in range(2):
            self._turned.clear()
            self._wake.set()
            await self._turned.wait()

    def record(self) -> None:
        """Record until `stop`, whatever the setting `mode`; opens files at the next turn."""
        self._session.start()
        self._wake.set()

    def stop(self) -> None:
        """Stop recording until the next request or flight."""
        self._session.stop()
        self._wake.set()

    def set_in_flight(self, *, in_flight: bool, operates: bool) -> None:
        """Note whether an own aircraft is in flight, and whether one is armed."""
        if self._holds:
            # The armed bit of own aircraft may follow the recording. Some of them report an
            # autopilot's state, and have no samples.
            own = self._seen | self._vehicles_of().keys()
            in_flight = operates or bool(self._armed_of().keys() - own)
        self._session.set_in_flight(in_flight)

    def note(self, text: str) -> bool:
        """Send a note, and add it to the recording at this moment; return whether one runs."""
        for part in self._parts():
            part.add_note(TableNote(self._clock(), text))
        self._announce(False, NOTE + text)
        return self._part is not None

    async def save(self, name: str) -> None:
        """Rename the present or last session.

        Raises RecordingError if there is none, or the name is taken or invalid.
        """
        if not self._session.name:
            raise RecordingError("nothing was recorded since the gateway started")
        await self._restamped()
        old, files = self._session.name, self._files
        if files is None:
            await done_by(self._syncer, move_recording, self.folder, old, name)
        else:
            await done_by(self._writer, files.rename, name)
        self._session.name = name
        if self._part is not None:
            self._part.session = name
        # Not in the thread that writes.
        await done_by(self._syncer, sync_folder, self.folder)

    def status(self) -> RecorderStatus:
        """Return the present state."""
        session, disk = self._session, self._disk
        return RecorderStatus(
            state=session.state.value,
            name=session.name,
            part=session.part,
            duration_s=session.duration_s,
            part_bytes=disk.part_bytes,
            free_bytes=disk.free_bytes,
            reason=session.reason,
            folder=str(self.folder),
            mode=self._settings.mode,
            held_s=(self._clock() - self._memory[0].begin_us) / US_PER_S if self._memory else 0.0,
        )

    @property
    def expected(self) -> bool:
        """Whether a user expects a recording now."""
        return self._session.expected

    @property
    def trouble(self) -> str:
        """Why nothing can be recorded at the moment, or empty."""
        return self._session.reason if self._session.state is SessionState.BLOCKED else ""

    @property
    def recording(self) -> bool:
        """Whether a recording runs, and its first bytes are written."""
        return self._session.state is SessionState.RECORDING and self._disk.part_bytes > 0

    def frame(self, frame: bytes) -> None:
        """Record a MAVLink frame that was sent or received."""
        for part in self._parts() if self._settings.tlog else ():
            part.add_frame(frame, self._clock())

    @property
    def takes_frames(self) -> bool:
        """Whether frames are recorded at the moment, or held in memory."""
        return self._settings.tlog and (self._part is not None or self._holds)

    @property
    def _part(self) -> Part | None:
        """The part that is being written."""
        return self._present

    @_part.setter
    def _part(self, part: Part | None) -> None:
        self._present = part
        self._on_change()

    def run(self, run: Forwarding) -> None:
        """Record frames that the hub has forwarded together."""
        for part in self._parts() if self._settings.tlog else ():
            part.add_run(run, self._clock())

    def flight(self, record: BaroRaw | GpsFix | FusedSample | NodeStatus) -> None:
        """Record a sample of the estimator, or the resulting state."""
        if isinstance(record, FusedSample):
            vehicle_id = record.vehicle_id
        else:
            vehicle_id = record.node.vehicle_id
            if self._gps_time and isinstance(record, GpsFix) and record.utc_us is not None:
                self._civil.update_gps(vehicle_id, record.utc_us, record.time_us)
        for part in self._parts():
            if self._settings.tlog and vehicle_id not in part.introduced:
                part.introduced.add(vehicle_id)
                for frame in self._introduction_of(vehicle_id):
                    part.add_frame(frame, self._clock())
            if self._settings.table:
                if vehicle_id not in part.tables:
                    part.prepare_table(self._header(vehicle_id, part))
                part.add_flight(vehicle_id, record)
        self._seen.add(vehicle_id)

    def settings_changed(self, vehicle_id: int) -> None:
        """Note that the following samples are fused with other settings, in a new header line."""
        for part in self._parts():
            if vehicle_id in part.tables:
                part.change_settings(self._header(vehicle_id, part))

    def _parts(self) -> list[Part]:
        return [*self._memory] if self._part is None else [self._part]

    def _hold(self) -> None:
        """Discard the oldest stretch in memory, and begin to hold the next one."""
        if not self._holds:
            return
        if self._part is not None or any(p.stamper.has_jumped(self._civil) for p in self._parts()):
            self._memory.clear()
        now_us = self._clock()
        newest = self._memory[-1] if self._memory else None
        is_full = newest and (now_us - newest.begin_us >= HELD_US or newest.size > HELD_BYTES)
        if self._part is None and (newest is None or is_full):
            begun = session_name(now_us + (self._civil.offset_us or 0))
            self._memory.append(self._begin_part(begun, 1))
        while len(self._memory) > 2:
            self._memory.popleft()

    def _new_part(self, session: str, number: int) -> Part:
        """Start buffering for a part; the first of a session begins with the data in memory."""
        if number == 1:
            self._offsets.clear()
        if number == 1 and self._memory:
            part = self._memory[0]
            part.session = session
        else:
            part = self._begin_part(session, number)
        self._memory.clear()
        self._offsets[number] = part.stamper.offset_us
        return part

    def _begin_part(self, session: str, number: int) -> Part:
        """Start buffering for a part, with the present state of the fusion for its head."""
        part = Part(session, number, self._civil.offset_us or 0, self._clock())
        if self._settings.table:
            for vehicle_id in self._seen:
                part.prepare_table(self._header(vehicle_id, part), self._state_of(vehicle_id))
        return part

    def _label_of(self) -> str:
        """Return the text after the time in the name of a recording that begins now."""
        if self._settings.name == "time":
            return ""
        known = dict(self._armed_of()) if self._holds else {}
        own = self._vehicles_of().items()
        known |= {key: at for key, at in own if at is not None or key not in known}
        return label_of(known, with_location=self._settings.name == "place")

    def _header(self, vehicle_id: int, part: Part) -> TableHeader:
        return msgspec.structs.replace(
            self._header_of(vehicle_id),
            vehicle_id=vehicle_id,
            session=part.session,
            part=part.number,
            cold_start=vehicle_id not in self._seen,
            unix_us_at_zero=part.stamper.offset_us,
        )

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            # The pause is shorter by the time that a slow disk needs.
            due_s = loop.time() + self._settings.flush_s
            self._wake.clear()
            await self._turn()
            self._turned.set()
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), max(due_s - loop.time(), 0.0))

    async def _turn(self) -> None:
        """Write the buffered bytes, then let the session decide."""
        self._civil.update_machine(self._machine_us(), self._clock())
        actions = await self._flush()
        self._hold()
        if not actions:
            now_us, disk = self._clock(), self._disk
            part = self._part
            begin_us = self._memory[0].begin_us if self._memory else now_us
            actions = self._session.poll(
                now_us,
                begin_us + (self._civil.offset_us or 0),
                disk.part_bytes,
                disk.free_bytes,
                jumped=part is not None and part.stamper.has_jumped(self._civil),
                label=self._label_of(),
            )
        while actions:
            actions = await self._perform(actions)

    async def _flush(self) -> list[SessionAction]:
        now_us, part, files = self._clock(), self._part, self._files
        try:
            if part is None or files is None:
                free_bytes = await done_by(self._writer, free_bytes_near, self.folder)
                self._disk = DiskState(0, free_bytes)
                return []
            if part.size > PENDING_LIMIT:
                return self._session.failed("disk is too slow", now_us)
            self._disk = await done_by(self._writer, files.write, part.take())
            self._session.name = part.session = files.session
            self._check_sync()
        except OSError as error:
            return self._session.failed(reason_of(error), self._clock())
        if self._syncing is None and now_us >= self._sync_due_us:
            self._sync_due_us = now_us + round(self._settings.sync_s * US_PER_S)
            self._syncing = self._syncer.submit(files.sync_job())
        return []

    def _check_sync(self) -> None:
        """Clear the last sync if it has ended; raises the OSError with which it failed."""
        if self._syncing is not None and self._syncing.done():
            ended, self._syncing = self._syncing, None
            ended.result()

    async def _perform(self, actions: list[SessionAction]) -> list[SessionAction]:
        """Carry out the session's actions; return its actions upon their outcome."""
        closing = self._part
        opening = next((action for action in actions if isinstance(action, OpenPart)), None)
        # The next part buffers from here on, so that no data is lost while the last one closes.
        if closing is not None and any(isinstance(a, ClosePart) for a in actions):
            closing.flush_rows()
            self._part = None
        if opening is not None:
            self._part = self._new_part(opening.session, opening.part)
        following: list[SessionAction] = []
        for action in actions:
            match action:
                case ClosePart():
                    await self._close_part(closing, is_last=opening is None)
                case CorrectTimes():
                    await self._correct_times()
                case OpenPart():
                    following += await self._open_part(action)
                case Announce():
                    self._say(action)
        return following

    def _say(self, action: Announce) -> None:
        (log.warning if action.is_trouble else log.info)("%s", action.text)
        # Others need not know the folders of this machine, whose names may contain spaces.
        text = action.text.replace(str(self.folder), self.folder.name)
        self._announce(action.is_trouble, without_folders(text))

    def _open_at_once(self) -> None:
        now_us, offset_us = self._clock(), self._civil.offset_us or 0
        try:
            self._disk = DiskState(0, free_bytes_near(self.folder))
            actions = self._session.poll(now_us, now_us + offset_us, 0, self._disk.free_bytes)
            for action in actions:
                if isinstance(action, OpenPart):
                    files = PartFiles(self.folder, action.session, action.part)
                    self._part = self._new_part(action.session, action.part)
                    actions = self._adopt(files)
        except OSError as error:
            actions = self._session.failed(self._trouble_of(error), now_us)
        for action in actions:
            if isinstance(action, Announce):
                self._say(action)

    def _trouble_of(self, error: OSError) -> str:
        return f"{error.filename or self.folder}: {reason_of(error)}"

    async def _open_part(self, action: OpenPart) -> list[SessionAction]:
        try:
            files = await done_by(self._writer, PartFiles, self.folder, action.session, action.part)
        except OSError as error:
            self._part = None
            return self._session.failed(self._trouble_of(error), self._clock())
        return self._adopt(files)

    def _adopt(self, files: PartFiles) -> list[SessionAction]:
        self._files = files
        self._session.name = files.session
        if self._part is not None:
            self._part.session = files.session
        return self._session.opened(self._clock())

    async def _close_part(self, part: Part | None, *, is_last: bool) -> None:
        """Write the end of a part and close it after its syncs; wait only for the last one."""
        files, self._files = self._files, None
        syncing, self._syncing = self._syncing, None
        if part is None or files is None:
            return
        written = self._writer.submit(files.write, part.take())
        self._closing = self._syncer.submit(close_behind, files, written, syncing)
        if is_last:
            await asyncio.shield(asyncio.wrap_future(self._closing))

    async def _correct_times(self) -> None:
        """Queue the finished parts of the session to be shifted to the true time."""
        await self._restamped()
        try:
            # Not in the thread that syncs the previous part.
            found = await done_by(self._writer, find_recording, self.folder, self._session.name)
        except (OSError, RecordingError) as error:
            log.warning("Recording %s keeps its times: %s", self._session.name, error)
            return
        true_us = self._civil.offset_us or 0
        if self._closing is not None:
            # A file may be replaced once it is closed.
            self._restamper.submit(self._closing.result)
        floor = round(self._settings.free_floor_mb * 1e6)
        for path in found.files:
            if shift_us := true_us - self._offsets.get(part_of(path), true_us):
                job = self._restamper.submit(shift_times, path, shift_us, floor)
                self._restamping.append(job)
        self._offsets = dict.fromkeys(self._offsets, true_us)

    async def _restamped(self) -> None:
        """Wait until no file is being copied, so that its name may change."""
        while self._restamping:
            await asyncio.shield(asyncio.wrap_future(self._restamping.pop()))
