"""Resets, hangs and the clocks' wrap, in flight."""

import itertools

import pytest

from firmware.rig.boards import Board
from firmware.rig.mcu import BROWN_OUT, WATCHDOG
from gateway.records import ImuFlags
from gateway.wire.link import Link
from gateway.wire.payloads import ImuPayload, NodeStatusPayload
from tests.firmware.harness import Bench, MakeBench, MakeRig

pytestmark = [pytest.mark.io, pytest.mark.slow]

MAG_NEW = ImuFlags.MAG_NEW
OVERFLOWS_16_MHZ = 1 << 17
"""Of timer 1 in 2**32 us: 65536 ticks of half a microsecond each."""


@pytest.mark.parametrize(
    ("cause", "through_bootloader"), [(BROWN_OUT, False), (WATCHDOG, False), (WATCHDOG, True)]
)
def test_reset_in_flight_costs_little_and_is_reported(
    imu_rig: MakeRig, cause: int, through_bootloader: bool
) -> None:
    rig, node = imu_rig(1.2)
    reset_s = rig.now_s
    node.reset(cause, through_bootloader)
    rig.run(1.2)
    first = next(t for t, f in rig.frames if t > reset_s + 0.005)
    assert first - reset_s < 0.1
    assert rig.last(NodeStatusPayload).reset_cause == cause
    # A self-test in flight would find the manoeuvre, not the chip.
    assert ImuFlags.SELF_TEST_FAILED not in rig.last(ImuPayload).flags
    assert len(rig.payloads(ImuPayload, since_s=reset_s + 0.2)) > 90
    assert rig.statuses[-1].pipes[0].lost == 0


@pytest.mark.parametrize("which", ["imu", "gps", "receiver"])
def test_program_that_hangs_is_restarted_by_its_watchdog(bench: MakeBench, which: str) -> None:
    rig = bench()
    boards = {"imu": rig.imu_node(), "gps": rig.gps_node(), "receiver": rig.receiver}
    rig.run(1.0)
    board = boards[which]
    release = board.mcu.hang("events_wait()")
    rig.run(0.3)
    assert board.mcu.resets == 1
    release()
    rig.run(1.4)
    assert board.mcu.resets in (1, 2)
    if which == "receiver":
        assert rig.statuses[-1].reset_cause == WATCHDOG
    else:
        assert rig.node_status(int(which == "gps")).reset_cause == WATCHDOG
    assert len(rig.payloads(ImuPayload, since_s=rig.now_s - 0.5)) == pytest.approx(50, abs=3)


def test_time_wraps_after_71_minutes_without_a_gap(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(0.6)
    for board in (node, rig.receiver):
        board.mcu.write_variable("clock_overflows", OVERFLOWS_16_MHZ - 10, 4)
    since_s = rig.now_s + 0.02
    # Setting the time put off what was due next: the first report comes after the wrap.
    rig.run(2.6)
    stamps = [
        f.header.node_time_us
        for t, f in rig.frames
        if t > since_s and isinstance(f.payload, ImuPayload)
    ]
    steps = [(b - a) % 2**32 for a, b in itertools.pairwise(stamps)]
    assert stamps[0] > 2**32 - 400_000
    assert stamps[-1] < 2**31
    assert all(step == pytest.approx(10_000, abs=40) for step in steps)
    arrivals = [f.receiver_time_us for t, f in rig.frames if t > since_s]
    assert all((b - a) % 2**32 < 50_000 for a, b in itertools.pairwise(arrivals))
    assert rig.statuses[-1].pipes[0].lost == 0
    assert node.mcu.resets == rig.receiver.mcu.resets == 0


def pass_forty_minutes(rig: Bench, board: Board) -> None:
    """Put a board's clock on: past half of its wrap, where an old time looks like one to come."""
    for twenty_minutes in (1, 2):
        board.mcu.write_variable("clock_overflows", twenty_minutes * OVERFLOWS_16_MHZ * 2 // 7, 4)
        rig.run(1.5)  # the reports that fell due meanwhile


def test_receiver_that_loses_its_radio_late_sets_it_up_at_once(imu_rig: MakeRig) -> None:
    rig, _ = imu_rig(0.6)
    pass_forty_minutes(rig, rig.receiver)
    rig.receiver.radio.power_cycle()
    rig.run(1.6)
    assert len(rig.payloads(ImuPayload, since_s=rig.now_s - 0.4)) == pytest.approx(40, abs=3)


def test_magnetometer_that_comes_late_is_read(imu_rig: MakeRig) -> None:
    rig, node = imu_rig()
    node.compass.absent = True
    rig.run(0.6)
    pass_forty_minutes(rig, node)
    node.compass.absent = False
    rig.run(0.5)
    new = [p for p in rig.payloads(ImuPayload, since_s=rig.now_s - 0.2) if MAG_NEW in p.flags]
    assert len(new) > 10


def test_gateways_link_sees_every_sample_and_a_restart(imu_rig: MakeRig) -> None:
    rig, node = imu_rig(2.2, loss=0.1, clock_ppm=40.0)
    node.reset(BROWN_OUT)
    rig.run(1.3)
    link = Link()
    records = [
        record for end_ps, byte in rig.line for record in link.feed(bytes([byte]), end_ps // 10**6)
    ]
    report = link.report(round(rig.now_s * 1e6), connected=True, port="rig")
    assert report.nodes[0].restarts == 1
    assert report.nodes[0].lost == 0
    assert report.frames_lost == 0
    assert not report.faults
    assert len(records) >= len(rig.payloads(ImuPayload))
