"""Write MCAP files of version 0: chunks of messages with their indexes, and a summary.

The library's records are used for all that is rare. Its writer takes 5 µs for each message, which
would be most of a conversion; so messages and their indexes are packed here.
"""

import zlib
from collections import Counter
from struct import Struct
from typing import Final

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_SIZE: Final = 1 << 20
ZSTD: Final = "zstd"
_MESSAGE: Final = Struct("<BQHIQQ")
_MESSAGE_BASE: Final = 22
"""Size of a message without its data."""
_INDEX: Final = Struct("<BQHI")
_INDEX_BASE: Final = 6
_FOOTER: Final = Struct("<BQQQ")
_FOOTER_SIZE: Final = 20


class McapWriter:
    """Make the bytes of a file piece by piece; `take` returns those made since the last call."""

    def __init__(self, library: str) -> None:
        self._made = bytearray(MAGIC)
        self._taken = 0
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._counts: Counter[int] = Counter()
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._chunk = bytearray()
        self._messages: list[tuple[int, int, int]] = []
        """Channel, time in ns, and offset in the chunk of each message."""
        self._made += _bytes_of(Header(profile="", library=library))

    def take(self) -> bytes:
        """Return the bytes made since the last call."""
        data = bytes(self._made)
        self._taken += len(data)
        self._made.clear()
        return data

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema, and return its id."""
        self._schemas.append(Schema(len(self._schemas) + 1, data, encoding, name))
        self._chunk += _bytes_of(self._schemas[-1])
        return len(self._schemas)

    def add_channel(self, topic: str, encoding: str, schema: int) -> int:
        """Add a channel, and return its id."""
        self._channels.append(Channel(len(self._channels) + 1, topic, encoding, {}, schema))
        self._chunk += _bytes_of(self._channels[-1])
        return len(self._channels)

    def add_message(self, channel: int, time_ns: int, data: bytes, sequence: int = 0) -> None:
        """Add a message that was logged and published at one time."""
        self._messages.append((channel, time_ns, len(self._chunk)))
        size = _MESSAGE_BASE + len(data)
        self._chunk += _MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence, time_ns, time_ns)
        self._chunk += data
        if len(self._chunk) > CHUNK_SIZE:
            self._end_chunk()

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Add texts by name."""
        record, begin = _bytes_of(Metadata(name, values)), self._taken + len(self._made)
        self._made += record
        self._metadata.append(MetadataIndex(begin, len(record), name))

    def finish(self) -> bytes:
        """Return the rest of the file."""
        self._end_chunk()
        self._made += _bytes_of(DataEnd(0))
        begin, summary, offsets = self._taken + len(self._made), bytearray(), bytearray()
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, [*self._schemas]), (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [self._statistics()]), (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        )  # fmt: skip
        for opcode, records in groups:
            group = b"".join(map(_bytes_of, records))
            offsets += _bytes_of(SummaryOffset(opcode, begin + len(summary), len(group)))
            summary += group
        places = (begin, begin + len(summary))
        summary += offsets
        head = _FOOTER.pack(Opcode.FOOTER, _FOOTER_SIZE, *places)
        footer = Footer(*places, zlib.crc32(head, zlib.crc32(summary)))
        self._made += summary + _bytes_of(footer) + MAGIC
        return self.take()

    def _statistics(self) -> Statistics:
        begins = [chunk.message_start_time for chunk in self._chunks]
        ends = [chunk.message_end_time for chunk in self._chunks]
        return Statistics(
            attachment_count=0, channel_count=len(self._channels),
            channel_message_counts=dict(self._counts), chunk_count=len(self._chunks),
            message_count=self._counts.total(), message_start_time=min(begins, default=0),
            message_end_time=max(ends, default=0), metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )  # fmt: skip

    def _end_chunk(self) -> None:
        if not self._messages:
            return
        data = bytes(self._chunk)
        found = np.array(self._messages, np.uint64)
        times_ns = found[:, 1]
        chunk = Chunk(
            ZSTD, zstandard.compress(data), int(times_ns.max()), int(times_ns.min()),
            zlib.crc32(data), len(data),
        )  # fmt: skip
        begin, record = self._taken + len(self._made), _bytes_of(chunk)
        self._made += record
        offsets: dict[int, int] = {}
        index_begin = self._taken + len(self._made)
        for channel in np.unique(found[:, 0]).tolist():
            entries = found[found[:, 0] == channel, 1:].astype("<u8").tobytes()
            offsets[channel] = self._taken + len(self._made)
            self._counts[channel] += len(entries) // 16
            size = _INDEX_BASE + len(entries)
            self._made += _INDEX.pack(Opcode.MESSAGE_INDEX, size, channel, len(entries)) + entries
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(record), chunk_start_offset=begin, compression=ZSTD,
                compressed_size=len(chunk.data), message_end_time=chunk.message_end_time,
                message_index_length=self._taken + len(self._made) - index_begin,
                message_index_offsets=offsets, message_start_time=chunk.message_start_time,
                uncompressed_size=len(data),
            )
        )  # fmt: skip
        self._chunk.clear()
        self._messages.clear()


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]
