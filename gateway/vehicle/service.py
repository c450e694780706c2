"""A client's request, its answers, and the interface of the services that answer."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import ClientInterval, Outgoing
from gateway.sensing.calibration import NodeCalibration
from gateway.settings import Settings
from gateway.vehicle.plan import StoredPlan

CRITICAL: Final = mavlink.MAV_SEVERITY_CRITICAL
WARNING: Final = mavlink.MAV_SEVERITY_WARNING
NOTICE: Final = mavlink.MAV_SEVERITY_NOTICE
INFO: Final = mavlink.MAV_SEVERITY_INFO
BATCH: Final = 10
BATCH_INTERVAL_US: Final = 10_000
"""Size and interval of batches, for all transfers of a service together."""
MAX_TRANSFERS: Final = 512


class Reply(msgspec.Struct, frozen=True, gc=False):
    """A message before it is encoded: to the client that requested it, or to all."""

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
    reason: str = ""
    """The reason why it may not, with the remedy."""
    is_rejected: bool = False
    """Whether its signature is wrong, so that it is not handled at all."""

    def reply(self, message: Any) -> Reply:
        """Answer the client that sent the request."""
        return Reply(message, self.client_id)


@dataclass(frozen=True, slots=True)
class StatusText:
    """A text and its severity."""

    severity: int
    text: str


@dataclass(frozen=True, slots=True)
class SettingsChange:
    """A new, checked value of a section of this vehicle's settings, to be applied at once."""

    section: str
    """Key of the section, as it was given to the vehicle."""
    settings: Settings


@dataclass(frozen=True, slots=True)
class SaveSettings:
    """Store the differences to the settings file, and report the outcome to the vehicle."""

    vehicle_id: int
    request: Request
    """The request that waits for the outcome."""


@dataclass(frozen=True, slots=True)
class SavePlan:
    """Store missions, mark and home for the next start."""

    vehicle_id: int
    plan: StoredPlan


@dataclass(frozen=True, slots=True)
class RecordingRequest:
    """Start or stop the recording."""

    start: bool


@dataclass(frozen=True, slots=True)
class LogWarning:
    """Write a line to the log."""

    text: str


@dataclass(frozen=True, slots=True)
class CalibrationMeasured:
    """A calibration of the calibrated samples, to be combined with that of the aircraft."""

    correction: NodeCalibration
    """Calibration in body axes; see `gateway.sensing.calibrating.corrected_by`."""


Action = (
    Outgoing
    | ClientInterval
    | SettingsChange
    | SaveSettings
    | SavePlan
    | RecordingRequest
    | LogWarning
    | CalibrationMeasured
)
Answer = Reply | Action


class Service:
    """One group of requests; by default it changes nothing and sends nothing by itself."""

    types: tuple[str, ...] = ()
    """Names of the messages that it handles."""

    def changes_state(self, _request: Request) -> bool:
        """Return whether only a trusted client may send this request."""
        return False

    def handle(self, _request: Request, _now_us: int) -> list[Answer]:
        """Answer a request."""
        return []

    def refuse(self, _request: Request, _result: int) -> list[Answer]:
        """Answer a client that may not send this request; the result is a command's."""
        return []

    def poll(self, _now_us: int) -> list[Answer]:
        """Return the answers that are due."""
        return []

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to do."""
        return None

    def remove_client(self, client_id: int) -> None:
        """Discard the state of a client that has gone."""


class TransferService(Service):
    """A service that sends lists and files in batches of a few answers, each transfer in turn.

    That bounds the load of the gateway, and overflows neither a receive buffer nor a slow link.
    """

    def __init__(self) -> None:
        self._transfers: dict[int, Iterator[Answer]] = {}
        """Remaining answers of each transfer; the first transfer is the next one to continue."""
        self._due_us = 0

    def poll(self, now_us: int) -> list[Answer]:
        """Return the next answers of the transfers."""
        found: list[Answer] = []
        if not self._transfers or now_us < self._due_us:
            return found
        while self._transfers and len(found) < BATCH:
            key = next(iter(self._transfers))
            answers = self._transfers.pop(key)
            if (answer := next(answers, None)) is not None:
                found.append(answer)
                self._transfers[key] = answers
        self._due_us = now_us + BATCH_INTERVAL_US
        return found

    def next_due_us(self) -> int | None:
        """Return when `poll` has something to send."""
        return self._due_us if self._transfers else None

    def _start(self, key: int, answers: Iterator[Answer], now_us: int) -> list[Answer]:
        """Start a transfer, or start it again; return its first answers."""
        if key in self._transfers or len(self._transfers) < MAX_TRANSFERS:
            self._transfers[key] = answers
        return self.poll(now_us)
