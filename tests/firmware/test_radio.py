"""The radio driver, the sender and the receiver on an air that loses and collides."""

import bisect
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from firmware.rig.air import Air, Packet
from firmware.rig.bench import PS_PER_S, PS_PER_US
from firmware.rig.bench import Bench as TimeLine
from firmware.rig.boards import LORA_PARTS, Parts, Setup
from gateway.wire.payloads import ImuPayload
from tests.firmware.harness import Bench, MakeBench, MakeRig

pytestmark = [pytest.mark.io, pytest.mark.slow]

RUNNING_S = 1.0
"""By then every board has started."""


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
def test_nothing_is_lost_up_to_30_percent_on_the_air(imu_rig: MakeRig, loss: float) -> None:
    rig, _ = imu_rig(loss=loss, seed=3, clock_ppm=40.0)
    rig.gps_node(clock_ppm=-30.0)
    rig.run(RUNNING_S + 2.5)
    assert len(rig.payloads(ImuPayload, since_s=RUNNING_S)) == pytest.approx(250, abs=3)
    assert rig.lost(0) == rig.lost(1) == 0
    assert rig.node_status(0).radio_failed == rig.node_status(1).radio_failed == 0
    retries = rig.node_status(0).radio_retries
    # A packet is repeated if it or its acknowledgement is lost.
    expected = 130 * 2.5 * ((1 - loss) ** -2 - 1)
    assert 0.6 * expected <= retries <= 1.5 * expected + 40
    assert [p.lost for p in rig.statuses[-1].pipes] == [0] * 6
    assert (rig.statuses[-1].uart_dropped, rig.faults) == (0, [])


def test_half_of_the_samples_reach_the_line_within_5_ms(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(RUNNING_S + 1.0, loss=0.1)
    late_s = []
    for end_s, frame in rig.frames:
        if isinstance(frame.payload, ImuPayload):
            # The node's clock starts within half a millisecond behind the reset.
            stamp_ps = frame.header.node_time_us * PS_PER_US + PS_PER_US * 500
            at = bisect.bisect(node.imu.sampled_ps, stamp_ps) - 1
            late_s.append(end_s - node.imu.sampled_ps[at] / PS_PER_S)
    assert 0.002 < np.median(late_s) < 0.005


def test_receiver_counts_received_and_lost_packets(imu_rig: MakeRig) -> None:
    rig, _ = imu_rig(1.2)
    rig.setup.air.loss = 1.0
    rig.run(0.5)
    rig.setup.air.loss = 0.0
    rig.run(1.4)
    gaps, last = rig.lost(0), rig.statuses[-1]
    assert gaps > 20
    assert rig.node_status(0).radio_failed == pytest.approx(gaps, abs=9)
    received = sum(f.receiver_time_us <= last.receiver_time_us for _, f in rig.frames)
    assert (last.pipes[0].lost, last.pipes[0].received) == (gaps, received)


def test_payloads_come_in_order_and_once(imu_rig: MakeRig) -> None:
    rig, _ = imu_rig(2.5, loss=0.3, seed=8)
    seqs = [header.seq for header in rig.headers(0)]
    assert all(b - a == 1 for a, b in pairwise(seqs))
    frame_seqs = [frame.frame_seq for _, frame in rig.frames]
    assert all((b - a) % 256 <= 2 for a, b in pairwise(frame_seqs))


def test_nodes_that_start_in_step_get_through(
    bench: MakeBench, changed: Callable[..., Path]
) -> None:
    """Three nodes that sample at the same instants, again and again: the worst for an air."""
    rig = bench(seed=5)
    for vehicle in (1, 2, 3):
        rig.setup.build = changed(vehicle_id=vehicle)
        rig.imu_node()
    rig.run(RUNNING_S + 2.0)
    assert rig.setup.air.collisions > 50
    assert {f.header.node.vehicle_id for _, f in rig.frames} == {1, 2, 3}
    assert len(rig.payloads(ImuPayload, since_s=RUNNING_S)) == pytest.approx(600, abs=6)
    assert rig.node_status(0).radio_failed <= 2


def test_noise_on_the_channel_is_reported_and_own_packets_are_not(imu_rig: MakeRig) -> None:
    rig, _ = imu_rig(2.2, seed=2)
    assert rig.statuses[-1].noise_percent == 0
    rig.setup.air.noise = 0.5
    rig.run(2.0)
    assert rig.statuses[-1].noise_percent == pytest.approx(50, abs=25)


class Radio(NamedTuple):
    """A board's radio, and the limit of its recovery."""

    parts: Parts
    rate_hz: float
    """Of IMU payloads."""
    tolerance: float
    back_s: float
    """Longest time until payloads come again after a lost supply."""
    start_s: float
    least: int
    """More payloads come within `start_s` from a start."""


RADIOS = {
    "nrf24": Radio(Parts(), 100, 0.075, 1.8, 0.8, 20),
    "sx1276": Radio(Parts(**LORA_PARTS), 10, 0.15, 2.0, 1.5, 5),
}


@pytest.fixture
def rig(bench: MakeBench, build: Callable[..., Path], radio: str) -> Bench:
    return bench(build=build(radio=radio), parts=RADIOS[radio].parts)


@pytest.mark.parametrize("radio", RADIOS)
@pytest.mark.parametrize("side", ["receiver", "node"])
def test_radio_that_lost_its_supply_is_set_up_again(rig: Bench, radio: str, side: str) -> None:
    node = rig.imu_node()
    rig.run(RUNNING_S)
    (rig.receiver if side == "receiver" else node).radio.power_cycle()
    rig.run(3.0)
    of = RADIOS[radio]
    found = rig.payloads(ImuPayload, since_s=RUNNING_S + of.back_s)
    assert len(found) == pytest.approx((3.0 - of.back_s) * of.rate_hz, rel=of.tolerance)
    assert rig.receiver.mcu.resets == node.mcu.resets == 0


@pytest.mark.parametrize("radio", RADIOS)
def test_node_without_its_radio_waits_for_it(rig: Bench, radio: str) -> None:
    node = rig.imu_node()
    node.radio.absent = True
    rig.run(1.0)
    assert not rig.frames
    node.radio.absent = False
    rig.run(RADIOS[radio].start_s)
    assert len(rig.payloads(ImuPayload)) > RADIOS[radio].least
    assert node.mcu.resets == 0


@pytest.mark.parametrize(
    ("radio", "settings"),
    [
        ("nrf24", {"radio_address": 0x01020304}),
        ("nrf24", {"radio_channel": 40}),
        ("sx1276", {"lora_sync_word": 0x34}),
        ("sx1276", {"lora_frequency_khz": 869_525}),
        ("sx1276", {"lora_spreading": 8}),
    ],
    ids=str,
)
def test_node_of_other_settings_is_not_received(
    rig: Bench, changed: Callable[..., Path], radio: str, settings: dict[str, int]
) -> None:
    rig.setup.build = changed(radio, **settings)
    rig.imu_node()
    rig.run(RUNNING_S)
    assert not rig.frames
    assert not rig.faults


def test_models_air_times_follow_the_specification() -> None:
    full = Packet(76, 1000, b"12345", bytes(32), 0, is_ack=False)
    assert full.duration_ps == 329 * PS_PER_US
    assert Packet(76, 250, b"12345", b"", 0, is_ack=True).duration_ps == 73 * 4 * PS_PER_US


def test_packets_that_overlap_destroy_each_other() -> None:
    line = TimeLine()
    air = Air(line, np.random.default_rng(1))
    heard: list[bytes] = []

    class Ear:
        def listens(self, packet: Packet, start_ps: int) -> bool:
            return packet.channel == 76

        def hear(self, packet: Packet) -> None:
            heard.append(packet.payload)

    air.listeners.append(Ear())
    sender = Ear()
    for at_us, channel, payload in (
        (0, 76, b"a"), (50, 76, b"b"), (60, 77, b"c"), (500, 76, b"d"), (900, 76, b"e"),
    ):  # fmt: skip
        packet = Packet(channel, 1000, b"12345", payload, 0, is_ack=False)
        line.at(at_us * PS_PER_US, lambda packet=packet: air.send(packet, sender, lambda: None))
    line.run_until(PS_PER_S // 100)
    assert heard == [b"d", b"e"]
    assert air.collisions == 2


def test_same_seed_gives_the_same_bytes(bench: MakeBench, programs: Path) -> None:
    def bytes_of(seed: int) -> list[tuple[int, int]]:
        rig = Bench(Setup(seed=seed, loss=0.2, build=programs))
        rig.imu_node()
        rig.run(0.9)
        rig.close()
        return rig.line

    first = bytes_of(11)
    assert len(first) > 1000
    assert first == bytes_of(11)
    assert first != bytes_of(12)
