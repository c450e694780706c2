"""The MAVLink that is recorded, of all that the hub sends and receives.

A ground station's broadcast is both handled and forwarded: it is recorded once. Frames of untrusted
clients are recorded only if they had an effect, and those of each client within a quota. Messages
with a key or a password are not recorded.
"""

from collections.abc import Sequence
from typing import Final

from gateway.live.recorder import Recorder
from gateway.recordings.tlog import UNRECORDED
from gateway.records import RECORDED_ONLY, Incoming, Outgoing
from gateway.token_bucket import ClientQuotas
from gateway.wire.mavlink_messages import ids_of
from gateway.wire.mavlink_splitter import message_id_of

TRUSTED_RATE: Final = 64_000
"""Bytes a second for each trusted client: more than any ground station sends."""
UNTRUSTED_RATE: Final = 4_000
"""Bytes a second for all untrusted clients together."""
BURST_S: Final = 16
"""Size of a burst as time: a ground station requests much when it connects, then little."""
SECRET_MESSAGES: Final = ids_of("CHANGE_OPERATOR_CONTROL", "SETUP_SIGNING")
"""Messages that are not recorded: recordings are shared more easily than passwords."""


class RecordedTraffic:
    """Selects the frames that the recorder gets."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self.quotas = ClientQuotas(
            TRUSTED_RATE, TRUSTED_RATE * BURST_S, UNTRUSTED_RATE, UNTRUSTED_RATE * BURST_S
        )

    def received(self, incoming: Incoming, now_us: int, *, had_effect: bool) -> None:
        """Record a frame of a client to our vehicles."""
        bucket = self.quotas.of(incoming.client_id, now_us, trusted=incoming.trusted)
        is_kept = (incoming.trusted or had_effect) and not incoming.forwarded
        if is_kept and bucket.take(now_us, len(incoming.frame)):
            self.forwarded((incoming.frame,))

    def forwarded(self, frames: Sequence[bytes]) -> None:
        """Record frames of other senders, unless they contain a key or a password."""
        for frame in frames:
            if message_id_of(frame) not in SECRET_MESSAGES:
                self._recorder.frame(frame)

    def sent(self, outgoing: Outgoing, now_us: int) -> None:
        """Record a frame of ours; one to a single client within its quota."""
        to, frame = outgoing.client_id, outgoing.frame
        if outgoing.message_id in UNRECORDED:
            return
        if to is not None and to != RECORDED_ONLY:
            bucket = self.quotas.known(to) or self.quotas.shared
            if not bucket.take(now_us, len(frame)):
                return
        self._recorder.frame(frame)
