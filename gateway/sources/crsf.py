"""CRSF: telemetry of ExpressLRS and Crossfire links, mirrored by EdgeTX or sent by a receiver.

Theory of operation. A frame is address, length, type, payload and a CRC-8 of type and payload; any
address is accepted, since each hop writes its own.

Scales are those that Betaflight sends and EdgeTX displays. The published specification differs: it
states 10 uV instead of 0.1 V, and 0.01 km/h instead of 0.1 km/h. It differs as well in the axes of
accelerometer and gyroscope (0x13), which are x forward, y right and z down for both.

ArduPilot's own frames (0x80) contain packets of FrSky's passthrough protocol. Mode, arming state
and vehicle type are taken from them if they are received, otherwise from the text of the flight
mode.

Betaflight, INAV and their relatives count pitch as positive with the nose down; the specification,
ArduPilot and PX4 with the nose up. These two groups differ as well in the meaning of a mode
without a mark (`flight_modes`). The group is recognised by, in this order:

| evidence                                             | firmware               |
| ---------------------------------------------------- | ---------------------- |
| device information (0x29) of the flight controller   | by its name            |
| frames 0x7F and 0x80; 0x11, 0x12 and 0x13            | ArduPilot; Betaflight  |
| a mode that one group alone sends, a mark `!` or `?` | by `flight_modes`      |
| attitudes that all are whole tenths of a degree      | Betaflight or INAV     |
| any other attitude                                   | ArduPilot or PX4       |

Betaflight and INAV convert whole tenths of a degree to 1e-4 rad, other firmware sends any value:
three angles of another firmware look like tenths once in 5,000 frames.

References
----------
.. [1] Team BlackSheep, "CRSF protocol", github.com/tbs-fpv/tbs-crsf-spec.
"""

import math
import struct
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Any, Final

from fastcrc.crc8 import dvb_s2
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import (
    NAN,
    BaroRaw,
    BatteryReport,
    GpsFix,
    GpsFixType,
    ImuRaw,
    NodeId,
    RadioSignal,
    Vec3,
    VehicleReport,
)
from gateway.sources.flight_modes import (
    FIXED_WING,
    QUADROTOR,
    ardupilot_mode,
    mode_of_text,
    wanted_sign,
    wanted_type,
)
from gateway.sources.sampling import SampleClock, fix_at, imu_raw, velocity
from gateway.sources.settings import SourceUrl
from gateway.sources.source import CheckedFrames
from gateway.units import DEG_PER_DEGE7, M_PER_CM, RAD_PER_DEG, STANDARD_GRAVITY_MPS2, US_PER_S
from gateway.wire.framing import Fault
from gateway.wire.timesync import WRAP_MASK

MIN_LENGTH, MAX_LENGTH = 2, 62
"""Limits of the length byte, which counts type, payload and CRC."""
HEAD: Final = 2
MSP_START, MSP_HEAD = b"$X", 8
"""Start and header size of the packet with a CRC in which an ExpressLRS Backpack sends frames."""
KMH10_MPS: Final = 1.0 / 36.0
SPEED_RANGE, SPEED_LINEAR = 0.026, 100.0
"""Encoding of the vertical speed, cm/s: (exp(|n| * 0.026) - 1) * 100."""
ACCEL_LSB_MPS2: Final = 16.0 * STANDARD_GRAVITY_MPS2 / 32767.0
GYRO_LSB_DPS: Final = 2000.0 / 32767.0
MAG_LSB_UT: Final = 0.1 / 3.0
"""A third of a milligauss, in µT."""
TENTH_DEGREE: Final = math.radians(0.1) * 1e4
"""A tenth of a degree in the unit of the attitude, 1e-4 rad."""
ROUNDING: Final = 0.01
"""Error of the conversion in single precision, 1e-4 rad."""
FULL_TURN: Final = 36_000
"""Of the course, in 0.01 deg. PX4 until 1.17 sends -180 to 180 deg, as a negative 16-bit number."""
FIRMWARE: Final = {
    b"betaflight": True, b"inav": True, b"emuflight": True, b"cleanflight": True,
    b"rotorflight": True, b"quicksilver": True, b"ardu": False, b"rover": False, b"px4": False,
}  # fmt: skip
"""Beginnings of names in the device information, and whether these firmwares are of Betaflight's
group."""
FLIGHT_CONTROLLER: Final = 0xC8
IDENTITY_US: Final = 10 * US_PER_S
"""Time without a frame after which another aircraft may have been switched on."""
EXTRA_AGE_US: Final = 2 * US_PER_S
"""Maximum age of the extended frame and of the time, to be used with a fix."""
PERCENT: Final = 100
UNUSED: Final = frozenset(
    {0x0B, 0x10, 0x15, 0x17, 0x18, 0x22, 0x28, 0x2B, 0x2C, 0x2D, 0x2E, 0x32, 0x34, 0x3A, 0x3C}
    | {0x78, 0x7A, 0x7B, 0x7C, 0x7D, 0x7E, 0xAA, 0xAC}
)
"""Known types without telemetry of the vehicle: heartbeat, parameters, commands, MSP."""

ADDRESSES: Final = frozenset(
    {0x00, 0x0E, 0x10, 0x12, 0x13, 0x14, 0x80, 0xC0, 0xC2, 0xC4, 0xC8, 0xCC, 0xCE, 0xEA, 0xEB}
    | {0xEC, 0xED, 0xEE, 0xEF}
)
"""Addresses in the specification."""
NOT_READ: Final = (0, -1, None)
OWN_FRAMES: Final = {0x11: True, 0x12: True, 0x13: True, 0x7F: False, 0x80: False}
"""Frames of Betaflight and of ArduPilot: whether the firmware is of Betaflight's group."""
EVIDENCE: Final = ("device", "frame", "mode", "attitude")
"""Kinds of evidence of the firmware, the best first."""
Parts = dict[str, Any]
Reader = Callable[[bytes, int], Any]


class CrsfDecoder(CheckedFrames):
    """Decode a stream of CRSF."""

    def __init__(self, url: SourceUrl, node: NodeId) -> None:
        super().__init__()
        self._node = node
        self._is_datagram = url.transport == "udp"
        self._nose_down = wanted_sign(url)
        """Sign of the pitch that the URL sets."""
        self._wanted_type = wanted_type(url)
        self._last_us = 0
        self._begin_identity()
        self._velocity: tuple[int, tuple[Any, ...]] | None = None
        self._utc: tuple[int, int] | None = None
        self._fix: GpsFix | None = None
        self._clock = SampleClock()
        self._mag_ut: Vec3 | None = None
        """Newest magnetic field, until it is used in a sample."""
        self._frames = self._read_frames()
        self._passthrough: dict[int, Callable[[int, int], Parts]] = {
            0x5001: self._status,
            0x5003: _passthrough_battery(0),
            0x5004: self._home,
            0x5007: self._parameter,
            0x5008: _passthrough_battery(1),
        }

    def _read_frames(self) -> dict[int, tuple[int, int, Reader]]:
        """Return minimum and maximum payload, and the reader, of each type that is read.

        After an address outside of the specification only these are accepted as frames: noise has a
        valid 8-bit CRC once in 256 times, and a wrong length would delay the frames after it.
        """
        return {
            0x02: (15, 15, self._gps),
            0x03: (9, 9, self._gps_time),
            0x06: (20, 20, self._gps_extended),
            0x07: (2, 4, _scaled(">h", 0, "climb_mps", M_PER_CM)),
            0x08: (8, 8, _battery),
            0x09: (2, 4, _barometer),
            0x0A: (2, 2, _scaled(">H", 0, "airspeed_mps", KMH10_MPS)),
            0x0C: (4, 58, _rpm),
            0x0D: (3, 41, _temperatures),
            0x0E: (3, 59, _cells),
            0x11: (8, 8, self._pressure),
            0x12: (6, 6, self._field),
            0x13: (18, 18, self._inertial),
            0x14: (10, 10, _link),
            0x16: (22, 22, _channels),
            0x1C: (5, 5, _scaled("B", 2, "link_quality_percent", 1.0)),
            0x1D: (6, 6, _link_of_transmitter),
            0x1E: (6, 6, self._attitude),
            0x1F: (9, 9, _mavlink_fc),
            0x21: (1, 32, self._flight_mode),
            0x29: (16, 60, self._device),
            0x7F: (3, 60, self._ardupilot),
            0x80: (3, 60, self._ardupilot),
        }

    def _begin_identity(self) -> None:
        """Discard what is known of the firmware and the vehicle."""
        self._type = self._wanted_type
        self._has_passthrough = self._has_marks = False
        self._evidence: dict[str, bool] = {}
        """Whether the firmware is of Betaflight's group, by kind of evidence."""

    @property
    def _is_betaflight(self) -> bool:
        """Whether the firmware is of Betaflight's group, by the best evidence so far."""
        return next((self._evidence[kind] for kind in EVIDENCE if kind in self._evidence), False)

    def feed(self, data: bytes, arrival_us: int) -> list[Any]:
        """Decode every frame that a chunk completes."""
        if self._is_datagram and data.startswith(MSP_START):
            # Without the CRC behind it, if it is there.
            data = data[MSP_HEAD : MSP_HEAD + int.from_bytes(data[6:MSP_HEAD], "little")]
        return super().feed(data, arrival_us)

    def size_at(self, data: bytes, at: int) -> int:
        """Return the size of a frame that begins here, complete or not; 0 if there is none."""
        length, end = data[at + 1], at + HEAD + data[at + 1]
        least, most, _ = self._frames.get(data[at + HEAD], NOT_READ)
        if data[at] in ADDRESSES:
            least, most = 0, MAX_LENGTH - MIN_LENGTH
        if not least <= length - MIN_LENGTH <= most:
            return 0
        wrong = end <= len(data) and dvb_s2(data[at + HEAD : end - 1]) != data[end - 1]
        return 0 if wrong else HEAD + length

    def read(self, frame: bytes, arrival_us: int) -> list[Any]:
        """Return the records and faults in a frame."""
        kind, payload = frame[HEAD], frame[HEAD + 1 : -1]
        if arrival_us - self._last_us > IDENTITY_US:
            self._begin_identity()
        self._last_us = arrival_us
        if kind in OWN_FRAMES:
            self._evidence["frame"] = OWN_FRAMES[kind]
        *_, read = self._frames.get(kind, NOT_READ)
        if read is None:
            unknown = Fault("unknown type", len(payload), f"type {kind:#x} is not known")
            return [] if kind in UNUSED else [unknown]
        try:
            found = read(payload, arrival_us)
        except (struct.error, IndexError, ValueError, OverflowError):
            why = f"type {kind:#x} with {len(payload)} bytes"
            return [Fault("payload", len(payload), why)]
        if not isinstance(found, dict):
            return [] if found is None else [found]
        if not found:
            return []
        return [VehicleReport(time_us=arrival_us, node=self._node, **found)]

    def _gps(self, payload: bytes, arrival_us: int) -> GpsFix | None:
        lat, lon, speed, course, height, satellites = struct.unpack_from(">iiHHHB", payload)
        course -= 0x10000 if course > FULL_TURN else 0
        vel = velocity(speed * KMH10_MPS, course / 100.0)
        # Without satellites it is the position before the receiver lost them.
        fix_type = None if satellites else GpsFixType.NONE
        h_acc = v_acc = speed_acc = NAN
        if self._velocity is not None and arrival_us - self._velocity[0] <= EXTRA_AGE_US:
            kind, north, east, up, speed_cm, _, _, h_cm, v_cm = self._velocity[1]
            vel = (north * M_PER_CM, east * M_PER_CM, -up * M_PER_CM)
            h_acc, v_acc, speed_acc = h_cm * M_PER_CM, v_cm * M_PER_CM, speed_cm * M_PER_CM
            known = {2: GpsFixType.FIX_2D}.get(kind, GpsFixType.FIX_3D)
            fix_type = known if kind > 1 else GpsFixType.NONE
        utc_us = None
        if self._utc is not None and arrival_us - self._utc[0] <= EXTRA_AGE_US:
            utc_us = self._utc[1] + arrival_us - self._utc[0]
        self._fix = fix_at(
            arrival_us,
            self._node,
            lat * DEG_PER_DEGE7,
            lon * DEG_PER_DEGE7,
            height - 1000.0,
            vel_n_mps=vel,
            satellites=satellites,
            fix_type=fix_type,
            h_acc_m=h_acc,
            v_acc_m=v_acc,
            speed_acc_mps=speed_acc,
            utc_us=utc_us,
        )
        if self._fix is None:
            raise ValueError("coordinates")
        return self._fix

    def _gps_time(self, payload: bytes, arrival_us: int) -> None:
        year, month, day, hour, minute, second, ms = struct.unpack_from(">hBBBBBH", payload)
        civil = datetime(year, month, day, hour, minute, second, tzinfo=UTC)
        self._utc = (arrival_us, round(civil.timestamp() * US_PER_S) + ms * 1000)

    def _gps_extended(self, payload: bytes, arrival_us: int) -> None:
        self._velocity = (arrival_us, struct.unpack_from(">Bhhhhhhhh", payload))

    def _pressure(self, payload: bytes, arrival_us: int) -> BaroRaw:
        pascals, centidegrees = struct.unpack_from(">ii", payload)
        stamp = arrival_us & WRAP_MASK
        return BaroRaw(arrival_us, self._node, stamp, float(pascals), centidegrees / 100.0)

    def _field(self, payload: bytes, _arrival_us: int) -> None:
        x, y, z = (count * MAG_LSB_UT for count in struct.unpack_from(">hhh", payload))
        self._mag_ut = (x, y, z)

    def _inertial(self, payload: bytes, arrival_us: int) -> ImuRaw | None:
        """Read a sample, with its axes converted to x forward, y left, z up, as for the compass."""
        stamp_us, *counts, centidegrees = struct.unpack_from(">I7h", payload)
        gx, gy, gz = (count * GYRO_LSB_DPS for count in counts[:3])
        ax, ay, az = (count * ACCEL_LSB_MPS2 for count in counts[3:])
        mag, self._mag_ut = self._mag_ut, None
        time_us = self._clock.own(stamp_us, arrival_us)
        degc = centidegrees / 100.0
        return imu_raw(time_us, self._node, (ax, -ay, -az), (gx, -gy, -gz), mag, degc)

    def _attitude(self, payload: bytes, _arrival_us: int) -> Parts:
        counts = struct.unpack_from(">hhh", payload)
        in_tenths = all(map(_is_in_tenths, counts))
        self._evidence["attitude"] = in_tenths and self._evidence.get("attitude", True)
        pitch, roll, yaw = (angle * 1e-4 for angle in counts)
        nose_down = self._is_betaflight if self._nose_down is None else self._nose_down
        return {"attitude_rad": (roll, -pitch if nose_down else pitch, yaw)}

    def _flight_mode(self, payload: bytes, _arrival_us: int) -> Parts:
        text = payload.partition(b"\0")[0].decode("ascii", "replace").strip()
        mode = mode_of_text(text)
        if mode.is_betaflight is not None:
            self._evidence["mode"] = mode.is_betaflight
        if self._has_passthrough:
            return {}
        self._has_marks |= mode.armed is False
        if not self._wanted_type and mode.vehicle_type is not None and self._type != FIXED_WING:
            # This mode exists only on aeroplanes; all others have the same names on copters.
            self._type = mode.vehicle_type
        kind = self._type
        number = mode.plane if kind == FIXED_WING else mode.copter
        is_marked = self._has_marks or self._is_betaflight
        armed = {} if mode.armed is None or not is_marked else {"armed": mode.armed}
        return {"mode": mode.name, "custom_mode": number, "vehicle_type": kind, **armed}

    def _device(self, payload: bytes, _arrival_us: int) -> Parts:
        """Read the name of the flight controller's firmware in the device information."""
        if payload[1] != FLIGHT_CONTROLLER:
            return {}
        name = payload[2:].partition(b"\0")[0].lower()
        for begin, is_betaflight in FIRMWARE.items():
            if name.startswith(begin):
                self._evidence["device"] = is_betaflight
        if name.startswith(b"betaflight"):
            self._type = self._wanted_type or QUADROTOR
        return {}

    def _ardupilot(self, payload: bytes, arrival_us: int) -> Parts:
        """Read texts, and one or several packets of FrSky's passthrough protocol."""
        kind, body = payload[0], payload[1:]
        if kind == 0xF1:
            text = body[1:].partition(b"\0")[0].decode("utf-8", "replace")
            return {"text": (body[0] & 7, text)} if text else {}
        found: Parts = {}
        packets = body[1 : 1 + 6 * body[0]] if kind == 0xF2 else body[:6]
        for number, value in struct.iter_unpack("<HI", packets[: len(packets) // 6 * 6]):
            if (read := self._passthrough.get(number)) is not None:
                found |= read(value, arrival_us)
        return found

    def _status(self, value: int, _arrival_us: int) -> Parts:
        self._has_passthrough = True
        number = (value & 0x1F) - 1
        found: Parts = {"armed": bool(value >> 8 & 1)}
        if number >= 0:
            name = ardupilot_mode(self._type, number)
            found |= {"mode": name, "custom_mode": number, "vehicle_type": self._type}
        return found | {"throttle_percent": (value >> 19 & 0x3F) / 0.63}

    def _parameter(self, value: int, _arrival_us: int) -> Parts:
        if value >> 24 == 1 and not self._wanted_type:
            self._type = value & 0xFF
        return {}

    def _home(self, value: int, arrival_us: int) -> Parts:
        """Read distance and direction from the vehicle to home, and the height above home."""
        distance_m = _number(value & 0xFFF, 2)
        height_m = 0.1 * _number(value >> 12 & 0xFFF, 2) * (-1.0 if value >> 24 & 1 else 1.0)
        found: Parts = {"alt_home_m": height_m}
        fix = self._fix
        is_new = fix is not None and arrival_us - fix.time_us <= EXTRA_AGE_US
        if fix is not None and is_new and fix.fix_ok and (fix.lat_dege7 or fix.lon_dege7):
            bearing = (value >> 25 & 0x7F) * 3.0 * RAD_PER_DEG
            lat_deg, lon_deg = fix.lat_dege7 * DEG_PER_DEGE7, fix.lon_dege7 * DEG_PER_DEGE7
            per_m = math.degrees(1.0 / 6_371_000.0)
            shrink = max(math.cos(math.radians(lat_deg)), 1e-3)
            home_lat = lat_deg + distance_m * math.cos(bearing) * per_m
            home_lon = lon_deg + distance_m * math.sin(bearing) * per_m / shrink
            found["home"] = (home_lat, home_lon, fix.alt_amsl_m - height_m)
        return found


def _is_in_tenths(angle: int) -> bool:
    """Return whether 1e-4 rad may be whole tenths of a degree, rounded towards zero."""
    tenths = math.ceil((abs(angle) - ROUNDING) / TENTH_DEGREE)
    return tenths * TENTH_DEGREE < abs(angle) + 1


def _number(bits: int, width: int) -> float:
    """Decode a number of the passthrough protocol, with a power of ten in its lowest bits."""
    mantissa: float = (bits >> width) * 10.0 ** (bits & (1 << width) - 1)
    return mantissa


def _passthrough_battery(number: int) -> Callable[[int, int], Parts]:
    def read(value: int, _arrival_us: int) -> Parts:
        battery = BatteryReport(
            number=number,
            voltage_v=(value & 0x1FF) * 0.1,
            current_a=0.1 * _number(value >> 9 & 0xFF, 1),
            used_mah=float(value >> 17),
        )
        return {"battery": battery}

    return read


def _mavlink_fc(payload: bytes, _arrival_us: int) -> Parts:
    _, base_mode, number, _, kind = struct.unpack_from(">hBIBB", payload)
    armed = bool(base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    name = ardupilot_mode(kind, number)
    return {"mode": name, "custom_mode": number, "armed": armed, "vehicle_type": kind}


def _scaled(kind: str, at: int, name: str, unit: float) -> Callable[[bytes, int], Parts]:
    """Return a reader for a scaled number in a payload."""

    def read(payload: bytes, _arrival_us: int) -> Parts:
        return {name: struct.unpack_from(kind, payload, at)[0] * unit}

    return read


def _battery(payload: bytes, _arrival_us: int) -> Parts:
    """Read a battery; without one, flight controllers send zeros."""
    voltage, current = struct.unpack_from(">HH", payload)
    remaining = payload[7]
    if not any(payload[:7]):
        return {}
    battery = BatteryReport(
        voltage_v=voltage * 0.1 or NAN,
        current_a=current * 0.1,
        used_mah=float(int.from_bytes(payload[4:7], "big")),
        remaining_percent=float(remaining) if remaining <= PERCENT else NAN,
    )
    return {"battery": battery}


def _barometer(payload: bytes, _arrival_us: int) -> Parts:
    (packed,) = struct.unpack_from(">H", payload)
    height_m = float(packed & 0x7FFF) if packed & 0x8000 else (packed - 10_000) * 0.1
    found: Parts = {"alt_home_m": height_m}
    if len(payload) == 3:
        (speed,) = struct.unpack_from(">b", payload, 2)
        size = (math.exp(abs(speed) * SPEED_RANGE) - 1.0) * SPEED_LINEAR
        found["climb_mps"] = math.copysign(size, speed) * M_PER_CM
    elif len(payload) > 3:
        (speed,) = struct.unpack_from(">h", payload, 2)
        found["climb_mps"] = speed * M_PER_CM
    return found


def _rpm(payload: bytes, _arrival_us: int) -> Parts:
    source, found = payload[0], []
    for number, at in enumerate(range(1, len(payload) - 2, 3)):
        value = int.from_bytes(payload[at : at + 3], "big", signed=True)
        found.append((f"rpm{source}.{number}", float(value)))
    return {"values": tuple(found)}


def _temperatures(payload: bytes, _arrival_us: int) -> Parts:
    source = payload[0]
    deci = struct.unpack(f">{len(payload) // 2}h", payload[1 : 1 + len(payload) // 2 * 2])
    return {"values": tuple((f"temp{source}.{k}", value * 0.1) for k, value in enumerate(deci))}


def _cells(payload: bytes, _arrival_us: int) -> Parts:
    source, count = payload[0], (len(payload) - 1) // 2
    volts = tuple(mv * 1e-3 for mv in struct.unpack_from(f">{count}H", payload, 1))
    if source >= 128:
        return {"values": tuple((f"volt{source}.{k}"[:10], v) for k, v in enumerate(volts))}
    battery = BatteryReport(number=source, voltage_v=sum(volts), cells_v=volts)
    return {"battery": battery}


def _link(payload: bytes, _arrival_us: int) -> Parts:
    """Read the signal of the downlink, which carries telemetry, and the quality of the uplink."""
    first, second, quality, snr, antenna, _, _, down, _, down_snr = struct.unpack_from(
        ">BBBbBBBBBb", payload
    )
    up = second if antenna == 1 else first
    signal = RadioSignal(-down, float(down_snr)) if down else RadioSignal(-up, float(snr))
    return {"signal": signal, "link_quality_percent": float(quality)}


def _link_of_transmitter(payload: bytes, _arrival_us: int) -> Parts:
    (snr,) = struct.unpack_from(">b", payload, 3)
    return {"signal": RadioSignal(-payload[0], float(snr))}


def _channels(payload: bytes, _arrival_us: int) -> Parts:
    if len(payload) < 22:
        raise ValueError("channels")
    bits = int.from_bytes(payload[:22], "little")
    ticks = [bits >> 11 * k & 0x7FF for k in range(16)]
    return {"channels_us": tuple(round((tick - 992) * 5 / 8 + 1500) for tick in ticks)}
