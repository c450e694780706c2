"""The gateway's status over its control socket, polled once a second for all pages."""

import asyncio
from contextlib import suppress
from typing import Any, Final

from gateway.live.control_socket import ControlError
from gateway.panel.control_client import ControlClient
from gateway.panel.state.fleet_picture import FleetPicture
from gateway.panel.state.instant import Spot
from gateway.records import NAN

INTERVAL_S: Final = 1.0


class GatewayWatch:
    """The newest answers of the gateway on this machine.

    Parameters
    ----------
    control : ControlClient
        Sends the requests.
    fleet : FleetPicture
        Gets the gateway's exact marks; MAVLink rounds them.
    """

    def __init__(self, control: ControlClient, fleet: FleetPicture) -> None:
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
