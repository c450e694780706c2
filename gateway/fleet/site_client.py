"""A site as one client of the hub here: its vehicles are heard behind it, under ids of ours."""

from collections.abc import Callable
from typing import Final

from gateway.edges.hub.client import Client
from gateway.edges.hub.fleet_link.site_keys import in_key
from gateway.edges.hub.fleet_link.zenoh_session import PATIENT_IDS, Outlets
from gateway.fleet.frame_translation import FrameTranslation
from gateway.routing.endpoint import Endpoint
from gateway.wire.mavlink_splitter import SplitFault, split_datagram

NO_BROADCASTS: Final = frozenset({1 << 24})
"""No message has this number. One site's telemetry is none of another's: a site gets what addresses
its vehicles and what ground stations say to all."""


class SiteClient(Client):
    """One site; what moves frames is shared by all."""

    outlets: Callable[[], Outlets | None]
    translation: FrameTranslation
    is_here: bool = False
    """Whether its liveliness token is there."""

    def set_up(
        self, translation: FrameTranslation, outlets: Callable[[], Outlets | None]
    ) -> "SiteClient":
        """Give the site its ids and its way out."""
        self.translation = translation
        self.outlets = outlets
        self.become("connecting")
        return self

    def take(self, data: bytes) -> None:
        """Take what the site has published."""
        now_us = self.context.now_us()
        events: list[bytes | SplitFault] = []
        for event in split_datagram(data):
            if isinstance(event, SplitFault):
                events.append(event)
            elif (frame := self.translation.from_site(event, now_us)) is not None:
                events.append(frame)
        if self.state != "open":
            self.become("open")
        self.receive(events, len(data), now_us)

    def transmit(self, frame: bytes, message_id: int) -> None:
        """Publish a frame for a vehicle of the site."""
        outlets = self.outlets()
        found = self.translation.to_site(frame)
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
