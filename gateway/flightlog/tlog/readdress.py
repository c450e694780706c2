"""Give a recorded frame another sender, so that several recordings fly on one map."""

from typing import Final

from fastcrc.crc16 import mcrf4xx

from gateway.wire.mavlink_messages import CRC_EXTRA
from gateway.wire.mavlink_splitter import SIGNATURE_SIZE, START_V2, is_signed, message_id_of

_FLAGS_AT: Final = 2
_SYSTEM_AT_V2: Final = 5
_SYSTEM_AT_V1: Final = 3


def readdress(frame: bytes, system_id: int) -> bytes:
    """Return a frame as if another system had sent it.

    Parameters
    ----------
    frame : bytes
        A complete frame. Its signature is removed, since it would be invalid; a frame of an
        unknown message is returned unchanged, since its checksum cannot be computed.
    system_id : int
        1 to 255.

    Returns
    -------
    bytes
        The frame with the checksum that fits.
    """
    extra = CRC_EXTRA.get(message_id_of(frame))
    if extra is None:
        return frame
    body = bytearray(frame[: -SIGNATURE_SIZE - 2] if is_signed(frame) else frame[:-2])
    if frame[0] == START_V2:
        body[_FLAGS_AT] = 0
        body[_SYSTEM_AT_V2] = system_id
    else:
        body[_SYSTEM_AT_V1] = system_id
    crc: int = mcrf4xx(extra, mcrf4xx(bytes(body[1:])))
    return bytes(body) + crc.to_bytes(2, "little")
