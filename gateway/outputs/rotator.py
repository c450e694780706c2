"""Antenna rotators: GS-232 and EasyComm II on a serial line, and rotctld of Hamlib.

    rotator:serial:DEVICE:BAUD?protocol=gs232  rotator:tcp:HOST:4533?protocol=rotctld

Without a valid position the antenna is not moved.

References
----------
.. [1] Yaesu, "GS-232B Computer Control Interface", operating manual: the W command.
.. [2] Hamlib, rotctld(1): the P command.
"""

from collections.abc import Callable, Iterable
from typing import Final

from gateway.hub.endpoint import Endpoint, EndpointKind
from gateway.outputs.output import Output, station_of
from gateway.printable import unknown_choice
from gateway.vehicle_state.antenna import Pointing, pointing_of

MAX_ELEVATION_DEG: Final = 90.0


PROTOCOLS: Final[dict[str, Callable[[float, float], str]]] = {
    "gs232": lambda azimuth, elevation: f"W{round(azimuth) % 360:03d} {elevation:03.0f}\r",
    "easycomm": lambda azimuth, elevation: f"AZ{_tenths(azimuth)} EL{elevation:.1f}\n",
    "rotctld": lambda azimuth, elevation: f"P {_tenths(azimuth)} {elevation:.1f}\n",
}
"""Commands by protocol for azimuth and elevation in degrees."""


class RotatorOutput(Output):
    """Commands that point an antenna at a vehicle."""

    carriers = (EndpointKind.SERIAL, EndpointKind.TCP, EndpointKind.UDP)

    @classmethod
    def check(cls, endpoint: Endpoint) -> None:
        """Raise ValueError if the endpoint is invalid."""
        super().check(endpoint)
        protocol = endpoint.added.get("protocol", "gs232")
        if protocol not in PROTOCOLS:
            raise ValueError(unknown_choice("protocol", protocol, sorted(PROTOCOLS)))

    def compose(self, now_us: int) -> Iterable[bytes]:
        """Return the command for the present direction; empty if it is unknown."""
        state = self.chosen(now_us)
        if state is None:
            return []
        station = station_of(self.endpoint)
        pointing = pointing_of(station, state, self.vehicles.states, now_us)
        protocol = self.endpoint.added.get("protocol", "gs232")
        return [] if pointing is None else [command(protocol, pointing)]


def _tenths(azimuth_deg: float) -> str:
    return f"{round(azimuth_deg, 1) % 360.0:.1f}"


def command(protocol: str, pointing: Pointing) -> bytes:
    """Return the command in a protocol; an antenna is not pointed below the horizon."""
    elevation_deg = min(max(pointing.elevation_deg, 0.0), MAX_ELEVATION_DEG)
    return PROTOCOLS[protocol](pointing.azimuth_deg, elevation_deg).encode("ascii")
