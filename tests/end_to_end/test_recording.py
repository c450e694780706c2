"""The simulated flight, recorded, replayed and fused again, is the same flight."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import takewhile
from pathlib import Path
from typing import Any

import msgspec
import pytest

from gateway.aircraft import Outputs
from gateway.cli.live.demo import calibrated_aircraft
from gateway.config import GatewaySettings
from gateway.live import recorder as recorder_module
from gateway.live.recorder import Recorder
from gateway.live.session import Mode
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.opening import TlogFile
from gateway.recordings.play import Player, Track
from gateway.recordings.recorded_fusion import RecordedFusion
from gateway.recordings.recorded_table import ReadOptions, header_for
from gateway.recordings.recording import open_recordings
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableHeader, TableReader
from gateway.recordings.tlog import UNRECORDED
from gateway.records import RECORDED_ONLY, FusedSample, FusionState, NavState
from gateway.simulator.receiver import simulate
from gateway.simulator.source_bytes import SOURCE_BYTES
from gateway.sources.kinds import make_sources
from gateway.sources.settings import SourceSettings
from tests.conftest import ManualClock
from tests.kit.cli import invoke
from tests.kit.recorder import UNIX_US, RecorderBench, frames_of

pytestmark = [pytest.mark.io, pytest.mark.slow]

FLIGHT_S = 20.0
TURN_US = 500_000


class Flight:
    """A simulated receiver's or source's bytes through a pipeline, as the daemon would run it.

    `name` is that of an estimator of the receiver's samples, or of a kind of source.
    """

    def __init__(self, name: str, clock: ManualClock) -> None:
        self.kind = name if name in SOURCE_BYTES else ""
        estimation = {"estimator": "eskf" if self.kind else name}
        self.settings = msgspec.convert({"estimation": estimation}, GatewaySettings)
        self.aircraft = calibrated_aircraft(self.settings)
        self.clock = clock
        urls = (SourceSettings(url=f"{self.kind}:stdin"),) if self.kind else ()
        self.pipeline = Pipeline(
            PipelineSettings(
                self.settings.default_aircraft,
                self.aircraft,
                UNIX_US,
                sources=make_sources(urls, str),
            )
        )

    def outputs(self) -> Iterator[Outputs]:
        pipeline, settings = self.pipeline, self.settings.simulator
        if self.kind:
            (source,) = pipeline.sources
            frames = SOURCE_BYTES[self.kind](settings, UNIX_US)
            feed = partial(pipeline.feed_source, source)
        else:
            frames, feed = simulate(settings, UNIX_US).frames(), pipeline.feed
        for frame in takewhile(lambda frame: frame.time_s < FLIGHT_S, frames):
            self.clock.now_us = round(frame.time_s * 1e6)
            yield feed(frame.data, self.clock.now_us)
            if self.pipeline.next_due_us() <= self.clock.now_us:
                yield self.pipeline.poll(self.clock.now_us)

    def header(self, vehicle_id: int) -> TableHeader:
        return header_for(self.aircraft[vehicle_id], vehicle_id)

    def fusion_state(self, vehicle_id: int) -> FusionState:
        return self.pipeline.aircraft[vehicle_id].fusion_state


class Recording:
    """A recorder that is turned while a flight goes on."""

    def __init__(
        self,
        folder: Path,
        clock: ManualClock,
        *of_flight: Callable[[int], Any],
        mode: Mode = "always",
    ) -> None:
        self._clock = clock
        self._turned_us = clock()
        self._bench = RecorderBench(folder, clock, *of_flight, mode=mode, rotate_mb=1)

    async def turn(self) -> None:
        if self._clock() - self._turned_us >= TURN_US:
            self._turned_us = self._clock()
            await self._bench.turn(0.0)

    async def __aenter__(self) -> Recorder:
        await self._bench.turn(0.0)
        return self._bench.recorder

    async def __aexit__(self, *_: object) -> None:
        self._bench.recorder.close()


async def record(
    flight: Flight,
    folder: Path,
    clock: ManualClock,
    *introduction: Callable[[int], list[bytes]],
    mode: Mode = "always",
    before_turn: Callable[[Recorder], None] = lambda _: None,
) -> tuple[list[bytes], list[NavState]]:
    """Record a flight as the daemon does, without HIGH_LATENCY2; return its frames and states."""
    of_flight = (flight.header, flight.fusion_state, *introduction)
    recording = Recording(folder, clock, *of_flight, mode=mode)
    frames: list[bytes] = []
    states: list[NavState] = []
    async with recording as recorder:
        for out in flight.outputs():
            for sent in out.frames:
                is_kept = sent.client_id in (None, RECORDED_ONLY)
                if is_kept and sent.message_id not in UNRECORDED:
                    frames.append(sent.frame)
                    recorder.frame(sent.frame)
                    # Frames of one post of a phone take time, as those of a running gateway do.
                    clock.now_us += 10
            for record in out.records:
                recorder.flight(record)
                if isinstance(record, FusedSample):
                    states.append(record.state)
            before_turn(recorder)
            await recording.turn()
    return frames, states


@pytest.mark.parametrize("name", ["eskf", "paper", "lines", "phone", "crsf"])
async def test_flight_recorded_replayed_recorded_again_and_fused_again_is_equal(
    name: str, tmp_path: Path, clock: ManualClock
) -> None:
    flight, folder = Flight(name, clock), tmp_path / "first"
    frames, states = await record(flight, folder, clock)
    assert len(frames) > (80 if flight.kind else 100) * FLIGHT_S
    assert frames_of(folder) == frames
    sources = [TlogFile(path) for path in sorted(folder.glob("*.tlog"))]
    player = Player([Track(source, with_commands=True) for source in sources], clock(), speed=10.0)
    recording = Recording(tmp_path / "second", clock)
    async with recording as recorder:
        while (due_us := player.next_due_us()) is not None:
            clock.now_us = max(clock.now_us, due_us)
            for frame in player.poll(clock(), 100):
                recorder.frame(frame)
            await recording.turn()
    for source in sources:
        source.close()
    assert frames_of(tmp_path / "second") == frames
    check_tables(folder, states, flight)


def check_tables(folder: Path, states: list[NavState], flight: Flight) -> None:
    """Check that the tables alone give the recorded states bit for bit."""
    paths = sorted(folder.glob("*.csv"))
    # Of CRSF only the fixes are fused; its states are in the tlog.
    assert flight.kind == "crsf" or len(paths) > 1, "the parts of a recording must fuse as one"
    rows: list[TableRow] = []
    for number, path in enumerate(paths):
        reader = TableReader()
        events = reader.feed(path.read_bytes(), final=True)
        rows += [event for event in events if isinstance(event, TableRow)]
        assert reader.header is not None
        assert reader.header.cold_start is (number == 0)
    assert repr([row.state for row in rows if row.state is not None]) == repr(states)
    options = ReadOptions(PipelineSettings(flight.settings.default_aircraft))
    again = [
        row
        for row in RecordedFusion(open_recordings(paths), options).table().rows
        if isinstance(row, TableRow)
    ]
    assert repr(again) == repr(rows)
    # A later part alone begins in flight, and goes on from what the fusion remembered there.
    out = folder / "again.csv"
    invoke("fuse", paths[-1], "-o", out, code=0)
    assert out.read_bytes() == paths[-1].read_bytes()


async def test_table_that_begins_before_arming_is_fused_again_bit_for_bit(
    tmp_path: Path, clock: ManualClock, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "HELD_US", 5_000_000)

    def report(recorder: Recorder) -> None:
        recorder.set_in_flight(in_flight=False, operates=clock() > 17_000_000)

    armed = tmp_path / "armed"
    await record(Flight("eskf", clock), armed, clock, mode="armed", before_turn=report)
    (path,) = armed.glob("*.csv")
    reader = TableReader()
    times_us = [
        event.time_us
        for event in reader.feed(path.read_bytes(), final=True)
        if isinstance(event, TableRow)
    ]
    assert 7_000_000 <= times_us[0] <= 12_000_000
    assert times_us[-1] > 19_000_000
    assert reader.header is not None
    assert not reader.header.cold_start
    invoke("fuse", path, "-o", path.with_name("again.csv"), code=0)
    assert path.with_name("again.csv").read_bytes() == path.read_bytes()
