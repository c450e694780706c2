"""What the gateway tells over its control socket, asked once a second for all pages."""

import asyncio
import logging
from contextlib import suppress
from typing import Any, Final

from gateway.edges.operator.control_socket import ControlError
from gateway.panel.control_client import ControlClient
from gateway.panel.state.fleet_picture import FleetPicture
from gateway.panel.state.instant import Spot
from gateway.records import NAN

log = logging.getLogger(__name__)

INTERVAL_S: Final = 1.0


class GatewayWatch:
    """The newest answers of the gateway on this machine.

    Parameters
    ----------
    control : ControlClient
        Asks it.
    fleet : FleetPicture
        Whose marks the gateway knows exactly; MAVLink rounds them.
    """

    def __init__(self, control: ControlClient, fleet: FleetPicture) -> None:
        self.status: dict[str, Any] | None = None
        """As the verb `status` answers; None while no gateway runs."""
        self.before: dict[str, Any] | None = None
        """The answer before it, to tell rates."""
        self.recorder: dict[str, Any] | None = None
        """As `record.status` answers."""
        self._control = control
        self._fleet = fleet
        self._task: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Begin to ask; needs a running event loop."""
        self._task = asyncio.get_running_loop().create_task(self._watch())

    def close(self) -> None:
        """Ask no more."""
        if self._task is not None:
            self._task.cancel()

    async def refresh(self) -> None:
        """Ask now."""
        try:
            status = await self._control.ask("status")
        except ControlError:
            self.status = self.before = self.recorder = None
            return
        self.before, self.status, self.recorder = self.status, status, status["recorder"]
        for aircraft in status["aircraft"]:
            vehicle = self._fleet.vehicles.get(aircraft["vehicle_id"])
            if vehicle is not None:
                vehicle.told_mark = _spot_of(aircraft["mark"])

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
