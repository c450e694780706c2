"""Print the settings file of the system service: the defaults, with the service's own folders."""

from pathlib import Path

from msgspec.structs import replace

from gateway.config import GatewaySettings, render

STATE = Path("/var/lib/mavgate")
"""StateDirectory of the unit, its only writable folder."""

default = GatewaySettings()
recording = replace(default.recording, folder=str(STATE / "recordings"))
settings = replace(default, aircraft_folder=str(STATE / "aircraft"), recording=recording)
print(render(settings), end="")
