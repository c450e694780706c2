"""Messages of an aircraft, as the panel decodes them, and those of a flight."""

import math
from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.wire.recorded_frames import RecordedFrame
from tests.kit.mavlink import Sender
from tests.kit.recordings import make_tlog, records_of

BEGIN_US = 1_750_000_000_000_000
HOSTILE_TEXT = "</script><script>window.ran = 1</script><img src=x onerror=window.ran=1>"


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


def flight_records(seconds: int, hz: int = 10) -> Iterator[RecordedFrame]:
    """Make the messages of a flight in circles, with a little noise."""
    sender = Sender(3)
    for step in range(seconds * hz):
        time_us, turn = BEGIN_US + step * 1_000_000 // hz, step / hz / 20
        wobble = math.sin(step * 12.9898) * 0.03
        north, east = round(20_000 * math.sin(turn)), round(20_000 * math.cos(turn))
        height = 400 + 80 * math.sin(turn / 7)
        messages: list[Any] = [
            mavlink.MAVLink_attitude_message(0, 0.4 + wobble, wobble, turn % 6 - 3, 0, 0, 0),
            mavlink.MAVLink_global_position_int_message(
                0, 470_000_000 + north, 80_000_000 + east, round(height * 1e3),
                round((height - 320) * 1e3), 0, 0, 0, round(turn * 5729) % 36000,
            ),
            mavlink.MAVLink_vfr_hud_message(18 + wobble, 17 + wobble, 10, 50, height, wobble),
        ]  # fmt: skip
        if step % hz == 0:
            messages += [
                mavlink.MAVLink_heartbeat_message(1, 0, 128, 0, 4, 3),
                mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 11800, -1, 63, 0, 0, 0, 0, 0, 0),
            ]
        if step == 5 * hz:
            text = HOSTILE_TEXT.encode()[:50]
            messages.append(mavlink.MAVLink_statustext_message(2, text))
        for message in messages:
            yield RecordedFrame(time_us, sender.pack(message))


def short_tlog() -> bytes:
    """Return a tlog of five heartbeats, one a second."""
    return make_tlog(records_of([Sender().heartbeat()] * 5, US_PER_S))
