"""Messages of an aircraft, as the panel decodes them."""

from typing import Any

from pymavlink.dialects.v20 import all as mavlink


def decoded(message: Any, system_id: int = 1, component_id: int = 1) -> Any:
    """Send a message through the wire format, so that it has a sender and rounded fields."""
    sender = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=component_id)
    return mavlink.MAVLink(None).decode(bytearray(message.pack(sender)))


def heartbeat(kind: int = mavlink.MAV_TYPE_FIXED_WING, **sender: int) -> Any:
    return decoded(mavlink.MAVLink_heartbeat_message(kind, 0, 0, 0, 4, 3), **sender)


def position(lat_deg: float, lon_deg: float, alt_m: float = 100.0, **sender: int) -> Any:
    return decoded(
        mavlink.MAVLink_global_position_int_message(
            0, round(lat_deg * 1e7), round(lon_deg * 1e7), round(alt_m * 1e3), 5000,
            1200, -500, -100, 9000,
        ),
        **sender,
    )  # fmt: skip


def fix(lat_deg: float, lon_deg: float, kind: int = 3, satellites: int = 12) -> Any:
    return decoded(
        mavlink.MAVLink_gps_raw_int_message(
            0, kind, round(lat_deg * 1e7), round(lon_deg * 1e7), 101_000, 65535, 65535, 65535,
            65535, satellites, h_acc=1500,
        )
    )  # fmt: skip
