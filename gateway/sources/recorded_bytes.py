"""Store a source's bytes as TUNNEL messages in a tlog, so that they can be decoded again."""

from collections.abc import Iterator
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import NodeId
from gateway.wire.mavlink_messages import MESSAGE_IDS
from gateway.wire.mavlink_splitter import message_id_of

TUNNEL_ID: Final = MESSAGE_IDS["TUNNEL"]
FIRST_TYPE: Final = 0x8000
"""First TUNNEL payload type that is free for any use; the id of the node is added to it."""
PIECE: Final = 128


class TunnelWriter:
    """Pack the bytes of one source in TUNNEL messages."""

    def __init__(self, node: NodeId) -> None:
        self._type = FIRST_TYPE + node.node_id
        self._sender = mavlink.MAVLink(None, node.vehicle_id, mavlink.MAV_COMP_ID_LOG)

    def frames(self, data: bytes) -> Iterator[bytes]:
        """Yield frames that contain the given bytes."""
        for at in range(0, len(data), PIECE):
            piece = data[at : at + PIECE]
            padded = [*piece.ljust(PIECE, b"\0")]
            message = mavlink.MAVLink_tunnel_message(0, 0, self._type, len(piece), padded)
            yield message.pack(self._sender)
            self._sender.seq = (self._sender.seq + 1) % 256


def tunnelled(frame: bytes, node: NodeId) -> bytes:
    """Return the bytes in a frame; empty if it is no TUNNEL, of another source, or damaged."""
    if message_id_of(frame) != TUNNEL_ID:
        return b""
    try:
        message = mavlink.MAVLink(None).decode(bytearray(frame))
    except mavlink.MAVError:
        return b""
    sender = (message.get_srcSystem(), message.payload_type)
    if sender != (node.vehicle_id, FIRST_TYPE + node.node_id):
        return b""
    return bytes(message.payload[: message.payload_length])
