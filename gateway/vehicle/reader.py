"""Frames of clients to checked requests; invalid ones are counted and dropped."""

from collections import Counter
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import Incoming
from gateway.vehicle.actions import Request
from gateway.vehicle.encoder import AUTOPILOT_COMPONENT
from gateway.vehicle.signing import Verifier

V1_START: Final = 0xFE
V2_START: Final = 0xFD
SIGNED: Final = 0x01
V1_OVERHEAD: Final = 8
V2_OVERHEAD: Final = 12
BROADCAST: Final = 0
BAD_SIGNATURE: Final = "bad signature"


class RequestReader:
    """Decode frames and check their sender and target.

    Parameters
    ----------
    system_id : int
        The target system of the requests.
    """

    def __init__(self, system_id: int) -> None:
        self.faults: Counter[str] = Counter()
        """Frames dropped, by reason."""
        self.verifier: Verifier | None = None
        """Checks signatures; with one, an unsigned client may only read."""
        self._system_id = system_id
        self._mav: Any = mavlink.MAVLink(None)

    def read(self, incoming: Incoming, now_us: int) -> Request | None:
        """Decode one whole frame.

        Parameters
        ----------
        incoming : Incoming
            MAVLink 1 or 2.
        now_us : int
            Gateway clock.

        Returns
        -------
        Request or None
            None if it is damaged, unknown, forged, or for another system.
        """
        frame = incoming.frame
        message = self._decode(frame)
        if isinstance(message, str):
            self.faults[message] += 1
            return None
        if not self._is_for_us(message):
            return None
        allowed = incoming.trusted
        if self.verifier is not None:
            signed = frame[0] == V2_START and frame[2] & SIGNED
            if signed and not self.verifier.accepts(frame, now_us):
                self.faults[BAD_SIGNATURE] += 1
                return None
            allowed = allowed and bool(signed)
        return Request(
            incoming.client_id,
            message.get_srcSystem(),
            message.get_srcComponent(),
            message,
            allowed,
        )

    def _decode(self, frame: bytes) -> Any:
        """Decode a frame, or return what is wrong with it."""
        if not _is_whole(frame):
            return "malformed"
        try:
            message = self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            return "broken"
        if message.get_type().startswith("UNKNOWN"):
            return "unknown"
        # Only the pair is ours: a companion computer shares the system id of its vehicle.
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == (self._system_id, AUTOPILOT_COMPONENT):
            return "own id"
        return message

    def _is_for_us(self, message: Any) -> bool:
        system = getattr(message, "target_system", BROADCAST)
        component = getattr(message, "target_component", BROADCAST)
        return system in (BROADCAST, self._system_id) and component in (
            BROADCAST,
            AUTOPILOT_COMPONENT,
        )


def _is_whole(frame: bytes) -> bool:
    if len(frame) < V1_OVERHEAD:
        return False
    if frame[0] == V1_START:
        return len(frame) == frame[1] + V1_OVERHEAD
    if frame[0] != V2_START or frame[2] & ~SIGNED:
        # An unknown incompatibility flag forbids reading on.
        return False
    signature = 13 if frame[2] & SIGNED else 0
    return len(frame) == frame[1] + V2_OVERHEAD + signature
