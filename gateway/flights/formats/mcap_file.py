"""MCAP, the container of Foxglove and PlotJuggler: see `gateway.flightlog.foxglove`."""

from collections.abc import Iterator
from typing import Any

import msgspec
from mcap.writer import Writer
from pymavlink.dialects.v20 import all as mavlink

from gateway import __version__
from gateway.flightlog.foxglove import SCHEMAS, FoxgloveView, fields_of_message, schema_of_message
from gateway.flightlog.tlog.recorded_commands import is_station
from gateway.flights.formats.decoded import decoded
from gateway.flights.formats.pieces import Pieces
from gateway.flights.writing import FlightToWrite
from gateway.wire.mavlink_splitter import (
    is_station_heartbeat,
    message_id_of,
    origin_of,
    sequence_of,
)


class _Topics:
    """Channels and schemas of one file, each registered at its first use."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}

    def add(
        self, topic: str, schema: dict[str, Any], content: Any, time_us: int, sequence: int = 0
    ) -> None:
        channel = self._channels.get(topic)
        if channel is None:
            number = self._schema(schema)
            channel = self._writer.register_channel(topic, "json", number)
            self._channels[topic] = channel
        time_ns = time_us * 1000
        data = msgspec.json.encode(content)
        self._writer.add_message(channel, time_ns, data, time_ns, sequence)

    def _schema(self, schema: dict[str, Any]) -> int:
        name = schema["title"]
        if name not in self._schemas:
            data = msgspec.json.encode(schema)
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", data)
        return self._schemas[name]


def write(flight: FlightToWrite) -> Iterator[bytes]:
    """Write a flight, at its civil times."""
    pieces = Pieces()
    writer = Writer(pieces)  # type: ignore[arg-type]
    writer.start(library=f"mavgate {__version__}")
    topics, view = _Topics(writer), FoxgloveView()
    stations: set[int] = set()
    for record, message in decoded(flight):
        frame, time_us = record.frame, record.time_us
        system, component = origin_of(frame)
        origin = system << 8 | component
        if message_id_of(frame) == mavlink.MAVLINK_MSG_ID_HEARTBEAT and is_station_heartbeat(frame):
            stations.add(origin)
        topic = f"/mavlink/{system}/{component}/{message.msgname}"
        fields = fields_of_message(message)
        topics.add(topic, schema_of_message(message), fields, time_us, sequence_of(frame))
        if not is_station(origin, stations):
            for shown in view.feed(system, component, message, time_us):
                topics.add(shown.topic, SCHEMAS[shown.schema], shown.content, time_us)
        if data := pieces.taken():
            yield data
    if view.origin is not None:
        lat_deg, lon_deg, alt_m = map(str, view.origin)
        origin_facts = {"latitude": lat_deg, "longitude": lon_deg, "altitude_amsl_m": alt_m}
        writer.add_metadata("origin of the frame map", origin_facts)
    writer.finish()  # type: ignore[no-untyped-call]
    yield pieces.taken()
