"""MAVLink frames and tlogs for the tests of recordings."""

from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.tlog import TlogRecord, encode_record
from tests.kit.mavlink import Sender

START_US = 1_760_000_000_000_000
STEP_US = 20_000


def make_frames(count: int, system_id: int = 1) -> list[bytes]:
    """Pack a row of messages of changing kind and size."""
    sender, frames = Sender(system_id), []
    for i in range(count):
        message = (
            mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3),
            mavlink.MAVLink_attitude_quaternion_message(20 * i, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            mavlink.MAVLink_statustext_message(6, f"number {i}".encode()),
        )[i % 3]
        frames.append(sender.pack(message))
    return frames


def make_records(count: int, system_id: int = 1) -> list[TlogRecord]:
    return [
        TlogRecord(START_US + i * STEP_US, frame)
        for i, frame in enumerate(make_frames(count, system_id))
    ]


def make_tlog(records: list[TlogRecord]) -> bytes:
    return b"".join(encode_record(record.time_us, record.frame) for record in records)
