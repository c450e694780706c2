"""A recorded flight, fused again, is the flight."""

import math
from collections.abc import Iterable
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from gateway.aircraft import AircraftSettings, FusedStates
from gateway.estimation.columns import NAV_ALT, NAV_LAT, NAV_LON, NAV_QUAT, nav_row
from gateway.estimation.paper import PaperSettings
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.recordings.columns import GPS_CODEC
from gateway.recordings.files import FlightError
from gateway.recordings.fuse import Fusion, interpolated_positions
from gateway.recordings.recorded_fusion import Replay
from gateway.recordings.recorded_table import header_for, settings_of
from gateway.recordings.rows import TableRow
from gateway.recordings.table import TableEvent, TableHeader, TableNote, TableReader, block_of
from gateway.records import NavState
from gateway.sensing.calibration import NodeCalibration
from gateway.vehicle.service import SettingsChange
from gateway.vehicle.vehicle_settings import VehicleSettings
from tests.recordings.flights import (
    fly,
    fly_from_the_middle,
    make_fix,
    make_flight,
    make_settings,
    read,
)


def fuse_again(settings: AircraftSettings, lines: Iterable[TableEvent]) -> list[NavState]:
    return states_of(Fusion(1, settings, follow=True), lines)


def states_of(fusion: Fusion, lines: Iterable[TableEvent]) -> list[NavState]:
    rows = fusion.block(block_of(lines)).events(1)
    return [row.state for row in rows if isinstance(row, TableRow) and row.state]


@pytest.mark.parametrize("estimator", ["paper", "eskf"])
def test_table_fused_again_gives_bit_equal_states(rng: np.random.Generator, estimator: str) -> None:
    settings = make_settings(estimator)
    table, states = fly(settings, make_flight(rng, 30))
    header, rows = read(table)
    assert repr([row.state for row in rows if row.state]) == repr(states)
    assert repr(fuse_again(settings_of(header), rows)) == repr(states)
    assert math.isfinite(states[-1].lat_deg)
    if estimator == "paper":
        # The calibrated values of the same samples give the same states.
        assert repr(fuse_again(settings, [replace(row, raw=None) for row in rows])) == repr(states)


def test_settings_changed_in_flight_are_changed_in_replay(rng: np.random.Generator) -> None:
    settings = make_settings("paper")
    changes = {
        400: SettingsChange("estimation", make_settings("eskf").estimation),
        800: SettingsChange("calibration", NodeCalibration()),
        1200: SettingsChange("vehicle", VehicleSettings()),
    }
    table, states = fly(settings, make_flight(rng, 30), changes)
    events = TableReader().feed(table, final=True)
    assert sum(isinstance(event, TableHeader) for event in events) == 2
    assert repr(fuse_again(settings, events)) == repr(states)


@pytest.mark.parametrize("estimator", ["paper", "eskf"])
def test_flight_resumed_from_a_state_gives_bit_equal_states(
    rng: np.random.Generator, estimator: str
) -> None:
    settings, state, rows = fly_from_the_middle(estimator, rng)
    recorded = [row.state for row in rows if row.state]
    assert repr(fuse_again(settings, [state, *rows])) == repr(recorded)
    assert repr(fuse_again(settings, rows)) != repr(recorded)
    assert state.home is not None
    assert state.home[3] < rows[0].time_us
    # With other settings, home is still where it was.
    other, played = make_settings("paper" if estimator == "eskf" else "eskf"), FusedStates()
    pipeline = Pipeline(PipelineSettings(other, fused=played))
    Fusion(1, other, follow=True, played=played).block(block_of([state, rows[0]]))
    for line in (state, rows[0]):
        for _ in Replay(pipeline).feed(line):
            pass
    assert pipeline.aircraft[1].fusion_state.home == state.home


@pytest.mark.parametrize("estimator", ["paper", "eskf"])
def test_unsuitable_state_is_reported_and_not_restored(
    rng: np.random.Generator, estimator: str
) -> None:
    settings, state, rows = fly_from_the_middle(estimator, rng)
    estimation = msgspec.structs.replace(settings.estimation, paper=PaperSettings())
    other = msgspec.structs.replace(settings, estimation=estimation)
    old = msgspec.structs.replace(state, fits="0.0.1 0")
    cut = msgspec.structs.replace(state, estimation=state.estimation[:-40])
    for settings_now, found, reason in (
        (other, state, "other settings"),
        (settings, old, "another version"),
        (settings, cut, "truncated"),
    ):
        fusion = Fusion(1, settings_now, follow=True)
        states = states_of(fusion, [found, *rows[:50]])
        (refused,) = fusion.refused
        assert reason in refused
        assert repr(states) == repr(fuse_again(settings_now, rows[:50]))


def test_replay_sends_messages_at_their_rates(rng: np.random.Generator) -> None:
    settings = make_settings("eskf")
    table, _ = fly(settings, make_flight(rng, 10))
    replay = Replay(Pipeline(PipelineSettings(settings)))
    sent = [
        (now_us, sent.message_id)
        for row in read(table)[1]
        for now_us, out in replay.feed(row)
        for sent in out.frames
    ]
    assert sent == sorted(sent, key=lambda each: each[0])
    assert 9 <= sum(message_id == 0 for _, message_id in sent) <= 11


def test_marks_and_settings_of_the_flight_are_replayed_at_their_time(
    rng: np.random.Generator,
) -> None:
    settings = make_settings("eskf")
    _, rows = read(fly(settings, make_flight(rng, 3))[0])
    for follow in (True, False):
        pipeline = Pipeline(PipelineSettings(settings))
        playing = Replay(pipeline, follow=follow)
        for row in rows:
            *_, (last_us, _) = playing.feed(row)
        texts = [
            (now_us, sent.message_id)
            for now_us, out in playing.feed(TableNote(last_us + 40_000, "over the gate"))
            for sent in out.frames
            if b"over the gate" in sent.frame
        ]
        assert texts == [(last_us + 40_000, 253)]
        changed = list(playing.feed(header_for(make_settings("paper"), 1)))
        assert {now_us for now_us, _ in changed} == ({last_us + 40_000} if follow else set())
        estimator = pipeline.aircraft[1].settings.estimation.estimator
        assert estimator == ("paper" if follow else "eskf")


def test_settings_are_restored_from_the_head() -> None:
    settings = make_settings("paper")
    header = header_for(settings, 1)
    assert "secret" not in repr(header)
    open_vehicle = msgspec.structs.replace(settings.vehicle, signing_passphrase="")
    assert settings_of(header) == msgspec.structs.replace(settings, vehicle=open_vehicle)


def test_settings_of_another_version_are_refused() -> None:
    with pytest.raises(FlightError, match=r"another version .*wings"):
        settings_of(TableHeader(settings={"estimation": {"wings": 2}}))


def test_interpolated_positions_lie_on_the_line_between_the_fixes(rng: np.random.Generator) -> None:
    first, second = make_fix(1_000_000, rng), make_fix(2_000_000, rng)
    first = msgspec.structs.replace(first, lon_dege7=1_799_999_000, alt_amsl_m=10.0)
    second = msgspec.structs.replace(second, lon_dege7=-1_799_999_000, alt_amsl_m=20.0)
    position = interpolated_positions(
        np.array([*map(GPS_CODEC.write, (first, second))], float), 0.25
    )
    _, states = fly(make_settings("paper"), make_flight(rng, 1))
    row = np.array([nav_row(states[0])] * 2)
    middle, outside = position(np.array([1_250_000, 2_000_000]), row)
    assert middle[NAV_ALT] == pytest.approx(15.0)
    assert middle[NAV_LON] == pytest.approx(-180.0)
    assert middle[NAV_LAT] == pytest.approx((first.lat_dege7 + second.lat_dege7) * 0.5e-7)
    assert middle[NAV_QUAT : NAV_QUAT + 4].tolist() == row[0, NAV_QUAT : NAV_QUAT + 4].tolist()
    np.testing.assert_array_equal(outside, row[0])
