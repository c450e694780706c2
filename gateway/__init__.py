"""mavgate: a MAVLink telemetry gateway for home-made UAV trackers.

The names that a program needs to run the stages by itself; each is imported at its first use:

    from gateway import AircraftSettings, Outputs, Pipeline, PipelineSettings
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from gateway.aircraft import Aircraft, AircraftSettings, Outputs
    from gateway.pipeline import Pipeline, PipelineSettings
    from gateway.records import (
        BaroRaw,
        FusedSample,
        GpsFix,
        ImuCalibrated,
        ImuRaw,
        Incoming,
        NavState,
        NodeId,
        Outgoing,
    )

__version__ = "0.1.0"

__all__ = [
    "Aircraft", "AircraftSettings", "BaroRaw", "FusedSample", "GpsFix", "ImuCalibrated", "ImuRaw",
    "Incoming", "NavState", "NodeId", "Outgoing", "Outputs", "Pipeline", "PipelineSettings",
    "__version__",
]  # fmt: skip
HOMES: Final = ("records", "aircraft", "pipeline")


def __getattr__(name: str) -> Any:
    """Import a name of the library at its first use."""
    for home in HOMES if name in __all__ else ():
        if found := getattr(import_module(f"gateway.{home}"), name, None):
            return found
    raise AttributeError(f"module 'gateway' has no attribute {name!r}")
