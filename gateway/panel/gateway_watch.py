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
            self.recorder = await self._control.ask("record.status")
        except ControlError:
            self.status = self.before = self.recorder = None
            return
        self.before, self.status = self.status, status
        marks = {
            system_id: Spot(lat_deg, lon_deg, NAN if alt_amsl_m is None else alt_amsl_m)
            for system_id, lat_deg, lon_deg, alt_amsl_m in status["marks"]
        }
        for system_id, vehicle in self._fleet.vehicles.items():
            if system_id in marks or any(system_id == key for key, _ in status["states"]):
                vehicle.told_mark = marks.get(system_id)

    async def _watch(self) -> None:
        while True:
            with suppress(OSError):
                await self.refresh()
            await asyncio.sleep(INTERVAL_S)
