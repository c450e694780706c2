"""The GPS node's program against the model of a u-blox M8."""

from collections.abc import Callable
from itertools import pairwise

import pytest

from firmware.rig.gps import ubx
from gateway.records import GpsFixType
from gateway.wire.payloads import GpsFixPayload, GpsQualityPayload, NodeStatusPayload
from tests.firmware.harness import GPS, MakeRig, always

pytestmark = [pytest.mark.io, pytest.mark.slow]

CONFIGURED_S = 3.0


def test_receiver_fresh_from_the_factory_is_configured(gps_rig: MakeRig) -> None:
    rig, node = gps_rig(CONFIGURED_S)
    gps = node.gps
    assert (gps.baud, gps.period_s, gps.dynamic_model) == (57_600, 0.2, 8)
    assert (gps.messages_on, gps.nmea_on) == ({0x07}, False)
    rig.run(2.0)
    assert len(rig.payloads(GpsFixPayload, since_s=CONFIGURED_S)) == pytest.approx(10, abs=1)
    assert rig.sensors == (GPS, 0)
    assert rig.last(NodeStatusPayload).sample_rate_hz == pytest.approx(5, abs=1)


def test_fix_and_quality_carry_the_solution(gps_rig: MakeRig) -> None:
    rig, _ = gps_rig(CONFIGURED_S + 0.5, world=always(geoid_separation_m=-7.5, alt_amsl_m=-12.5))
    fix, quality = rig.last(GpsFixPayload), rig.last(GpsQualityPayload)
    assert (fix.lat_dege7, fix.lon_dege7, fix.alt_amsl_mm) == (-77_123_456, 1_103_654_321, -12_500)
    assert fix.vel_n_cmps == (1234, -567, -89)
    assert (fix.fix_type, fix.fix_ok, fix.satellites) == (GpsFixType.FIX_3D, True, 14)
    assert (quality.h_acc_cm, quality.v_acc_cm, quality.speed_acc_cmps) == (180, 310, 42)
    assert (quality.course_acc_cdeg, quality.pdop_centi) == (275, 161)
    assert quality.geoid_separation_cm == -750
    assert str(quality.utc).startswith("2026-11-19 00:00:0")


def test_quality_comes_directly_before_its_fix_and_every_payload_is_counted(
    gps_rig: MakeRig,
) -> None:
    rig, _ = gps_rig(CONFIGURED_S + 1.5, loss=0.2, seed=4)
    assert all((b.seq - a.seq) % 65536 == 1 for a, b in pairwise(rig.headers(1)))
    frames = [f for _, f in rig.frames if not isinstance(f.payload, NodeStatusPayload)]
    assert len(frames) >= 14
    for quality, fix in zip(frames[::2], frames[1::2], strict=False):
        assert isinstance(quality.payload, GpsQualityPayload)
        assert isinstance(fix.payload, GpsFixPayload)
        assert quality.payload.itow_ms == fix.payload.itow_ms
        assert quality.header.node_time_us == fix.header.node_time_us


def test_node_time_is_the_arrival_of_the_first_byte(gps_rig: MakeRig) -> None:
    rig, _ = gps_rig(CONFIGURED_S + 1.5, gps_computing_s=0.12)
    for _, frame in rig.frames:
        if isinstance(frame.payload, GpsFixPayload):
            late_us = frame.header.node_time_us % 200_000 - 120_000
            assert -1000 < late_us < 1000


def test_restarted_node_uses_a_receiver_that_is_already_configured(gps_rig: MakeRig) -> None:
    rig, node = gps_rig(CONFIGURED_S + 0.5)
    node.reset(cause=2)
    again_s = rig.now_s
    rig.run(1.2)
    assert len(rig.payloads(GpsFixPayload, since_s=again_s + 0.5)) >= 3
    assert rig.last(NodeStatusPayload).reset_cause == 2


def test_garbage_on_the_line_costs_no_more_than_the_message_it_hits(gps_rig: MakeRig) -> None:
    rig, node = gps_rig(CONFIGURED_S, seed=9)
    for _ in range(8):
        node.gps.send(b"\xb5\x62")
        node.gps.send_garbage(60)
        rig.run(0.25)
    fixes = rig.payloads(GpsFixPayload, since_s=CONFIGURED_S)
    assert len(fixes) >= 7
    assert all((f.lat_dege7, f.satellites) == (-77_123_456, 14) for f in fixes)
    assert rig.last(NodeStatusPayload).bus_errors > 0
    assert not rig.faults


@pytest.mark.parametrize(
    "left", [b"\xb5", ubx(0x01, 0x07, bytes(92))[:60]], ids=["one byte", "a head"]
)
def test_message_that_was_cut_off_leaves_the_next_alone(gps_rig: MakeRig, left: bytes) -> None:
    rig, node = gps_rig(CONFIGURED_S)
    node.gps.send(left)
    rig.run(1.0)
    fixes = [f for t, f in rig.frames if t > CONFIGURED_S and isinstance(f.payload, GpsFixPayload)]
    assert len(fixes) == 5
    assert all(abs(f.header.node_time_us % 200_000 - 150_000) < 1000 for f in fixes)


def test_missing_receiver_is_reported_and_searched_for(gps_rig: MakeRig) -> None:
    rig, node = gps_rig()
    node.gps.absent = True
    rig.run(2.3)
    assert not rig.payloads(GpsFixPayload)
    assert rig.sensors == (0, GPS)
    node.gps.absent = False
    rig.run(2.5)
    assert len(rig.payloads(GpsFixPayload)) >= 5
    assert rig.sensors[0] == GPS
    assert node.mcu.resets == 0


def test_ten_fixes_a_second_at_8_mhz(gps_rig: MakeRig, build: Callable[..., object]) -> None:
    folder = build("-DGPS_RATE_HZ=10 -DGPS_DYNAMIC_MODEL=6", 8_000_000)
    rig, node = gps_rig(CONFIGURED_S + 1.5, build=folder, frequency_hz=8_000_000)
    assert (node.gps.baud, node.gps.dynamic_model) == (38_400, 6)
    assert len(rig.payloads(GpsFixPayload, since_s=CONFIGURED_S)) == pytest.approx(15, abs=1)
