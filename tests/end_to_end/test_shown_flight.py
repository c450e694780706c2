"""A recording shows one flight: as a tlog in a ground station's own replay, and as it is played."""

from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.aircraft import Aircraft
from gateway.answers.log_answers import ANSWERS, VehicleAnswers
from gateway.recordings.opening import lay_out, open_flights
from gateway.recordings.play import AS_FAST_AS_POSSIBLE, Player
from gateway.recordings.recorded_table import ReadOptions
from gateway.recordings.tlog import TlogScanner
from gateway.records import Incoming, Outgoing
from gateway.vehicle.recorded_vehicle import RecordedVehicle
from gateway.wire.mavlink_splitter import message_id_of
from tests.conftest import ManualClock
from tests.end_to_end.test_recording import Flight, record
from tests.kit.mavlink import packed

pytestmark = [pytest.mark.io, pytest.mark.slow]


@dataclass
class Shown:
    """What a ground station such as QGroundControl shows of one vehicle."""

    parameters: dict[str, tuple[float, int]] = field(default_factory=dict)
    modes: set[str] = field(default_factory=set)
    states: list[tuple[bool, int, int]] = field(default_factory=list)
    """Armed, custom mode, system status: each change."""
    track: list[tuple[int, int, int, int]] = field(default_factory=list)
    home: set[tuple[int, int]] = field(default_factory=set)
    version: int | None = None

    def take(self, frames: Iterable[bytes]) -> "Shown":
        decoder = mavlink.MAVLink(None)
        decoder.robust_parsing = True
        for frame in frames:
            self._show(decoder.decode(bytearray(frame)))
        return self

    def _show(self, m: Any) -> None:
        match m.get_type():
            case "HEARTBEAT":
                state = (bool(m.base_mode & 128), m.custom_mode, m.system_status)
                if self.states[-1:] != [state]:
                    self.states.append(state)
            case "HIGH_LATENCY2":
                raise AssertionError("a station would take it for another state and position")
            case "PARAM_VALUE":
                self.parameters[m.param_id] = (m.param_value, m.param_type)
            case "AVAILABLE_MODES":
                self.modes.add(m.mode_name)
            case "GLOBAL_POSITION_INT":
                self.track.append((m.lat, m.lon, m.alt, m.relative_alt))
            case "HOME_POSITION":
                self.home.add((m.latitude, m.longitude))
            case "AUTOPILOT_VERSION":
                self.version = m.flight_sw_version


@pytest.fixture
async def folder(tmp_path: Path, clock: ManualClock) -> Path:
    """Record with the head of every part, as the daemon does."""
    flight = Flight("eskf", clock)

    def introduction(vehicle_id: int) -> list[bytes]:
        return [sent.frame for sent in flight.pipeline.aircraft[vehicle_id].vehicle.introduction()]

    await record(flight, tmp_path, clock, introduction)
    return tmp_path


async def test_tlog_and_playback_show_the_same_flight(folder: Path) -> None:
    files = sorted(folder.glob("*.tlog"))
    assert len(files) > 1
    heads = [TlogScanner().feed(file.read_bytes(), final=True) for file in files]
    for batch in heads:
        first = Shown().take(batch.frame(i) for i in range(200))
        assert len(first.parameters) > 50
        assert first.modes
        assert first.version is not None
    recorded = Shown().take(batch.frame(i) for batch in heads for i in range(len(batch)))
    with ExitStack() as opened:
        options = ReadOptions(Flight("eskf", ManualClock()).pipeline._settings)
        (flight,) = lay_out(open_flights(files, options, opened), with_commands=False)
        player = Player(flight.tracks, 0, speed=AS_FAST_AS_POSSIBLE)
        frames: list[bytes] = []
        while some := player.poll(0, 1000):
            frames += some
        sent = {message_id_of(frame) for frame in frames}
        assert not sent & {*ANSWERS.tolist()}
        played = Shown().take(frames)
        (played_as,) = flight.system_ids.values()
        answers = VehicleAnswers(flight.answers, played_as, played_as, lambda: player.position_us)
        metadata = Aircraft(1, options.current.default).vehicle.metadata
        vehicle = RecordedVehicle(played_as, answers, metadata)
        played.take(asked(vehicle, mavlink.MAVLink_param_request_list_message(played_as, 1)))
        for message_id in (148, 435):
            request = mavlink.MAVLink_command_long_message(
                played_as, 1, 512, 0, message_id, 0, 0, 0, 0, 0, 0
            )
            played.take(asked(vehicle, request))
        (count,) = asked(vehicle, mavlink.MAVLink_mission_request_list_message(played_as, 1, 0))
        assert mavlink.MAVLink(None).decode(bytearray(count)).count == 0
    assert played.parameters == recorded.parameters
    assert played.modes == recorded.modes
    assert played.states == recorded.states
    assert played.track == recorded.track
    assert played.home == recorded.home
    assert played.version == recorded.version
    assert vehicle.metadata is metadata


def asked(vehicle: RecordedVehicle, request: Any) -> list[bytes]:
    """Ask a played vehicle as a ground station does; frames without the acknowledgement."""
    frame = packed(request, 255, 190)
    actions = vehicle.handle(Incoming(1, frame, trusted=True), 0)
    now_us = 0
    while (due_us := vehicle.next_due_us()) is not None:
        now_us = max(now_us, due_us)
        actions += vehicle.poll(now_us)
    return [a.frame for a in actions if isinstance(a, Outgoing) and a.message_id != 77]
