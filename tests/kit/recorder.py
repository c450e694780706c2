"""The recorder on a manual clock."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from gateway.live.recorder import Recorder
from gateway.live.session import RecordingSettings, VehicleLocations
from gateway.live.vehicle_watch import VehicleWatch
from gateway.recordings.table import TableHeader, TableReader
from gateway.recordings.tlog import encode_record
from gateway.records import BaroRaw, FusedSample, FusionState, GpsFix, NodeId
from gateway.wire.mavlink_splitter import frame_of
from gateway.wire.timesync import ENOUGH
from tests.conftest import ManualClock
from tests.kit.recordings import make_frames, read_tlog
from tests.kit.records import fix_at

UNIX_US = 1_781_187_930_000_000
NAME = "20260611-142530"
FRAMES = make_frames(40)
HEADER = TableHeader(mavgate_version="1.2", settings={"a": {"b": 1}}, calibration={"c": [0.5]})


def frames_of(folder: Path) -> list[bytes]:
    """Return the frames of all tlogs of a folder, none of which is damaged."""
    return [r.frame for path in sorted(folder.glob("*.tlog")) for r in read_tlog(path)]


def read_table(path: Path) -> tuple[TableHeader, list[Any]]:
    """Return the header of a table, and all that follows."""
    reader = TableReader()
    events = reader.feed(path.read_bytes(), final=True)
    assert reader.header is not None
    return reader.header, events


class ListedRun:
    """Frames that the hub has forwarded together."""

    def __init__(self, frames: list[bytes]) -> None:
        self.frames, self.run_length = frames, len(frames)

    def run(self) -> list[bytes]:
        return self.frames

    def records(self, first_us: int, step_us: int) -> bytes:
        times = [first_us + number * step_us for number in range(len(self.frames))]
        return b"".join(map(encode_record, times, self.frames))


class RecorderBench:
    """A recorder in a folder of its own that is turned by hand, and what it announced."""

    def __init__(
        self,
        folder: Path,
        clock: ManualClock,
        header_of: Callable[[int], TableHeader] = lambda _: HEADER,
        fusion_of: Callable[[int], FusionState | None] = lambda _: None,
        introduction_of: Callable[[int], list[bytes]] = lambda _: [],
        vehicles_of: Callable[[], VehicleLocations] = dict,
        **settings: object,
    ) -> None:
        self.clock = clock
        self.unix_at_zero_us = UNIX_US
        self.announced: list[tuple[bool, str]] = []
        options = {"folder": str(folder), "mode": "always", "free_floor_mb": 0.0, **settings}
        self.takes_frames: list[bool] = []
        self._watch = VehicleWatch()
        self.recorder = Recorder(
            RecordingSettings(**options),
            clock,
            lambda: self.unix_at_zero_us + clock(),
            header_of,
            lambda is_trouble, text: self.announced.append((is_trouble, text)),
            fusion_of,
            introduction_of,
            vehicles_of,
            lambda: self._watch.armed(clock()),
            lambda: self.takes_frames.append(self.recorder.takes_frames),
        )

    async def turn(self, seconds: float = 0.5) -> None:
        self.clock.advance(seconds)
        await self.recorder._turn()

    def send(self, frames: list[bytes]) -> None:
        for frame in frames:
            self.clock.advance(0.001)
            self.recorder.frame(frame)
            self._watch.feed(frame_of(frame), self.clock())

    async def record(self, frames: list[bytes], seconds: float = 0.5) -> None:
        self.send(frames)
        await self.turn(seconds)

    def fly(self, records: Iterable[BaroRaw | GpsFix | FusedSample]) -> None:
        for record in records:
            self.recorder.flight(record)

    def receive_gps_time(self, unix_at_zero_us: int, times: int = ENOUGH) -> None:
        """Let fixes of an aircraft report a civil time."""
        now_us = self.clock()
        fix = fix_at(now_us, node=NodeId(3, 1), utc_us=unix_at_zero_us + now_us)
        self.fly([fix] * times)

    @property
    def troubles(self) -> list[str]:
        return [text for is_trouble, text in self.announced if is_trouble]


MakeBench = Callable[..., RecorderBench]
"""Makes a bench by its settings; it is closed after the test."""
