"""The simulated flight in the bytes of other trackers: CRSF, lines of text, a phone."""

import json
import math
import struct
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from fastcrc.crc8 import dvb_s2

from gateway.geometry.quaternion import to_euler
from gateway.records import BaroRaw, GpsFix, ImuFlags, ImuRaw, RawRecord
from gateway.simulator.flight import SimulatedAircraft
from gateway.simulator.receiver import simulate
from gateway.simulator.simulator_settings import SimulatorSettings
from gateway.simulator.timed_frame import TimedFrame
from gateway.simulator.trajectory import FLIGHT_S, Truth
from gateway.units import DEG_PER_DEGE7, DEGE7_PER_DEG, STANDARD_GRAVITY_MPS2, US_PER_S
from gateway.wire.framing import xor_of
from gateway.wire.link import Link

RADIO: Final = 0xEA
"""CRSF address of the remote control."""
CRSF_HZ: Final = 50
KMH10: Final = 36.0
"""Tenths of km/h per m/s."""
FLYING_MPS: Final = 3.0
FULL_V, EMPTY_V, CAPACITY_MAH = 12.6, 10.8, 1300.0
COUNTS: Final = 32768.0
GYRO_LSB: Final = {250: 131.0, 500: 65.5, 1000: 32.8, 2000: 16.4}
PUSH_S: Final = 0.2
"""Interval between two posts of the simulated phone."""


def crsf_frame(kind: int, payload: bytes) -> bytes:
    """Encode one CRSF frame."""
    body = bytes([kind]) + payload
    return bytes([RADIO, len(body) + 1]) + body + bytes([dvb_s2(body)])


def crsf_bytes(settings: SimulatorSettings, start_unix_us: int) -> Iterator[TimedFrame]:
    """Simulate the flight endlessly, with a flight controller that sends CRSF.

    Rates: attitude 25 Hz, position 5 Hz, link and climb 5 Hz, mode 2 Hz, battery 1 Hz.
    """
    motion = SimulatedAircraft(settings, 0, start_unix_us).trajectory
    tick = 0
    while True:
        time_s = np.arange(tick, tick + CRSF_HZ) / CRSF_HZ
        truth = motion.truth_at(time_s)
        for k in range(CRSF_HZ):
            data = b"".join(
                make(truth, k) for every, phase, make in _CRSF if (tick + k) % every == phase
            )
            if data:
                yield TimedFrame(float(time_s[k]), data)
        tick += CRSF_HZ


def _attitude(truth: Truth, k: int) -> bytes:
    roll, pitch, yaw = (round(a * 1e4) for a in to_euler(tuple(truth.q_nb[k].tolist())))
    return crsf_frame(0x1E, struct.pack(">hhh", pitch, roll, yaw))


def _position(truth: Truth, k: int) -> bytes:
    north, east, _ = truth.vel_n_mps[k].tolist()
    course = round(math.degrees(math.atan2(east, north)) % 360.0 * 100.0) % 36_000
    place = round(truth.lat_deg[k] * DEGE7_PER_DEG), round(truth.lon_deg[k] * DEGE7_PER_DEG)
    speed, height = round(math.hypot(north, east) * KMH10), round(truth.alt_amsl_m[k] + 1000.0)
    return crsf_frame(0x02, struct.pack(">iiHHHB", *place, speed, course, height, 14))


def _climb(truth: Truth, k: int) -> bytes:
    return crsf_frame(0x07, struct.pack(">h", round(-truth.vel_n_mps[k][2] * 100.0)))


def _link(truth: Truth, k: int) -> bytes:
    away_m = float(np.linalg.norm(truth.pos_n_m[k]))
    down = round(55.0 + 20.0 * math.log10(1.0 + away_m / 10.0))
    quality = max(70, 100 - round(away_m / 100.0))
    values = (down, down + 3, quality, 8, 0, 2, 3, down, 99, 7)
    return crsf_frame(0x14, struct.pack(">BBBbBBBBBb", *values))


def _mode(truth: Truth, k: int) -> bytes:
    flying = float(truth.airspeed_mps[k]) > FLYING_MPS
    return crsf_frame(0x21, b"AUTO\0" if flying else b"STAB*\0")


def _battery(truth: Truth, k: int) -> bytes:
    used = float(truth.time_s[k]) % FLIGHT_S / FLIGHT_S * 0.6
    volts, amps = FULL_V - used * (FULL_V - EMPTY_V), 8.0
    payload = struct.pack(">HH", round(volts * 10.0), round(amps * 10.0))
    payload += round(used * CAPACITY_MAH).to_bytes(3, "big") + bytes([round(100.0 * (1.0 - used))])
    return crsf_frame(0x08, payload)


_CRSF: Final[tuple[tuple[int, int, Callable[[Truth, int], bytes]], ...]] = (
    (2, 0, _attitude),
    (10, 1, _position),
    (10, 3, _climb),
    (10, 5, _link),
    (25, 7, _mode),
    (50, 9, _battery),
)
"""Period in ticks of `CRSF_HZ`, phase in ticks, and function that encodes the frame."""


def lines_bytes(settings: SimulatorSettings, start_unix_us: int) -> Iterator[TimedFrame]:
    """Simulate the flight endlessly, with the measurements as lines of JSON and NMEA."""
    link = Link()
    for frame in simulate(settings, start_unix_us).frames():
        records = link.feed(frame.data, round(frame.time_s * US_PER_S))
        text = "".join(map(line_of, records))
        if text:
            yield TimedFrame(frame.time_s, text.encode())


def line_of(record: RawRecord) -> str:
    """Format one record as a line; empty if lines cannot represent it."""
    match record:
        case ImuRaw():
            content: dict[str, object] = {
                "t_ms": record.time_us / 1000.0,
                "accel_mps2": _accel_mps2(record),
                "gyro_dps": _scaled(record.gyro_raw, 1.0 / GYRO_LSB[record.gyro_range_dps]),
            }
            if record.flags & ImuFlags.MAG_NEW:
                content["mag_ut"] = _scaled(record.mag_raw, 100.0 / record.mag_lsb_per_gauss)
            return json.dumps(content) + "\n"
        case BaroRaw():
            pressure = round(record.pressure_pa / 100.0, 4)
            return json.dumps({"t_ms": record.time_us / 1000.0, "pressure_hpa": pressure}) + "\n"
        case GpsFix():
            return nmea_of(record)
        case _:
            return ""


def phone_bytes(settings: SimulatorSettings, start_unix_us: int) -> Iterator[TimedFrame]:
    """Simulate the flight endlessly, with a phone whose app Sensor Logger posts its readings."""
    link = Link()
    payload: list[dict[str, object]] = []
    posted_s, number = 0.0, 0
    for frame in simulate(settings, start_unix_us).frames():
        for record in link.feed(frame.data, round(frame.time_s * US_PER_S)):
            payload += _readings(record, start_unix_us)
        if payload and frame.time_s - posted_s >= PUSH_S:
            post = {"messageId": number, "sessionId": "demo", "deviceId": "demo"}
            text = json.dumps(post | {"payload": payload}) + "\n"
            yield TimedFrame(frame.time_s, text.encode())
            posted_s, number, payload = frame.time_s, number + 1, []


def _readings(record: RawRecord, start_unix_us: int) -> Iterator[dict[str, object]]:
    """Yield the readings that Sensor Logger would produce for a record."""

    def reading(name: str, **values: float) -> dict[str, object]:
        time_ns = (start_unix_us + record.time_us) * 1000
        return {"name": name, "time": time_ns, "values": values}

    match record:
        case ImuRaw():
            x, y, z = _accel_mps2(record)
            # The axes of a phone whose top points to the nose.
            yield reading("gravity", x=0.0, y=0.0, z=STANDARD_GRAVITY_MPS2)
            yield reading("accelerometer", x=-y, y=x, z=round(z - STANDARD_GRAVITY_MPS2, 5))
            rate = math.radians(1.0 / GYRO_LSB[record.gyro_range_dps])
            x, y, z = _scaled(record.gyro_raw, rate)
            yield reading("gyroscope", x=-y, y=x, z=z)
            if record.flags & ImuFlags.MAG_NEW:
                x, y, z = _scaled(record.mag_raw, 100.0 / record.mag_lsb_per_gauss)
                yield reading("magnetometer", x=-y, y=x, z=z)
        case BaroRaw():
            yield reading("barometer", pressure=round(record.pressure_pa / 100.0, 4))
        case GpsFix(fix_ok=True):
            north, east, _ = record.vel_n_mps
            yield reading(
                "location",
                latitude=record.lat_dege7 * DEG_PER_DEGE7,
                longitude=record.lon_dege7 * DEG_PER_DEGE7,
                altitudeAboveMeanSeaLevel=record.alt_amsl_m,
                speed=math.hypot(north, east),
                bearing=math.degrees(math.atan2(east, north)) % 360.0,
                horizontalAccuracy=3.0,
                verticalAccuracy=5.0,
            )


def _accel_mps2(record: ImuRaw) -> list[float]:
    return _scaled(record.accel_raw, record.accel_range_g * STANDARD_GRAVITY_MPS2 / COUNTS)


def _scaled(counts: tuple[int, int, int], scale: float) -> list[float]:
    return [round(count * scale, 5) for count in counts]


def nmea_of(fix: GpsFix) -> str:
    """Format a fix as GGA and RMC."""
    second = (fix.utc_us or 0) // US_PER_S
    time = f"{second // 3600 % 24:02d}{second // 60 % 60:02d}{second % 60:02d}"
    time += f".{(fix.utc_us or 0) % US_PER_S // 10_000:02d}"
    lat, lon = _minutes(fix.lat_dege7, "NS", 2), _minutes(fix.lon_dege7, "EW", 3)
    north, east, _ = fix.vel_n_mps
    knots = math.hypot(north, east) * 3600.0 / 1852.0
    course = math.degrees(math.atan2(east, north)) % 360.0
    date = np.datetime64(fix.utc_us or 0, "us").item().strftime("%d%m%y")
    state, quality = ("A", 1) if fix.fix_ok else ("V", 0)
    height = f"{fix.alt_amsl_m:.2f},M,,M,,"
    found = ""
    for body in (
        f"GPGGA,{time},{lat},{lon},{quality},{fix.satellites:02d},0.8,{height}",
        f"GPRMC,{time},{state},{lat},{lon},{knots:.3f},{course:.2f},{date},,,A",
    ):
        found += f"${body}*{xor_of(body.encode()):02X}\r\n"
    return found


def _minutes(dege7: int, sides: str, digits: int) -> str:
    degrees, rest = divmod(abs(dege7), 10_000_000)
    return f"{degrees:0{digits}d}{rest * 60e-7:08.5f},{sides[dege7 < 0]}"


SOURCE_BYTES: Final[dict[str, Callable[[SimulatorSettings, int], Iterator[TimedFrame]]]] = {
    "crsf": crsf_bytes,
    "lines": lines_bytes,
    "phone": phone_bytes,
}
"""Functions that produce the bytes, by kind of source."""
