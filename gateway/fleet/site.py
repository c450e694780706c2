"""A site as one client of the fleet's hub, with its vehicles behind it under ids of this side."""

from collections.abc import Callable
from typing import Any, Final

from gateway.fleet.frame_translation import FrameTranslation
from gateway.hub.endpoint import SITE_NAME, Endpoint
from gateway.hub.transports.base import Client
from gateway.hub.transports.zenoh.keys import in_key
from gateway.hub.transports.zenoh.session import RELIABLE_IDS, Payload, Publishers
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import MavFrame, SplitFault, split_datagram

NO_BROADCASTS: Final = frozenset({1 << 24})
"""No message has this number. No site receives the telemetry of another: it gets frames addressed
to its vehicles, and broadcasts of ground stations."""
MAX_SESSIONS: Final = 16
"""Sessions under the name of one site that are remembered; more are forged."""


class SiteClient(Client):
    """One site of the fleet."""

    publishers: Callable[[], Publishers | None]
    translation: FrameTranslation
    tokens: set[str]
    """Its sessions by Zenoh's liveliness; more than one are sites of the same name."""

    @property
    def is_here(self) -> bool:
        """Whether a session of it is present."""
        return bool(self.tokens)

    may_return = False

    def set_up(
        self, translation: FrameTranslation, publishers: Callable[[], Publishers | None]
    ) -> "SiteClient":
        """Set the translation of its frames, and where frames for it are published."""
        self.tokens = set()
        self.translation = translation
        self.publishers = publishers
        self.become("connecting")
        return self

    def handle_presence(self, token: str, is_here: bool) -> bool:
        """Update its sessions; return whether the site has appeared or disappeared."""
        was_here = self.is_here
        if not is_here:
            self.tokens.discard(token)
        elif len(self.tokens) < MAX_SESSIONS and SITE_NAME.fullmatch(token):
            self.tokens.add(token)
        return self.is_here != was_here

    def handle(self, payload: Payload, *, is_own: bool) -> None:
        """Handle a published message, of the gateway's own vehicles or of its clients."""
        data, size = payload
        now_us = self.context.now_us()
        if not data:
            self.counters.bytes_received += size
            self.counters.bytes_garbage += size
            return
        if self.state != "open":
            self.become("open")
        for event in split_datagram(data):
            if isinstance(event, SplitFault):
                self.receive([event], event.size, now_us)
                continue
            frame = self.translation.from_site(event, now_us, is_own=is_own)
            if frame is not None:
                self.receive([frame], len(frame.data), now_us)

    def transmit(self, frame: MavFrame) -> None:
        """Publish a frame for a vehicle of the site."""
        publishers = self.publishers()
        found = self.translation.to_site(frame, self.context.now_us())
        if publishers is None or found is None:
            self.counters.dropped += 1
            return
        system_id, changed = found
        key = in_key(self.endpoint.site, system_id)
        if publishers.publish(key, changed.data, reliable=frame.message_id in RELIABLE_IDS):
            self.counters.sent += 1
            self.counters.bytes_sent += len(changed.data)
        else:
            self.counters.dropped += 1

    def describe(self, now_us: int) -> dict[str, Any]:
        """Return the site and its vehicles as they are now."""
        round_trip_us, counters = self.round_trip_us, self.translation.counters
        return {
            "name": self.endpoint.site,
            "is_here": self.is_here,
            "sessions": len(self.tokens),
            "round_trip_s": None if round_trip_us is None else round_trip_us / US_PER_S,
            "vehicles": [
                {
                    "system_id": system_id,
                    "id": self.translation.id_of(system_id),
                    "rate_hz": traffic.rate_hz(now_us),
                    "age_s": (now_us - traffic.heard_us) / US_PER_S,
                    "frames": traffic.frames,
                    "lost": traffic.lost,
                }
                for system_id, traffic in sorted(self.translation.traffic.items())
            ],
            "sent": self.counters.sent,
            "dropped": self.counters.dropped,
            "bytes_garbage": self.counters.bytes_garbage,
            "unknown": counters.unknown,
            "signed": counters.signed,
            "unsigned": counters.unsigned,
            "forged": counters.forged,
            "replayed": counters.replayed,
            "looped": counters.looped,
        }

    @property
    def queued(self) -> int:
        """Frames of all sites that wait for a congested link."""
        publishers = self.publishers()
        return 0 if publishers is None else publishers.queued


def site_endpoint(site: str) -> Endpoint:
    """Return the endpoint that stands for a site in tables."""
    place = f"site:{site}"
    return Endpoint(
        url=place,
        kind="site",
        host=site,
        port=0,
        location=place,
        name=site,
        allow=NO_BROADCASTS,
        trusted=True,
        site=site,
    )
