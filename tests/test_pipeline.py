"""The stages joined: bytes in, actions out, several aircraft, a source that comes and goes."""

import math
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.aircraft import AircraftSettings, Outputs
from gateway.estimation.select import EstimationSettings
from gateway.pipeline import GONE_US, Pipeline, PipelineSettings
from gateway.records import BaroRaw, FusedSample, GpsFix, GpsFixType, ImuFlags, Incoming
from gateway.sensing.calibration import NodeCalibration
from gateway.vehicle.plan import Location
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire import payloads
from gateway.wire.mavlink_signing import EPOCH_2015_US, key_from_passphrase
from gateway.wire.mavlink_splitter import frame_of
from tests.kit.payloads import QUALITY, Tracker

UNIX_US = 1_790_000_000_000_000
LEVEL = payloads.ImuPayload(
    accel=(0, 0, 4096),
    gyro=(0, 0, 0),
    mag=(218, 0, 431),
    temperature=-3920,
    flags=ImuFlags.MAG_NEW,
    accel_range=2,
    gyro_range=2,
    mag_gain=1,
)
FIX = payloads.GpsFixPayload(
    1000, -77_656_000, 1_103_728_000, 110_000, (0, 0, 0), GpsFixType.FIX_3D, True, 12
)


@pytest.fixture
def pipeline() -> Pipeline:
    tilted = NodeCalibration(mounting=((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
    # The paper's estimator knows roll and pitch from the first sample on.
    default = AircraftSettings(estimation=EstimationSettings(estimator="paper"))
    second = msgspec.structs.replace(default, calibration=tilted)
    return Pipeline(PipelineSettings(default, {2: second}))


def decode(out: Outputs) -> list[mavlink.MAVLink_message]:
    parser = mavlink.MAVLink(None)
    return [parser.decode(bytearray(sent.frame)) for sent in out.frames]


def named(out: Outputs, name: str) -> list[mavlink.MAVLink_message]:
    return [message for message in decode(out) if message.get_type() == name]


def test_aircraft_needs_two_frames_with_agreeing_clocks(pipeline: Pipeline) -> None:
    """Noise may pass the check of a frame; two of it that agree do not come."""
    ghost, true = Tracker(7), Tracker()
    assert pipeline.feed(ghost.one(0, LEVEL), 5_000) == Outputs()
    pipeline.feed(true.frame(0, LEVEL), 6_000)
    assert list(pipeline.aircraft) == [1]
    late = ghost.one(3_000_000_000, LEVEL)
    assert pipeline.feed(late, 20_000) == Outputs(), "their clocks do not agree"
    assert list(pipeline.aircraft) == [1]
    out = pipeline.feed(ghost.one(3_000_010_000, LEVEL), 30_000)
    assert sum(isinstance(record, FusedSample) for record in out.records) == 2, "nothing is lost"
    assert sorted(pipeline.aircraft) == [1, 7]


def test_aircraft_is_removed_after_a_timeout_and_returns_unchanged(pipeline: Pipeline) -> None:
    tracker = Tracker()
    pipeline.feed(tracker.frame(0, LEVEL), 5_000)
    pipeline.mark(Location(-7.0, 110.0, 0.0), 1, 5_000)
    aircraft = pipeline.aircraft[1]
    pipeline.poll(GONE_US)
    assert list(pipeline.aircraft) == [1]
    pipeline.poll(GONE_US + 2_000_000)
    assert pipeline.aircraft == {}
    assert pipeline.find(1) is aircraft
    assert named(pipeline.poll(GONE_US + 4_000_000), "HEARTBEAT") == []
    actions = pipeline.feed(tracker.frame(605_000_000, LEVEL), 605_010_000)
    assert decode(actions)[0].get_type() == "HEARTBEAT"
    assert pipeline.aircraft[1] is aircraft


def test_first_imu_frame_gives_a_heartbeat_and_then_the_attitude(pipeline: Pipeline) -> None:
    first = pipeline.feed(Tracker().frame(0, LEVEL), 5_000)
    kinds = [message.get_type() for message in decode(first)]
    assert (kinds[0], kinds.count("HEARTBEAT")) == ("HEARTBEAT", 1)
    (message,) = named(first, "ATTITUDE_QUATERNION")
    assert (message.get_srcSystem(), message.time_boot_ms) == (1, 5)
    (attitude,) = named(first, "ATTITUDE")
    assert (attitude.roll, attitude.pitch) == pytest.approx((0.0, 0.0), abs=1e-3)
    for out in (pipeline.poll(6_000), pipeline.feed(Tracker().frame(0, LEVEL), 7_000)):
        assert named(out, "HEARTBEAT") == []


def test_records_are_returned_in_order_of_fusion(pipeline: Pipeline) -> None:
    tracker = Tracker()
    records: list[Any] = []
    for time_us, line in (
        (0, tracker.frame(0, LEVEL)),
        (5_000, tracker.frame(5_000, payloads.BaroPayload(10_000_000, 250))),
        (8_000, tracker.frame(0, QUALITY, 1) + tracker.frame(0, FIX, 1)),
        (10_000, tracker.frame(10_000, LEVEL)),
    ):
        records += pipeline.feed(line, time_us).records
    assert [type(record) for record in records] == [FusedSample, BaroRaw, GpsFix, FusedSample]
    first, baro, fix, second = records
    assert baro.pressure_pa == 100_000.0
    assert fix.h_acc_m == pytest.approx(1.2)
    assert math.isnan(first.state.lat_deg)
    assert second.state.lat_deg == pytest.approx(-7.7656)


def test_two_aircraft_are_two_systems_with_their_own_calibration(pipeline: Pipeline) -> None:
    nose_up = payloads.ImuPayload(
        (2048, 0, 3547), (0, 0, 0), (0, 0, 0), 0, ImuFlags.MAG_ABSENT, 2, 2, 1
    )
    attitudes = {}
    for vehicle_id in (1, 2):
        actions = pipeline.feed(Tracker(vehicle_id).frame(0, nose_up), 0)
        (message,) = named(actions, "ATTITUDE")
        attitudes[message.get_srcSystem()] = (message.roll, message.pitch)
    assert attitudes[1] == pytest.approx((0.0, 0.5236), abs=2e-3)
    assert attitudes[2] == pytest.approx((-0.5236, 0.0), abs=2e-3)


def test_loss_of_the_receiver_is_reported_and_heartbeats_continue(pipeline: Pipeline) -> None:
    pipeline.connect("/dev/ttyUSB0")
    pipeline.feed(Tracker().frame(0, LEVEL), 0)
    pipeline.poll(1_000)
    pipeline.disconnect("/dev/ttyUSB0")
    outs = [pipeline.poll(time_us) for time_us in range(50_000, 10_000_000, 50_000)]
    texts = [message.text for out in outs for message in named(out, "STATUSTEXT")]
    assert sum("/dev/ttyUSB0" in text for text in texts) == 1
    assert 9 <= sum(len(named(out, "HEARTBEAT")) for out in outs) <= 11
    assert not pipeline.report.connected


def test_mark_gives_distance_and_bearing(pipeline: Pipeline) -> None:
    tracker = Tracker()
    pipeline.feed(tracker.frame(0, QUALITY, 1) + tracker.frame(0, FIX, 1), 0)
    pipeline.feed(tracker.frame(0, LEVEL), 0)
    pipeline.mark(Location(-7.7656 + 0.001, 110.3728, math.nan), 1, 1_000)
    times_us = range(10_000, 3_000_000, 10_000)
    *_, message = (m for t in times_us for m in named(pipeline.poll(t), "NAV_CONTROLLER_OUTPUT"))
    assert message.wp_dist == pytest.approx(111, abs=2)
    assert message.target_bearing == 0
    for lat_deg, vehicle_id, reason in ((91.0, 1, "91"), (0.0, 7, "no aircraft 7; received: 1")):
        with pytest.raises(ValueError, match=reason):
            pipeline.mark(Location(lat_deg, 0.0, 0.0), vehicle_id, 0)


def test_no_frame_is_sent_before_the_first_sample(pipeline: Pipeline) -> None:
    assert pipeline.poll(0) == Outputs()
    assert pipeline.next_due_us() == 1_000_000
    pipeline.feed(b"\x05garbage\x00" * 100, 0)
    assert pipeline.aircraft == {}
    assert pipeline.poll(1_000_000) == Outputs()
    assert dict(pipeline.report.faults)


def test_signatures_of_all_messages_pass_strict_check() -> None:
    vehicle = VehicleSettings(signing_passphrase="correct horse", operator_control="exclusive")
    pipeline = Pipeline(PipelineSettings(AircraftSettings(vehicle=vehicle), {}, UNIX_US))
    receiver, tracker, kinds = mavlink.MAVLink(None), Tracker(), set()
    receiver.signing.secret_key = key_from_passphrase("correct horse")
    receiver.signing.timestamp = (UNIX_US - EPOCH_2015_US) // 10
    station = mavlink.MAVLink(None, 255, 190)
    for time_us in range(0, 3_000_000, 10_000):
        frames = pipeline.feed(tracker.frame(time_us, LEVEL), time_us).frames
        frames += pipeline.poll(time_us).frames
        wanted = 148 + time_us // 10_000
        ask = mavlink.MAVLink_command_long_message(1, 1, 512, 0, wanted, *[0] * 6)
        read = mavlink.MAVLink_param_request_read_message(1, 1, b"", 0)
        for question in (ask, read):
            incoming = Incoming(7, bytes(question.pack(station)), trusted=True)
            frames += pipeline.handle(incoming, time_us).frames
        for sent in frames:
            frame = frame_of(sent.frame)
            signed = pipeline.signer.sequence_and_sign(frame, frame.sequence, time_us).data
            # It steps over the signatures of messages that it does not know.
            assert receiver.decode(bytearray(signed)) is not None
            assert signed[2] & 1
            kinds.add(sent.message_id)
    assert kinds > {0, 22, 30, 31, 77, 300, 397, 435, 512}


def test_rejected_requests_are_counted_by_reason(pipeline: Pipeline) -> None:
    for vehicle_id in (1, 2):
        pipeline.feed(Tracker(vehicle_id).frame(0, LEVEL), 0)
    pipeline.sign_by("correct horse", {}, 0)
    station = mavlink.MAVLink(None, 255, 190)
    change = mavlink.MAVLink_param_set_message(1, 1, b"RATE_ATT", 5.0, 9)
    for _ in range(3):
        pipeline.handle(Incoming(7, bytes(change.pack(station)), trusted=True), 0)
    station.signing.secret_key, station.signing.sign_outgoing = bytes(32), True
    pipeline.handle(Incoming(7, bytes(change.pack(station)), trusted=True), 0)
    assert (pipeline.refused, pipeline.forged) == (3, 1)


def test_other_passphrases_reach_aircraft_heard_and_not_yet_heard(pipeline: Pipeline) -> None:
    trackers = {vehicle_id: Tracker(vehicle_id) for vehicle_id in (1, 2, 3)}

    def signers(time_us: int) -> dict[int, bool]:
        outs = [pipeline.feed(each.frame(time_us, LEVEL), time_us) for each in trackers.values()]
        frames = [frame_of(sent.frame) for out in outs for sent in out.frames]
        sign = pipeline.signer.sequence_and_sign
        return {f.origin[0]: sign(f, f.sequence, time_us).signed for f in frames}

    pipeline.feed(trackers[1].frame(0, LEVEL), 0)
    pipeline.sign_by("", {1: "mine", 3: "theirs"}, 1_000_000)
    assert signers(2_000_000) == {1: True, 2: False, 3: True}
    pipeline.sign_by("all", {}, 3_000_000)
    assert signers(4_000_000) == {1: True, 2: True, 3: True}
    assert {a.settings.vehicle.signing_passphrase for a in pipeline.aircraft.values()} == {"all"}
    pipeline.sign_by("", {}, 5_000_000)
    assert signers(6_000_000) == {1: False, 2: False, 3: False}
