"""The gateway on this machine: requests to its control socket, and its status once a second."""

import asyncio
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from gateway.live.control_socket import ControlError, find_socket, request
from gateway.panel.state.fleet import FleetState
from gateway.panel.state.vehicle import Spot
from gateway.records import NAN

READING: Final = frozenset(
    {"status", "verbs", "clients.list", "record.status", "record.list", "play.status"}
)
"""Verbs that a viewer may use: they change nothing."""


class ControlClient:
    """Send requests to a running gateway (or player)."""

    def __init__(self, path: Path | None) -> None:
        self.path = path

    async def ask(self, verb: str, **params: Any) -> Any:
        """Send a request, and return the result, decoded from JSON.

        Raises ControlError if no gateway listens, or the request is refused.
        """
        return await asyncio.to_thread(self._ask, verb, params)

    def _ask(self, verb: str, params: dict[str, Any]) -> Any:
        return request(self.path or find_socket("run"), verb, params)


INTERVAL_S: Final = 1.0


class GatewayWatch:
    """The newest answers of the gateway on this machine."""

    def __init__(self, control: ControlClient, fleet: FleetState) -> None:
        self.status: dict[str, Any] | None = None
        """Result of the verb `status`; None while no gateway runs."""
        self.before: dict[str, Any] | None = None
        """The result before it, to compute rates."""
        self.recorder: dict[str, Any] | None = None
        """Result of `record.status`."""
        self._control = control
        self._fleet = fleet
        self._task: asyncio.Task[None] | None = None
        self._asking = asyncio.Lock()
        """An answer to an earlier question must not come after that to a later one."""

    def start(self) -> None:
        """Start polling; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._watch())

    def close(self) -> None:
        """Stop polling."""
        if self._task is not None:
            self._task.cancel()

    async def refresh(self) -> None:
        """Poll now; what is known then is not older than the call."""
        async with self._asking:
            await self._refresh()

    async def _refresh(self) -> None:
        try:
            status = await self._control.ask("status")
        except ControlError:
            self.status = self.before = self.recorder = None
            return
        self.before, self.status, self.recorder = self.status, status, status["recorder"]
        for aircraft in status["aircraft"]:
            vehicle = self._fleet.vehicles.get(aircraft["vehicle_id"])
            if vehicle is not None:
                vehicle.exact_mark = _spot_of(aircraft["mark"])

    async def _watch(self) -> None:
        while True:
            with suppress(OSError):
                await self.refresh()
            await asyncio.sleep(INTERVAL_S)


def _spot_of(mark: dict[str, Any] | None) -> Spot | None:
    if mark is None:
        return None
    alt_amsl_m = NAN if mark["alt_amsl_m"] is None else mark["alt_amsl_m"]
    return Spot(mark["lat_deg"], mark["lon_deg"], alt_amsl_m)
