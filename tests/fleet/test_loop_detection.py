"""A fleet's own clients fed back into a site: frames end after one round."""

from pymavlink.dialects.v20 import all as mavlink

from gateway.fleet.frame_translation import FrameTranslation
from gateway.fleet.id_map import IdMap, SiteVehicle
from gateway.fleet.loop_detection import MAX_CHANCE, MAX_FRAMES, SPAN_US, LoopDetection
from gateway.wire.mavlink_splitter import frame_of, origin_of
from tests.kit.mavlink import Sender

STEP_US = 20_000


class Ring:
    """Sites a and b of one aircraft 1 each, and c, which is fed with what the fleet gives out."""

    def __init__(self, ids: IdMap | None = None) -> None:
        self.ids = ids or IdMap()
        self.loops = LoopDetection()
        self.sites = {name: FrameTranslation(name, self.ids, None, self.loops) for name in "abc"}
        self.vehicles = {name: Sender(1, 1) for name in "ab"}
        self.now_us = 0

    def attitude(self, name: str) -> bytes:
        self.now_us += STEP_US
        time_ms = self.now_us // 1000
        return self.vehicles[name].pack(mavlink.MAVLink_attitude_message(time_ms, 0, 0, 0, 0, 0, 0))

    def passed(self, name: str) -> bytes:
        """Return the next frame of a site's vehicle, as the stations get it."""
        given = self.give(name, self.attitude(name))
        assert given is not None
        return given

    def give(self, name: str, frame: bytes, *, is_own: bool = False) -> bytes | None:
        given = self.sites[name].from_site(frame_of(frame), self.now_us, is_own=is_own)
        return None if given is None else given.data


def test_looped_frames_end_after_one_round_and_assign_no_id() -> None:
    ring = Ring()
    for _ in range(300):
        for name in "ab":
            given = ring.passed(name)
            ring.now_us += STEP_US
            assert ring.give("c", given) is None
    assert ring.ids.items() == [(("a", 1), 1), (("b", 1), 2)]
    assert ring.sites["c"].counters["looped"] == 600
    assert ring.sites["c"].traffic == {}
    assert ring.sites["a"].counters["looped"] == ring.sites["b"].counters["looped"] == 0


def test_frame_returned_through_its_own_site_is_no_loop() -> None:
    ring = Ring(IdMap({SiteVehicle("a", 1): 7}))
    given = ring.passed("a")
    assert origin_of(given)[0] == 7
    assert ring.give("a", given) is None
    assert ring.ids.known_id("a", 7) is None


def test_two_equal_vehicles_are_separated_by_the_first_differing_frame() -> None:
    """Their heartbeats are equal, byte for byte."""
    ring = Ring()
    assert ring.give("a", ring.vehicles["a"].heartbeat()) is not None
    assert ring.give("b", ring.vehicles["b"].heartbeat()) is None
    for _ in range(50):
        for name in "ab":
            ring.passed(name)
        for name in "ab":
            assert ring.give(name, ring.vehicles[name].heartbeat()) is not None
    assert ring.ids.known_id("b", 1) == 2


def test_two_gateways_with_equal_frames_are_taken_for_a_loop() -> None:
    """As one recording played at two sites: what a gateway made itself is no copy."""
    ring = Ring()
    for _ in range(100):
        frame = ring.attitude("a")
        for name in "ab":
            given = ring.give(name, frame, is_own=True)
            assert given is not None
            assert ring.give("c", given) is None, "fed back it ends all the same"
    assert ring.ids.items() == [(("a", 1), 1), (("b", 1), 2)]
    assert [ring.sites[name].counters["looped"] for name in "abc"] == [0, 0, 200]


def test_two_equal_vehicles_with_constant_frames_keep_their_ids() -> None:
    ring = Ring()
    for _ in range(MAX_CHANCE + 1):
        frames = [vehicle.heartbeat() for vehicle in ring.vehicles.values()]
        assert frames[0] == frames[1]
        passed = [ring.give(*each) for each in zip("ab", frames, strict=True)]
    assert None not in passed
    assert ring.ids.known_id("b", 1) == 2
    given = passed[1]
    assert given is not None
    assert ring.give("c", given) is None, "its id is not its own: this has gone round"


def test_looped_vehicle_with_an_id_is_dropped_after_a_run() -> None:
    ring = Ring(IdMap({SiteVehicle("b", 1): 2, SiteVehicle("c", 2): 3}))
    passed = 0
    for _ in range(100):
        passed += ring.give("c", ring.passed("b")) is not None
    assert passed == MAX_CHANCE
    assert ring.sites["c"].counters["looped"] == 100 - MAX_CHANCE
    own = Sender(2, 1).pack(mavlink.MAVLink_attitude_message(1, 2, 0, 0, 0, 0, 0))
    assert ring.give("c", own) is not None, "an aircraft that is really there"


def test_returned_command_ends_on_both_ways() -> None:
    ring = Ring(IdMap({SiteVehicle("a", 1): 7}))
    asked = Sender(255, 190).command(7, 1)
    found = ring.sites["a"].to_site(frame_of(asked), 0)
    assert found is not None
    system_id, sent = found[0], found[1].data
    assert system_id == 1
    for frame in (asked, sent):
        assert ring.give("c", frame) is None
    assert ring.ids.known_id("c", 255) is None
    assert ring.loops.is_returned_by_client(sent, 0), "for another vehicle's id"
    assert not ring.loops.is_returned_by_client(asked, 0), "a program may send the same frame again"
    assert ring.loops.looped == 1


def test_memory_is_bounded_in_time_and_number() -> None:
    ring = Ring()
    given = ring.passed("b")
    ring.now_us += 2 * SPAN_US + 1
    assert ring.give("c", given) is not None
    loops = LoopDetection()
    numbers = (number.to_bytes(4, "little") for number in range(3 * MAX_FRAMES))
    frames = [frame_of(b"\xfd\x04" + bytes(8) + number) for number in numbers]
    for frame in frames:
        loops.record_given(frame, SiteVehicle("a", 1), 0)
    known = [
        loops.is_returned(each, SiteVehicle("c", 2), has_id=False, now_us=0) for each in frames
    ]
    assert known[-1]
    assert sum(known) <= 2 * MAX_FRAMES
