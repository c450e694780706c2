"""Messages of a vehicle in flight at one position."""

import math
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from tests.kit.mavlink import message_of

HERE = (47.397_742_0, -8.545_594_1, 488.13)
"""Latitude, longitude and height AMSL in m."""


def beat(kind: int = 2, autopilot: int = 3, mode: int = 5, base_mode: int = 0x81) -> Any:
    return mavlink.MAVLink_heartbeat_message(kind, autopilot, base_mode, mode, 4, 3)


def at(
    lat_deg: float = HERE[0], lon_deg: float = HERE[1], alt_m: float = HERE[2], hdg: int = 9050
) -> Any:
    """Return GLOBAL_POSITION_INT: north 3 m/s, east -4 m/s, climb 1 m/s."""
    return mavlink.MAVLink_global_position_int_message(
        0, round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3), 20_000,
        300, -400, -100, hdg,
    )  # fmt: skip


def gps(kind: int = 3, satellites: int = 11, ellipsoid_m: float = HERE[2] + 47.5) -> Any:
    return mavlink.MAVLink_gps_raw_int_message(
        0, kind, round(HERE[0] * 1e7), round(HERE[1] * 1e7), round(HERE[2] * 1e3), 120, 150, 500,
        30_687, satellites, alt_ellipsoid=round(ellipsoid_m * 1e3), h_acc=1500,
    )  # fmt: skip


def home(lat_deg: float, lon_deg: float, alt_m: float) -> Any:
    return message_of(
        "HOME_POSITION", latitude=round(lat_deg * 1e7), longitude=round(lon_deg * 1e7),
        altitude=round(alt_m * 1e3), q=[1, 0, 0, 0],
    )  # fmt: skip


def text(words: str | bytes, severity: int = 4, number: int = 0, chunk: int = 0) -> Any:
    data = words.encode() if isinstance(words, str) else words
    return mavlink.MAVLink_statustext_message(severity, data, number, chunk)


def chunks(words: str, severity: int = 4, number: int = 9) -> list[Any]:
    """Return the texts that a long one is sent as."""
    data = words.encode()
    parts = [data[at : at + 50] for at in range(0, len(data) + (len(data) % 50 == 0), 50)]
    return [text(part, severity, number, chunk) for chunk, part in enumerate(parts)]


def attitude(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, **known: float) -> Any:
    return message_of("ATTITUDE", roll=roll, pitch=pitch, yaw=yaw, **known)


def estimator(flags: int) -> Any:
    return mavlink.MAVLink_estimator_status_message(
        0, flags, *[math.nan] * 6, pos_horiz_accuracy=1, pos_vert_accuracy=1
    )
