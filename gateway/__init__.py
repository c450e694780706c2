"""mavgate: a MAVLink telemetry gateway for home-made UAV trackers.

The names that a program needs to run the stages by itself; each is imported at its first use:

    from gateway import AircraftSettings, Outputs, Pipeline, PipelineSettings
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from gateway.aircraft import Aircraft as Aircraft
    from gateway.aircraft import AircraftSettings as AircraftSettings
    from gateway.aircraft import Outputs as Outputs
    from gateway.pipeline import Pipeline as Pipeline
    from gateway.pipeline import PipelineSettings as PipelineSettings
    from gateway.records import BaroRaw as BaroRaw
    from gateway.records import FusedSample as FusedSample
    from gateway.records import GpsFix as GpsFix
    from gateway.records import ImuCalibrated as ImuCalibrated
    from gateway.records import ImuRaw as ImuRaw
    from gateway.records import Incoming as Incoming
    from gateway.records import NavState as NavState
    from gateway.records import NodeId as NodeId
    from gateway.records import Outgoing as Outgoing

__version__ = "0.1.0"

_HOMES: Final = {
    "aircraft": ("Aircraft", "AircraftSettings", "Outputs"),
    "pipeline": ("Pipeline", "PipelineSettings"),
    "records": (
        "BaroRaw", "FusedSample", "GpsFix", "ImuCalibrated", "ImuRaw", "Incoming", "NavState",
        "NodeId", "Outgoing",
    ),
}  # fmt: skip
_MODULE_OF: Final = {name: module for module, names in _HOMES.items() for name in names}

__all__ = ["__version__", *_MODULE_OF]


def __getattr__(name: str) -> Any:
    """Import a name of the library at its first use."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'gateway' has no attribute {name!r}")
    return getattr(import_module(f"gateway.{_MODULE_OF[name]}"), name)
