"""The frames on the line: decodable, in order, with the losses that were asked for."""

import gc
import itertools
import tracemalloc
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import gateway
from gateway.records import BaroRaw, GpsFix, ImuRaw, LinkReport, NodeId
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.node import nodes_of
from gateway.simulator.receiver import SimulatedReceiver, damage, simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.wire.framing import Fault, FaultKind, FrameDecoder, encode_frame
from gateway.wire.link import Link
from gateway.wire.payloads import RadioFrame, ReceiverStatusFrame, decode_content
from tools.simulated_flight import fly

SECONDS = 20.0


def settings(**changes: object) -> SimulatorSettings:
    return msgspec.structs.replace(SimulatorSettings(), **changes)


def frames(seconds: float = SECONDS, **changes: object) -> list[TimedFrame]:
    return list(simulate(settings(**changes)).frames(seconds))


def decoded(line: list[TimedFrame]) -> list[RadioFrame | ReceiverStatusFrame]:
    events = FrameDecoder().feed(b"".join(frame.data for frame in line))
    found = [decode_content(event) for event in events if isinstance(event, bytes)]
    assert len(found) == len(line)
    return [c for c in found if isinstance(c, RadioFrame | ReceiverStatusFrame)]


def reports_of(contents: list[RadioFrame | ReceiverStatusFrame]) -> list[ReceiverStatusFrame]:
    return [content for content in contents if isinstance(content, ReceiverStatusFrame)]


def feed(line: list[TimedFrame]) -> tuple[list[Any], LinkReport]:
    """Return the records of frames, and the report of their link."""
    link = Link()
    found = [each for f in line for each in link.feed(f.data, round(f.time_s * 1e6))]
    return found, link.report(round(line[-1].time_s * 1e6), connected=True, port="")


class Counted:
    """A sampler whose pieces are counted."""

    def __init__(self, sampler: Any, made: list[int]) -> None:
        self.take_samples, self.made = sampler.take, made
        self.clock = getattr(sampler, "clock", None)

    def take(self, until_s: float) -> Any:
        samples = self.take_samples(until_s)
        self.made.append(len(samples.time_s))
        return samples


@pytest.fixture(scope="module")
def line() -> list[TimedFrame]:
    return frames()


class TestLine:
    def test_every_frame_decodes(self, line: list[TimedFrame]) -> None:
        contents = decoded(line)
        assert len(contents) == len(line)
        sequence = [content.frame_seq for content in contents]
        assert all((b - a) % 256 == 1 for a, b in itertools.pairwise(sequence))

    def test_frame_times_allow_for_transmission_at_line_speed(self, line: list[TimedFrame]) -> None:
        for before, after in itertools.pairwise(line):
            assert after.time_s - before.time_s >= len(after.data) * 10 / 500_000 - 1e-9
        assert line[-1].time_s < SECONDS + 0.01

    def test_receiver_time_is_that_of_arrival(self, line: list[TimedFrame]) -> None:
        for frame, content in zip(line, decoded(line), strict=True):
            heard_s = (content.receiver_time_us - 1_618_033) * 1e-6 / (1.0 + 60e-6)
            assert 0.0 < frame.time_s - heard_s < 0.006

    def test_receiver_reports_once_a_second(self, line: list[TimedFrame]) -> None:
        reports = reports_of(decoded(line))
        assert len(reports) == 19
        assert reports[-1].pipes[0].received == pytest.approx(19 * 126, rel=0.03)
        assert reports[-1].pipes[1].received == pytest.approx(19 * 11, rel=0.05)
        assert reports[-1].pipes[2].received == 0

    def test_equal_seeds_give_equal_frames(self, line: list[TimedFrame]) -> None:
        same, other = frames(5.0), frames(5.0, seed=2)
        assert same == line[: len(same)]
        assert same != other

    def test_each_frame_needs_at_most_one_piece_of_samples(self) -> None:
        """More would block the event loop that asks for the frame."""
        made: list[int] = []
        four, nodes = settings(vehicles=4, radio_loss=0.0), []
        for index in range(4):
            aircraft = SimulatedAircraft(four, index)
            for name in ("imu", "baro", "gps"):
                setattr(aircraft, name, Counted(getattr(aircraft, name), made))
            nodes += nodes_of(aircraft, four)
        line = SimulatedReceiver(four, nodes).frames(6.0)
        assert next(line).time_s < 0.1
        total = len(made)
        for _ in line:
            assert len(made) <= total + 1
            total = len(made)
        assert total > 100
        assert max(made) <= 21

    def test_too_slow_line_drops_frames_and_counts_them(self) -> None:
        contents = decoded(frames(10.0, baud=38_400, imu_rate_hz=200))
        assert reports_of(contents)[-1].uart_dropped > 100
        radio = [c.frame_seq for c in contents]
        assert any((b - a) % 256 > 1 for a, b in itertools.pairwise(radio)), "the gap shows"

    def test_1000_samples_per_second_fit_on_the_line(self) -> None:
        contents = decoded(frames(3.0, imu_rate_hz=1000, radio_loss=0.0))
        assert reports_of(contents)[-1].uart_dropped == 0
        assert len(contents) == pytest.approx(3 * 1037, rel=0.01)


class TestRadio:
    @pytest.mark.parametrize(("loss", "burst"), [(0.0, 1.0), (0.01, 1.0), (0.1, 1.0), (0.1, 20.0)])
    def test_loss_equals_its_setting(self, loss: float, burst: float) -> None:
        rates = {"baro_rate_hz": 1, "radio_duplicates": 0.0}
        line = frames(60.0, radio_loss=loss, radio_burst=burst, **rates)
        seqs = [
            c.header.seq for c in decoded(line)
            if isinstance(c, RadioFrame) and c.header.node == NodeId(1, 0)
        ]  # fmt: skip
        gaps = np.diff(seqs) - 1
        assert (gaps >= 0).all()
        share = gaps.sum() / (gaps.sum() + len(seqs))
        # A burst counts as one draw: fewer independent draws, wider bounds.
        assert share == pytest.approx(loss, abs=4.0 * np.sqrt(2.0 * burst * loss / 6_120) + 1e-9)
        if loss:
            assert gaps[gaps > 0].mean() == pytest.approx(burst, rel=0.35)

    def test_duplicates_are_counted_and_not_lost(self) -> None:
        _, report = feed(frames(30.0, radio_duplicates=0.05, radio_loss=0.0))
        imu = next(node for node in report.nodes if node.node == NodeId(1, 0))
        assert imu.duplicates == pytest.approx(0.05 * imu.received, rel=0.2)
        assert imu.lost == 0


class TestThroughTheWire:
    def test_clock_skew_equals_its_setting(self) -> None:
        _, report = feed(frames(60.0, clock_skew_ppm=300.0))
        skews = {node.node.node_id: node.clock_skew_ppm for node in report.nodes}
        assert skews[0] == pytest.approx(300.0, abs=5.0)
        assert skews[1] == pytest.approx(-300.0, abs=15.0)

    def test_decoded_records_equal_those_of_the_flight(self) -> None:
        # Without losses, since a fix whose quality payload was lost has no accuracy or time.
        records, _ = feed(frames(radio_loss=0.0))
        flown = fly(settings(), duration_s=SECONDS)
        direct = {(type(r), r.node_time_us): r for r in flown.records()}
        for record in records:
            if isinstance(record, ImuRaw | BaroRaw | GpsFix):
                original = direct[type(record), record.node_time_us]
                assert abs(record.time_us - original.time_us) < 12_000
                names = {
                    ImuRaw: "accel_raw gyro_raw mag_raw flags temperature_raw accel_range_g",
                    BaroRaw: "pressure_pa",
                    GpsFix: "lat_dege7 lon_dege7 utc_us fix_type fix_ok satellites",
                }[type(record)].split()
                for name in names:
                    assert getattr(record, name) == getattr(original, name), (name, record)

    def test_node_restart_is_counted_and_leaves_a_gap(self) -> None:
        records, report = feed(frames(30.0, imu_restart_s=12.0))
        imu = [record for record in records if isinstance(record, ImuRaw)]
        assert [node.restarts for node in report.nodes] == [1, 0]
        silent_us = max(b.time_us - a.time_us for a, b in itertools.pairwise(imu))
        assert 590_000 < silent_us < 640_000
        assert min(r.node_time_us for r in imu) == pytest.approx(600_000, abs=10_000)
        assert imu[-1].time_us == pytest.approx(30e6, abs=30_000)

    def test_three_aircraft_share_the_receiver(self) -> None:
        _, report = feed(frames(5.0, vehicles=3, vehicle_id=7))
        assert {(n.node.vehicle_id, n.node.node_id, n.pipe) for n in report.nodes} == {
            (7, 0, 0), (7, 1, 1), (8, 0, 2), (8, 1, 3), (9, 0, 4), (9, 1, 5)
        }  # fmt: skip


@pytest.mark.parametrize(
    ("start_unix_us", "years"),
    [(0, set()), (-(10**15), set()), (10**18, {2254}), (8 * 10**15, {2223})],
)
def test_impossible_start_time_is_limited_to_gps_range(start_unix_us: int, years: set[int]) -> None:
    """A clock that was never set gives the year 2000, which is rejected."""
    line = simulate(settings(gps_first_fix_s=0.5), start_unix_us).frames(3.0)
    records, report = feed(list(line))
    reported_us = [r.utc_us for r in records if isinstance(r, GpsFix) and r.utc_us is not None]
    assert {datetime.fromtimestamp(us / 1e6, UTC).year for us in reported_us} == years
    assert ("gps_date" in dict(report.faults)) == (not years)


def test_vehicle_ids_must_fit_the_protocol() -> None:
    with pytest.raises(ValueError, match="up to 32"):
        simulate(settings(vehicle_id=31, vehicles=2))


class TestDamage:
    def test_damage_affects_the_set_share_of_bytes(
        self, rng: np.random.Generator, line: list[TimedFrame]
    ) -> None:
        hit = list(damage(iter(line), 0.1, rng))
        size = sum(len(frame.data) for frame in line)
        assert sum(f.damaged for f in hit) == pytest.approx(0.1 * size, rel=0.03)
        for before, after in zip(line, hit, strict=True):
            differing = sum(a != b for a, b in zip(before.data, after.data, strict=True))
            assert differing == after.damaged
            assert after.time_s == before.time_s

    @pytest.mark.parametrize("share", [0.002, 0.02, 0.1])
    def test_undamaged_frames_are_the_ones_that_decode(self, share: float) -> None:
        """A frame survives if it and the delimiter before it are whole."""
        clean = frames(10.0)
        hit = frames(10.0, corrupt_bytes=share)
        expected = 0
        delimiter = True
        for frame in hit:
            expected += delimiter and frame.damaged == 0
            delimiter = frame.data[-1] == 0
        events = FrameDecoder().feed(b"".join(frame.data for frame in hit))
        good = [event for event in events if isinstance(event, bytes)]
        assert len(good) == expected
        contents = {encode_frame(content) for content in good}
        assert contents <= {frame.data for frame in clean}
        assert any(event.kind is FaultKind.CRC for event in events if isinstance(event, Fault))


@pytest.mark.slow
def test_memory_does_not_grow_with_flight_time() -> None:
    """The simulator keeps only frames that are not yet due."""
    assert _growth_bytes(kept=None) < 30_000
    # The same measurement shows growth where all frames are kept.
    assert _growth_bytes(kept=[]) > 80_000


def _growth_bytes(kept: list[TimedFrame] | None) -> int:
    """Return by how much the simulator's memory grows from 20 to 40 s.

    The libraries' caches, which fill whenever some test is the first to need them, do not count.
    """
    walk = simulate(settings(imu_rate_hz=20, baro_rate_hz=1)).frames()
    own = tracemalloc.Filter(True, str(Path(gateway.__file__).parent / "*"))
    sizes = []
    tracemalloc.start()
    for until_s in (20.0, 40.0):
        for frame in walk:
            if frame.time_s > until_s:
                break
            if kept is not None:
                kept.append(frame)
        gc.collect()
        traces = tracemalloc.take_snapshot().filter_traces([own]).traces
        sizes.append(sum(trace.size for trace in traces))
    tracemalloc.stop()
    return sizes[1] - sizes[0]
