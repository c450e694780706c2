"""Play recordings: when each recorded frame is due.

Theory of operation. During playback, a linear relation ties the gateway clock to the recording:

    due = anchor_now + (time - anchor_time) / speed

Pausing, a change of speed, a seek, a skipped gap, and a jump of the recorded clock only set a new
anchor. Frames are played in the order of their times over all tracks. At infinite speed everything
is due at once, and the caller's batch size limits the rate.

| state   | resume, seek, step, speed               | end of the range reached            |
| ------- | --------------------------------------- | ----------------------------------- |
| playing | takes effect from the present position  | loop: seek to its start; else ended |
| paused  | resume: playing; step: next frames      | stays paused                        |
| ended   | seek: playing; resume: from the start   |                                     |
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import chain
from types import MappingProxyType
from typing import Final

import numpy as np

from gateway.answers.log_answers import answers_of, key_of, telemetry_of
from gateway.recordings.recorded_clock import DAY_US, is_step
from gateway.recordings.tlog import SEEK_BYTES, STRIDE, TlogScanner
from gateway.recordings.tlog_index import TlogIndex
from gateway.wire.frame_editing import edit_frame, renumbered
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import frame_of, message_id_of, origin_of
from gateway.wire.recorded_frames import Batch, IntArray, RecordedFrame

BLOCK_BYTES: Final = 1 << 18
"""Bytes per read during playback: minutes of flight, for 0.1 s of processing."""

CONTEXT_RECORDS: Final = 20 * STRIDE
"""Records that a seek searches backwards for a vehicle's state: more than a minute."""
CONTEXT_IDS: Final = [
    MESSAGE_IDS[name]
    for name in (
        "HEARTBEAT", "SYS_STATUS", "GPS_RAW_INT", "ATTITUDE", "ATTITUDE_QUATERNION",
        "GLOBAL_POSITION_INT", "GPS_GLOBAL_ORIGIN", "VFR_HUD", "AUTOPILOT_VERSION",
        "HOME_POSITION", "EXTENDED_SYS_STATE",
    )
]  # fmt: skip
"""Messages that contain the state of a vehicle."""
_CONTEXT: Final = frozenset(CONTEXT_IDS)
LEAST_SPEED: Final = 0.1
GREATEST_SPEED: Final = 100.0
AS_FAST_AS_POSSIBLE: Final = math.inf
END_OF_TIME_US: Final = 1 << 64
MAX_NUMBERS: Final = 256
"""Maximum number of frames of one message and sender with different numbers that are stored."""


class Source:
    """A tlog that exists, or is generated while it is read."""

    index: TlogIndex
    """Index of the part that is available so far."""

    @property
    def last_us(self) -> int:
        """Time of its end as far as it is known; 0 if it is empty."""
        return self.index.last_us or 0

    def read(self, offset: int, size: int) -> bytes:
        """Read up to `size` bytes; empty at the end, or if the medium fails."""
        raise NotImplementedError

    def prepare(self, until_us: int) -> bool:  # noqa: ARG002
        """Do a part of the work for reading up to a time; return whether it is finished."""
        return True


class Track:
    """A tlog in playback."""

    def __init__(
        self,
        source: Source,
        *,
        shift_us: int = 0,
        system_ids: Mapping[int, int] = MappingProxyType({}),
        with_commands: bool = False,
    ) -> None:
        self._source = source
        self._shift_us = shift_us
        self._system_ids = system_ids
        self._with_commands = with_commands
        self._records = self._records_of(self._read_from(0))
        self._next = next(self._records, None)
        self.ahead: list[bytes] = []
        """First message of each kind after the last seek that contains a vehicle's state."""

    @property
    def first_us(self) -> int:
        """Time of the first record; 0 if the recording is empty."""
        return (self._source.index.first_us or 0) + self._shift_us

    @property
    def last_us(self) -> int:
        """Time of the last record."""
        return self._source.last_us + self._shift_us

    def prepare(self, time_us: int) -> bool:
        """Do a part of the work for a seek; return whether the seek would be immediate now."""
        return self._source.prepare(time_us - self._shift_us)

    def peek_us(self) -> int | None:
        """Return the time of the next record; None at the end."""
        return None if self._next is None else self._next.time_us + self._shift_us

    def take(self) -> bytes:
        """Return the next frame and move on; raises ValueError at the end."""
        record = self._next
        if record is None:
            raise ValueError("the recording has ended")
        self._next = next(self._records, None)
        return self._addressed(record.frame)

    def seek(self, time_us: int) -> list[bytes]:
        """Move to the first record at or after a time; return the frames of the state before it."""
        wanted_us = time_us - self._shift_us
        newest: dict[tuple[int, int], bytes] = {}
        batches = self._read_from(self._source.index.offset_before(wanted_us, CONTEXT_RECORDS))
        self._records = iter(())
        for batch in batches:
            reached = np.flatnonzero(batch.time_us >= wanted_us)
            begin = int(reached[0]) if len(reached) else len(batch)
            known = self._wanted(batch, 0)
            known = known[(known < begin) & np.isin(batch.message_ids[known], CONTEXT_IDS)]
            for i in known.tolist():
                frame = batch.frame(i)
                key = _kind_of(frame)
                # Removed first, so that the newest frames are last.
                newest.pop(key, None)
                newest[key] = frame
            if len(reached):
                self.ahead = self._ahead(batch, begin)
                self._records = self._records_of(chain([batch], batches), begin)
                break
        self._next = next(self._records, None)
        return [self._addressed(frame) for frame in newest.values()]

    def _ahead(self, batch: Batch, begin: int) -> list[bytes]:
        """Return the first message of each kind that contains a state."""
        wanted = self._wanted(batch, begin)
        shown = wanted[np.isin(batch.message_ids[wanted], CONTEXT_IDS)]
        kinds = batch.origins[shown] << 32 | batch.message_ids[shown]
        firsts = np.sort(np.unique(kinds, return_index=True)[1])
        return [self._addressed(batch.frame(i)) for i in shown[firsts].tolist()]

    def _wanted(self, batch: Batch, begin: int) -> IntArray:
        if self._with_commands:
            return np.arange(begin, len(batch))
        return telemetry_of(batch, begin, self._source.index.senders)

    def _records_of(self, batches: Iterator[Batch], begin: int = 0) -> Iterator[RecordedFrame]:
        """Yield the records to play; sequence numbers are closed up where answers are left out.

        `begin` is the first record of the first batch.
        """
        left_out: Counter[int] = Counter()
        for batch in batches:
            wanted = self._wanted(batch, begin)
            answers = answers_of(batch, self._source.index.senders.stations)
            answers = answers[:0] if self._with_commands else answers[answers >= begin]
            begin = 0
            if not len(answers) and not left_out:
                yield from batch.records(wanted)
                continue
            is_answer = np.isin(every := np.union1d(wanted, answers), answers)
            for i, is_left_out in zip(every.tolist(), is_answer.tolist(), strict=True):
                origin = int(batch.origins[i])
                if is_left_out:
                    left_out[origin] += 1
                    continue
                frame = batch.frame(i)
                if count := left_out[origin]:
                    read = frame_of(frame)
                    frame = renumbered(read, read.sequence - count & 0xFF).data
                yield RecordedFrame(int(batch.time_us[i]), frame)

    def _addressed(self, frame: bytes) -> bytes:
        system_id = self._system_ids.get(origin_of(frame)[0])
        if system_id is None:
            return frame
        read = frame_of(frame)
        return (edit_frame(read, system=system_id, drop_signature=True) or read).data

    def _read_from(self, offset: int) -> Iterator[Batch]:
        def chunks() -> Iterator[bytes]:
            at, size = offset, SEEK_BYTES
            while data := self._source.read(at, size):
                yield data
                at, size = at + len(data), BLOCK_BYTES

        return map(self._source.index.timeline.apply, TlogScanner(offset).feed_all(chunks()))


class PlayState(StrEnum):
    """State of the player."""

    PLAYING = "playing"
    PAUSED = "paused"
    ENDED = "ended"


def check_speed(speed: float) -> float:
    """Check a speed: 0.1 to 100, or infinite; raises ValueError for any other."""
    if speed != AS_FAST_AS_POSSIBLE and not LEAST_SPEED <= speed <= GREATEST_SPEED:
        raise ValueError(f"speed {speed:g}; {LEAST_SPEED:g} to {GREATEST_SPEED:g}, or inf")
    return speed


class Player:
    """Play several recordings simultaneously."""

    def __init__(
        self,
        tracks: Sequence[Track],
        now_us: int,
        *,
        speed: float = 1.0,
        begin_us: int | None = None,
        end_us: int | None = None,
        max_gap_us: int | None = None,
        loop: bool = False,
    ) -> None:
        self._tracks = tracks
        first_us = min(t.first_us for t in tracks)
        self.begin_us = first_us if begin_us is None else max(begin_us, first_us)
        self._end_us = end_us
        self.max_gap_us = max_gap_us
        self.loop = loop
        self.state = PlayState.PLAYING
        self.sent = 0
        """Number of frames sent."""
        self.speed = check_speed(speed)
        """Ratio of playback to recorded time."""
        self._anchor = (now_us, self.begin_us)
        self.position_us = self.begin_us
        """Recorded time of the last frame played."""
        self._newest: dict[tuple[int, int], dict[bytes, bytes]] = {}
        """The newest frames by sender and message, and by their number if they have one."""
        self._context = self._seek_tracks(self.begin_us)

    @property
    def end_us(self) -> int:
        """End of the range; it may change while a table is fused during playback."""
        last_us = max(t.last_us for t in self._tracks)
        return last_us if self._end_us is None else min(self._end_us, last_us)

    def set_speed(self, speed: float, now_us: int) -> None:
        """Change the speed from now on; raises ValueError like `check_speed`."""
        here_us = self._time_at(now_us)
        self.speed = check_speed(speed)
        self._anchor = (now_us, here_us)

    def pause(self, now_us: int) -> None:
        """Pause."""
        if self.state is PlayState.PLAYING:
            self._anchor = (now_us, self._time_at(now_us))
            self.state = PlayState.PAUSED

    def resume(self, now_us: int) -> None:
        """Resume; after the end, start again."""
        if self.state is PlayState.ENDED:
            self.seek(self.begin_us, now_us)
        elif self.state is PlayState.PAUSED:
            self._anchor = (now_us, self._anchor[1])
        self.state = PlayState.PLAYING

    def step(self, now_us: int, count: int = 1) -> list[bytes]:
        """Pause, and return the next frames immediately."""
        self.pause(now_us)
        frames, self._context = self._context, []
        for _ in range(count):
            track = self._next_track()
            if track is None:
                break
            frames.append(self._next_frame(track))
        self._anchor = (now_us, self.position_us)
        return frames

    def held(self) -> list[bytes]:
        """Return the frames of the vehicles' state at the present position.

        For a message that was not sent before this position, the first one after it is returned.
        """
        ahead = {_kind_of(frame): frame for track in self._tracks for frame in track.ahead}
        newest = {
            kind: frame for kind, frames in self._newest.items() if kind[1] in _CONTEXT
            for frame in frames.values()
        }  # fmt: skip
        return list((ahead | newest).values())

    def newest(self, origin: int, message_id: int) -> list[bytes]:
        """Return the newest frames of a message and sender (system << 8 | component)."""
        return list(self._newest.get((origin, message_id), {}).values())

    def prepare(self, time_us: int) -> bool:
        """Do a part of the work for a seek; return whether the seek would be immediate now."""
        return all(track.prepare(time_us) for track in self._tracks)

    def seek(self, time_us: int, now_us: int) -> None:
        """Move to a recorded time, limited to the range; a paused player stays paused."""
        time_us = min(max(time_us, self.begin_us), self.end_us)
        self._context = self._seek_tracks(time_us)
        self._anchor = (now_us, time_us)
        self.position_us = time_us
        if self.state is PlayState.ENDED:
            self.state = PlayState.PLAYING

    def next_due_us(self) -> int | None:
        """Return when `poll` must be called next; None while nothing will be due."""
        if self._context:
            return self._anchor[0]
        if self.state is not PlayState.PLAYING:
            return None
        track = self._next_track()
        return self._anchor[0] if track is None else self._due_us(track)

    def poll(self, now_us: int, limit: int) -> list[bytes]:
        """Return the frames that are due."""
        frames, self._context = self._context, []
        if self.state is not PlayState.PLAYING:
            return frames
        for _ in range(limit):
            track = self._next_track()
            if track is None:
                self._end(now_us)
                break
            self._skip_gap(track, now_us)
            if self._due_us(track) > now_us:
                break
            frames.append(self._next_frame(track))
        return frames

    def _seek_tracks(self, time_us: int) -> list[bytes]:
        context = [frame for track in self._tracks for frame in track.seek(time_us)]
        self._newest = {}
        for frame in context:
            self._keep(frame)
        return context

    def _keep(self, frame: bytes) -> None:
        frames = self._newest.setdefault(_kind_of(frame), {})
        if len(frames) < MAX_NUMBERS:
            frames[key_of(frame)] = frame

    def _next_track(self) -> Track | None:
        """Find the track whose next frame is the earliest; None at the end of the range."""
        found: Track | None = None
        earliest_us = END_OF_TIME_US if self._end_us is None else self._end_us
        for track in self._tracks:
            time_us = track.peek_us()
            if time_us is not None and (
                time_us < earliest_us or (found is None and time_us == earliest_us)
            ):
                found, earliest_us = track, time_us
        return found

    def _next_frame(self, track: Track) -> bytes:
        self.position_us = track.peek_us() or self.position_us
        self.sent += 1
        frame = track.take()
        self._keep(frame)
        return frame

    def _end(self, now_us: int) -> None:
        if self.loop and self.sent:
            self.seek(self.begin_us, now_us)
        else:
            self.state = PlayState.ENDED

    def _time_at(self, now_us: int) -> int:
        """Return the recorded time at a moment of playback."""
        anchor_now_us, anchor_time_us = self._anchor
        if self.state is not PlayState.PLAYING:
            return anchor_time_us
        if self.speed == AS_FAST_AS_POSSIBLE:
            return self.position_us
        return anchor_time_us + round((now_us - anchor_now_us) * self.speed)

    def _due_us(self, track: Track) -> int:
        anchor_now_us, anchor_time_us = self._anchor
        time_us = track.peek_us()
        if time_us is None or self.speed == AS_FAST_AS_POSSIBLE:
            return anchor_now_us
        # Rounded up, so that a frame is not due before its time.
        return anchor_now_us + math.ceil((time_us - anchor_time_us) / self.speed)

    def _skip_gap(self, track: Track, now_us: int) -> None:
        """Set a new anchor if the next frame is too far ahead, or the recorded clock went back."""
        time_us = track.peek_us() or 0
        gap_us = time_us - self.position_us
        longest_us = DAY_US if self.max_gap_us is None else self.max_gap_us
        if not is_step(gap_us, ahead_us=longest_us):
            return
        went_back = gap_us < 0
        kept_us = 0 if went_back or self.max_gap_us is None else self.max_gap_us
        due_last_us = self._anchor[0] + math.ceil((self.position_us - self._anchor[1]) / self.speed)
        self._anchor = (max(due_last_us, now_us) if went_back else due_last_us, time_us - kept_us)
        self.position_us = time_us - kept_us


def _kind_of(frame: bytes) -> tuple[int, int]:
    system, component = origin_of(frame)
    return system << 8 | component, message_id_of(frame)
