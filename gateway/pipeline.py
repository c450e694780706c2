"""The one place where the stages meet: `wire → sensing → estimation → vehicle`.

    receiver's bytes ─ Link ─ raw records ─┬─ Aircraft 1: SensorChain ─ Estimator ─ Vehicle ─┐
                                           └─ Aircraft 2: …                                  │
    client's frames ──────────────────────────────────────────────────────────── Vehicle ────┤
                                                                                          actions

Pure: time is an argument, and what should happen outside comes back as a list of actions, in
order. An aircraft comes into being with its first payload. Live, demo and playback differ only in
who calls `feed` (bytes) or `take` (raw records of a recording).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from gateway.estimation.interface import Estimator
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import (
    BaroRaw,
    FusedSample,
    GpsFix,
    ImuCalibrated,
    ImuRaw,
    ImuSample,
    Incoming,
    LinkReport,
    NavState,
    NodeStatus,
    Outgoing,
    RawRecord,
)
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensingSettings, SensorChain
from gateway.units import US_PER_S
from gateway.vehicle.settings import VehicleSettings
from gateway.vehicle.vehicle import Vehicle
from gateway.wire.link import Link

REPORT_INTERVAL_US: Final = US_PER_S

Action = Outgoing | FusedSample | BaroRaw | GpsFix
"""Frames to send, and what a recording keeps, in the order in which the estimator took it."""


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """The settings of all stages."""

    sensing: SensingSettings
    estimation: EstimationSettings
    vehicle: VehicleSettings
    calibrations: Mapping[int, NodeCalibration]
    """Calibration of the IMU node by vehicle id; an aircraft without one is taken as ideal."""
    correct: Callable[[NavState], NavState] | None = None
    """Changes the states before they are told: for a playback that knows what comes."""


class Aircraft:
    """The stages of one aircraft, from its raw records on."""

    def __init__(self, vehicle_id: int, settings: PipelineSettings) -> None:
        calibration = settings.calibrations.get(vehicle_id, NodeCalibration())
        self.vehicle_id = vehicle_id
        self.state: NavState | None = None
        self.vehicle = Vehicle(settings.vehicle, vehicle_id)
        self._chain = SensorChain(settings.sensing, calibration)
        self._estimator: Estimator = make_estimator(settings.estimation)
        self._correct = settings.correct

    def take(self, record: RawRecord | ImuCalibrated, now_us: int) -> list[Action]:
        """Let one raw record run through the stages."""
        match record:
            case ImuRaw():
                return self._take_imu(record, self._chain.imu(record), now_us)
            case ImuCalibrated():
                return self._take_imu(None, self._filter(record), now_us)
            case BaroRaw():
                baro = self._chain.baro(record)
                self._estimator.update_baro(baro)
                return [*self.vehicle.on_baro(baro, now_us), record]
            case GpsFix():
                self._estimator.update_gps(record)
                return [*self.vehicle.on_gps(record, now_us), record]
            case NodeStatus():
                return [*self.vehicle.on_node_status(record, now_us)]

    def _filter(self, imu: ImuCalibrated) -> ImuSample:
        return self._chain.imu_si(
            imu.time_us,
            imu.accel_b_mps2,
            imu.gyro_b_radps,
            imu.mag_b_ut,
            imu.temperature_degc,
            imu.flags,
        )

    def _take_imu(self, raw: ImuRaw | None, sample: ImuSample, now_us: int) -> list[Action]:
        state = self._estimator.update_imu(sample)
        self.state = state if self._correct is None else self._correct(state)
        fused = FusedSample(self.vehicle_id, raw, sample, self.state)
        # Frames first: nothing that is recorded may delay what is shown.
        return [*self.vehicle.on_state(self.state, sample, now_us), fused]


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

    def take(self, record: RawRecord | ImuCalibrated, now_us: int) -> list[Action]:
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
        return []

    def poll(self, now_us: int) -> list[Action]:
        """Do what is due by time."""
        actions: list[Action] = []
        if now_us >= self._report_due_us:
            self._report_due_us = now_us + REPORT_INTERVAL_US
            self.report = self._link.report(now_us, connected=self._connected, port=self._port)
            for aircraft in self.aircraft.values():
                actions += aircraft.vehicle.on_link(self.report, now_us)
        for aircraft in self.aircraft.values():
            actions += aircraft.vehicle.poll(now_us)
        return actions

    def next_due_us(self) -> int:
        """Tell when `poll` is to be called next, at the latest."""
        due = [aircraft.vehicle.next_due_us() for aircraft in self.aircraft.values()]
        return min([self._report_due_us, *due])
