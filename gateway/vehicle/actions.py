"""What the vehicle asks of the rest of the gateway; the pipeline carries it out."""

from dataclasses import dataclass
from enum import StrEnum
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval, Outgoing
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Settings
from gateway.vehicle.plan import StoredPlan


class Reply(msgspec.Struct, frozen=True, gc=False):
    """A message before it is encoded: to the client that asked, or to all."""

    message: Any
    client_id: int | None = None


@dataclass(frozen=True, slots=True)
class Request:
    """One checked message of a client to this vehicle."""

    client_id: int
    system_id: int
    component_id: int
    message: Any
    may_change: bool
    """Whether the client may change state: trusted, and signed where a key is set."""

    def reply(self, message: Any) -> Reply:
        """Answer the client that asked."""
        return Reply(message, self.client_id)


CRITICAL: Final = mavlink.MAV_SEVERITY_CRITICAL
WARNING: Final = mavlink.MAV_SEVERITY_WARNING
NOTICE: Final = mavlink.MAV_SEVERITY_NOTICE
INFO: Final = mavlink.MAV_SEVERITY_INFO


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text and its severity."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class SettingsChange:
    """A section of this vehicle's settings has a new, already checked value: apply it live."""

    vehicle_id: int
    section: str
    """Key of the section, as it was given to the vehicle."""
    settings: Settings
    """The whole section with the change in it."""
    path: str
    """What changed, as dotted keys below the section; empty if all of it."""


@dataclass(frozen=True, slots=True)
class SaveSettings:
    """Store what differs from the settings file, and report the outcome to the vehicle."""

    vehicle_id: int
    request: Request
    """Who waits for the outcome."""


@dataclass(frozen=True, slots=True)
class SavePlan:
    """Keep missions, mark and home for the next start."""

    vehicle_id: int
    plan: StoredPlan


@dataclass(frozen=True, slots=True)
class RecordingRequest:
    """Start or stop the recording."""

    start: bool


class CalibrationKind(StrEnum):
    """The sensor error that was measured."""

    GYRO = "gyro"
    ACCEL = "accel"
    LEVEL = "level"
    MAG = "mag"


@dataclass(frozen=True, slots=True)
class CalibrationMeasured:
    """A calibration of the calibrated samples, which the aircraft's own is then joined with."""

    vehicle_id: int
    kind: CalibrationKind
    correction: NodeCalibration
    """In body axes; see `gateway.sensing.calibrating.corrected_by`."""


Action = (
    Outgoing
    | ClientInterval
    | SettingsChange
    | SaveSettings
    | SavePlan
    | RecordingRequest
    | CalibrationMeasured
)

Answer = Reply | Action
