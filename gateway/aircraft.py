"""One aircraft: `sensing → estimation → vehicle`, and changes of their settings in operation.

Pure: time is an argument, and results are added to the `Outputs` that the caller passes.
"""

import zlib
from collections import deque
from collections.abc import Iterable
from dataclasses import astuple, dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway import __version__
from gateway.estimation.columns import nav_state
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.select import EstimationSettings, Estimator, make_estimator
from gateway.records import (
    BaroRaw,
    BaroSample,
    ClientInterval,
    FusedSample,
    FusionState,
    GpsFix,
    ImuCalibrated,
    ImuRaw,
    ImuSample,
    NavState,
    NodeStatus,
    Outgoing,
    RawRecord,
    VehicleReport,
)
from gateway.sensing.calibrating import corrected_by
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.settings import Settings
from gateway.vehicle.plan import Home, Location, StoredPlan
from gateway.vehicle.service import (
    WARNING,
    Action,
    CalibrationMeasured,
    LogWarning,
    RecordingRequest,
    SavePlan,
    SaveSettings,
    SettingsChange,
    StatusText,
)
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_signing import SigningClock, SigningTimestamps

Order = ClientInterval | LogWarning | RecordingRequest | SaveSettings | SavePlan


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """A change of settings, which applies to the samples after it."""

    vehicle_id: int


Recorded = FusedSample | BaroRaw | GpsFix | NodeStatus | SettingsChanged


class Outputs(msgspec.Struct):
    """Results of a call of the stages, by kind, each kind in its order."""

    frames: list[Outgoing] = []
    """Frames to send."""
    records: list[Recorded] = []
    """Records for the recording, in the order of the fusion."""
    orders: list[Order] = []
    """Requested message intervals of clients, files to write, and similar orders."""


class AircraftSettings(Settings, frozen=True):
    """The settings of one aircraft's stages; ground stations may change them as parameters."""

    vehicle: VehicleSettings = VehicleSettings()
    estimation: EstimationSettings = EstimationSettings()
    calibration: NodeCalibration = NodeCalibration()


class Aircraft:
    """The stages of one aircraft, which process its raw records.

    Its id is that in its nodes' frames, and its MAVLink system id. If a recording is played
    that was fused before, its states replace the estimator.
    """

    def __init__(
        self,
        vehicle_id: int,
        settings: AircraftSettings,
        *,
        clock: SigningClock | None = None,
        timestamps: SigningTimestamps | None = None,
        stored: StoredPlan | None = None,
        fused: "FusedStates | None" = None,
    ) -> None:
        self.vehicle_id = vehicle_id
        self.settings = settings
        self.state: NavState | None = None
        self.received_us: int | None = None
        """Time of arrival of the newest record."""
        sections = {name: getattr(settings, name) for name in ("estimation", "calibration")}
        self.vehicle = Vehicle(
            settings.vehicle,
            vehicle_id,
            sections=sections,
            clock=clock,
            timestamps=timestamps,
            stored=stored,
        )
        self.chain, self.estimator = make_fusion(settings)
        self._fused = fused
        if fused is not None:
            self.estimator = fused

    @property
    def fusion_state(self) -> FusionState:
        """State of the estimator, and home."""
        home = self.vehicle.telemetry.home
        return FusionState(
            vehicle_id=self.vehicle_id,
            fits=_fits(self.settings),
            estimation=self.estimator.snapshot(),
            home=None if home is None else (*astuple(home.location), home.set_time_us),
        )

    def restore(self, state: FusionState) -> None:
        """Restore a state, bit for bit; raises ValueError as `make_fusion`.

        Home is restored even if the state of the estimator cannot be.
        """
        if state.home is not None:
            *location, since_us = state.home
            self.vehicle.telemetry.set_home(Home(Location(*location), since_us))
        if self._fused is None:
            self.chain, self.estimator = make_fusion(self.settings, state)

    def feed(
        self, record: RawRecord | ImuCalibrated | VehicleReport, now_us: int, out: Outputs
    ) -> None:
        """Run one raw record through the stages, and add what results."""
        vehicle = self.vehicle
        if isinstance(record, ImuRaw):
            self._feed_imu(record, self.chain.imu(record), now_us, out)
        elif isinstance(record, ImuCalibrated):
            self._feed_imu(None, self.chain.imu_calibrated(record), now_us, out)
        elif isinstance(record, VehicleReport):
            # Not added to the fusion's records, since the fusion does not use it.
            self.perform(vehicle.on_report(record, now_us), now_us, out)
            self.state = vehicle.telemetry.state
        else:
            # Recorded before its effects, which can change the settings for the next record.
            out.records.append(record)
            if isinstance(record, BaroRaw):
                baro = self.chain.baro(record)
                self.estimator.update_baro(baro)
                self.perform(vehicle.on_baro(baro, now_us), now_us, out)
            elif isinstance(record, GpsFix):
                self.estimator.update_gps(record)
                self.perform(vehicle.on_gps(record, now_us), now_us, out)
                latency_s = latency_in_use(self.estimator)
                if latency_s is not None:
                    self.perform(vehicle.on_latency(*latency_s, now_us), now_us, out)
                self.state = vehicle.telemetry.state
            else:
                self.perform(vehicle.on_node_status(record, now_us), now_us, out)

    def _feed_imu(self, raw: ImuRaw | None, sample: ImuSample, now_us: int, out: Outputs) -> None:
        self.state = state = self.estimator.update_imu(sample)
        out.records.append(FusedSample(self.vehicle_id, raw, sample, state))
        self.perform(self.vehicle.on_state(state, sample, now_us), now_us, out)

    def perform(self, wanted: Iterable[Action], now_us: int, out: Outputs) -> None:
        """Apply the vehicle's actions to the other stages, and add all others to the outputs."""
        for action in wanted:
            if isinstance(action, Outgoing):
                out.frames.append(action)
            elif isinstance(action, SettingsChange):
                self._change(action.section, action.settings, out)
            elif isinstance(action, CalibrationMeasured):
                self._recalibrate(action, now_us, out)
            else:
                out.orders.append(action)

    def _recalibrate(self, measured: CalibrationMeasured, now_us: int, out: Outputs) -> None:
        """Add a measured calibration to the present one, unless its values are not plausible."""
        try:
            fresh = corrected_by(self.settings.calibration, measured.correction)
            calibration = msgspec.convert(msgspec.to_builtins(fresh), NodeCalibration)
        except ValueError as error:
            text = StatusText(WARNING, f"Calibration refused: {error}")
            self.perform(self.vehicle.announce(text, now_us), now_us, out)
            return
        self._change("calibration", calibration, out)
        self.perform(self.vehicle.apply_settings("calibration", calibration), now_us, out)

    def change(self, settings: AircraftSettings, now_us: int, out: Outputs) -> None:
        """Apply changed settings, and send the parameters that differ."""
        for section in ("calibration", "estimation"):
            wanted = getattr(settings, section)
            if wanted != getattr(self.settings, section):
                self._change(section, wanted, out)
                self.perform(self.vehicle.apply_settings(section, wanted), now_us, out)

    def sign_by(self, passphrase: str, now_us: int, out: Outputs) -> None:
        """Sign frames, and verify signatures, with another passphrase from now on."""
        self.settings = with_passphrase(self.settings, passphrase)
        vehicle = self.settings.vehicle
        self.perform(self.vehicle.apply_settings("vehicle", vehicle), now_us, out)

    def _change(self, section: str, settings: Settings, out: Outputs) -> None:
        """Rebuild the stage whose settings have changed; the other stages keep their state."""
        wanted = msgspec.structs.replace(self.settings, **{section: settings})
        if section == "calibration":
            self.chain = SensorChain(wanted.calibration)
        elif section == "estimation" and self._fused is None:
            fresh = make_estimator(wanted.estimation)
            if wanted.estimation.estimator == self.settings.estimation.estimator:
                fresh.restore(self.estimator.snapshot())
            self.estimator = fresh
        # Only here, so that the settings are unchanged if a stage cannot be built.
        self.settings = wanted
        if section != "vehicle":
            out.records.append(SettingsChanged(self.vehicle_id))


def make_fusion(
    settings: AircraftSettings, state: FusionState | None = None
) -> tuple[SensorChain, Estimator]:
    """Build the two stages from raw records to navigation states, and restore their state.

    Raises ValueError if the state is damaged, or of another version or other settings.
    """
    chain = SensorChain(settings.calibration)
    estimator = make_estimator(settings.estimation)
    if state is not None:
        if state.fits != _fits(settings):
            raise ValueError("it is of another version or other settings")
        estimator.restore(state.estimation)
    return chain, estimator


class FusedStates:
    """Replaces the estimator by the states of a recording that was fused before."""

    def __init__(self) -> None:
        self.states: deque[NDArray[np.float64]] = deque()
        """States of the next IMU samples, each of shape (NAV_COLUMNS,)."""
        self.latencies: deque[tuple[float, float] | None] = deque()
        """Result of `latency_in_use` after each of the next fixes."""
        self.gps_latency_s: tuple[float, float] | None = None

    def update_imu(self, sample: ImuSample) -> NavState:
        """Return the state of the next sample."""
        return nav_state(sample.time_us, self.states.popleft())

    def update_baro(self, sample: BaroSample) -> None:
        """Ignore a height, which has been fused already."""

    def update_gps(self, fix: GpsFix) -> None:  # noqa: ARG002
        """Set the latency that was in use after this fix."""
        self.gps_latency_s = self.latencies.popleft()

    def snapshot(self) -> bytes:
        """Return no data: there is no state to restore."""
        return b""

    def restore(self, snapshot: bytes) -> None:
        """Ignore a state, which the fusion has restored."""

    def reset(self) -> None:
        """Discard the states."""
        self.states.clear()
        self.latencies.clear()


def latency_in_use(estimator: Estimator) -> tuple[float, float] | None:
    """Return the GPS latency in use and the configured one, s; None if it is not estimated."""
    if isinstance(estimator, KernelEstimator | FusedStates):
        return estimator.gps_latency_s
    return None


def _fits(settings: AircraftSettings) -> str:
    """Return a short checksum of the version and the settings."""
    fused_with = (settings.estimation, settings.calibration)
    return f"{__version__} {zlib.crc32(msgspec.json.encode(fused_with)):08x}"


def with_passphrase(settings: AircraftSettings, passphrase: str) -> AircraftSettings:
    """Return the settings with another signing passphrase."""
    vehicle = msgspec.structs.replace(settings.vehicle, signing_passphrase=passphrase)
    return msgspec.structs.replace(settings, vehicle=vehicle)
