"""The SX1276 driver, nodes that share a channel, and the receiver's frames with signal."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from firmware.rig.boards import LORA_PARTS, LORA_VERSIONS, Parts
from firmware.rig.sx1276 import LoraPacket
from gateway.records import RadioState
from gateway.wire.payloads import BaroPayload, ForeignFrame, GpsFixPayload, ImuPayload
from tests.firmware.harness import Bench, MakeBench

pytestmark = [pytest.mark.io, pytest.mark.slow]

RUNNING_S = 1.0
RUN_S = 6.0
CHANNEL = (868_300, 7, 250, 5, 0x12)
"""Frequency, spreading factor, bandwidth, coding and sync word of the default settings."""


@pytest.fixture
def lora(bench: MakeBench, build: Callable[..., Path], changed: Callable[..., Path]) -> MakeBench:
    """Make benches whose boards have LoRa radios; the receiver may have other settings."""

    def make(parts: dict[str, str] = LORA_PARTS, receiver: Any = None, **setup: Any) -> Bench:
        nodes = build(radio="sx1276")
        rig = bench(build=changed("sx1276", **receiver) if receiver else nodes,
                    parts=Parts(**parts), **setup)  # fmt: skip
        rig.setup.build = nodes
        return rig

    return make


def test_two_nodes_share_the_channel(lora: MakeBench) -> None:
    rig = lora()
    rig.imu_node(clock_ppm=40.0).radio.strength_db = -100.0
    rig.gps_node(clock_ppm=-30.0).radio.strength_db = -121.0
    rig.run(RUNNING_S + RUN_S)
    # Two nodes that begin at one moment lose some 3 %, and more of the weaker one.
    assert max(rig.lost(node_id, RUNNING_S) for node_id in (0, 1)) <= 5
    for kind, rate_hz in ((ImuPayload, 10), (BaroPayload, 2), (GpsFixPayload, 1)):
        assert 0.6 * rate_hz * RUN_S <= len(rig.payloads(kind, RUNNING_S)) <= rate_hz * RUN_S + 2
    assert not rig.faults
    assert rig.statuses[-1].radio is RadioState.OK
    assert max(status.noise_percent for status in rig.statuses) <= 5
    signals = {f.header.node.node_id: f.signal for _, f in rig.frames}
    # The second is below the noise: -174 dBm/Hz, 250 kHz and 6 dB.
    for node_id, rssi_dbm, snr_db in ((0, -100, 10.0), (1, -121, -7.0)):
        assert signals[node_id].rssi_dbm == pytest.approx(rssi_dbm, abs=1)
        assert signals[node_id].snr_db == pytest.approx(snr_db, abs=0.5)


def test_four_nodes_that_sample_together_lose_a_tenth_at_most(
    lora: MakeBench, changed: Callable[..., Path]
) -> None:
    """Half of the channel's time is used; nodes that start at one moment are the worst case."""
    wide = {"lora_bandwidth_khz": 500}
    rig = lora(receiver=wide, seed=3)
    for vehicle in (1, 2):
        rig.setup.build = changed("sx1276", vehicle_id=vehicle, **wide)
        rig.imu_node(clock_ppm=40.0 - 15.0 * vehicle)
        rig.gps_node(clock_ppm=-30.0 + 10.0 * vehicle)
    rig.run(RUNNING_S + RUN_S)
    assert rig.setup.air.sent > 24 * RUN_S
    pipes = rig.statuses[-1].pipes
    received, lost = sum(p.received for p in pipes), sum(p.lost for p in pipes)
    assert received > 22 * RUN_S
    assert lost < 0.1 * received


@pytest.mark.parametrize("version", LORA_VERSIONS)
def test_look_alike_is_accepted_by_what_it_does(lora: MakeBench, version: str) -> None:
    rig = lora(parts={"radio": version, "node_radio": version})
    rig.imu_node()
    rig.run(RUNNING_S + 1.5)
    assert len(rig.payloads(ImuPayload, RUNNING_S)) > 10
    assert rig.statuses[-1].radio is RadioState.OK


@pytest.mark.parametrize("passed_on", [True, False])
def test_packets_of_other_programs_are_passed_on_by_setting(
    lora: MakeBench, passed_on: bool
) -> None:
    rig = lora(receiver={"lora_foreign": passed_on})
    node = rig.imu_node()
    rig.run(RUNNING_S)
    # RadioHead's header: to everybody, from 7, the 33rd packet, no flags.
    packet = b"\xff\x07\x21\x00" + b"lat=48.1,lon=11.5"
    rig.setup.air.send(LoraPacket(*CHANNEL, packet, -60.0), node.radio, lambda: None)
    rig.run(0.2)
    assert [frame.packet for _, frame in rig.foreign] == [packet] * passed_on
    assert all(frame.signal.rssi_dbm == pytest.approx(-60, abs=1) for _, frame in rig.foreign)
    assert all(isinstance(frame, ForeignFrame) for _, frame in rig.foreign)


def test_unusable_packets_leave_the_receiver_receiving(lora: MakeBench) -> None:
    rig = lora(receiver={"lora_foreign": True})
    node = rig.imu_node()
    rig.run(RUNNING_S)
    for payload, crc_on in ((b"\xff" * 20, False), (b"\xff" * 200, True), (b"", True)):
        packet = LoraPacket(*CHANNEL, payload, -70.0, crc_on=crc_on)
        rig.setup.air.send(packet, node.radio, lambda: None)
        rig.run(1.0)
        assert len(rig.payloads(ImuPayload, rig.now_s - 0.6)) >= 4, payload
    assert not rig.foreign
    assert not rig.faults


def test_stronger_packet_survives_an_overlap(lora: MakeBench) -> None:
    rig = lora(receiver={"lora_foreign": True})
    node = rig.imu_node()
    node.radio.absent = True
    rig.run(0.5)
    weak, strong, equal = (LoraPacket(*CHANNEL, bytes([i]) * 20, s) for i, s in
                           enumerate((-100.0, -90.0, -93.0)))  # fmt: skip
    for first, second in ((weak, strong), (strong, equal)):
        rig.setup.air.send(first, node.radio, lambda: None)
        rig.run(0.005)
        rig.setup.air.send(second, node.radio, lambda: None)
        rig.run(0.1)
    assert [frame.packet for _, frame in rig.foreign] == [strong.payload]
