"""Links too narrow for everything: thinned by importance, and nothing starves."""

import itertools
from collections import Counter, defaultdict

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gateway.hub.bandwidth import FLOOR_HZ, HIGH_LATENCY2, NEVER_THINNED, Bandwidth, Offered
from gateway.hub.endpoint import parse_endpoint
from gateway.hub.fanout import Fanout
from gateway.hub.routing_table import SystemPath
from gateway.units import US_PER_S
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import frame_of, message_id_of
from tests.kit.hub import KeepingClient

STREAMS = {
    # Message: rate in Hz and payload in bytes, as the default settings send them.
    0: (1, 9), 1: (2, 31), 2: (1, 12), 24: (5, 52), 29: (5, 14), 30: (50, 28), 31: (50, 32),
    33: (10, 28), 42: (1, 18), 62: (2, 26), 74: (10, 20), 105: (10, 62), 109: (1, 9), 147: (1, 41),
    230: (1, 42), 242: (1, 52), 245: (2, 2), 235: (0.2, 42),
}  # fmt: skip


class Flight:
    """A vehicle at its default rates, and clients of some bandwidths."""

    def __init__(self, *urls: str) -> None:
        self.fanout = Fanout(FrameSigner())
        self.sinks = [KeepingClient(number, url) for number, url in enumerate(urls, start=1)]
        for sink in self.sinks:
            self.fanout.add(sink)
        self.now_us = 0
        self.sequence = 0
        self.due_us: dict[int, float] = defaultdict(float)

    def run(self, seconds: float) -> int:
        """Fly; return when it began."""
        begin_us = self.now_us
        while self.now_us < begin_us + seconds * US_PER_S:
            for message_id, (rate_hz, size) in STREAMS.items():
                if self.now_us >= self.due_us[message_id]:
                    self.due_us[message_id] += US_PER_S / rate_hz
                    self.publish(message_id, size)
            self.now_us += 5000
            if self.now_us % 250_000 == 0:
                self.fanout.thin(self.now_us)
        return begin_us

    def publish(self, message_id: int, size: int) -> None:
        for sink in self.sinks:
            sink.now_us = self.now_us
        head = bytes((size, 0, 0, self.sequence, 1, 1)) + message_id.to_bytes(3, "little")
        self.sequence = (self.sequence + 1) % 256
        frame = frame_of(b"\xfd" + head + bytes(size - 1) + b"\1\0\0")
        self.fanout.publish(frame, frame.sequence, self.now_us)


def rates(frames: list[bytes], seconds: float) -> dict[int, float]:
    return {key: count / seconds for key, count in Counter(map(message_id_of, frames)).items()}


@pytest.mark.parametrize("budget", [5760, 3000, 1500, 800])
def test_no_message_starves_and_all_fit_the_bandwidth_without_a_gap(budget: int) -> None:
    flight = Flight(f"udp:h:1?budget={budget}", "udp:h:2")
    flight.run(10)
    begin_us = flight.run(20)
    narrow, wide = (rates(sink.since(begin_us), 20) for sink in flight.sinks)
    flow = sum(map(len, flight.sinks[0].since(begin_us))) / 20
    assert flow <= 1.05 * budget
    if budget >= 1500:
        assert flow >= 0.85 * budget
    assert narrow.keys() == wide.keys() == STREAMS.keys() - {HIGH_LATENCY2}
    for message_id, rate in narrow.items():
        assert rate >= 0.9 * min(FLOOR_HZ, STREAMS[message_id][0])
    assert narrow[0] == wide[0] == pytest.approx(1.0, abs=0.1)
    assert wide[31] == pytest.approx(50, abs=1)
    numbers = [frame_of(frame).sequence for frame in flight.sinks[0].frames]
    assert {(b - a) % 256 for a, b in itertools.pairwise(numbers)} == {1}


def test_position_and_health_are_thinned_less_than_raw_values() -> None:
    flight = Flight("udp:h:1?budget=2000")
    flight.run(10)
    parts = {
        key: rate / STREAMS[key][0]
        for key, rate in rates(flight.sinks[0].since(flight.run(20)), 20).items()
    }
    assert parts[33] > 1.5 * parts[31] > 2 * parts[105]
    assert parts[33] == pytest.approx(parts[24], rel=0.3)


def test_telemetry_resumes_soon_after_many_answers() -> None:
    """All parameters within two seconds, as they are sent: four times the bandwidth of the link."""
    flight = Flight("udp:h:1?budget=960")
    flight.run(10)
    usual = rates(flight.sinks[0].since(flight.run(10)), 10)
    for number in range(110):
        frame = b"\xfd\x19\0\0" + bytes([number, 1, 1, 22, 0, 0]) + bytes(27)
        flight.fanout.answer(frame_of(frame), number, [1], flight.now_us)
        flight.run(0.02)
    flight.run(4)
    again = rates(flight.sinks[0].since(flight.run(6)), 6)
    for message_id, rate in usual.items():
        assert again.get(message_id, 0.0) >= 0.5 * min(rate, 2.0) - 0.17


def test_serial_line_has_the_bandwidth_of_its_baud_rate() -> None:
    assert parse_endpoint("serial:/dev/ttyUSB0:57600").budget == 5760
    assert parse_endpoint("serial:/dev/ttyUSB0:57600?budget=2000").budget == 2000
    assert parse_endpoint("udp:h:1").budget == 0


def test_wide_link_gets_everything_without_delay() -> None:
    flight = Flight("udp:h:1?budget=50000", "udp:h:2")
    flight.run(20)
    assert flight.sinks[0].sent == flight.sinks[1].sent


@pytest.mark.parametrize("budget", [10, 54, 99])
def test_satellite_link_gets_one_message_only(budget: int) -> None:
    flight = Flight(f"udp:h:1?budget={budget}")
    flight.run(60)
    kinds = {message_id_of(frame) for frame in flight.sinks[0].frames}
    assert kinds == {HIGH_LATENCY2}
    assert sum(len(frame) for frame in flight.sinks[0].frames[1:]) <= budget * 60 * 1.1


def test_message_of_a_foreign_satellite_link_goes_to_all() -> None:
    flight = Flight("udp:h:1", "udp:h:2?budget=20", "udp:h:3?budget=5760")
    frame = b"\xfd\x01\0\0\0\x2a\1\xeb\0\0" + bytes(3)
    source = KeepingClient(9, "udp:h:9")
    flight.fanout.make_route(frame_of(frame), source, SystemPath(0), None).forward(
        frame_of(frame), 10
    )
    assert [len(sink.frames) for sink in flight.sinks] == [1, 1, 1]


def test_radio_whose_buffer_fills_is_sent_less_and_then_more_again() -> None:
    flight = Flight("serial:/dev/ttyUSB0:57600")
    flows = []
    for free_percent in (100, 10, 100):
        for _ in range(30):
            flight.fanout.update_buffer(1, free_percent)
            begin_us = flight.run(1)
        begin_us = flight.run(5)
        flows.append(sum(map(len, flight.sinks[0].since(begin_us))) / 5)
    assert flows[1] < 0.25 * flows[0]
    assert flows[2] > 0.7 * flows[0]


@pytest.mark.parametrize(("budget", "is_kept"), [(1500, True), (3000, False), (0, False)])
def test_plan_of_a_link_lasts_until_its_bandwidth_changes(budget: int, is_kept: bool) -> None:
    flight = Flight("udp:h:1?budget=1500")
    flight.run(10)
    sink = flight.sinks[0]
    sink.endpoint = parse_endpoint(f"udp:h:1?name=radio&budget={budget}")
    flight.fanout.reconfigure(sink)
    flow = sum(map(len, sink.since(flight.run(10)))) / 10
    assert (flow <= 1.1 * 1500) is is_kept


@pytest.mark.parametrize("how", ["answer", "deliver"])
def test_answers_reduce_the_bandwidth_for_telemetry(how: str) -> None:
    """Our own answers, and frames that others address to a system behind the link."""
    flight = Flight("udp:h:1?budget=3000")
    flight.run(10)
    answer = frame_of(b"\xfd\xc8\0\0\0\1\1\x16\0\0" + bytes(202))
    begin_us = flight.now_us
    for _ in range(100):
        for _ in range(10):
            if how == "answer":
                flight.fanout.answer(answer, 0, [1], flight.now_us)
            else:
                flight.fanout.deliver(answer, [1], 9)
        flight.run(1)
    frames = flight.sinks[0].since(begin_us + 90 * US_PER_S)
    telemetry = [frame for frame in frames if message_id_of(frame) != 22]
    assert 0 < sum(map(len, telemetry)) / 10 < 1100


KINDS = st.dictionaries(
    st.integers(0, 400), st.tuples(st.integers(1, 2000), st.integers(12, 280)), max_size=40
)


@given(KINDS, st.integers(100, 20_000), st.integers(0, 30_000))
def test_any_load_is_planned_so_that_it_fits_or_nothing_starves(
    kinds: dict[int, tuple[int, int]], budget: int, answered: int
) -> None:
    bandwidth = Bandwidth(budget)
    offered = {
        message_id.to_bytes(5, "big"): Offered(message_id, frames, frames * size)
        for message_id, (frames, size) in kinds.items()
    }
    bandwidth.plan(offered, answered, 1.0)
    flow = fixed = floors = 0.0
    for key, (message_id, frames, size) in offered.items():
        interval_us = bandwidth.interval_us(key)
        rate = min(frames, US_PER_S / interval_us) if interval_us else frames
        assert rate > 0
        assert interval_us == 0 or message_id not in NEVER_THINNED
        each = size / frames
        flow += rate * each
        fixed += size if message_id in NEVER_THINNED else 0
        floors += min(FLOOR_HZ, frames) * each
    assert flow <= 1.01 * max(budget - 0.3 * answered, fixed + floors) + 1
