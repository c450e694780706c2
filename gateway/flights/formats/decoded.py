"""The MAVLink of a flight, message by message."""

from collections.abc import Iterator
from typing import Any

from pymavlink.dialects.v20 import all as mavlink

from gateway.flightlog.tlog.tlog import TlogRecord
from gateway.flights.writing import FlightToWrite
from gateway.units import counted


def decoded(flight: FlightToWrite) -> Iterator[tuple[TlogRecord, Any]]:
    """Yield a flight's frames with their messages; unknown ones are mentioned in a remark."""
    decoder, unknown = mavlink.MAVLink(None), 0
    for record in flight.frames():
        try:
            yield record, decoder.decode(bytearray(record.frame))
        except mavlink.MAVError:
            unknown += 1
    if unknown:
        flight.remark(f"left out {counted(unknown, 'message')} that no MAVLink dialect here knows")
