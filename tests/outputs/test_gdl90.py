"""GDL90, read by a decoder after the specification."""

import math
import struct
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as mavlink

from gateway.outputs.gdl90 import framed
from gateway.units import US_PER_S
from tests.kit.messages import HERE, at, beat, gps
from tests.outputs.conftest import UNIX_US, OutputRig

ATTITUDE = mavlink.MAVLink_attitude_message(0, math.radians(12.5), math.radians(-7.3), 1, 0, 0, 0)
PRESSURE = mavlink.MAVLink_scaled_pressure_message(0, 954.61, 0, 2000)
"""5000 ft in the standard atmosphere is 843.07 hPa, 1640 ft 954.61 hPa."""


def crc_of(message: bytes) -> int:
    """Compute the checksum bit by bit, as the table of the specification is made."""
    crc = 0
    for byte in message:
        high = crc >> 8 << 8
        for _ in range(8):
            high = (high << 1 ^ (0x1021 if high & 0x8000 else 0)) & 0xFFFF
        crc = (high ^ crc << 8 ^ byte) & 0xFFFF
    return crc


def messages_in(datagram: bytes) -> list[bytes]:
    """Split, unescape and check the messages of a datagram."""
    found, message, is_escaped = [], bytearray(), False
    for byte in datagram:
        if byte == 0x7E:
            if message:
                assert crc_of(message[:-2]) == int.from_bytes(message[-2:], "little")
                found.append(bytes(message[:-2]))
            message = bytearray()
        elif byte == 0x7D:
            is_escaped = True
        else:
            message.append(byte ^ 0x20 if is_escaped else byte)
            is_escaped = False
    return found


def signed(value: int, bits: int) -> int:
    return value - (1 << bits) if value >> (bits - 1) else value


def report_in(message: bytes) -> dict[str, Any]:
    """Decode an ownship or traffic report."""
    assert len(message) == 28
    word = int.from_bytes(message[:27], "big")

    def field(first_bit: int, bits: int) -> int:
        return word >> (27 * 8 - first_bit - bits) & (1 << bits) - 1

    return {
        "kind": field(0, 8), "alert": field(8, 4), "address_type": field(12, 4),
        "address": field(16, 24),
        "lat": signed(field(40, 24), 24) * 180 / 2**23,
        "lon": signed(field(64, 24), 24) * 180 / 2**23,
        "feet": field(88, 12) * 25 - 1000, "airborne": field(100, 1), "track_type": field(102, 2),
        "nic": field(104, 4), "nacp": field(108, 4), "knots": field(112, 12),
        "fpm": signed(field(124, 12), 12) * 64, "track": field(136, 8) * 360 / 256,
        "emitter": field(144, 8), "callsign": message[19:27].decode(),
    }  # fmt: skip


async def taken(outputs: OutputRig) -> dict[int, bytes]:
    """Return the messages of one turn by their ids, extended ones by 256 plus the second byte."""
    found = messages_in(await outputs.sent())
    return {each[0] if each[0] != 0x65 else 256 + each[1]: each for each in found}


def test_heartbeat_of_the_specification_has_its_checksum() -> None:
    frame = bytes.fromhex("7E008141DBD00802B38B7E")
    assert framed(bytes.fromhex("008141DBD00802")) == frame
    assert messages_in(frame) == [frame[1:-3]]


def test_any_message_survives_framing(rng: np.random.Generator) -> None:
    for size in (2, 3, 7, 28, 200):
        message = bytes(rng.choice([0x7D, 0x7E, 0x5D, 0, 255], size).astype(np.uint8))
        assert messages_in(framed(message)) == [message]


async def test_ownship_contains_position_and_motion(outputs: OutputRig) -> None:
    await outputs.udp("gdl90", "?callsign=FISH7")
    outputs.hear(beat(), at(), gps(), PRESSURE, ATTITUDE)
    found = await taken(outputs)
    assert sorted(found) == [0, 10, 11, 256, 257]
    own = report_in(found[10])
    assert (own.pop("lat"), own.pop("lon")) == pytest.approx(HERE[:2], abs=2.2e-5)
    assert own == {
        "kind": 10, "alert": 0, "address_type": 1, "address": 0xF00001, "feet": 1650,
        "airborne": 1, "track_type": 1, "nic": 8, "nacp": 11, "knots": 10, "fpm": 192,
        "track": pytest.approx(306.9, abs=0.71), "emitter": 14, "callsign": "FISH7   ",
    }  # fmt: skip
    height, accuracy = struct.unpack(">hH", found[11][1:])
    assert height * 5 * 0.3048 == pytest.approx(488.13 + 47.5, abs=0.8)
    assert accuracy == 0x7FFF
    assert len(found[256]) == 39


async def test_heartbeat_contains_validity_and_time_of_day(outputs: OutputRig) -> None:
    await outputs.udp("gdl90")
    outputs.hear(beat(), at())
    for seconds, is_valid in ((0, True), (6, False), (10 * 3600, False)):
        outputs.clock.now_us = seconds * US_PER_S
        outputs.hear(beat())
        message = (await taken(outputs))[0]
        _, first, second, low, _ = struct.unpack("<BBBHH", message)
        assert (bool(first & 0x80), first & 1, second & 1) == (is_valid, 1, 1)
        assert low | (second >> 7) << 16 == (UNIX_US // US_PER_S + seconds) % 86_400


async def test_attitude_is_sent_at_its_rate_and_the_rest_once_a_second(outputs: OutputRig) -> None:
    await outputs.udp("gdl90", "?rate=5")
    seen: list[int] = []
    for _ in range(10):
        outputs.hear(beat(), at(), ATTITUDE)
        seen += await taken(outputs)
        outputs.clock.now_us += US_PER_S // 5
    assert (seen.count(257), seen.count(0), seen.count(10)) == (10, 2, 2)


async def test_attitude_contains_known_angles_only(outputs: OutputRig) -> None:
    await outputs.udp("gdl90")
    hud = mavlink.MAVLink_vfr_hud_message(20.0, 5.0, 90, 0, 488.0, 1.0)
    outputs.hear(beat(), at(), ATTITUDE, hud)
    message = (await taken(outputs))[257]
    assert struct.unpack(">BBhhHHH", message) == (0x65, 1, 125, -73, 905, 39, 0xFFFF)
    outputs.clock.now_us = 6 * US_PER_S
    outputs.hear(at(hdg=65535))
    message = (await taken(outputs))[257]
    assert struct.unpack(">BBhhHHH", message)[2:] == (0x7FFF, 0x7FFF, 0xFFFF, 0xFFFF, 0xFFFF)


async def test_other_vehicles_are_traffic(outputs: OutputRig) -> None:
    await outputs.udp("gdl90", "?vehicle=2")
    for system in (1, 2, 3):
        lat = 0.0 if system == 3 else float(system)
        outputs.hear(beat(base_mode=0), at(lat_deg=lat, lon_deg=0.0), system=system)
    found = await taken(outputs)
    assert 11 not in found, "its separation is not known"
    own, other = report_in(found[10]), report_in(found[20])
    assert (own["address"], own["lat"]) == (0xF00002, pytest.approx(2.0, abs=2.2e-5))
    assert (other["address"], other["lat"]) == (0xF00001, pytest.approx(1.0, abs=2.2e-5))
    assert (other["callsign"], other["airborne"], other["nic"]) == ("VEH1    ", 0, 0)
    assert other["feet"] == 0xFFF * 25 - 1000
