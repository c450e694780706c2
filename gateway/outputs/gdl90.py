"""GDL90 for tablets with aviation maps: heartbeat, ownship, traffic, geometric altitude, AHRS.

    gdl90:udp:HOST:4000  gdl90:udp-broadcast:192.168.1.255:4000

One vehicle is the ownship, the others are traffic. AHRS is sent at the rate of the endpoint, all
other messages once a second. There is no report of a vehicle without a valid position.

References
----------
.. [1] "GDL 90 Data Interface Specification", Garmin 560-1058-00 revision A, 2007.
.. [2] "GDL 90 Extended Specification", ForeFlight: identification and AHRS.
"""

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import Final

from fastcrc.crc16 import xmodem

from gateway.geometry.atmosphere import pressure_altitude_m
from gateway.geometry.quaternion import to_euler
from gateway.hub.endpoint import Endpoint, EndpointKind
from gateway.outputs.output import Output
from gateway.units import FEET_PER_M, KNOTS_PER_MPS, PA_PER_HPA, US_PER_S
from gateway.vehicle_state.newest import POSITION_OLD_US, STATE_IDS, NewestState
from gateway.vehicle_state.positions import Position
from gateway.wire.mavlink_messages import ids_of

FLAG: Final = b"\x7e"
HEARTBEAT, OWNSHIP, GEOMETRIC_ALTITUDE, TRAFFIC, EXTENDED = 0, 10, 11, 20, 0x65
FPM_PER_MPS: Final = 60 * FEET_PER_M
UNKNOWN_U12, UNKNOWN_CLIMB = 0xFFF, 0x800
UNKNOWN_ANGLE, UNKNOWN_U16 = 0x7FFF, 0xFFFF
SELF_ASSIGNED: Final = 1
"""Address type of our addresses, which are 24 bits with the system id in the last eight."""
FIRST_ADDRESS: Final = 0xF00000
UNMANNED: Final = 14
"""Emitter category of an unmanned aircraft."""
INTEGRITY: Final = 8
"""Navigation integrity category for a receiver of known accuracy without integrity monitoring."""
ACCURACIES_M: Final = ((3, 11), (10, 10), (30, 9), (92.6, 8), (185.2, 7), (555.6, 6), (926, 5))
"""Limits of the horizontal accuracy in m, and the category for better values; 0 is unknown."""
PRESSURES: Final = ("SCALED_PRESSURE", "SCALED_PRESSURE2")
LETTERS: Final = frozenset("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789 ")
IDENTIFICATION: Final = (
    bytes((EXTENDED, 0, 1)) + b"\xff" * 8 + b"mavgate\0" + b"mavgate".ljust(16, b"\0") + bytes(4)
)
"""Version 1, no serial number, names, and geometric altitude relative to the ellipsoid."""


class Gdl90Output(Output):
    """One vehicle as the ownship, and all others as traffic."""

    carriers = (EndpointKind.UDP, EndpointKind.UDP_BROADCAST, EndpointKind.UDP_MULTICAST)
    default_rate_hz = 5.0
    wanted_ids = STATE_IDS | ids_of(*PRESSURES)
    _reported_us = -US_PER_S

    @classmethod
    def check(cls, endpoint: Endpoint) -> None:
        """Raise ValueError if the endpoint is invalid."""
        super().check(endpoint)
        callsign = endpoint.added.get("callsign", "X")
        if not 1 <= len(callsign) <= 8 or not set(callsign) <= LETTERS:
            raise ValueError(f"callsign {callsign!r} is not 1 to 8 of A to Z and 0 to 9")

    def compose(self, now_us: int) -> Iterable[bytes]:
        """Return the messages that are due, as one datagram."""
        own_id = next(iter(self.heard(now_us)), 0)
        own = self.vehicles.states.get(own_id)
        found = [] if own is None else [attitude(own, now_us)]
        # A quarter of an interval early, since timers are not exact.
        if now_us - self._reported_us >= US_PER_S - self.interval_s * US_PER_S / 4:
            self._reported_us = now_us
            found += self._reports(own_id, now_us)
        return [b"".join(map(framed, found))] if found else []

    def _reports(self, own_id: int, now_us: int) -> Iterable[bytes]:
        valid = {
            system_id: (state, position)
            for system_id, state in self.vehicles.states.items()
            if (position := state.valid_position(now_us))
        }
        yield heartbeat(self.unix_us(), is_valid=own_id in valid)
        yield IDENTIFICATION
        for system_id, (state, position) in valid.items():
            kind = OWNSHIP if system_id == own_id else TRAFFIC
            given = self.endpoint.added.get("callsign") if kind == OWNSHIP else None
            yield report(kind, system_id, given or f"VEH{system_id}", state, position, now_us)
            if kind == OWNSHIP and (height := geometric_altitude(state, position)):
                yield height


def framed(message: bytes) -> bytes:
    """Return a message with checksum and escaping, between flag bytes."""
    # The checksum is XMODEM, except that the last two bytes are not shifted through.
    crc = xmodem(message[:-2]) ^ int.from_bytes(message[-2:], "big")
    body = message + crc.to_bytes(2, "little")
    return FLAG + body.replace(b"\x7d", b"\x7d\x5d").replace(FLAG, b"\x7d\x5e") + FLAG


def heartbeat(unix_us: int, *, is_valid: bool) -> bytes:
    """Return the heartbeat, with validity of the ownship position, and time of day."""
    at = datetime.fromtimestamp(unix_us / US_PER_S, UTC)
    second = at.hour * 3600 + at.minute * 60 + at.second
    status = (0x80 if is_valid else 0) | 0x01, (second >> 16) << 7 | 0x01
    return bytes((HEARTBEAT, *status)) + (second & 0xFFFF).to_bytes(2, "little") + bytes(2)


def report(
    kind: int, system_id: int, callsign: str, state: NewestState, position: Position, now_us: int
) -> bytes:
    """Return an ownship or traffic report."""
    course = state.course_deg(position)
    down_mps = position.vel_n_mps[2]
    is_airborne = state.is_armed()
    altitude = _bounded((_pressure_feet(state, now_us) + 1000) / 25, 0, 0xFFE, UNKNOWN_U12)
    speed = _bounded(position.groundspeed_mps * KNOTS_PER_MPS, 0, 0xFFE, UNKNOWN_U12)
    climb = _bounded(-down_mps * FPM_PER_MPS / 64, -510, 510, UNKNOWN_CLIMB) & 0xFFF
    misc = (0x8 if is_airborne else 0) | (0x1 if math.isfinite(course) else 0)
    accuracy = _accuracy(state)
    motion = speed << 12 | climb
    return b"".join(
        (
            bytes((kind, SELF_ASSIGNED)),
            (FIRST_ADDRESS | system_id).to_bytes(3, "big"),
            _semicircles(position.lat_deg),
            _semicircles(position.lon_deg),
            (altitude << 4 | misc).to_bytes(2, "big"),
            bytes(((INTEGRITY if accuracy else 0) << 4 | accuracy,)),
            motion.to_bytes(3, "big"),
            bytes((round(course * 256 / 360) & 0xFF if math.isfinite(course) else 0, UNMANNED)),
            callsign.ljust(8).encode("ascii"),
            bytes(1),
        )
    )


def geometric_altitude(state: NewestState, position: Position) -> bytes | None:
    """Return the height above the ellipsoid; None if the geoid separation is not known."""
    found = state.fix()
    feet = (position.alt_amsl_m + found.separation_m) * FEET_PER_M if found else math.nan
    if found is None or not math.isfinite(feet):
        return None
    height = _bounded(feet / 5, -0x8000, 0x7FFF, 0)
    accuracy = _bounded(found.v_acc_m, 0, 0x7FFE, 0x7FFF)
    head = bytes((GEOMETRIC_ALTITUDE,))
    return head + height.to_bytes(2, "big", signed=True) + accuracy.to_bytes(2, "big")


def attitude(state: NewestState, now_us: int) -> bytes:
    """Return roll, pitch, true heading and indicated airspeed, as far as known and recent."""
    is_new = state.age_us(now_us, "ATTITUDE", "ATTITUDE_QUATERNION") <= POSITION_OLD_US
    roll, pitch, _ = to_euler(state.attitude()[0]) if is_new else (math.nan,) * 3
    angles = (
        _bounded(math.degrees(each) * 10, -1800, 1800, UNKNOWN_ANGLE) for each in (roll, pitch)
    )
    heading = _bounded(state.true_heading_deg(now_us) * 10, 0, 3600, UNKNOWN_U16)
    is_new = state.age_us(now_us, "VFR_HUD") <= POSITION_OLD_US
    airspeed_mps = state.airspeed_mps() if is_new else math.nan
    words = (heading, _bounded(airspeed_mps * KNOTS_PER_MPS, 0, 0xFFFE, UNKNOWN_U16), UNKNOWN_U16)
    signed = b"".join(each.to_bytes(2, "big", signed=True) for each in angles)
    return bytes((EXTENDED, 1)) + signed + b"".join(each.to_bytes(2, "big") for each in words)


def _bounded(value: float, low: int, high: int, unknown: int) -> int:
    return min(max(round(value), low), high) if math.isfinite(value) else unknown


def _semicircles(angle_deg: float) -> bytes:
    return (round(angle_deg * (1 << 23) / 180) & 0xFFFFFF).to_bytes(3, "big")


def _pressure_feet(state: NewestState, now_us: int) -> float:
    for name in PRESSURES:
        if state.age_us(now_us, name) <= POSITION_OLD_US:
            return pressure_altitude_m(state.fields[name]["press_abs"] * PA_PER_HPA) * FEET_PER_M
    return math.nan


def _accuracy(state: NewestState) -> int:
    found = state.fix()
    accuracy_m = found.h_acc_m if found else math.nan
    return next((category for bound_m, category in ACCURACIES_M if accuracy_m < bound_m), 0)
