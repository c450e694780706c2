"""Cache of the answers of foreign vehicles on slow links, for further ground stations.

The first station loads parameters, missions and metadata over the link; the answers that pass are
kept, and further stations are answered from them. For a vehicle that signs, this requires that the
gateway has its key: requests must be signed with it, and the answers are signed with it too.

Answers are kept for each link separately, since two links may lead to two vehicles with one id.
Those of a link that has gone are used again when the vehicle returns to the same endpoint.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.answers.cached_vehicle import CachedVehicle
from gateway.answers.live_answers import HASH_NAME, NOTED_IDS, PARAMETERS, LiveAnswers
from gateway.records import Incoming, Outgoing
from gateway.units import US_PER_S
from gateway.vehicle.plan import KINDS
from gateway.vehicle.service import Request
from gateway.vehicle_state.senders import AUTOPILOT
from gateway.wire.frame_editing import edit_frame
from gateway.wire.mavlink_signing import FrameSigner
from gateway.wire.mavlink_splitter import MavFrame, frame_of

MAX_VEHICLES: Final = 16
"""Vehicles of `MAX_BYTES` each; the one received longest ago is removed for a new one."""
CHECK_US: Final = 10 * US_PER_S
"""Timeout of the vehicle's answer to a checksum request; slow links delay it by seconds."""


@dataclass(slots=True)
class _Entry:
    """The kept answers of one vehicle."""

    endpoint: str
    live: LiveAnswers
    vehicle: CachedVehicle
    heard_us: int = 0
    key: bytes | None = b""
    """Key with which it signs: empty if it does not sign, None if the gateway lacks the key."""
    checked: tuple[int, int, MavFrame] | None = None
    """Set while the checksum of an answered list is requested: time, client, original request."""


class AnswerCache:
    """The kept answers of all vehicles by link and system id.

    A link is the client that leads to the vehicle, or the endpoint of one that has gone.
    """

    def __init__(self, signer: FrameSigner) -> None:
        self._signer = signer
        self._entries: dict[tuple[int | str, int], _Entry] = {}

    @staticmethod
    def reads(message_id: int) -> bool:
        """Return whether this cache evaluates a message without a target."""
        return message_id in NOTED_IDS

    def add(self, link: int, endpoint: str, frame: MavFrame, now_us: int) -> MavFrame | None:
        """Process a frame of a vehicle; return a request that must still be sent to it.

        `endpoint` is the location of its link's endpoint.
        """
        system, component = frame.origin
        if component != AUTOPILOT:
            known = self._entries.get((link, system))
            if known is not None and frame.message_id == mavlink.MAVLINK_MSG_ID_PARAM_VALUE:
                known.vehicle.other_lists = True
            return None
        entry = self._entry(link, endpoint, system)
        key = self._signer.key_of(frame) if frame.signed else b""
        if key != entry.key:
            # The kept answers were not signed with this key, so anybody could have sent them.
            entry.live.clear()
            entry.key = key
        entry.heard_us = now_us
        had = entry.live.missing
        entry.live.add(frame, now_us)
        if entry.checked is not None and had is not None and entry.live.missing is None:
            (since_us, client_id, request), entry.checked = entry.checked, None
            entry.vehicle.remove_client(client_id)
            return request if now_us - since_us <= CHECK_US else None
        return None

    def handle(
        self,
        client_id: int,
        frame: MavFrame,
        now_us: int,
        links: Sequence[int],
        *,
        may_answer: bool,
    ) -> tuple[list[Outgoing], MavFrame | None]:
        """Answer a station's request, or note the values that it writes.

        `links` lead to the vehicle; the first that can answer does. Returns the answers, and the
        frame to be sent to the vehicle, if any.
        """
        known = (self._entries.get((link, frame.target[0])) for link in links)
        entries = [entry for entry in known if entry is not None]
        incoming = Incoming(client_id, frame.data, trusted=True)
        requests = [entry.vehicle.read(incoming, now_us) for entry in entries]
        for entry, request in zip(entries, requests, strict=True):
            is_usable = may_answer and self._fits(entry, frame) and entry.live.is_fresh(now_us)
            if request is None or not is_usable:
                continue
            answers = entry.vehicle.answer(request, now_us)
            if answers is not None:
                passed = self._check(entry, request, frame, now_us)
                return [self._sealed(entry, each, now_us) for each in answers], passed
        for entry, request in zip(entries, requests, strict=True):
            if request is not None:
                entry.live.add_request(client_id, request.message, frame, now_us)
        return [], frame

    def asker(self, link: int, frame: MavFrame) -> int | None:
        """Return the client whose request for a file a frame answers; None if that is not certain.

        Stations that share an id are sent each other's answers otherwise.
        """
        entry = self._entries.get((link, frame.origin[0]))
        return entry.live.asker(frame) if entry is not None else None

    def poll(self, now_us: int) -> list[Outgoing]:
        """Return the next answer of every list and file transfer in progress."""
        return [
            self._sealed(entry, each, now_us)
            for entry in self._entries.values()
            for each in entry.vehicle.poll(now_us)
            if isinstance(each, Outgoing)
        ]

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        due = (entry.vehicle.next_due_us() for entry in self._entries.values())
        return min((time_us for time_us in due if time_us is not None), default=None)

    def drop(self, link: int) -> None:
        """Drop all answers of a link, as after a change of its options."""
        for at, system in [*self._entries]:
            if at == link:
                del self._entries[at, system]

    def remove_client(self, client_id: int) -> None:
        """Drop the downloads of a client that has gone; keep the answers that it brought."""
        for (link, system), entry in [*self._entries.items()]:
            entry.vehicle.remove_client(client_id)
            entry.live.remove_client(client_id)
            if link == client_id:
                del self._entries[link, system]
                self._entries[entry.endpoint, system] = entry

    def describe(self, link: int, system: int, now_us: int) -> str:
        """List the kept answers of a vehicle with the age of each part; empty if there are none."""
        entry = self._entries.get((link, system))
        if entry is None or not entry.live.since_us:
            return ""
        live = entry.live
        counts = {PARAMETERS: len(live.parameters()), "files": len(live.files)}
        counts |= {name: len(live.mission(kind) or ()) for kind, name in KINDS.items()}
        parts = (
            f"{name}{f' ({counts[name]})' if name in counts else ''} "
            f"{(now_us - since_us) // US_PER_S} s"
            for name, since_us in live.since_us.items()
        )
        return f"system {system}: {', '.join(parts)}"

    def _entry(self, link: int, endpoint: str, system: int) -> _Entry:
        entry = self._entries.get((link, system))
        if entry is None:
            entry = self._entries.pop((endpoint, system), None)
            if len(self._entries) >= MAX_VEHICLES:
                del self._entries[min(self._entries, key=lambda each: self._entries[each].heard_us)]
            if entry is None:
                live = LiveAnswers(system)
                entry = _Entry(endpoint, live, CachedVehicle(system, live))
            self._entries[link, system] = entry
        return entry

    def _fits(self, entry: _Entry, request: MavFrame) -> bool:
        """Return whether a request is signed with the vehicle's key, or both are unsigned."""
        return entry.key is not None and entry.key == (
            self._signer.key_of(request) if request.signed else b""
        )

    def _check(
        self, entry: _Entry, request: Request, frame: MavFrame, now_us: int
    ) -> MavFrame | None:
        """Return a checksum request to send instead of a list request, if the checksum is known."""
        is_list = request.message.get_type() == "PARAM_REQUEST_LIST"
        if not is_list or entry.live.hash_frame is None or frame.signed:
            return None
        entry.checked = now_us, request.client_id, frame
        message = mavlink.MAVLink_param_request_read_message(
            frame.target[0], AUTOPILOT, HASH_NAME.encode(), -1
        )
        sender = mavlink.MAVLink(None, *frame.origin)
        sender.seq = frame.sequence
        return frame_of(bytes(message.pack(sender)))

    def _sealed(self, entry: _Entry, answer: Outgoing, now_us: int) -> Outgoing:
        """Sign an answer if the vehicle signs."""
        frame = edit_frame(frame_of(answer.frame), drop_signature=True)
        assert frame is not None
        if entry.key:
            frame = self._signer.signed(frame, entry.key, now_us)
        return Outgoing(frame.data, answer.message_id, answer.client_id, frame)
