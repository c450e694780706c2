"""The one place where the stages meet: `wire → sensing → estimation → vehicle`.

    receiver's bytes ─ Link ─ raw records ─┬─ Aircraft 1: SensorChain ─ Estimator ─ Vehicle ─┐
                                           └─ Aircraft 2: …                                  │
    client's frames ──────────────────────────────────────────────────────────── Vehicle ────┤
                                                                                          actions

Pure: time is an argument, and what should happen outside comes back as a list of actions, in
order. An aircraft comes into being with its first payload. Live, demo and playback differ only in
who calls `feed` (bytes) or `take` (raw records of a recording).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from gateway.estimation.interface import Estimator
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import (
    BaroRaw,
    FusedSample,
    GpsFix,
    ImuRaw,
    Incoming,
    LinkReport,
    NavState,
    NodeStatus,
    RawRecord,
)
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensingSettings, SensorChain
from gateway.sensing.recalibration import (
    absorb_accel_error,
    absorb_gyro_error,
    absorb_mag_error,
    absorb_tilt,
)
from gateway.settings import Settings
from gateway.units import US_PER_S
from gateway.vehicle.actions import Action as VehicleAction
from gateway.vehicle.actions import CalibrationKind, CalibrationMeasured, SettingsChange
from gateway.vehicle.settings import VehicleSettings
from gateway.vehicle.vehicle import Vehicle
from gateway.wire.link import Link

REPORT_INTERVAL_US: Final = US_PER_S

Action = VehicleAction | FusedSample | BaroRaw | GpsFix
"""What the vehicles ask for, and what a recording keeps, in the order in which the estimator
took it. Changes of settings and calibration are carried out here already."""

ABSORB: Final = {
    CalibrationKind.GYRO: absorb_gyro_error,
    CalibrationKind.ACCEL: absorb_accel_error,
    CalibrationKind.LEVEL: absorb_tilt,
    CalibrationKind.MAG: absorb_mag_error,
}


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """The settings of all stages."""

    sensing: SensingSettings
    estimation: EstimationSettings
    vehicle: VehicleSettings
    calibrations: Mapping[int, NodeCalibration]
    """Calibration of the IMU node by vehicle id; an aircraft without one is taken as ideal."""
    unix_us_at_zero: int = 0
    """Unix time when the gateway clock was zero, for the time stamps of signed frames."""


class Aircraft:
    """The stages of one aircraft, from its raw records on."""

    def __init__(self, vehicle_id: int, settings: PipelineSettings) -> None:
        self.vehicle_id = vehicle_id
        self.state: NavState | None = None
        self._sensing = settings.sensing
        self._calibration = settings.calibrations.get(vehicle_id, NodeCalibration())
        self._chain = SensorChain(self._sensing, self._calibration)
        self._estimator: Estimator = make_estimator(settings.estimation)
        self.vehicle = Vehicle(
            settings.vehicle,
            vehicle_id,
            sections={
                "sensing": settings.sensing,
                "estimation": settings.estimation,
                "calibration": self._calibration,
            },
            unix_us_at_zero=settings.unix_us_at_zero,
        )

    def take(self, record: RawRecord, now_us: int) -> list[Action]:
        """Let one raw record run through the stages."""
        match record:
            case ImuRaw():
                return self._take_imu(record, now_us)
            case BaroRaw():
                baro = self._chain.baro(record)
                self._estimator.update_baro(baro)
                return [*self.vehicle.on_baro(baro, now_us), record]
            case GpsFix():
                self._estimator.update_gps(record)
                return [*self.vehicle.on_gps(record, now_us), record]
            case NodeStatus():
                return [*self.vehicle.on_node_status(record, now_us)]

    def _take_imu(self, raw: ImuRaw, now_us: int) -> list[Action]:
        sample = self._chain.imu(raw)
        self.state = self._estimator.update_imu(sample)
        fused = FusedSample(self.vehicle_id, raw, sample, self.state)
        # Frames first: nothing that is recorded may delay what is shown.
        told = self.vehicle.on_state(self.state, sample, now_us)
        return [*self._carry_out(told, now_us), fused]

    def handle(self, incoming: Incoming, now_us: int) -> list[Action]:
        """Let the vehicle answer a client's frame."""
        return self._carry_out(self.vehicle.handle(incoming, now_us), now_us)

    def poll(self, now_us: int) -> list[Action]:
        """Do what is due by time."""
        return self._carry_out(self.vehicle.poll(now_us), now_us)

    def _carry_out(self, actions: list[VehicleAction], now_us: int) -> list[Action]:
        """Take live what the vehicle wants changed; the rest is for others to do."""
        rest: list[Action] = []
        for action in actions:
            match action:
                case SettingsChange():
                    self._change(action.settings)
                case CalibrationMeasured():
                    self._change(ABSORB[action.kind](self._calibration, action.error_b))
                    rest += self.vehicle.take_settings("calibration", self._calibration, now_us)
                case _:
                    rest.append(action)
        return rest

    def _change(self, settings: Settings) -> None:
        match settings:
            case EstimationSettings():
                self._estimator = _succeed(self._estimator, make_estimator(settings))
            case SensingSettings():
                self._sensing = settings
            case NodeCalibration():
                self._calibration = settings
        if isinstance(settings, SensingSettings | NodeCalibration):
            self._chain = SensorChain(self._sensing, self._calibration)


def _succeed(old: Estimator, new: Estimator) -> Estimator:
    """Let a retuned estimator go on from the state of the one before, if it is of its kind."""
    state = getattr(old, "state", None)
    if state is not None and type(new) is type(old):
        new.state = state  # type: ignore[attr-defined]
    return new


class Pipeline:
    """Everything between the source's bytes and the clients' frames.

    Parameters
    ----------
    settings : PipelineSettings
        The settings of all stages.
    """

    def __init__(self, settings: PipelineSettings) -> None:
        self._settings = settings
        self._link = Link()
        self._connected = False
        self._port = ""
        self._report_due_us = 0
        self.aircraft: dict[int, Aircraft] = {}
        self.report: LinkReport = self._link.report(0, connected=False, port="")
        """The newest link report, renewed once a second."""

    def feed(self, data: bytes, now_us: int) -> list[Action]:
        """Take bytes of the receiver, read at `now_us`."""
        actions: list[Action] = []
        for record in self._link.feed(data, now_us):
            actions += self.take(record, now_us)
        return actions

    def take(self, record: RawRecord, now_us: int) -> list[Action]:
        """Take one raw record, from the link or from a recording."""
        vehicle_id = record.node.vehicle_id
        aircraft = self.aircraft.get(vehicle_id)
        if aircraft is None:
            aircraft = self.aircraft[vehicle_id] = Aircraft(vehicle_id, self._settings)
        return aircraft.take(record, now_us)

    def connect(self, port: str) -> None:
        """Note that the source was opened; what was half received is forgotten."""
        self._link.reopened()
        self._connected, self._port = True, port
        self._report_due_us = 0

    def disconnect(self, port: str) -> None:
        """Note that the source is gone."""
        self._connected, self._port = False, port
        self._report_due_us = 0

    def handle(self, incoming: Incoming, now_us: int) -> list[Action]:
        """Let every aircraft answer a client's frame if it is the one addressed."""
        actions: list[Action] = []
        for aircraft in self.aircraft.values():
            actions += aircraft.handle(incoming, now_us)
        return actions

    def poll(self, now_us: int) -> list[Action]:
        """Do what is due by time."""
        actions: list[Action] = []
        if now_us >= self._report_due_us:
            self._report_due_us = now_us + REPORT_INTERVAL_US
            self.report = self._link.report(now_us, connected=self._connected, port=self._port)
            for aircraft in self.aircraft.values():
                actions += aircraft.vehicle.on_link(self.report, now_us)
        for aircraft in self.aircraft.values():
            actions += aircraft.poll(now_us)
        return actions

    def next_due_us(self) -> int:
        """Tell when `poll` is to be called next, at the latest."""
        due = [aircraft.vehicle.next_due_us() for aircraft in self.aircraft.values()]
        return min([self._report_due_us, *due])
