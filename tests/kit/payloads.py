"""Payloads of the radio, read as the receiver's line brings them."""

from gateway.wire.framing import Fault
from gateway.wire.payloads import Header, Payload, decode_content, encode_radio


def decode_payload(data: bytes) -> tuple[Header, Payload] | Fault:
    """Read one payload; a fault counts its bytes alone."""
    content = encode_radio(0, 0, 0, data)
    frame = decode_content(content)
    if isinstance(frame, Fault):
        return Fault(frame.kind, frame.size - len(content) + len(data))
    assert hasattr(frame, "payload")
    return frame.header, frame.payload
