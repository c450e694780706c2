import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.records import ClientInterval
from tests.kit.ground_station import GroundStation, kinds, results
from tests.kit.records import sample_at, state_at

ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
SET, GET = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_GET_MESSAGE_INTERVAL
ATTITUDE, QUATERNION, HOME = 30, 31, 242


@pytest.mark.parametrize(("requested_us", "reported_us"), [(200_000,) * 2, (-1, -1), (0, 20_000)])
def test_slower_rate_is_passed_to_the_hub(
    station: GroundStation, requested_us: int, reported_us: int
) -> None:
    """Also none at all, and that of the settings."""
    assert results(station.command(SET, ATTITUDE, 50_000)) == [ACCEPTED]
    assert results(station.command(SET, ATTITUDE, requested_us)) == [ACCEPTED]
    assert station.requested_intervals[1:] == [ClientInterval(7, 1, ATTITUDE, requested_us)]
    [_, reported] = station.command(GET, ATTITUDE)
    assert (reported.message_id, reported.interval_us) == (ATTITUDE, reported_us)


def test_faster_rate_is_sent_to_the_requesting_client_only(station: GroundStation) -> None:
    other = station.other()
    station.command(SET, QUATERNION, 10_000)
    assert station.requested_intervals == [ClientInterval(7, 1, QUATERNION, -1)]
    common = kinds(other.fly(2.0)).count("ATTITUDE_QUATERNION")
    assert common == pytest.approx(100, abs=2)
    both = kinds(station.fly(2.0)).count("ATTITUDE_QUATERNION")
    assert both - common == pytest.approx(200, abs=4), "the hub keeps the common ones away"


@pytest.mark.parametrize("message_id", [26, 27, 32, 141, 331])
def test_derived_message_is_sent_only_to_the_client_that_requested_it(
    station: GroundStation, message_id: int
) -> None:
    name = mavlink.mavlink_map[message_id].msgname
    other = station.other()
    assert name not in kinds(station.fly(2.0))
    assert results(station.command(SET, message_id, 50_000)) == [ACCEPTED]
    assert kinds(station.fly(2.0)).count(name) == pytest.approx(40, abs=1)
    assert name not in kinds(other.fly(2.0))
    assert kinds(station.request(message_id)) == ["COMMAND_ACK", name]


def test_origin_of_the_local_frame_does_not_move_with_home(station: GroundStation) -> None:
    station.fly(0.1)
    [_, before] = station.request(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    station.command(mavlink.MAV_CMD_DO_SET_HOME, 0, 0, 0, 0, 47.5, 8.5, 900.0)
    [_, after] = station.request(mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED)
    assert (after.x, after.y, after.z) == (before.x, before.y, before.z)
    [_, origin] = station.request(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)
    assert (origin.latitude, origin.altitude) == (471_234_567, 520_250)


@pytest.mark.parametrize(("requested_us", "sent"), [(100_000, 20), (1, 100)])
def test_faster_rate_of_a_timed_message_is_bounded(
    station: GroundStation, requested_us: int, sent: int
) -> None:
    station.command(SET, HOME, requested_us)
    assert kinds(station.fly(2.0)).count("HOME_POSITION") == pytest.approx(sent + 2, abs=4)


def test_faster_rate_is_denied_to_an_untrusted_client(station: GroundStation) -> None:
    station.trusted = False
    assert results(station.command(SET, QUATERNION, 10_000)) == [DENIED]
    assert station.command(SET, QUATERNION, 100_000)[0].result == ACCEPTED
    assert station.requested_intervals == [ClientInterval(7, 1, QUATERNION, 100_000)]


def test_requested_intervals_end_when_the_client_is_removed(station: GroundStation) -> None:
    station.command(SET, QUATERNION, 10_000)
    station.vehicle.remove_client(7)
    assert kinds(station.fly(2.0)).count("ATTITUDE_QUATERNION") == pytest.approx(100, abs=2)


@pytest.mark.parametrize("requested", [-1, 2_000_000])
def test_heartbeats_cannot_be_switched_off(station: GroundStation, requested: int) -> None:
    assert station.command(SET, 0, requested)[0].result == DENIED
    assert station.command(SET, 0, 1_000_000)[0].result == ACCEPTED


@pytest.mark.parametrize("message_id", [77, 148, 9999])
def test_interval_of_an_unstreamed_message_is_refused_and_reported_as_zero(
    station: GroundStation, message_id: int
) -> None:
    assert station.command(SET, message_id, 100_000)[0].result in (DENIED, UNSUPPORTED)
    [_, reported] = station.command(GET, message_id)
    assert reported.interval_us == 0


@pytest.mark.parametrize(
    ("stream", "rate", "start", "expected"),
    [
        (10, 4, 1, {ATTITUDE: 250_000, QUATERNION: 250_000}),
        # SYS_STATUS is slower than that by itself, and nothing is made faster.
        (0, 4, 1, {33: 250_000, 74: 250_000, 1: 0}),
        (6, 4, 0, {33: -1}),
    ],
)
def test_data_streams_thin_their_groups_for_one_client(
    station: GroundStation, stream: int, rate: int, start: int, expected: dict[int, int]
) -> None:
    request = mavlink.MAVLink_request_data_stream_message(1, 1, stream, rate, start)
    assert station.send(request) == []
    intervals = {w.message_id: w.interval_us for w in station.requested_intervals}
    assert intervals == (intervals if stream == 0 else {}) | expected
    assert 0 not in intervals


def test_requested_intervals_are_bounded(station: GroundStation) -> None:
    for client_id in range(3000):
        station.client_id = client_id
        station.command(SET, QUATERNION, 9000)
    found = station.vehicle.on_state(state_at(2_000_000), sample_at(2_000_000), 2_000_000)
    assert len(found) < 100
