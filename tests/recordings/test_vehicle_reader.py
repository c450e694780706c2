"""One reader of recorded vehicles: positions, attitude, the vehicle's component, joined texts."""

import math
from typing import Any

import pytest

from gateway.recordings.vehicle_reader import VehicleMessage
from gateway.units import US_PER_S
from gateway.vehicle_state.positions import Continuity, GroundDistance
from gateway.vehicle_state.status_texts import MAX_OPEN, TIMEOUT_US, TextJoiner
from tests.kit.mavlink import message_of, packed
from tests.kit.messages import attitude, beat, chunks, text
from tests.kit.recordings import START_US, Sent, messages_of, records_sent

LAT, LON = 470_000_000, 85_000_000
VEHICLE, GIMBAL, CAMERA, STATION = (1, 1), (1, 154), (1, 100), (255, 190)


def read(sent: Sent) -> list[VehicleMessage]:
    return messages_of(records_sent(sent, US_PER_S // 10))


def positions(sent: Sent) -> list[tuple[float, float, float]]:
    found = [message.position for message in read(sent) if message.position is not None]
    return [(round(p.lat_deg, 6), round(p.lon_deg, 6), round(p.alt_amsl_m, 2)) for p in found]


def fused(lat: int = LAT, lon: int = LON) -> Any:
    return message_of("GLOBAL_POSITION_INT", lat=lat, lon=lon, alt=430_000, vx=100)


def raw(fix_type: int = 3, lat: int = LAT, lon: int = LON, name: str = "GPS_RAW_INT") -> Any:
    return message_of(name, fix_type=fix_type, lat=lat, lon=lon, alt=430_000, vel=250)


def local(north_m: float) -> Any:
    return message_of("LOCAL_POSITION_NED", x=north_m, z=-30.0, vx=3.0, vy=4.0)


def frame_origin(lat: int = LAT) -> Any:
    return message_of("GPS_GLOBAL_ORIGIN", latitude=lat, longitude=LON, altitude=400_000)


GPS2 = "GPS2_RAW"
COVARIANCE = message_of("GLOBAL_POSITION_INT_COV", lat=LAT, lon=LON, alt=430_000, vx=1.0)
NARROW = message_of(
    "HIGH_LATENCY", latitude=LAT, longitude=LON, groundspeed=5, altitude_amsl=430, gps_fix_type=3
)
NARROW2 = message_of("HIGH_LATENCY2", latitude=LAT, longitude=LON, groundspeed=25, altitude=430)
HERE = (47.0, 8.5, 430.0)


@pytest.mark.parametrize(
    ("messages", "speed_mps"),
    [
        ([fused()], 1.0), ([COVARIANCE], 1.0), ([raw()], 2.5), ([raw(2)], 2.5),
        ([raw(name=GPS2)], 2.5), ([NARROW], 5.0), ([NARROW2], 5.0),
        ([frame_origin(), local(0.0)], 5.0), ([local(0.0), frame_origin()], 5.0),
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
        raw(0), raw(1), raw(3, 0, 0), raw(1, name=GPS2), local(0.0),
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
        ([raw(name=GPS2), raw(1)], [HERE]),
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
        [(VEHICLE, beat()), (GIMBAL, beat(26, 8)), (GIMBAL, fused(LAT + 7))],
        [(VEHICLE, beat()), (CAMERA, beat(30, 8)), (CAMERA, fused(LAT + 7))],
        [(CAMERA, fused(LAT + 7))],
        [(STATION, beat(6, 8)), (STATION, fused(LAT + 7))],
    ],
    ids=["gimbal", "camera", "without heartbeats", "ground station"],
)
def test_position_of_another_component_is_not_the_vehicles(others: Sent) -> None:
    assert positions([*others, (VEHICLE, fused())]) == [HERE]


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([((1, 1), beat(18, 8)), ((1, 1), fused(LAT + 7)), ((1, 3), beat()), ((1, 3), fused())], 1),
        ([((1, 100), beat(30, 8)), ((1, 100), fused())], 1),
        ([((1, 1), beat()), ((1, 100), fused())], 0),
    ],
    ids=["autopilot is component 3", "positions of a camera alone", "vehicle without positions"],
)
def test_vehicle_is_the_autopilot_or_else_the_sender_of_positions(
    sent: Sent, expected: int
) -> None:
    assert positions(sent) == [HERE] * expected


def test_attitude_of_a_gimbal_is_not_the_vehicles() -> None:
    turned, other = attitude(0.1, 0.2, 0.3), attitude(1.1, 1.2, 1.3)
    sent = [
        (VEHICLE, beat()),
        (GIMBAL, other),
        *((VEHICLE, m) for m in (turned, attitude(math.nan))),
    ]
    (q_nb,) = (m.q_nb for m in read(sent) if m.q_nb is not None)
    assert q_nb[1] == pytest.approx(0.034, abs=1e-3)


A, B = b"a" * 49 + b" ", b"b" * 50
LONG = "Höhe über Grund: " + "äöüß" * 20


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ([(VEHICLE, text("Größe 5 µT".encode()))], ["Größe 5 µT"]),
        ([(VEHICLE, m) for m in chunks(LONG)], [LONG]),
        ([(VEHICLE, m) for m in reversed(chunks(LONG))], [LONG]),
        ([(VEHICLE, text(A, 4, 9)), (CAMERA, text(B, 4, 9)), (VEHICLE, text(b"x", 4, 9, 1)),
          (CAMERA, text(b"y", 4, 9, 1))], [A.decode() + "x", B.decode() + "y"]),
        ([(VEHICLE, text(B, 4, 31)), (VEHICLE, text(b"Landed", 4, 32))], ["Landed", B.decode()]),
        ([(VEHICLE, text(A, 4, 5))], [A.decode().rstrip() + "…"]),
        ([(VEHICLE, text(A, 4, 5)), (VEHICLE, text(B, 4, 5, 1))], [A.decode() + B.decode() + "…"]),
        ([(VEHICLE, text(A, 4, 5)), (VEHICLE, text(b"end", 4, 5, 2))], [A.decode() + "…end"]),
        ([(VEHICLE, text(b"end", 4, 5, 1))], ["…end"]),
        ([(VEHICLE, m) for m in chunks("ü" * 40)[1:]], ["…" + "ü" * 15]),
        ([(VEHICLE, text(A, 4, 5)), (VEHICLE, text(B, 4, 5))],
         [A.decode().rstrip() + "…", B.decode()]),
        ([(VEHICLE, text(A, 4, 5)), (VEHICLE, text(A, 4, 5)), (VEHICLE, text(b"x", 4, 5, 1)),
          (VEHICLE, text(b"x", 4, 5, 1))], [A.decode() + "x"]),
        ([(STATION, text(b"hello"))], []),
    ],
    ids=["UTF-8", "character cut in two", "reversed", "two components", "exactly 50", "last lost",
         "last of three lost", "middle lost", "first lost", "first lost within a character",
         "id used again", "twice by two links", "ground station"],
)  # fmt: skip
def test_texts_are_joined(sent: Sent, expected: list[str]) -> None:
    found = [message for message in read(sent) if message.text is not None]
    assert [message.text.text for message in found if message.text] == expected
    if len(found) == 1:
        # Of its first chunk.
        assert (found[0].time_us, found[0].text and found[0].text.severity) == (START_US, 4)


def test_lost_chunk_is_waited_for_no_longer_than_the_timeout() -> None:
    joiner = TextJoiner()
    assert joiner.feed(packed(text(A, 4, 5), 1, 1), 0) == []
    assert joiner.poll(TIMEOUT_US - 1) == []
    (late,) = joiner.poll(TIMEOUT_US)
    assert late.text.endswith("…")
    assert joiner.flush() == []


def test_flood_of_first_chunks_is_bounded() -> None:
    joiner = TextJoiner()
    found = [joiner.feed(packed(text(A, 4, n), 1, 1), 0) for n in range(1, 3 * MAX_OPEN)]
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
