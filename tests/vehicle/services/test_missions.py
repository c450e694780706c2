"""The mission protocol as its page has it, both directions, with and without loss."""

import math
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from gateway.vehicle.plan import MAX_ITEMS, Location, distance_and_bearing
from tests.vehicle.ground_station import GroundStation, kinds
from tests.vehicle.samples import STATE

MISSION, FENCE, RALLY, ALL = 0, 1, 2, 255
WAYPOINT, RALLY_POINT, FENCE_VERTEX = 16, 5100, 5001
GLOBAL_INT, RELATIVE_INT, LOCAL_NED, MISSION_FRAME = 5, 6, 1, 2
ACCEPTED = mavlink.MAV_MISSION_ACCEPTED
COMMANDS = {MISSION: WAYPOINT, FENCE: FENCE_VERTEX, RALLY: RALLY_POINT}


def item(seq: int, kind: int = MISSION, **changes: Any) -> mavlink.MAVLink_mission_item_int_message:
    fields: dict[str, Any] = {
        "target_system": 1,
        "target_component": 1,
        "seq": seq,
        "frame": GLOBAL_INT,
        "command": COMMANDS[kind],
        "current": 0,
        "autocontinue": 1,
        "param1": 1.5,
        "param2": 0.0,
        "param3": 0.0,
        "param4": math.nan,
        "x": 471_000_000 + 1000 * seq,
        "y": -87_000_000 - 1000 * seq,
        "z": 600.0 + seq,
        "mission_type": kind,
    }
    return mavlink.MAVLink_mission_item_int_message(**(fields | changes))


def count(number: int, kind: int = MISSION) -> mavlink.MAVLink_mission_count_message:
    return mavlink.MAVLink_mission_count_message(1, 1, number, kind)


def request(seq: int, kind: int = MISSION) -> mavlink.MAVLink_mission_request_int_message:
    return mavlink.MAVLink_mission_request_int_message(1, 1, seq, kind)


def upload(station: GroundStation, items: list[Any], kind: int = MISSION) -> int | None:
    """Upload as a ground station does: answer each request; the result of the ACK, if one comes."""
    found = station.ask(count(len(items), kind), "MISSION_REQUEST_INT", "MISSION_ACK")
    for _ in range(100 + 20 * len(items)):
        if found and found[-1].get_type() == "MISSION_ACK":
            return int(found[-1].type)
        found = station.send(items[found[-1].seq]) if found else station.wait(0.25)
        found = [m for m in found if m.get_type() in ("MISSION_REQUEST_INT", "MISSION_ACK")]
    return None


def download(station: GroundStation, kind: int = MISSION) -> list[Any]:
    listing = mavlink.MAVLink_mission_request_list_message(1, 1, kind)
    [first, *_] = station.ask(listing, "MISSION_COUNT", retries=20)
    assert first.mission_type == kind

    def ask_for(seq: int) -> Any:
        for _ in range(20):
            # An item that was asked for twice is answered twice.
            for m in station.ask(
                request(seq, kind), "MISSION_ITEM_INT", retries=20, timeout_s=0.25
            ):
                if m.seq == seq:
                    return m
        raise AssertionError(f"item {seq} never came")

    found = [ask_for(seq) for seq in range(first.count)]
    station.send(mavlink.MAVLink_mission_ack_message(1, 1, ACCEPTED, kind))
    return found


def content(message: Any) -> tuple[Any, ...]:
    floats = (message.param1, message.param2, message.param3, message.z)
    assert math.isnan(message.param4)
    return (message.seq, message.frame, message.command, message.autocontinue, message.x,
            message.y, *floats, message.mission_type)  # fmt: skip


@pytest.mark.parametrize("kind", [MISSION, FENCE, RALLY])
def test_downloaded_items_equal_the_uploaded_ones(station: GroundStation, kind: int) -> None:
    items = [item(seq, kind) for seq in range(12)]
    assert upload(station, items, kind) == ACCEPTED
    assert [content(m) for m in download(station, kind)] == [content(m) for m in items]
    for other in {MISSION, FENCE, RALLY} - {kind}:
        assert download(station, other) == []


@pytest.mark.parametrize("seed", range(10))
def test_up_and_down_over_a_lossy_link(station: GroundStation, seed: int) -> None:
    rng = np.random.default_rng(seed)
    station.loses = lambda *_: rng.random() < 0.15
    items = [item(seq) for seq in range(20)]
    results = (upload(station, items) for _ in range(10))
    assert ACCEPTED in results
    assert [content(m) for m in download(station)] == [content(m) for m in items]


def old_item(seq: int) -> mavlink.MAVLink_mission_item_message:
    return mavlink.MAVLink_mission_item_message(
        1, 1, seq, 3, WAYPOINT, 0, 1, 1.5, 0.0, 0.0, math.nan, 47.1 + seq, -8.7, 50.0, MISSION
    )


def test_client_without_the_int_form_is_asked_and_answered_in_the_older_one(
    station: GroundStation,
) -> None:
    """DroneKit ignores MISSION_REQUEST_INT, and reads MISSION_ITEM only."""
    station.send(count(2))
    station.wait(0.9)
    wanted = [m.get_type() for m in station.inbox if "MISSION_REQUEST" in m.get_type()]
    assert wanted == ["MISSION_REQUEST_INT"] * 2 + ["MISSION_REQUEST"]
    [second] = station.send(old_item(0))
    assert (second.get_type(), second.seq) == ("MISSION_REQUEST", 1)
    assert kinds(station.send(old_item(1)))[0] == "MISSION_ACK"
    [first] = station.send(mavlink.MAVLink_mission_request_message(1, 1, 1, MISSION))
    assert (first.get_type(), first.frame) == ("MISSION_ITEM", 3)
    assert (first.x, first.y, first.z) == pytest.approx((48.1, -8.7, 50.0), abs=1e-5)
    [again] = station.send(count(1))
    assert again.get_type() == "MISSION_REQUEST", "the form is stored"


def test_client_of_the_int_form_is_never_answered_in_the_older_one(station: GroundStation) -> None:
    upload(station, [item(0)])
    [found] = station.send(mavlink.MAVLink_mission_request_message(1, 1, 0, MISSION))
    assert found.get_type() == "MISSION_ITEM_INT"
    other = GroundStation(station.vehicle, station.clock, client_id=9)
    [found] = other.send(mavlink.MAVLink_mission_request_message(1, 1, 0, MISSION))
    assert found.get_type() == "MISSION_ITEM"


def test_client_that_refuses_the_older_form_is_asked_in_the_int_form_again(
    station: GroundStation,
) -> None:
    """MAVSDK answers MISSION_REQUEST by MISSION_ACK unsupported."""
    station.send(count(1))
    station.wait(0.9)
    unsupported = mavlink.MAV_MISSION_UNSUPPORTED
    [wanted] = station.send(mavlink.MAVLink_mission_ack_message(1, 1, unsupported, MISSION))
    assert wanted.get_type() == "MISSION_REQUEST_INT"
    assert kinds(station.send(item(0)))[0] == "MISSION_ACK"


def test_items_are_asked_for_in_order_and_at_once(station: GroundStation) -> None:
    for seq in range(3):
        [wanted] = station.send(count(3) if seq == 0 else item(seq - 1))
        assert (wanted.get_type(), wanted.seq) == ("MISSION_REQUEST_INT", seq)
    [ack] = station.send(item(2))
    assert (ack.get_type(), ack.type, ack.mission_type) == ("MISSION_ACK", ACCEPTED, MISSION)
    assert (ack.target_system, ack.target_component) == (255, 190)


def asked_in(station: GroundStation, seconds: float) -> list[int]:
    """Let time pass; the items that are asked for meanwhile."""
    wanted = ("MISSION_REQUEST_INT", "MISSION_REQUEST")
    return [m.seq for m in station.wait(seconds) if m.get_type() in wanted]


def test_a_lost_item_is_asked_for_again_for_five_seconds(station: GroundStation) -> None:
    station.send(count(2))
    station.send(item(0))
    assert asked_in(station, 4.9) == [1] * 12
    [ack] = [m for m in station.wait(0.4) if m.get_type() == "MISSION_ACK"]
    assert ack.type == mavlink.MAV_MISSION_OPERATION_CANCELLED
    assert asked_in(station, 4.0) == []
    assert download(station) == []


def test_an_item_out_of_order_is_dropped_and_the_right_one_asked_for(
    station: GroundStation,
) -> None:
    station.send(count(3))
    [wanted] = station.send(item(2))
    assert wanted.seq == 0
    [wanted] = station.send(item(0))
    assert wanted.seq == 1
    assert station.send(item(0)) == [], "item 1 is asked for already"


def test_a_client_that_went_back_for_a_late_request_is_taken_from_there(
    station: GroundStation,
) -> None:
    station.send(count(4))
    for seq in range(3):
        station.send(item(seq))
    assert station.send(item(0)) == []
    assert asked_in(station, 0.4) == [1]
    for seq in (1, 2):
        [wanted] = station.send(item(seq))
        assert wanted.seq == seq + 1
    [ack] = station.send(item(3))
    assert ack.type == ACCEPTED


def test_a_begin_that_comes_twice_asks_once(station: GroundStation) -> None:
    """A request for each makes MAVSDK go back to the first item for good."""
    station.send(count(2))
    assert station.send(count(2)) == []
    assert [m.seq for m in station.send(count(3))] == [0], "another upload"


def test_a_last_item_that_comes_again_is_acknowledged_again(station: GroundStation) -> None:
    upload(station, [item(0), item(1)])
    assert station.send(item(0)) == []
    [ack] = station.send(item(1))
    assert ack.type == ACCEPTED
    [ack] = station.send(item(5))
    assert ack.type == mavlink.MAV_MISSION_ERROR


def test_where_a_request_was_lost_the_ack_may_be_too(station: GroundStation) -> None:
    """MAVSDK waits for it without a word, so the last item is asked for as if it had not come."""
    station.send(count(2))
    assert asked_in(station, 0.5) == [0]
    station.send(item(0))
    assert asked_in(station, 0.5) == [1]
    [ack] = station.send(item(1))
    assert ack.type == ACCEPTED
    assert station.send(item(1)) == [], "it was asked for twice"
    assert asked_in(station, 0.5) == [1]
    [ack] = station.send(item(1))
    assert ack.type == ACCEPTED
    assert asked_in(station, 5.0) == [1, 1]


def test_the_last_item_is_asked_for_though_an_older_one_came_late(station: GroundStation) -> None:
    station.send(count(3))
    assert asked_in(station, 0.5) == [0]
    for seq in (0, 1, 0, 2):
        station.send(item(seq))
    assert asked_in(station, 5.0) == [2, 2, 2]


def test_where_nothing_was_lost_an_upload_ends_with_its_ack(station: GroundStation) -> None:
    upload(station, [item(0), item(1)])
    assert asked_in(station, 5.0) == []


def test_a_failed_upload_leaves_the_old_mission(station: GroundStation) -> None:
    upload(station, [item(0), item(1)])
    broken = [item(0), item(1, x=910_000_000)]
    assert upload(station, broken) == mavlink.MAV_MISSION_INVALID_PARAM5_X
    station.send(count(4))
    station.send(item(0, x=1))
    station.wait(6.0)
    assert [m.x for m in download(station)] == [471_000_000, 471_001_000]


@pytest.mark.parametrize(
    ("kind", "changes", "result"),
    [
        (MISSION, {"x": -900_000_001}, mavlink.MAV_MISSION_INVALID_PARAM5_X),
        (MISSION, {"y": 1_800_000_001}, mavlink.MAV_MISSION_INVALID_PARAM6_Y),
        (MISSION, {"z": math.inf}, mavlink.MAV_MISSION_INVALID_PARAM7),
        (MISSION, {"frame": LOCAL_NED}, mavlink.MAV_MISSION_UNSUPPORTED_FRAME),
        (MISSION, {"command": 65_000}, mavlink.MAV_MISSION_UNSUPPORTED),
        (FENCE, {"command": WAYPOINT}, mavlink.MAV_MISSION_UNSUPPORTED),
        (RALLY, {"command": WAYPOINT}, mavlink.MAV_MISSION_UNSUPPORTED),
        (MISSION, {"frame": RELATIVE_INT, "z": math.nan}, ACCEPTED),
        (MISSION, {"command": 178, "frame": MISSION_FRAME, "x": -1, "y": 2**31 - 1}, ACCEPTED),
    ],
)
def test_items_are_checked(
    station: GroundStation, kind: int, changes: dict[str, Any], result: int
) -> None:
    assert upload(station, [item(0, kind, **changes)], kind) == result


def test_the_older_messages_with_floats(station: GroundStation) -> None:
    """MISSION_ITEM is stored, and MISSION_REQUEST answered by MISSION_ITEM."""
    station.version = 1
    station.send(mavlink.MAVLink_mission_count_message(1, 1, 1))
    older = mavlink.MAVLink_mission_item_message(
        1, 1, 0, 0, WAYPOINT, 0, 1, 1.5, 0.0, 0.0, math.nan, 47.1, -8.7, 600.0
    )
    [ack] = station.send(older)
    assert ack.type == ACCEPTED
    [found] = station.send(mavlink.MAVLink_mission_request_message(1, 1, 0))
    assert found.get_type() == "MISSION_ITEM"
    assert (found.x, found.y) == pytest.approx((47.1, -8.7), abs=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e30])
def test_floats_that_are_no_place_are_refused(station: GroundStation, bad: float) -> None:
    station.send(count(1))
    older = mavlink.MAVLink_mission_item_message(
        1, 1, 0, 0, WAYPOINT, 0, 1, 0.0, 0.0, 0.0, 0.0, bad, bad, 600.0
    )
    [ack] = station.send(older)
    assert ack.type == mavlink.MAV_MISSION_INVALID_PARAM5_X


@pytest.mark.parametrize("kind", [MISSION, FENCE, RALLY])
def test_too_many_items_are_refused(station: GroundStation, kind: int) -> None:
    [ack] = station.send(count(MAX_ITEMS[kind] + 1, kind))
    assert (ack.type, ack.mission_type) == (mavlink.MAV_MISSION_NO_SPACE, kind)
    assert station.send(count(MAX_ITEMS[kind], kind))[0].get_type() == "MISSION_REQUEST_INT"


def test_unknown_kinds_are_refused(station: GroundStation) -> None:
    listing = mavlink.MAVLink_mission_request_list_message(1, 1, 7)
    for message in (listing, count(1, 7), request(0, 7), item(0, mission_type=7, command=16)):
        assert station.send(message)[0].type != ACCEPTED
    partial = mavlink.MAVLink_mission_write_partial_list_message(1, 1, 0, 1, 0)
    assert station.send(partial)[0].type == mavlink.MAV_MISSION_UNSUPPORTED


def test_an_item_that_is_not_there(station: GroundStation) -> None:
    assert station.send(request(0))[0].type == mavlink.MAV_MISSION_INVALID_SEQUENCE


@pytest.mark.parametrize("kind", [MISSION, ALL])
def test_clearing(station: GroundStation, kind: int) -> None:
    upload(station, [item(0)])
    upload(station, [item(0, RALLY)], RALLY)
    [ack] = station.send(mavlink.MAVLink_mission_clear_all_message(1, 1, kind))
    assert (ack.type, ack.mission_type) == (ACCEPTED, kind)
    assert download(station) == []
    assert len(download(station, RALLY)) == (kind == MISSION)


def test_an_empty_upload_clears(station: GroundStation) -> None:
    upload(station, [item(0)])
    [ack] = station.send(count(0))
    assert ack.type == ACCEPTED
    assert download(station) == []


def test_an_upload_can_be_cancelled(station: GroundStation) -> None:
    station.send(count(3))
    cancelled = mavlink.MAVLink_mission_ack_message(
        1, 1, mavlink.MAV_MISSION_OPERATION_CANCELLED, MISSION
    )
    assert station.send(cancelled) == []
    assert "MISSION_REQUEST_INT" not in kinds(station.wait(2.0))


def test_a_late_end_of_a_download_ends_no_upload(station: GroundStation) -> None:
    station.send(count(2))
    station.send(mavlink.MAVLink_mission_ack_message(1, 1, ACCEPTED, MISSION))
    [wanted] = station.send(item(0))
    assert (wanted.get_type(), wanted.seq) == ("MISSION_REQUEST_INT", 1)


def test_two_uploads_do_not_mix(station: GroundStation) -> None:
    other = GroundStation(station.vehicle, station.clock, client_id=8, system_id=254)
    station.send(count(2))
    [denied] = other.send(count(1))
    assert (denied.type, denied.target_system) == (mavlink.MAV_MISSION_DENIED, 254)
    [error] = other.send(item(0))
    assert error.type == mavlink.MAV_MISSION_ERROR
    station.send(item(0))
    assert station.send(item(1))[0].type == ACCEPTED
    assert upload(other, [item(0)]) == ACCEPTED


def test_an_upload_on_a_slow_link_is_not_taken_over(station: GroundStation) -> None:
    other = GroundStation(station.vehicle, station.clock, client_id=8, system_id=254)
    station.send(count(2))
    for seq in range(2):
        station.wait(3.0)
        [denied] = other.send(count(1))
        assert denied.type == mavlink.MAV_MISSION_DENIED
        answers = station.send(item(seq))
    assert answers[0].type == ACCEPTED


def test_upload_without_progress_gives_way_after_the_timeout(station: GroundStation) -> None:
    """A restarted ground station is another client, and its old upload never ends."""
    other = GroundStation(station.vehicle, station.clock, client_id=8, system_id=254)
    station.send(count(2))
    station.send(item(0))
    station.wait(5.5)
    assert upload(other, [item(0)]) == ACCEPTED


def test_repeated_count_restarts_the_upload(station: GroundStation) -> None:
    station.send(count(2))
    station.send(item(0))
    [wanted] = station.send(count(2))
    assert wanted.seq == 0


def test_an_untrusted_client_may_read_only(station: GroundStation) -> None:
    upload(station, [item(0)])
    station.trusted = False
    for message in (
        count(1),
        count(0),
        item(0),
        mavlink.MAVLink_mission_clear_all_message(1, 1, ALL),
    ):
        assert station.send(message)[0].type == mavlink.MAV_MISSION_DENIED
    assert len(download(station)) == 1


def test_setting_the_current_item(station: GroundStation) -> None:
    upload(station, [item(seq) for seq in range(4)])
    [current] = station.send(mavlink.MAVLink_mission_set_current_message(1, 1, 2))
    assert (current.get_type(), current.seq, current.total) == ("MISSION_CURRENT", 2, 4)
    [text] = station.send(mavlink.MAVLink_mission_set_current_message(1, 1, 4))
    assert text.get_type() == "STATUSTEXT"
    ack, current = station.command(mavlink.MAV_CMD_DO_SET_MISSION_CURRENT, 3)
    assert (ack.result, current.seq) == (0, 3)
    assert [m.current for m in download(station)] == [0, 0, 0, 1]


def test_mission_current_without_a_mission(station: GroundStation) -> None:
    _, current = station.request(42)
    assert (current.seq, current.total) == (0, 65535)
    assert current.mission_state == mavlink.MISSION_STATE_NO_MISSION


class TestMark:
    """The marked location follows what ground stations do with their maps."""

    @staticmethod
    def way(station: GroundStation) -> Any:
        ack, *found = station.request(62)
        assert (ack.result == 0) == bool(found)
        return found[0] if found else None

    def test_nothing_is_marked_at_first(self, station: GroundStation) -> None:
        assert self.way(station) is None

    def test_distance_and_bearing(self, station: GroundStation) -> None:
        """A tenth of a degree north of 47.1 is 11118 m by the ellipsoid."""
        place = (STATE.lat_deg + 0.1, STATE.lon_deg, 623.456)
        station.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, *place)
        found = self.way(station)
        assert found.wp_dist == pytest.approx(11_118, abs=2)
        assert found.target_bearing == found.nav_bearing == 0
        assert found.alt_error == pytest.approx(100.0, abs=0.1)
        assert math.isnan(found.nav_roll)

    def test_the_other_end_of_the_earth_has_a_distance_too(self) -> None:
        """From Karney's article, where Vincenty's iteration does not converge."""
        way = distance_and_bearing(Location(0.0, 0.0, 0.0), Location(0.5, 179.7, 0.0))
        assert way == pytest.approx((19_944_127.421, math.radians(15.556883)), abs=1e-3)

    @pytest.mark.parametrize(
        ("north", "east", "bearing"), [(0.0, 0.01, 90), (-0.01, 0.0, -180), (0.0, -0.01, -90)]
    )
    def test_bearings(
        self, station: GroundStation, north: float, east: float, bearing: int
    ) -> None:
        place = (STATE.lat_deg + north, STATE.lon_deg + east, 500.0)
        station.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, *place)
        assert self.way(station).target_bearing == bearing

    def test_a_far_mark_saturates(self, station: GroundStation) -> None:
        station.command(mavlink.MAV_CMD_DO_SET_ROI_LOCATION, 0, 0, 0, 0, -40.0, 170.0, math.nan)
        found = self.way(station)
        assert found.wp_dist == 65535
        assert math.isnan(found.alt_error)

    def test_an_uploaded_mission_marks_its_current_item(self, station: GroundStation) -> None:
        jump = item(0, command=177, frame=MISSION_FRAME, x=1, y=2)
        upload(station, [jump, item(1), item(2, x=480_000_000)])
        near = self.way(station).wp_dist
        station.send(mavlink.MAVLink_mission_set_current_message(1, 1, 2))
        assert self.way(station).wp_dist > near + 50_000
        station.send(mavlink.MAVLink_mission_clear_all_message(1, 1, MISSION))
        assert self.way(station) is None

    def test_a_rally_point_marks_and_its_relative_height_counts_from_home(
        self, station: GroundStation
    ) -> None:
        upload(station, [item(0, RALLY, frame=RELATIVE_INT, z=100.0)], RALLY)
        assert self.way(station).alt_error == pytest.approx(620.25 - 523.456, abs=0.01)

    def test_a_fence_does_not(self, station: GroundStation) -> None:
        upload(station, [item(0, FENCE)], FENCE)
        assert self.way(station) is None

    def test_a_roi_outlives_the_mission_it_replaced(self, station: GroundStation) -> None:
        upload(station, [item(0)])
        station.command(mavlink.MAV_CMD_DO_SET_ROI, 3, 0, 0, 0, 47.2, -8.7, 500.0)
        station.send(mavlink.MAVLink_mission_clear_all_message(1, 1, MISSION))
        assert self.way(station) is not None
        station.command(mavlink.MAV_CMD_DO_SET_ROI_NONE)
        assert self.way(station) is None
