"""Decisions of the recorder: when to record, into which part, and how to handle disk errors.

Theory of operation. The session never touches a file: it returns actions to its owner, which
reports their outcome.

| state     | event                              | becomes   | actions                           |
| --------- | ---------------------------------- | --------- | --------------------------------- |
| idle      | requested (start, flight, always)  | opening   | open part 1 of a new session      |
| opening   | opened                             | recording | announce (first part only)        |
| opening   | failed                             | blocked   | announce the reason               |
| recording | no longer requested                | idle      | close, announce                   |
| recording | part too large or too old          | opening   | close, open the next part         |
| recording | the clock turns out to be wrong *  | opening   | close, correct, open the next     |
| recording | too little free space, or failed   | blocked   | close, announce the reason        |
| blocked   | retry is due and there is space    | opening   | open the next part                |
| blocked   | no longer requested                | idle      | announce                          |

* Only once per part: the part that this opens is not corrected again. Otherwise clocks that
disagree permanently would rewrite the session again and again.

A user's start or stop is valid until the next one; without one, the mode in the settings decides
whether a recording is requested.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from typing import Annotated, Final, Literal

from gateway.settings import Settings, setting
from gateway.units import US_PER_S

RETRY_US: Final = 5 * US_PER_S
RESUME_FACTOR: Final = 1.25
"""Recording resumes when the free space exceeds the floor by this factor, which avoids flapping."""
RESUME_LEAST_MB: Final = 1.0
"""Least free space to resume in any case: some ten seconds of recording."""
PART_DIGITS: Final = 2
MAX_LABELLED: Final = 4
"""Maximum vehicles in the name of a recording."""
VehicleLocations = Mapping[int, tuple[float, float] | None]
"""Latitude and longitude in degrees by system id; None if they are not known."""

Mode = Literal["manual", "in_flight", "armed", "always"]
NameStyle = Literal["time", "vehicle", "place"]
AFTER_US: Final = 10 * US_PER_S
"""Time for which a recording continues after disarming, in the mode `armed`."""


class RecordingSettings(Settings, frozen=True):
    """Content, location and times of recordings."""

    mode: Annotated[
        Mode,
        setting(
            "manual: on command only; in_flight: from arming or take-off to landing; armed: from "
            "at least 30 s before arming (held in memory) to 10 s after disarming; always: as "
            "long as the gateway runs."
        ),
    ] = "in_flight"
    name: Annotated[
        NameStyle,
        setting(
            "Name of a recording. time: its start time; vehicle: also the ids of its vehicles; "
            "place: also the location of the first of them at the start."
        ),
    ] = "time"
    folder: Annotated[
        str, setting("Folder of the recordings; created if it does not exist.", path=True)
    ] = "~/mavgate/recordings"
    tlog: Annotated[bool, setting("Record all MAVLink that is sent and received.")] = True
    table: Annotated[
        bool, setting("Record raw samples and fused states, one CSV per aircraft.")
    ] = True
    source_bytes: Annotated[
        bool,
        setting(
            "Record the bytes of sources in the tlog too, as TUNNEL messages: `mavgate run "
            "--source KIND:file:NAME.tlog` decodes them again."
        ),
    ] = False
    rotate_mb: Annotated[
        float, setting("A larger file is closed and the next one started.", "MB", ge=1, le=1e6)
    ] = 512.0
    rotate_min: Annotated[
        float, setting("An older file is closed and the next one started.", "min", ge=1, le=1e4)
    ] = 120.0
    free_floor_mb: Annotated[
        float, setting("Recording stops when the disk has less space left.", "MB", ge=0, le=1e6)
    ] = 200.0
    flush_s: Annotated[
        float, setting("Longest loss when the gateway is killed.", "s", ge=0.05, le=1)
    ] = 0.5
    sync_s: Annotated[
        float,
        setting(
            "Interval of syncs to the disk. Long: less wear of a card. Short: less lost by a "
            "power failure.",
            "s",
            ge=0.05,
            le=60,
        ),
    ] = 0.5
    unpacked_limit_mb: Annotated[
        float,
        setting(
            "Maximum unpacked size of a gzipped log that is read as a whole (ULog, DataFlash, "
            "Parquet, and a tlog to be played).",
            "MB",
            ge=1,
            le=1e6,
        ),
    ] = 1000.0

    @property
    def unpacked_limit(self) -> int:
        """`unpacked_limit_mb` in bytes."""
        return round(self.unpacked_limit_mb * 1e6)


class SessionState(StrEnum):
    """The states of the table in this module's head."""

    IDLE = "idle"
    OPENING = "opening"
    RECORDING = "recording"
    BLOCKED = "blocked"


@dataclass(frozen=True, slots=True)
class OpenPart:
    """Open the files of a part; report the outcome by `opened` or `failed`."""

    session: str
    part: int


@dataclass(frozen=True, slots=True)
class ClosePart:
    """Close the files of the part that is open."""


@dataclass(frozen=True, slots=True)
class Announce:
    """Announce a text to the user."""

    is_trouble: bool
    text: str


@dataclass(frozen=True, slots=True)
class CorrectTimes:
    """Correct the times in the files of the session, which are closed; its name stays."""


SessionAction = OpenPart | ClosePart | Announce | CorrectTimes


def session_name(unix_us: int) -> str:
    """Name a session by the civil time of its start, in UTC: `20260611-142530`."""
    return datetime.fromtimestamp(unix_us // US_PER_S, UTC).strftime("%Y%m%d-%H%M%S")


def part_stem(session: str, part: int) -> str:
    """Name the files of a part, without their endings: `20260611-142530_01`."""
    return f"{session}_{part:0{PART_DIGITS}d}"


def label_of(vehicles: VehicleLocations, *, with_location: bool) -> str:
    """Return the end of a recording's name: `-v1-v2-47.3977N-8.5456E`."""
    label = "".join(f"-v{system_id}" for system_id in sorted(vehicles)[:MAX_LABELLED])
    known = (at for _, at in sorted(vehicles.items()) if at is not None)
    if with_location and (at := next(known, None)) is not None:
        north, east = "NS"[at[0] < 0], "EW"[at[1] < 0]
        label += f"-{abs(at[0]):.4f}{north}-{abs(at[1]):.4f}{east}"
    return label


class Session:
    """Decide when files are opened and closed."""

    def __init__(self, settings: RecordingSettings) -> None:
        self._settings = settings
        self._in_flight = False
        self._requested: bool | None = None
        self._opened_us = 0
        self._retry_us = 0
        self._corrected = False
        self.state = SessionState.IDLE
        self.name = ""
        """Name of the session that runs, or ran last."""
        self.part = 0
        self.reason = ""
        """The reason why it is blocked."""
        self._begin_us = self._end_us = 0
        self._until_us = 0
        """End of the time after disarming."""
        self._is_after = False

    @property
    def duration_s(self) -> float:
        """Duration of the present session, or of the last one."""
        return (self._end_us - self._begin_us) / US_PER_S

    @property
    def wanted(self) -> bool:
        """Whether a recording is requested now."""
        if self._requested is not None:
            return self._requested
        mode = self._settings.mode
        return mode == "always" or (mode != "manual" and (self._in_flight or self._is_after))

    @property
    def expected(self) -> bool:
        """Whether a user expects a recording now: in the mode `armed` not while disarmed."""
        return self.wanted or self._settings.mode != "armed"

    def start(self) -> None:
        """Start on a user's request; a blocked recording is retried at once."""
        self._requested = True
        if self.state is SessionState.BLOCKED:
            self.state = SessionState.IDLE

    def stop(self) -> None:
        """Stop on a user's request, until the next request or the next flight."""
        self._requested = False

    def set_in_flight(self, in_flight: bool) -> None:
        """Note take-off or landing, in the mode `armed` arming or disarming.

        A take-off cancels an earlier request to stop.
        """
        if in_flight and not self._in_flight and self._requested is False:
            self._requested = None
        self._in_flight = in_flight

    def opened(self, now_us: int) -> list[SessionAction]:
        """Note that the files of the part are open."""
        self.state, self._opened_us = SessionState.RECORDING, now_us
        resumed, self.reason = bool(self.reason), ""
        if self.part == 1:
            self._begin_us = self._end_us = now_us
        if self.part == 1 or resumed:
            return [Announce(is_trouble=False, text=f"Recording {self.name}")]
        return []

    def failed(self, reason: str, now_us: int) -> list[SessionAction]:
        """Note that files could not be opened or written; this is retried later."""
        begun = self.state is SessionState.RECORDING
        closing: list[SessionAction] = [ClosePart()] if begun else []
        if self.state is SessionState.OPENING:
            self.part -= 1
        self.state, self._retry_us = SessionState.BLOCKED, now_us + RETRY_US
        known, self.reason = reason == self.reason, reason
        if known:
            return closing
        return [
            *closing,
            Announce(
                is_trouble=True, text=f"Recording {'stopped' if begun else 'not started'}: {reason}"
            ),
        ]

    def poll(
        self,
        now_us: int,
        unix_us: int,
        part_bytes: int,
        free_bytes: int,
        *,
        jumped: bool = False,
        label: str = "",
    ) -> list[SessionAction]:
        """Return the actions that are due; `label` follows the time in the name of a session."""
        if self._in_flight and self._settings.mode == "armed":
            self._until_us = now_us + AFTER_US
        self._is_after = now_us < self._until_us
        match self.state:
            case SessionState.IDLE if self.wanted:
                self.name, self.part = session_name(unix_us) + label, 0
                self._corrected = False
                if self._is_short(free_bytes):
                    return self._stop_short(now_us)
                return self._open_next()
            case SessionState.RECORDING:
                return self._poll_recording(now_us, part_bytes, free_bytes, jumped=jumped)
            case SessionState.BLOCKED:
                return self._poll_blocked(now_us, free_bytes)
            case _:
                return []

    def _poll_recording(
        self, now_us: int, part_bytes: int, free_bytes: int, *, jumped: bool
    ) -> list[SessionAction]:
        self._end_us = now_us
        if not self.wanted:
            self.state = SessionState.IDLE
            return [ClosePart(), Announce(is_trouble=False, text=f"Recording {self.name} ended")]
        if self._is_short(free_bytes):
            return self._stop_short(now_us)
        s, age_us = self._settings, now_us - self._opened_us
        too_old = age_us > s.rotate_min * 60 * US_PER_S
        if jumped and not self._corrected:
            self._corrected = True
            return [ClosePart(), CorrectTimes(), *self._open_next()]
        if too_old or part_bytes > s.rotate_mb * 1e6:
            self._corrected = False
            return [ClosePart(), *self._open_next()]
        return []

    def _poll_blocked(self, now_us: int, free_bytes: int) -> list[SessionAction]:
        if not self.wanted:
            self.state, self.reason = SessionState.IDLE, ""
            return [Announce(is_trouble=False, text=f"Recording {self.name} ended")]
        enough_mb = max(self._settings.free_floor_mb * RESUME_FACTOR, RESUME_LEAST_MB)
        if now_us < self._retry_us or free_bytes < enough_mb * 1e6:
            return []
        return self._open_next()

    def _is_short(self, free_bytes: int) -> bool:
        return free_bytes < self._settings.free_floor_mb * 1e6

    def _stop_short(self, now_us: int) -> list[SessionAction]:
        return self.failed(f"less than {self._settings.free_floor_mb:g} MB free", now_us)

    def _open_next(self) -> list[SessionAction]:
        self.state = SessionState.OPENING
        self.part += 1
        return [OpenPart(self.name, self.part)]
