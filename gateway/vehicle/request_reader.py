"""Decode the frames of clients, and check their sender, target and signature.

Invalid frames are counted and dropped.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import Incoming
from gateway.vehicle.encoding import AUTOPILOT_COMPONENT
from gateway.vehicle.service import Request
from gateway.wire.mavlink_signing import Verifier
from gateway.wire.mavlink_splitter import SIGNED, START_V2

BROADCAST: Final = 0
VEHICLE: Final = (AUTOPILOT_COMPONENT, BROADCAST)
"""Components for which the vehicle of a system answers."""
BAD_SIGNATURE: Final = "bad signature"
NOT_TRUSTED: Final = "not trusted; set trusted=yes at its endpoint"
NOT_SIGNED: Final = "not signed; set the signing passphrase in the ground station"


class RequestReader:
    """Decode frames and check their sender and target.

    `components` are the own component, and further ones for which it answers; with `BROADCAST`
    among them it also answers requests to all components.
    """

    def __init__(self, system_id: int, components: Sequence[int] = VEHICLE) -> None:
        self.faults: Counter[str] = Counter()
        """Frames dropped, by reason."""
        self.verifier: Verifier | None = None
        """Checks signatures; with one, an unsigned client may only read."""
        self._system_id = system_id
        self._targets = frozenset(components)
        self._own = (system_id, components[0])
        self._mav: Any = mavlink.MAVLink(None)

    def read(self, incoming: Incoming, now_us: int) -> Request | None:
        """Decode one whole frame; None if it is damaged, unknown, or for others."""
        frame = incoming.frame
        message = self._decode(frame)
        if isinstance(message, str):
            self.faults[message] += 1
            return None
        if not self._is_for_us(message):
            return None
        allowed, reason = incoming.trusted, "" if incoming.trusted else NOT_TRUSTED
        is_rejected = False
        if self.verifier is not None:
            signed = frame[0] == START_V2 and frame[2] & SIGNED
            if signed and (rejection := self.verifier.rejection(frame, now_us)):
                self.faults[BAD_SIGNATURE] += 1
                allowed, reason, is_rejected = False, rejection, True
            if allowed and not signed:
                allowed, reason = False, NOT_SIGNED
        sender = (message.get_srcSystem(), message.get_srcComponent())
        return Request(incoming.client_id, *sender, message, allowed, reason, is_rejected)

    def _decode(self, frame: bytes) -> Any:
        """Decode a frame, or return its fault."""
        # A frame with an unknown incompatibility flag must be discarded.
        if not frame or (frame[0] == START_V2 and frame[2:] and frame[2] & ~SIGNED):
            return "malformed"
        try:
            message = self._mav.decode(bytearray(frame))
        except mavlink.MAVError:
            return "broken"
        if message.get_type().startswith("UNKNOWN"):
            return "unknown"
        # Only the pair of ids is ours: a companion computer shares the system id of its vehicle.
        sender = (message.get_srcSystem(), message.get_srcComponent())
        if sender == self._own:
            return "own id"
        return message

    def _is_for_us(self, message: Any) -> bool:
        system = getattr(message, "target_system", BROADCAST)
        component = getattr(message, "target_component", BROADCAST)
        return component in self._targets and system in (BROADCAST, self._system_id)
