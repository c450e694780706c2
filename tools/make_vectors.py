"""Write the bytes of tests/vectors/frames.json again, of the fields that stand in it.

The Python tests and the firmware's host tests both read the table, so the two implementations of
firmware/PROTOCOL.md stay equal. Run it only when the protocol changes. A new vector is appended
with its fields; its position is the sequence number and sets the pipe.
"""

import json
from pathlib import Path
from typing import Any

import msgspec

from gateway.wire import payloads
from gateway.wire.framing import encode_frame

TARGET = Path(__file__).resolve().parent.parent / "tests" / "vectors" / "frames.json"


def with_bytes(vector: dict[str, Any]) -> dict[str, Any]:
    """Encode the fields of a vector."""
    if vector["kind"] == "ReceiverStatus":
        status = msgspec.convert(vector["fields"], payloads.ReceiverStatusFrame)
        content = payloads.encode_receiver_status(status)
        encoded = {}
    else:
        header = msgspec.convert(vector["header"], payloads.Header)
        payload = msgspec.convert(vector["fields"], getattr(payloads, vector["kind"]))
        packet = payloads.encode_payload(header, payload)
        content = payloads.encode_radio(
            vector["frame_seq"], vector["pipe"], vector["receiver_time_us"], packet
        )
        encoded = {"payload_hex": packet.hex()}
    encoded |= {"content_hex": content.hex(), "frame_hex": encode_frame(content).hex()}
    return vector | encoded


def table(vectors: list[dict[str, Any]]) -> str:
    """Return the text of the file."""
    return json.dumps([with_bytes(vector) for vector in vectors], indent=1) + "\n"


if __name__ == "__main__":
    TARGET.write_text(table(json.loads(TARGET.read_text())))
