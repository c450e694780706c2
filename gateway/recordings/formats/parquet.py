"""Parquet: a table as typed columns with units, or one type of MAVLink message.

The comment lines between the rows of a table (changed settings, states, marks, node reports) are
stored in the column `comments` of the next row, as in a CSV; settings and calibration are in the
metadata of the file. So a CSV can be restored exactly.
"""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from gateway.recordings.columns import COLUMNS, TRUTHS, WHOLE_COLUMNS, unit_of
from gateway.recordings.files import FlightError, is_packed, read_chunks, temporary_copy
from gateway.recordings.formats import message_csv
from gateway.recordings.recorded_table import ReadOptions, RecordedTable, table_of_blocks
from gateway.recordings.rows import TableRow, cells_of
from gateway.recordings.table import (
    FORMAT_LINE,
    HEADER_PREFIX,
    TableBlock,
    TableReader,
    encode_line,
)
from gateway.recordings.workshop.convert import FlightToWrite, Pieces
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import DEFINITIONS
from gateway.wire.recorded_frames import Batch, columns_of

ROWS: Final = 16_384
"""Rows per row group, which is held in memory as a whole: about 40 MB."""
COMMENTS: Final = "comments"
TIME: Final = "time"
"""Column with the civil time, if it is known."""
HEADER: Final = b"mavgate.header"
END: Final = "mavgate.end"
"""Metadata key of the comments after the last row."""

_TYPES: Final = {
    **{f"{sign}int{bits}_t": getattr(pa, f"{sign}int{bits}")() for sign in ("", "u")
       for bits in (8, 16, 32, 64)},
    "float": pa.float32(), "double": pa.float64(), "char": pa.string(),
    "uint8_t_mavlink_version": pa.uint8(),
}  # fmt: skip


def write(flight: FlightToWrite) -> Iterator[bytes]:
    """Write a flight's table, or its messages of the requested type."""
    if flight.message_id is None:
        return _write_table(flight.table())
    return _write_messages(flight, flight.message_id)


def read(path: Path, options: ReadOptions) -> RecordedTable:
    """Open a table that `write` wrote; raises FlightError for any other file."""
    reader = TableReader()

    def blocks() -> Iterator[TableBlock]:
        try:
            for text in _lines(path, options):
                yield reader.feed_block(text)
        except (pa.ArrowException, OSError) as error:
            # Errors of the operating system have a number, those of the library have none.
            if getattr(error, "errno", None) is not None:
                raise
            raise FlightError(f"{path}: cannot be read as Parquet: {error}") from error

    return table_of_blocks(path, reader, blocks())


def _write_table(table: RecordedTable) -> Iterator[bytes]:
    zero_us = table.header.unix_us_at_zero
    fields = [_column(name) for name in COLUMNS]
    if zero_us is not None:
        fields = [pa.field(TIME, pa.timestamp("us", "UTC")), *fields]
    fields.append(pa.field(COMMENTS, pa.string()))
    header = encode_line(table.header).removeprefix(HEADER_PREFIX).strip().encode()
    schema = pa.schema(fields, metadata={HEADER: header})
    pieces = Pieces()
    with _writer(pieces, schema) as writer:
        rows: list[tuple[Any, ...]] = []
        comments = ""
        for line in table.rows:
            if not isinstance(line, TableRow):
                comments += encode_line(line)
                continue
            civil = () if zero_us is None else (zero_us + line.time_us,)
            rows.append((*civil, *cells_of(line), comments or None))
            comments = ""
            if len(rows) == ROWS:
                writer.write_table(_batch(rows, schema))
                yield pieces.take()
                rows.clear()
        writer.write_table(_batch(rows, schema))
        if comments:
            writer.add_key_value_metadata({END: comments})
    yield pieces.take()


def _writer(pieces: Pieces, schema: pa.Schema) -> pq.ParquetWriter:
    file = pa.PythonFile(pieces, "w")
    return pq.ParquetWriter(file, schema, compression="zstd", write_page_checksum=True)


def _column(name: str) -> pa.Field:
    if name in TRUTHS:
        kind = pa.bool_()
    elif name in WHOLE_COLUMNS:
        kind = pa.int64()
    else:
        kind = pa.float64()
    unit = unit_of(name)
    return pa.field(name, kind, metadata={"unit": unit} if unit else None)


def _batch(rows: list[tuple[Any, ...]], schema: pa.Schema) -> pa.Table:
    columns = zip(*rows, strict=True) if rows else ([] for _ in schema)
    arrays = [
        # NaN becomes null, as it becomes an empty cell in CSV.
        pa.array(column, field.type, from_pandas=pa.types.is_floating(field.type))
        if not pa.types.is_boolean(field.type)
        else pa.array([None if value is None else bool(value) for value in column])
        for column, field in zip(columns, schema, strict=True)
    ]
    return pa.Table.from_arrays(arrays, schema=schema)


def _lines(path: Path, options: ReadOptions) -> Iterator[bytes]:
    """Yield the lines of the CSV that the file was made from, many at a time."""
    with (
        _plain(path, options) as plain,
        pq.ParquetFile(plain, page_checksum_verification=True) as file,
    ):
        known = file.schema_arrow.metadata or {}
        names = [name for name in COLUMNS if name in file.schema_arrow.names]
        if "time_us" not in names:
            raise FlightError(f"{path}: has no column time_us, so it is not a table of mavgate's")
        if HEADER in known:
            yield f"{FORMAT_LINE}\n{HEADER_PREFIX}{known[HEADER].decode()}\n".encode()
        yield (",".join(names) + "\n").encode()
        wanted = [*names, *({COMMENTS} & set(file.schema_arrow.names))]
        total, size = max(file.metadata.num_rows, 1), path.stat().st_size
        for batch in file.iter_batches(ROWS // 4, columns=wanted):
            columns = [column.to_pylist() for column in batch.columns]
            comments: Iterable[str | None] = [None] * batch.num_rows
            if len(columns) > len(names):
                comments = columns.pop()
            rows = zip(comments, zip(*columns, strict=True), strict=True)
            lines = (
                (comment or "") + ",".join(map(_text, cells)) + "\n" for comment, cells in rows
            )
            yield "".join(lines).encode()
            if options.progress is not None:
                options.progress(size * batch.num_rows // total)
        yield (file.metadata.metadata or {}).get(END.encode(), b"")


@contextmanager
def _plain(path: Path, options: ReadOptions) -> Iterator[Path | IO[bytes]]:
    """Yield a file that allows random access: for a packed one, a copy."""
    if not is_packed(path):
        yield path
        return
    with temporary_copy(path, read_chunks(path, None, options.unpacked_limit)) as copy:
        yield copy


def _text(cell: Any) -> str:
    if cell is None:
        return ""
    return repr(int(cell)) if isinstance(cell, bool) else repr(cell)


def _write_messages(flight: FlightToWrite, message_id: int) -> Iterator[bytes]:
    """Write every message of one type, from any sender; raises FlightError if there is none."""
    batches = message_csv.of_one_message(flight.chosen(), message_id)
    kind = DEFINITIONS[message_id]
    schema = pa.schema(
        [
            pa.field(TIME, pa.timestamp("us", "UTC")),
            pa.field("system_id", pa.uint8()),
            pa.field("component_id", pa.uint8()),
            *(_message_field(kind, field) for field in kind.fieldnames),
        ],
        metadata={"mavlink.message": kind.msgname},
    )
    pieces = Pieces()
    with _writer(pieces, schema) as writer:
        waiting = [schema.empty_table()]
        for batch in batches:
            waiting.append(_messages(batch, message_id, schema))
            if sum(map(len, waiting)) >= ROWS:
                writer.write_table(pa.concat_tables(waiting), row_group_size=ROWS)
                waiting.clear()
                yield pieces.take()
        if waiting:
            writer.write_table(pa.concat_tables(waiting), row_group_size=ROWS)
    yield pieces.take()


def _messages(batch: Batch, message_id: int, schema: pa.Schema) -> pa.Table:
    """Return messages of one type as a table; NaN becomes null."""
    values = columns_of(batch, np.arange(len(batch)), message_id)
    times = pa.array(batch.time_us.astype("datetime64[us]")).cast(schema.field(TIME).type)
    columns = [times, *(pa.array(ids.astype(np.uint8)) for ids in divmod(batch.origins, 256))]
    for name in DEFINITIONS[message_id].fieldnames:
        column, kind = values[name], schema.field(name).type
        if column.dtype.kind == "S":
            columns.append(pa.array([text_of(data) for data in column.tolist()], kind))
        elif column.ndim > 1:
            offsets = np.arange(0, column.size + 1, column.shape[1], dtype=np.int32)
            columns.append(pa.ListArray.from_arrays(offsets, pa.array(column.ravel()), type=kind))
        else:
            columns.append(pa.array(np.ascontiguousarray(column), kind, from_pandas=True))
    return pa.Table.from_arrays(columns, schema=schema)


def _message_field(kind: Any, name: str) -> pa.Field:
    written = kind.fieldtypes[kind.fieldnames.index(name)]
    length = kind.array_lengths[kind.ordered_fieldnames.index(name)]
    one = _TYPES[written]
    facts = {"unit": kind.fieldunits_by_name.get(name), "enum": kind.fieldenums_by_name.get(name)}
    metadata = {key: value for key, value in facts.items() if value}
    return pa.field(name, pa.list_(one) if length and written != "char" else one, metadata=metadata)
