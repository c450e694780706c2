"""Frames with their times: one, and many as columns; the fields of their payloads."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import DEFINITIONS, layout_of
from gateway.wire.mavlink_splitter import PAYLOAD_V1, PAYLOAD_V2, START_V2, message_id_of

IntArray = NDArray[np.int64]

LENGTH_AT: Final = 1
"""Offset of the payload length in a frame."""


@dataclass(frozen=True, slots=True)
class Damage:
    """A run of bytes that belong to no record."""

    offset: int
    size: int


@dataclass(frozen=True, slots=True)
class RecordedFrame:
    """One frame and the civil time at which it passed, in µs since 1970."""

    time_us: int
    frame: bytes


@dataclass(frozen=True, slots=True)
class Batch:
    """Consecutive records of a file, as columns."""

    data: bytes
    offset: int
    """Offset of `data` in the file."""
    starts: IntArray
    """Offset of each record in `data`."""
    sizes: IntArray
    """Size of each frame in bytes."""
    time_us: IntArray
    origins: IntArray
    """Sender of each frame: system id << 8 | component id."""
    message_ids: IntArray
    damage: tuple[Damage, ...]
    mended: int = 0
    """Number of damaged times, which were replaced by those of the previous record."""
    unfinished: int = 0
    """Bytes of an incomplete record at the end of the file: it is being written, or was cut off."""

    def __len__(self) -> int:
        return len(self.starts)

    def frame(self, index: int) -> bytes:
        """Return the bytes of one frame."""
        begin = int(self.starts[index]) + TIME_SIZE
        return self.data[begin : begin + int(self.sizes[index])]

    def chosen(self, wanted: NDArray[np.bool_]) -> "Batch":
        """Return the batch with the chosen records only, and all of its damage."""
        if wanted.all():
            return self
        columns = (self.starts, self.sizes, self.time_us, self.origins, self.message_ids)
        starts, sizes, time_us, origins, message_ids = (column[wanted] for column in columns)
        return replace(
            self, starts=starts, sizes=sizes, time_us=time_us, origins=origins,
            message_ids=message_ids,
        )  # fmt: skip

    def encoded(self) -> bytes:
        """Return the records as the bytes of a tlog, with the times of the batch."""
        edited = bytearray(self.data)
        times = np.maximum(self.time_us, 0).astype(">u8")
        np.frombuffer(edited, np.uint8)[self.starts[:, None] + np.arange(TIME_SIZE)] = times.view(
            np.uint8
        ).reshape(-1, TIME_SIZE)
        ends = self.starts + TIME_SIZE + self.sizes
        is_first = np.ones(len(self), np.bool_)
        is_first[1:] = self.starts[1:] != ends[:-1]
        begins, view = self.starts[is_first].tolist(), memoryview(edited)
        stops = ends[np.roll(is_first, -1)].tolist()
        return b"".join([view[begin:end] for begin, end in zip(begins, stops, strict=True)])

    def records(self, wanted: IntArray | None = None) -> Iterator[RecordedFrame]:
        """Yield the records, or those with the given indices."""
        data = self.data
        times, starts, sizes = self.time_us, self.starts, self.sizes
        if wanted is not None:
            times, starts, sizes = times[wanted], starts[wanted], sizes[wanted]
        for time_us, start, size in zip(
            times.tolist(), starts.tolist(), sizes.tolist(), strict=True
        ):
            yield RecordedFrame(time_us, data[start + TIME_SIZE : start + TIME_SIZE + size])


def payload_of(frame: bytes, size: int) -> bytes:
    """Return the first bytes of a payload, with the zeros that MAVLink 2 truncates."""
    begin = PAYLOAD_V2 if frame[0] == START_V2 else PAYLOAD_V1
    return frame[begin : begin + min(frame[LENGTH_AT], size)].ljust(size, b"\0")


def fields_of(frame: bytes) -> dict[str, Any]:
    """Return the fields of a frame of the dialect, as Python's built-in types."""
    layout = layout_of(message_id_of(frame))
    values = np.frombuffer(payload_of(frame, layout.itemsize), layout)[0].item()
    return dict(zip(layout.names or (), values, strict=True))


def fields_of_rows(batch: "Batch", wanted: IntArray) -> list[dict[str, Any]]:
    """Return the fields of some frames, as `fields_of`; empty for unknown messages."""
    found: list[dict[str, Any]] = [{}] * len(wanted)
    ids = batch.message_ids[wanted]
    for message_id in np.unique(ids).tolist():
        if message_id not in DEFINITIONS:
            continue
        rows, names = np.flatnonzero(ids == message_id), layout_of(message_id).names or ()
        columns = columns_of(batch, wanted[rows], message_id).tolist()
        for row, values in zip(rows.tolist(), columns, strict=True):
            found[row] = dict(zip(names, values, strict=True))
    return found


def columns_of(batch: "Batch", wanted: IntArray, message_id: int) -> NDArray[np.void]:
    """Read the fields of some frames of one message; truncated or unknown ones are zero."""
    layout = layout_of(message_id)
    data = np.frombuffer(batch.data, np.uint8)
    starts = batch.starts[wanted] + TIME_SIZE
    begins = starts + np.where(data[starts] == START_V2, PAYLOAD_V2, PAYLOAD_V1)
    offsets = np.arange(layout.itemsize)
    is_there = offsets < data[starts + LENGTH_AT][:, None]
    payloads = np.zeros((len(wanted), layout.itemsize), np.uint8)
    payloads[is_there] = data[(begins[:, None] + offsets)[is_there]]
    found: NDArray[np.void] = payloads.view(layout)[:, 0]
    return found
