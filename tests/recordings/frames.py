"""MAVLink frames and tlogs for the tests of recordings."""

from collections.abc import Iterable
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.senders import Senders
from gateway.recordings.tlog import TlogRecord, TlogScanner, encode_record
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
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


def read_tlog(path: Path) -> list[TlogRecord]:
    """Read a tlog without damage."""
    batch = TlogScanner(strict=True).feed(path.read_bytes(), final=True)
    assert batch.damage == ()
    return list(batch.records())


def senders_of(data: bytes) -> Senders:
    """Survey the senders of a tlog."""
    senders = Senders()
    senders.add(TlogScanner().feed(data, final=True))
    return senders


def messages_of(
    records: list[TlogRecord], wanted: Iterable[int] = (), system_id: int | None = None
) -> list[VehicleMessage]:
    """Read the vehicles of a recording."""
    reader = VehicleReader(senders_of(make_tlog(records)), wanted, system_id)
    found = [message for record in records for message in reader.feed(record)]
    return [*found, *reader.flush()]
