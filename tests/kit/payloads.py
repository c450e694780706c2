"""Payloads of the radio, read and written as the receiver's line brings them; frames of LTM."""

from functools import reduce
from operator import xor

from gateway.records import NodeId
from gateway.wire.framing import Fault, encode_frame
from gateway.wire.payloads import (
    GpsQualityPayload,
    Header,
    Payload,
    decode_content,
    encode_payload,
    encode_radio,
)

QUALITY = GpsQualityPayload(1000, 120, 200, 20, 500, 110, 2_300, None)


def decode_payload(data: bytes) -> tuple[Header, Payload] | Fault:
    """Read one payload; a fault counts its bytes alone."""
    content = encode_radio(0, 0, 0, data)
    frame = decode_content(content)
    if isinstance(frame, Fault):
        return Fault(frame.kind, frame.size - len(content) + len(data))
    assert hasattr(frame, "payload")
    return frame.header, frame.payload


def ltm(kind: bytes, payload: bytes) -> bytes:
    return b"$T" + kind + payload + bytes([reduce(xor, payload, 0)])


class Tracker:
    """One aircraft's nodes and the receiver's framing of them."""

    def __init__(self, vehicle_id: int = 1) -> None:
        self.vehicle_id = vehicle_id
        self.seq = [0, 0]

    def frame(self, time_us: int, payload: Payload, node: int = 0) -> bytes:
        """Encode a payload; a node's first after another, without which it is not accepted."""
        first = b"" if self.seq[node] else self.one(time_us, QUALITY, node)
        return first + self.one(time_us, payload, node)

    def one(self, time_us: int, payload: Payload, node: int = 0) -> bytes:
        header = Header(NodeId(self.vehicle_id, node), self.seq[node], time_us)
        self.seq[node] += 1
        packet = encode_payload(header, payload)
        return encode_frame(encode_radio(0, node, time_us, packet))
