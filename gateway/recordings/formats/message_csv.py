"""Write one type of MAVLink message as CSV, one row per message, with all its fields.

Messages of equal time, of other instances and of other senders have rows of their own as well. An
array has a column for each element; a text has one column.
"""

import csv
import io
from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np

from gateway.recordings.files import FlightError
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import DEFINITIONS, MESSAGE_NAMES, layout_of
from gateway.wire.recorded_frames import Batch, columns_of

HEAD: Final = ("time", "system_id", "component_id")
"""Columns before the fields; the time is civil, in UTC, to the microsecond."""
FORMULA: Final = ("=", "+", "-", "@", "\t", "\r")
"""Beginnings of a cell that a spreadsheet evaluates."""


def write(batches: Iterable[Batch], message_id: int) -> Iterator[bytes]:
    """Write all messages of one type; raises FlightError if there is none."""
    found = of_one_message(batches, message_id)
    yield csv_lines([(*HEAD, *_names(message_id))]).encode()
    for batch in found:
        yield csv_lines(zip(*_columns(batch, message_id), strict=True)).encode()


def of_one_message(batches: Iterable[Batch], message_id: int) -> Iterator[Batch]:
    """Yield the messages of one type; raises FlightError if it is unknown, or there is none."""
    if message_id not in DEFINITIONS:
        raise FlightError(f"the fields of message {message_id} are not known")
    return _chosen(batches, message_id)


def _chosen(batches: Iterable[Batch], message_id: int) -> Iterator[Batch]:
    met: set[int] = set()
    for batch in batches:
        met |= set(np.unique(batch.message_ids).tolist())
        found = batch.chosen(batch.message_ids == message_id)
        if len(found):
            yield found
    if message_id not in met:
        others = ", ".join(sorted(MESSAGE_NAMES.get(one, f"message {one}") for one in met))
        raise FlightError(f"the flight contains no {MESSAGE_NAMES[message_id]}, but {others}")


def _names(message_id: int) -> Iterator[str]:
    layout = layout_of(message_id)
    for name in DEFINITIONS[message_id].fieldnames:
        shape = layout[name].shape
        yield from (f"{name}[{k}]" for k in range(shape[0])) if shape else (name,)


def _columns(batch: Batch, message_id: int) -> Iterator[list[str]]:
    """Yield the columns of some messages of one type; floats as their shortest exact text."""
    times = np.maximum(batch.time_us, 0).astype("datetime64[us]")
    yield [f"{text}Z" for text in np.datetime_as_string(times).tolist()]
    yield (batch.origins >> 8).astype(str).tolist()
    yield (batch.origins & 0xFF).astype(str).tolist()
    values = columns_of(batch, np.arange(len(batch)), message_id)
    for name in DEFINITIONS[message_id].fieldnames:
        column = values[name]
        if column.dtype.kind == "S":
            yield [data_cell(text_of(data)) for data in column.tolist()]
        elif column.ndim > 1:
            yield from column.T.astype(str).tolist()
        else:
            yield column.astype(str).tolist()


def data_cell(text: str) -> str:
    """Return a text of others so that a spreadsheet takes it for data, not for a formula."""
    return f"'{text}" if text.startswith(FORMULA) else text


def csv_lines(rows: Iterable[Iterable[object]]) -> str:
    """Write rows as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()
