"""A site as one client of the hub here: its vehicles are heard behind it, under ids of ours."""

from collections.abc import Callable
from typing import Any, Final

from gateway.edges.hub.fleet_link.site_keys import in_key
from gateway.edges.hub.fleet_link.zenoh_session import PATIENT_IDS, Outlets
from gateway.fleet.frame_translation import FrameTranslation
from gateway.hub.endpoint import Endpoint
from gateway.hub.transports.base import Client
from gateway.units import US_PER_S
from gateway.wire.mavlink_splitter import SplitFault, key_of, split_datagram

NO_BROADCASTS: Final = frozenset({1 << 24})
"""No message has this number. One site's telemetry is none of another's: a site gets what addresses
its vehicles and what ground stations say to all."""


class SiteClient(Client):
    """One site; what moves frames is shared by all."""

    outlets: Callable[[], Outlets | None]
    translation: FrameTranslation
    tokens: set[str]
    """Its sessions that are there by Zenoh's liveliness; more than one are namesakes."""

    @property
    def is_here(self) -> bool:
        """Whether a session of it is there."""
        return bool(self.tokens)

    @property
    def has_fast_path(self) -> bool:
        """Whether it looks into `express` for what it has received."""
        return True

    def set_up(
        self, translation: FrameTranslation, outlets: Callable[[], Outlets | None]
    ) -> "SiteClient":
        """Give the site its ids and its way out."""
        self.tokens = set()
        self.translation = translation
        self.outlets = outlets
        self.become("connecting")
        return self

    def take(self, data: bytes, *, is_own: bool) -> None:
        """Take what the site has published; of its gateway's own vehicles, or of its clients."""
        now_us = self.context.now_us()
        if self.state != "open":
            self.become("open")
        for event in split_datagram(data):
            if isinstance(event, SplitFault):
                self.receive([event], event.size, now_us)
                continue
            frame = self.translation.from_site(event, now_us, is_own=is_own)
            if frame is None:
                continue
            if express := self.express.get(key_of(frame)):
                self.heard_us = now_us
                express.send(frame)
            else:
                self.receive([frame], len(frame), now_us)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Publish a frame for a vehicle of the site."""
        outlets = self.outlets()
        found = self.translation.to_site(frame, self.context.now_us())
        if outlets is None or found is None:
            self.counters.dropped += 1
            return
        system_id, changed = found
        key = in_key(self.endpoint.site, system_id)
        if outlets.publish(key, changed, patient=message_id in PATIENT_IDS):
            self.counters.sent += 1
            self.counters.bytes_sent += len(changed)
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
            "forged": counters.forged,
            "looped": counters.looped,
        }

    @property
    def queued(self) -> int:
        """Frames of all sites that wait for a congested link."""
        outlets = self.outlets()
        return 0 if outlets is None else outlets.queued


def site_endpoint(site: str) -> Endpoint:
    """Return the endpoint that stands for a site in tables."""
    place = f"site:{site}"
    return Endpoint(
        url=place,
        kind="site",
        host=site,
        port=0,
        place=place,
        name=site,
        allow=NO_BROADCASTS,
        trusted=True,
        site=site,
    )
