"""The hub of a fleet: what was sent to a site ends here if a client brings it back."""

from collections.abc import Callable

from gateway.fleet.loop_watch import LoopWatch
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.transports.base import Client


class FleetHub(Hub):
    """A hub without vehicles of its own.

    Parameters
    ----------
    settings : HubSettings
        Where ground stations are.
    now_us : callable
        The gateway clock.
    loops : LoopWatch
        Knows what was sent to sites.
    """

    def __init__(self, settings: HubSettings, now_us: Callable[[], int], loops: LoopWatch) -> None:
        super().__init__(settings, lambda _: None, now_us)
        self._loops = loops
        self._deliver_new = self.deliver
        self.deliver = self._deliver_once

    def _deliver_once(self, client: Client, frame: bytes, now_us: int) -> None:
        # It bears an id of the site, which is another vehicle's here.
        if not self._loops.came_back(frame, now_us):
            self._deliver_new(client, frame, now_us)
