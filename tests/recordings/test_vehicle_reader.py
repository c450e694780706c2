"""One reader of recorded vehicles: positions, attitude, the vehicle's component, joined texts."""

from typing import Any

import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.vehicle_reader import VehicleMessage
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import Continuity, GroundDistance
from gateway.vehicle_state.status_texts import MAX_OPEN, TIMEOUT_US, TextJoiner
from tests.kit.mavlink import packed
from tests.kit.recordings import START_US, Sent, messages_of, records_sent

LAT, LON = 470_000_000, 85_000_000
VEHICLE, GIMBAL, CAMERA, STATION = (1, 1), (1, 154), (1, 100), (255, 190)


def read(sent: Sent) -> list[VehicleMessage]:
    return messages_of(records_sent(sent, US_PER_S // 10))


def positions(sent: Sent) -> list[tuple[float, float, float]]:
    found = [message.position for message in read(sent) if message.position is not None]
    return [(round(p.lat_deg, 6), round(p.lon_deg, 6), round(p.alt_amsl_m, 2)) for p in found]


def fused(lat: int = LAT, lon: int = LON, alt_mm: int = 430_000) -> Any:
    return mavlink.MAVLink_global_position_int_message(0, lat, lon, alt_mm, 0, 100, 0, 0, 0)


def raw(fix_type: int = 3, lat: int = LAT, lon: int = LON) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(0, fix_type, lat, lon, 430_000, 1, 1, 250, 9000, 9)


def raw2(fix_type: int = 3) -> Any:
    position = (LAT, LON, 430_000)
    return mavlink.MAVLink_gps2_raw_message(0, fix_type, *position, 1, 1, 250, 9000, 9, 0, 0)


def narrow(kind: Any, groundspeed: int, **known: int) -> Any:
    fields = dict.fromkeys(kind.fieldnames, 0) | {"latitude": LAT, "longitude": LON}
    return kind(**fields | known | {"groundspeed": groundspeed})


COVARIANCE = mavlink.MAVLink_global_position_int_cov_message(
    0, 1, LAT, LON, 430_000, 0, 1.0, 0.0, 0.0, [0.0] * 36
)
NARROW = narrow(mavlink.MAVLink_high_latency_message, 5, altitude_amsl=430, gps_fix_type=3)
NARROW2 = narrow(mavlink.MAVLink_high_latency2_message, 25, altitude=430)


def local(north_m: float, east_m: float = 0.0) -> Any:
    return mavlink.MAVLink_local_position_ned_message(0, north_m, east_m, -30.0, 3.0, 4.0, 0.0)


def frame_origin(lat: int = LAT) -> Any:
    return mavlink.MAVLink_gps_global_origin_message(lat, LON, 400_000)


def beat(autopilot: int = 3, kind: int = 1) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, 0, 0, 4, 3)


HERE = (47.0, 8.5, 430.0)


@pytest.mark.parametrize(
    ("messages", "speed_mps"),
    [
        ([fused()], 1.0), ([COVARIANCE], 1.0), ([raw()], 2.5), ([raw(2)], 2.5), ([raw2()], 2.5),
        ([NARROW], 5.0), ([NARROW2], 5.0), ([frame_origin(), local(0.0)], 5.0),
        ([local(0.0), frame_origin()], 5.0),
    ],
    ids=["fused", "covariance", "GPS", "2D", "second GPS", "narrow", "narrow 2", "local",
         "local before its origin"],
)  # fmt: skip
def test_position_is_read_of_every_message_that_holds_one(
    messages: list[Any], speed_mps: float
) -> None:
    sent = [(VEHICLE, message) for message in messages]
    assert positions(sent) == [HERE]
    (found,) = (message.position for message in read(sent) if message.position is not None)
    assert found.groundspeed_mps == pytest.approx(speed_mps)


@pytest.mark.parametrize(
    "message",
    [
        fused(0, 0), fused(lat=2**31 - 1), fused(lat=-(2**31)), fused(lon=1_900_000_000),
        raw(0), raw(1), raw(3, 0, 0), raw2(1), local(0.0),
    ],
)  # fmt: skip
def test_position_without_a_fix_or_off_the_earth_is_left_out(message: Any) -> None:
    assert positions([(VEHICLE, message)]) == []


def test_position_on_the_equator_or_the_prime_meridian_is_valid() -> None:
    assert len(positions([(VEHICLE, fused(0, LON)), (VEHICLE, fused(LAT, 0))])) == 2


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([fused(), raw(lat=LAT + 500)], [HERE]),
        ([raw(), fused(0, 0), fused(0, 0)], [HERE]),
        ([fused(LAT + 500), *[raw()] * 40], [HERE] * 40),
        ([raw2(), raw(1)], [HERE]),
    ],
    ids=["fused", "only the GPS valid", "fused for a moment", "second GPS"],
)
def test_best_source_with_positions_most_of_the_time_is_used(
    sent: list[Any], expected: list[Any]
) -> None:
    assert positions([(VEHICLE, m) for m in sent]) == expected


def test_local_position_is_placed_by_the_newest_origin() -> None:
    sent = [frame_origin(), local(111.0), frame_origin(LAT + 10_000_000), local(0.0)]
    (lat, _, _), (other, _, _) = positions([(VEHICLE, m) for m in sent])
    assert lat == pytest.approx(47.001, abs=2e-5)
    assert other == 48.0


@pytest.mark.parametrize(
    "others",
    [
        [(VEHICLE, beat()), (GIMBAL, beat(8, 26)), (GIMBAL, fused(LAT + 7))],
        [(VEHICLE, beat()), (CAMERA, beat(8, 30)), (CAMERA, fused(LAT + 7))],
        [(CAMERA, fused(LAT + 7))],
        [(STATION, beat(8, 6)), (STATION, fused(LAT + 7))],
    ],
    ids=["gimbal", "camera", "without heartbeats", "ground station"],
)
def test_position_of_another_component_is_not_the_vehicles(others: Sent) -> None:
    assert positions([*others, (VEHICLE, fused())]) == [HERE]


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([((1, 1), beat(8, 18)), ((1, 1), fused(LAT + 7)), ((1, 3), beat()), ((1, 3), fused())], 1),
        ([((1, 100), beat(8, 30)), ((1, 100), fused())], 1),
        ([((1, 1), beat()), ((1, 100), fused())], 0),
    ],
    ids=["autopilot is component 3", "positions of a camera alone", "vehicle without positions"],
)
def test_vehicle_is_the_autopilot_or_else_the_sender_of_positions(
    sent: Sent, expected: int
) -> None:
    assert positions(sent) == [HERE] * expected


def test_attitude_of_a_gimbal_is_not_the_vehicles() -> None:
    turned = mavlink.MAVLink_attitude_message(0, 0.1, 0.2, 0.3, 0, 0, 0)
    other = mavlink.MAVLink_attitude_message(0, 1.1, 1.2, 1.3, 0, 0, 0)
    unknown = mavlink.MAVLink_attitude_message(0, float("nan"), 0.0, 0.0, 0, 0, 0)
    sent: Sent = [(VEHICLE, beat()), (GIMBAL, other), (VEHICLE, turned), (VEHICLE, unknown)]
    (q_nb,) = (m.q_nb for m in read(sent) if m.q_nb is not None)
    assert q_nb[1] == pytest.approx(0.034, abs=1e-3)


def text(words: bytes, number: int = 0, chunk: int = 0, severity: int = 4) -> Any:
    return mavlink.MAVLink_statustext_message(severity, words, number, chunk)


A, B = b"a" * 49 + b" ", b"b" * 50
LONG = "Höhe über Grund: " + "äöüß" * 20


def split(words: str, number: int) -> list[Any]:
    data = words.encode()
    return [text(data[at : at + 50], number, k) for k, at in enumerate(range(0, len(data) + 1, 50))]


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([(VEHICLE, text("Größe 5 µT".encode()))], ["Größe 5 µT"]),
        ([(VEHICLE, m) for m in split(LONG, 3)], [LONG]),
        ([(VEHICLE, m) for m in reversed(split(LONG, 3))], [LONG]),
        ([(VEHICLE, text(A, 9)), (CAMERA, text(B, 9)), (VEHICLE, text(b"x", 9, 1)),
          (CAMERA, text(b"y", 9, 1))], [A.decode() + "x", B.decode() + "y"]),
        ([(VEHICLE, text(B, 31)), (VEHICLE, text(b"Landed", 32))], ["Landed", B.decode()]),
        ([(VEHICLE, text(A, 5))], [A.decode().rstrip() + "…"]),
        ([(VEHICLE, text(A, 5)), (VEHICLE, text(B, 5, 1))], [A.decode() + B.decode() + "…"]),
        ([(VEHICLE, text(A, 5)), (VEHICLE, text(b"end", 5, 2))], [A.decode() + "…end"]),
        ([(VEHICLE, text(b"end", 5, 1))], ["…end"]),
        ([(VEHICLE, m) for m in split("ü" * 40, 6)[1:]], ["…" + "ü" * 15]),
        ([(VEHICLE, text(A, 5)), (VEHICLE, text(B, 5))], [A.decode().rstrip() + "…", B.decode()]),
        ([(VEHICLE, text(A, 5)), (VEHICLE, text(A, 5)), (VEHICLE, text(b"x", 5, 1)),
          (VEHICLE, text(b"x", 5, 1))], [A.decode() + "x"]),
        ([(STATION, text(b"hello"))], []),
    ],
    ids=["UTF-8", "character cut in two", "reversed", "two components", "exactly 50", "last lost",
         "last of three lost", "middle lost", "first lost", "first lost within a character",
         "id used again", "twice by two links", "ground station"],
)  # fmt: skip
def test_texts_are_joined(sent: Sent, expected: list[str]) -> None:
    assert [m.text.text for m in read(sent) if m.text is not None] == expected


def test_text_has_the_time_of_its_first_chunk() -> None:
    (found,) = read([(VEHICLE, text(A, 5)), (VEHICLE, text(b"x", 5, 1))])
    assert (found.time_us, found.text and found.text.severity) == (START_US, 4)


def test_lost_chunk_is_waited_for_no_longer_than_the_timeout() -> None:
    joiner = TextJoiner()
    assert joiner.feed(packed(text(A, 5), 1, 1), 0) == []
    assert joiner.poll(TIMEOUT_US - 1) == []
    (late,) = joiner.poll(TIMEOUT_US)
    assert late.text.endswith("…")
    assert joiner.flush() == []


def test_flood_of_first_chunks_is_bounded() -> None:
    joiner = TextJoiner()
    found = [joiner.feed(packed(text(A, n), 1, 1), 0) for n in range(1, 3 * MAX_OPEN)]
    assert sum(map(len, found)) + len(joiner.flush()) == 3 * MAX_OPEN - 1
    assert [len(one) for one in found[-3:]] == [1, 1, 1]


@pytest.mark.parametrize(
    ("steps", "is_broken"),
    [
        ([(0.5, 1e-5, 500)], False),
        ([(59.0, 0.0, 59_000)], False),
        ([(61.0, 0.0, 61_000)], True),
        ([(3600.0, 0.04, 3_600_000)], True),
        ([(0.5, 0.0, -30_000)], True),
        ([(-1.0, 0.0, -1_000)], False),
        ([(0.5, 0.04, 500)], True),
        ([(10.0, 0.02, 10_000)], False),
        ([(0.5, 0.04, None)], True),
        ([(0.5, 1e-5, None)], False),
    ],
)
def test_track_is_broken_by_interruption_restart_and_jump(
    steps: list[tuple[float, float, int | None]], is_broken: bool
) -> None:
    track, boot_ms = Continuity(), 40_000
    assert not track.is_broken_at(START_US, 47.0, 8.5, boot_ms * 1000)
    for step_s, step_deg, step_ms in steps:
        boot_us = None if step_ms is None else (boot_ms + step_ms) * 1000
        at = (START_US + round(step_s * US_PER_S), 47.0 + step_deg, 8.5)
        assert track.is_broken_at(*at, boot_us) is is_broken


def test_distance_does_not_count_an_interruption() -> None:
    distance = GroundDistance()
    assert distance.distance_m is None
    for k in range(10):
        distance.update(START_US + k * US_PER_S, 47.0 + 1e-4 * k, 8.5)
    flown_m = distance.distance_m
    for k in range(10):
        distance.update(START_US + (3600 + k) * US_PER_S, 47.05 + 1e-4 * k, 8.5)
    assert flown_m is not None
    assert flown_m == pytest.approx(100.0, rel=0.01)
    assert distance.distance_m == pytest.approx(2.0 * flown_m, rel=0.01)
