"""One receiver's line: records on the gateway clock, and an account that adds up."""

from collections.abc import Iterable
from datetime import UTC, datetime
from itertools import pairwise

import numpy as np
import pytest
from msgspec.structs import replace

from gateway.records import (
    BaroRaw,
    GpsFix,
    GpsFixType,
    ImuFlags,
    ImuRaw,
    LinkReport,
    NodeId,
    NodeStatus,
    PipeCounters,
    RawRecord,
)
from gateway.wire import payloads
from gateway.wire.framing import encode_frame
from gateway.wire.link import LATE_WINDOW, Link, SequenceCounter
from gateway.wire.timesync import WRAP_US

IMU = payloads.ImuPayload(
    (1, 2, 3), (4, 5, 6), (7, 8, 9), -100, ImuFlags.MAG_NEW, accel_range=2, gyro_range=2, mag_gain=1
)
FIX = payloads.GpsFixPayload(
    1000, -77_000_000, 1_103_000_000, 110_000, (100, -200, 30), GpsFixType.FIX_3D, True, 11
)
UTC_TIME = datetime(2026, 5, 4, 3, 2, 1, 200_000, tzinfo=UTC)
QUALITY = payloads.GpsQualityPayload(1000, 150, 65_535, 30, 120, 140, 2_300, UTC_TIME)


class Line:
    """A sender of frames with true counters, to be damaged by the tests."""

    def __init__(self, vehicle_id: int = 1, node_id: int = 0) -> None:
        self.node = NodeId(vehicle_id, node_id)
        self.seq = 0
        self.frame_seq = 0

    def frame(self, time_us: int, payload: payloads.Payload, seq: int | None = None) -> bytes:
        seq = self.seq if seq is None else seq
        self.seq = (seq + 1) % 65536
        packet = payloads.encode_payload(payloads.Header(self.node, seq, time_us), payload)
        content = payloads.encode_radio(self.frame_seq, self.node.node_id, time_us + 400, packet)
        self.frame_seq = (self.frame_seq + 1) % 256
        return encode_frame(content)

    def send(self, link: Link, numbers: Iterable[int], start_us: int = 0) -> list[RawRecord]:
        """Send IMU payloads of 100 Hz by their numbers, which arrive as they are sampled."""
        times_us = [number * 10_000 for number in numbers]
        return [r for us in times_us for r in link.feed(self.frame(us, IMU), start_us + us)]


def report(link: Link, now_us: int = 0) -> LinkReport:
    return link.report(now_us, connected=True, port="")


@pytest.mark.parametrize(
    ("sequence", "received", "lost", "duplicates", "reordered"),
    [
        ([0, 1, 2, 3], 4, 0, 0, 0),
        ([5, 6, 9, 10], 4, 2, 0, 0),
        ([65534, 65535, 0, 1], 4, 0, 0, 0),
        ([1, 2, 2, 3, 3, 3], 3, 0, 3, 0),
        ([1, 3, 2, 4], 4, 0, 0, 1),
        ([1, 5, 2, 2, 6], 4, 2, 1, 1),
        ([10, 9], 1, 0, 1, 0),
        ([40_000, 10, 11], 3, 25_545, 0, 0),
        ([40_000, 39_000, 39_001], 3, 0, 0, 0),
        ([1000, 1000 - LATE_WINDOW], 2, 0, 0, 0),
    ],
)
def test_sequence_numbers_are_counted_by_kind(
    sequence: list[int], received: int, lost: int, duplicates: int, reordered: int
) -> None:
    counter = SequenceCounter()
    for seq in sequence:
        counter.count(seq)
    account = (counter.received, counter.lost, counter.duplicates, counter.reordered)
    assert account == (received, lost, duplicates, reordered)


@pytest.mark.parametrize("seed", range(5))
def test_counts_equal_the_losses_and_duplicates_made(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sent = np.arange(5000)
    kept = sent[(rng.random(sent.size) > 0.1) | (sent == 0) | (sent == sent[-1])].tolist()
    line = [seq for seq in kept for _ in range(1 + (rng.random() < 0.05))]
    counter = SequenceCounter()
    arrivals = [counter.count((seq + 64_000) % 65536) for seq in line]
    assert counter.received == len(kept)
    assert counter.lost == sent.size - len(kept)
    assert arrivals.count(False) == counter.duplicates == len(line) - len(kept)


def test_first_imu_payload_is_returned_once_a_second_one_agrees() -> None:
    line, link = Line(3), Link()
    assert link.feed(line.frame(1_000_000, IMU), 9_000_000) == [], "not accepted yet"
    record, second = link.feed(line.frame(1_010_000, IMU), 9_010_000)
    assert second.time_us == 9_010_000
    assert record == ImuRaw(
        time_us=9_000_000,
        node=NodeId(3, 0),
        node_time_us=1_000_000,
        accel_raw=(1, 2, 3),
        gyro_raw=(4, 5, 6),
        mag_raw=(7, 8, 9),
        temperature_raw=-100,
        accel_range_g=8,
        gyro_range_dps=1000,
        mag_lsb_per_gauss=1090,
        flags=ImuFlags.MAG_NEW,
    )


def test_barometer_and_status_payloads_become_records() -> None:
    line, link = Line(), Link()
    pressure = payloads.BaroPayload(10_132_550, -12)
    baro, _ = link.feed(line.frame(0, pressure) + line.frame(500, pressure), 0)
    assert isinstance(baro, BaroRaw)
    assert (baro.pressure_pa, baro.temperature_degc) == pytest.approx((101_325.5, -1.2))
    status = payloads.NodeStatusPayload((1, 2), 8, 7, 1, 3, 4, 5, 600, 100, 3300)
    (record,) = link.feed(line.frame(1000, status), 1000)
    assert isinstance(record, NodeStatus)
    assert (record.firmware_version, record.supply_mv) == ((1, 2), 3300)


def test_fix_has_the_quality_of_its_own_epoch() -> None:
    line, link = Line(1, 1), Link()
    assert link.feed(line.frame(0, QUALITY), 0) == []
    (fix,) = link.feed(line.frame(0, FIX), 0)
    assert isinstance(fix, GpsFix)
    assert fix.h_acc_m == pytest.approx(1.5)
    assert np.isnan(fix.v_acc_m)
    assert fix.vel_n_mps == pytest.approx((1.0, -2.0, 0.3))
    assert fix.alt_ellipsoid_m == pytest.approx(133.0)
    assert fix.utc_us == 1_777_863_721_200_000
    assert datetime.fromtimestamp(fix.utc_us / 1e6, UTC) == UTC_TIME
    (fix,) = link.feed(line.frame(200_000, replace(FIX, itow_ms=1200)), 200_000)
    assert np.isnan([fix.h_acc_m, fix.v_acc_m, fix.speed_acc_mps, fix.course_acc_deg]).all()
    assert fix.utc_us is None
    assert fix.alt_ellipsoid_m == pytest.approx(133.0), "the geoid does not move"


def test_duplicate_and_late_payloads_give_no_records_and_are_no_fault() -> None:
    """Also where the node's clock wraps."""
    line, link = Line(), Link()
    begin_us = WRAP_US - 30_000
    frames = [line.frame((begin_us + i * 10_000) % WRAP_US, IMU) for i in range(6)]
    order = [0, 1, 3, 2, 3, 4, 2, 5, 5]
    records = [r for n, i in enumerate(order) for r in link.feed(frames[i], 50_000 + n * 10_000)]
    assert [(r.node_time_us - begin_us) % WRAP_US // 10_000 for r in records] == [0, 1, 3, 4, 5]
    assert all(a.time_us < b.time_us for a, b in pairwise(records))
    found = report(link)
    (node,) = found.nodes
    assert (node.received, node.lost, node.duplicates, node.reordered) == (6, 0, 3, 1)
    assert found.faults == ()


def test_restart_of_node_and_receiver_is_counted_and_loses_no_payload() -> None:
    line, link = Line(), Link()
    line.send(link, range(50), 100_000_000)
    line.seq = line.frame_seq = 0
    (record,) = link.feed(line.frame(70_000, IMU), 103_000_000)
    assert record.time_us == 103_000_000
    found = report(link)
    assert (found.nodes[0].lost, found.nodes[0].restarts, found.frames_lost) == (0, 1, 0)


@pytest.mark.parametrize(("next_seq", "restarts"), [(200, 0), (0, 1)], ids=["halted", "restarted"])
def test_halted_clock_is_a_restart_only_if_sequence_restarts(next_seq: int, restarts: int) -> None:
    line, link = Line(), Link()
    line.send(link, range(200), 100_000_000)
    line.seq = next_seq
    records = line.send(link, range(200, 1200), 104_000_000)
    assert records[-1].time_us == 104_000_000 + 1199 * 10_000
    assert all(a.time_us < b.time_us for a, b in pairwise(records))
    (node,) = report(link).nodes
    assert (node.lost, node.restarts) == (0, restarts)


@pytest.mark.parametrize("rate_hz", [50, 200, 1000])
@pytest.mark.parametrize("queue_us", [300, 5_000, 40_000])
def test_samples_come_a_little_closer_after_a_queue(rate_hz: int, queue_us: int) -> None:
    """The first samples wait in a queue that clears at once: theirs is a time too late."""
    link, line, period_us = Link(), Line(), 1_000_000 // rate_hz
    times_us, arrivals_us = [], []
    for number in range(64 * (queue_us // period_us + 2) + 20):
        node_us = 1_000_000 + number * period_us
        arrival_us = max(node_us, 1_000_000 + queue_us) + 1000
        times_us += [r.time_us for r in link.feed(line.frame(node_us, IMU), arrival_us)]
        arrivals_us.append(arrival_us)
    assert len(times_us) == len(arrivals_us)
    gaps_us = np.diff(times_us)
    assert gaps_us.min() >= period_us * 63 // 64
    assert gaps_us.max() <= period_us
    assert times_us[-1] == arrivals_us[-1]


def test_samples_of_a_long_queue_still_come_in_order() -> None:
    link, line = Link(), Line()
    stamps_us = range(1_000_000, 2_000_000, 5000)
    found = [record for us in stamps_us for record in link.feed(line.frame(us, IMU), 2_000_000)]
    times_us = np.array([record.time_us for record in found])
    assert len(times_us) == len(stamps_us)
    assert np.diff(times_us).min() >= 1
    assert times_us.max() <= 2_000_000 + 51_000


@pytest.mark.parametrize(("year", "counted"), [(2006, 1), (2023, 1), (2024, 0), (2026, 0)])
def test_date_before_the_protocol_is_a_fault_and_not_used(year: int, counted: int) -> None:
    line, link = Line(node_id=1), Link()
    quality = replace(QUALITY, utc=UTC_TIME.replace(year=year))
    records = []
    for number, payload in enumerate((IMU, IMU, quality, FIX)):
        records += link.feed(line.frame(number * 10_000, payload), number * 10_000)
    fix = records[-1]
    assert isinstance(fix, GpsFix)
    assert (fix.utc_us is None) == bool(counted)
    assert fix.h_acc_m == 1.5
    faults = dict(report(link).faults)
    assert faults == ({"gps_date": counted} if counted else {})


@pytest.mark.parametrize("first", [0, 5], ids=["from the first on", "later"])
def test_constant_sequence_number_is_a_fault(first: int) -> None:
    line, link = Line(), Link()
    for number in range(first + 20):
        link.feed(line.frame(number * 10_000, IMU, seq=min(number, first)), number * 10_000)
    assert dict(report(link).faults) == {"sequence": 19}


def test_aircraft_of_one_receiver_are_counted_separately() -> None:
    link = Link()
    lines = [Line(vehicle, node) for vehicle in (1, 2, 3) for node in (0, 1)]
    for i in range(60):
        lines[i % 6].frame_seq = i
        lines[i % 6].send(link, [i // 6])
    found = report(link, 90_000)
    assert {node.node for node in found.nodes} == {line.node for line in lines}
    assert all(node.received == 10 and node.lost == 0 for node in found.nodes)
    assert found.frames_lost == 0


def test_serial_and_radio_losses_are_counted_separately() -> None:
    line, link = Line(), Link()
    frames = [line.frame(i * 10_000, IMU) for i in range(10)]
    frames[4] = frames[4][:5] + b"\x55" + frames[4][6:]
    del frames[7]
    link.feed(b"".join(frames), 0)
    found = report(link)
    assert dict(found.faults) == {"crc": 1}
    assert (found.frames, found.frames_lost, found.nodes[0].lost) == (8, 2, 2)
    assert found.bytes_received == sum(map(len, frames))


def test_receiver_status_is_reported() -> None:
    pipes = tuple(PipeCounters(i, i + 1, i + 2) for i in range(6))
    status = payloads.ReceiverStatusFrame(0, 5_000_000, 76, 12, 3, 1, pipes)
    link = Link()
    assert link.feed(encode_frame(payloads.encode_receiver_status(status)), 7_000_000) == []
    receiver = report(link).receiver
    assert receiver is not None
    assert (receiver.time_us, receiver.noise_percent, receiver.pipes) == (7_000_000, 12, pipes)


def test_rate_is_that_of_the_last_second() -> None:
    line, link = Line(), Link()
    line.send(link, range(300))
    assert report(link, 2_990_000).nodes[0].rate_hz == 100.0
    assert report(link, 5_000_000).nodes[0].rate_hz == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_line_with_a_tenth_of_corrupt_bytes_gives_only_true_records(seed: int) -> None:
    rng = np.random.default_rng(seed)
    line, link = Line(), Link()
    stream = bytearray(b"".join(line.frame(i * 5_000, IMU) for i in range(2000)))
    hit = rng.random(len(stream)) < 0.10
    for index in np.flatnonzero(hit):
        stream[index] ^= int(rng.integers(1, 256))
    chunks = np.array_split(np.frombuffer(bytes(stream), np.uint8), 97)
    records = [each for chunk in chunks for each in link.feed(chunk.tobytes(), 10_000_000)]
    assert records
    found = report(link)
    assert found.frames == len(records)
    assert sum(count for _, count in found.faults) > 0
    assert all(r.accel_raw == (1, 2, 3) for r in records)
