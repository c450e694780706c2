"""Small recordings: MAVLink frames, the records of a tlog, and files of both formats."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from gateway.recordings.play import Track
from gateway.recordings.recorded_table import Line
from gateway.recordings.table import TableHeader, encode_head, encode_line
from gateway.recordings.tlog import TlogScanner, encode_record
from gateway.recordings.tlog_index import TlogIndex
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.vehicle_state.senders import Senders
from gateway.wire.recorded_frames import Batch, RecordedFrame
from tests.kit.mavlink import Sender, packed

START_US = 1_760_000_000_000_000
STEP_US = 20_000
"""Default interval of records."""
SECOND_US = 1_000_000

Sent = Iterable[tuple[tuple[int, int], Any]]
"""Messages, each with the ids of the system and component that sends it."""


def make_frames(count: int, system_id: int = 1) -> list[bytes]:
    """Pack a row of messages of changing kind and size."""
    return list(_frames(count, system_id))


@cache
def _frames(count: int, system_id: int) -> tuple[bytes, ...]:
    sender, frames = Sender(system_id), list[bytes]()
    for i in range(count):
        message = (
            mavlink.MAVLink_heartbeat_message(1, 0, 0, 0, 4, 3),
            mavlink.MAVLink_attitude_quaternion_message(20 * i, 1.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6),
            mavlink.MAVLink_statustext_message(6, f"number {i}".encode()),
        )[i % 3]
        frames.append(sender.pack(message))
    return tuple(frames)


def make_records(count: int, system_id: int = 1) -> list[RecordedFrame]:
    return records_of(make_frames(count, system_id))


def records_of(frames: Iterable[bytes], step_us: int = STEP_US) -> list[RecordedFrame]:
    """Record frames at equal intervals."""
    return [RecordedFrame(START_US + k * step_us, frame) for k, frame in enumerate(frames)]


def records_sent(sent: Sent, step_us: int = STEP_US) -> list[RecordedFrame]:
    """Record messages at equal intervals, each with sequence number 0."""
    return records_of((packed(message, *origin) for origin, message in sent), step_us)


def with_jump(records: list[RecordedFrame], at: int, by_us: int) -> list[RecordedFrame]:
    """Shift the times from a record on, as if the clock had been set before it."""
    return records[:at] + [RecordedFrame(r.time_us + by_us, r.frame) for r in records[at:]]


def make_tlog(records: Iterable[RecordedFrame]) -> bytes:
    return b"".join(encode_record(record.time_us, record.frame) for record in records)


def write_tlog(path: Path, records: Iterable[RecordedFrame]) -> Path:
    path.write_bytes(make_tlog(records))
    return path


def write_table(path: Path, header: TableHeader, lines: Iterable[Line]) -> Path:
    path.write_text(encode_head(header) + "".join(map(encode_line, lines)))
    return path


def batch_of(records: Iterable[RecordedFrame]) -> Batch:
    return TlogScanner().feed(make_tlog(records), final=True)


def index_of(batches: Iterable[Batch]) -> TlogIndex:
    index = TlogIndex()
    for batch in batches:
        index.add(batch)
    return index


def read_tlog(path: Path) -> list[RecordedFrame]:
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
    records: list[RecordedFrame], wanted: Iterable[int] = (), system_id: int | None = None
) -> list[VehicleMessage]:
    """Read the vehicles of a recording."""
    reader = VehicleReader(senders_of(make_tlog(records)), wanted, system_id)
    found = [message for record in records for message in reader.feed(record)]
    return [*found, *reader.flush()]


class MemoryTlog:
    """A tlog in memory as a source of a track."""

    def __init__(self, data: bytes) -> None:
        self.data, self.index = data, index_of([TlogScanner().feed(data, final=True)])
        self.last_us = self.index.last_us or 0

    def read(self, offset: int, size: int) -> bytes:
        return self.data[offset : offset + size]

    def prepare(self, until_us: int) -> bool:
        return True


def make_track(data: bytes, **options: object) -> Track:
    return Track(MemoryTlog(data), **options)


def play_all(track: Track) -> list[RecordedFrame]:
    found = []
    while (time_us := track.peek_us()) is not None:
        found.append(RecordedFrame(time_us, track.take()))
    return found
