"""One aircraft: `sensing → estimation → vehicle`, and changes of their settings as they run.

Pure: time is an argument, and effects are returned as a list of actions.
"""

import zlib
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from gateway import __version__
from gateway.estimation.columns import NAV_COLUMNS, imu_rows, nav_row, nav_state
from gateway.estimation.interface import Estimator
from gateway.estimation.kernel import KernelEstimator
from gateway.estimation.select import EstimationSettings, make_estimator
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
)
from gateway.sensing.calibrating import corrected_by
from gateway.sensing.calibration import NodeCalibration
from gateway.sensing.chain import SensorChain
from gateway.sensing.imu_log import ImuLog
from gateway.settings import Settings
from gateway.vehicle.actions import (
    WARNING,
    CalibrationMeasured,
    RecordingRequest,
    SavePlan,
    SaveSettings,
    SettingsChange,
    StatusText,
)
from gateway.vehicle.actions import Action as VehicleAction
from gateway.vehicle.location import Home, Location
from gateway.vehicle.plan import StoredPlan
from gateway.vehicle.signing import SigningClock, SigningTimestamps
from gateway.vehicle.vehicle import Vehicle
from gateway.vehicle.vehicle_settings import VehicleSettings


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """The following samples are fused with other settings."""

    vehicle_id: int


Recorded = FusedSample | BaroRaw | GpsFix | NodeStatus | SettingsChanged
Action = Outgoing | ClientInterval | RecordingRequest | SaveSettings | SavePlan | Recorded
"""Frames to send, clients' rates, and records for a recording, in the order of its fusion."""


class AircraftSettings(Settings, frozen=True):
    """The settings of one aircraft's stages; ground stations may change them as parameters."""

    vehicle: VehicleSettings = VehicleSettings()
    estimation: EstimationSettings = EstimationSettings()
    calibration: NodeCalibration = NodeCalibration()


class Aircraft:
    """The stages of one aircraft, from its raw records on.

    Parameters
    ----------
    vehicle_id : int
        Id in the frames of its nodes; MAVLink system id.
    settings : AircraftSettings
        Of all stages.
    clock : SigningClock, optional
        Civil time.
    stamps : SigningTimestamps, optional
        The signing timestamps accepted before.
    stored : StoredPlan, optional
        Missions, mark and home kept from an earlier run.
    correct : callable, optional
        Changes the states before they are sent: for a playback, which knows the future.
    """

    def __init__(
        self,
        vehicle_id: int,
        settings: AircraftSettings,
        *,
        clock: SigningClock | None = None,
        stamps: SigningTimestamps | None = None,
        stored: StoredPlan | None = None,
        correct: Callable[[NavState], NavState] | None = None,
    ) -> None:
        self.vehicle_id = vehicle_id
        self.settings = settings
        self.state: NavState | None = None
        sections = {name: getattr(settings, name) for name in ("estimation", "calibration")}
        self.vehicle = Vehicle(
            settings.vehicle,
            vehicle_id,
            sections=sections,
            clock=clock,
            stamps=stamps,
            stored=stored,
        )
        self._chain, self._estimator = make_fusion(settings)
        self._correct = correct

    @property
    def fusion_state(self) -> FusionState:
        """State of the estimator, and home."""
        home = self.vehicle.telemetry.home
        return FusionState(
            vehicle_id=self.vehicle_id,
            fits=_fits(self.settings),
            estimation=self._estimator.snapshot(),
            home=None if home is None else (*astuple(home.location), home.set_time_us),
        )

    def restore(self, state: FusionState) -> None:
        """Restore a state, bit for bit; raises ValueError as `make_fusion`.

        Home is restored even if the rest does not fit.
        """
        if state.home is not None:
            *location, since_us = state.home
            self.vehicle.telemetry.set_home(Home(Location(*location), since_us))
        self._chain, self._estimator = make_fusion(self.settings, state)

    def take(self, record: RawRecord | ImuCalibrated, now_us: int) -> list[Action]:
        """Run one raw record through the stages."""
        match record:
            case ImuRaw():
                return self._take_imu(record, self._chain.imu(record), now_us)
            case ImuCalibrated():
                return self._take_imu(None, self._chain.imu_calibrated(record), now_us)
            case BaroRaw():
                baro = self._chain.baro(record)
                self._estimator.update_baro(baro)
                return self._recorded(record, self.vehicle.on_baro(baro, now_us), now_us)
            case GpsFix():
                self._estimator.update_gps(record)
                wanted = self.vehicle.on_gps(record, now_us)
                if isinstance(self._estimator, KernelEstimator):
                    wanted += self.vehicle.on_latency(*self._estimator.gps_latency_s, now_us)
                return self._recorded(record, wanted, now_us)
            case NodeStatus():
                return self._recorded(record, self.vehicle.on_node_status(record, now_us), now_us)

    @property
    def chain(self) -> SensorChain:
        """The sensing stage."""
        return self._chain

    def fuse(
        self, log: ImuLog, aiding: Sequence[tuple[int, BaroRaw | GpsFix]]
    ) -> NDArray[np.float64]:
        """Run a recording's samples through estimation alone, without the vehicle.

        Parameters
        ----------
        log : ImuLog
            From the sensing stage.
        aiding : sequence of tuple
            Heights and fixes in their order, each with the number of the sample before which it
            arrived.

        Returns
        -------
        ndarray, shape (n, NAV_COLUMNS)
            The states that `take` records; see `gateway.estimation.columns`.
        """
        samples = [
            (k, self._chain.baro(record) if isinstance(record, BaroRaw) else record)
            for k, record in aiding
        ]
        if isinstance(self._estimator, KernelEstimator):
            imu = imu_rows(log.accel_b_mps2, log.gyro_b_radps, log.mag_b_ut, log.flags)
            states = self._estimator.run_in_arrival_order(log.time_us, imu, samples)
        else:
            states = fuse_singly(self._estimator, log.samples(), samples)
        if self._correct is not None:
            known = map(nav_state, log.time_us.tolist(), states)
            states = np.array([nav_row(self._correct(state)) for state in known])
        return states.reshape(-1, NAV_COLUMNS)

    def _take_imu(self, raw: ImuRaw | None, sample: ImuSample, now_us: int) -> list[Action]:
        state = self._estimator.update_imu(sample)
        self.state = state if self._correct is None else self._correct(state)
        fused = FusedSample(self.vehicle_id, raw, sample, self.state)
        return self._recorded(fused, self.vehicle.on_state(self.state, sample, now_us), now_us)

    def _recorded(
        self,
        record: FusedSample | BaroRaw | GpsFix | NodeStatus,
        wanted: Sequence[VehicleAction],
        now_us: int,
    ) -> list[Action]:
        """Add the record to the actions, before changes of the settings of the next one."""
        return self.perform(wanted, now_us, record) if wanted else [record]

    def perform(
        self,
        wanted: Iterable[VehicleAction],
        now_us: int,
        record: FusedSample | BaroRaw | GpsFix | NodeStatus | None = None,
    ) -> list[Action]:
        """Carry out the vehicle's actions on the other stages; return the rest.

        Parameters
        ----------
        wanted : iterable of VehicleAction
        now_us : int
            Gateway clock.
        record : FusedSample, BaroRaw, GpsFix or NodeStatus, optional
            Its cause, which is recorded before the settings change.

        Returns
        -------
        list of Action
        """
        actions: list[Action] = []
        changed: list[Action] = []
        for action in wanted:
            if isinstance(action, SettingsChange):
                changed += self._change(action.section, action.settings)
            elif isinstance(action, CalibrationMeasured):
                changed += self._recalibrate(action, now_us)
            else:
                actions.append(action)
        if record is not None:
            actions.append(record)
        return actions + changed if changed else actions

    def _recalibrate(self, measured: CalibrationMeasured, now_us: int) -> list[Action]:
        """Join the calibration with a measured one, unless no sensor has such errors."""
        try:
            fresh = corrected_by(self.settings.calibration, measured.correction)
            calibration = msgspec.convert(msgspec.to_builtins(fresh), NodeCalibration)
        except ValueError as error:
            text = StatusText(WARNING, f"Calibration refused: {error}")
            return self.perform(self.vehicle.say(text, now_us), now_us)
        changed = self._change("calibration", calibration)
        found = self.vehicle.take_settings("calibration", calibration)
        return changed + self.perform(found, now_us)

    def change(self, settings: AircraftSettings, now_us: int) -> list[Action]:
        """Apply what differs from the present settings, and send the parameters that differ."""
        actions: list[Action] = []
        for section in ("calibration", "estimation"):
            wanted = getattr(settings, section)
            if wanted != getattr(self.settings, section):
                actions += self._change(section, wanted)
                actions += self.perform(self.vehicle.take_settings(section, wanted), now_us)
        return actions

    def sign_by(self, passphrase: str, now_us: int) -> list[Action]:
        """Sign, and check signatures, with another passphrase from now on."""
        self.settings = with_passphrase(self.settings, passphrase)
        vehicle = self.settings.vehicle
        return self.perform(self.vehicle.take_settings("vehicle", vehicle), now_us)

    def _change(self, section: str, settings: Settings) -> list[Action]:
        """Rebuild the stage whose settings changed; the others keep their state."""
        wanted = msgspec.structs.replace(self.settings, **{section: settings})
        if section == "calibration":
            self._chain = SensorChain(wanted.calibration)
        elif section == "estimation":
            fresh = make_estimator(wanted.estimation)
            if wanted.estimation.estimator == self.settings.estimation.estimator:
                fresh.restore(self._estimator.snapshot())
            self._estimator = fresh
        # Only now, so that a stage that cannot be built changes no settings.
        self.settings = wanted
        return [] if section == "vehicle" else [SettingsChanged(self.vehicle_id)]


def make_fusion(
    settings: AircraftSettings, state: FusionState | None = None
) -> tuple[SensorChain, Estimator]:
    """Build the two stages that turn raw records into navigation states.

    Parameters
    ----------
    settings : AircraftSettings
        Of the aircraft.
    state : FusionState, optional
        To restore; without it they start fresh.

    Returns
    -------
    chain : SensorChain
    estimator : Estimator

    Raises
    ------
    ValueError
        If the state is of another version or other settings, or damaged.
    """
    chain = SensorChain(settings.calibration)
    estimator = make_estimator(settings.estimation)
    if state is not None:
        if state.fits != _fits(settings):
            raise ValueError("it is of another version or other settings")
        estimator.restore(state.estimation)
    return chain, estimator


def fuse_singly(
    estimator: Estimator,
    samples: Sequence[ImuSample],
    aiding: Iterable[tuple[int, BaroSample | GpsFix]],
) -> NDArray[np.float64]:
    """Run any estimator over samples and the heights and fixes between them, one by one.

    Parameters
    ----------
    estimator : Estimator
    samples : sequence of ImuSample
    aiding : iterable of tuple
        See `Aircraft.fuse`.

    Returns
    -------
    ndarray, shape (n, NAV_COLUMNS)
    """
    waiting = deque(aiding)
    rows = []
    for number, sample in enumerate([*samples, None]):
        while waiting and waiting[0][0] <= number:
            record = waiting.popleft()[1]
            if isinstance(record, BaroSample):
                estimator.update_baro(record)
            else:
                estimator.update_gps(record)
        if sample is not None:
            rows.append(nav_row(estimator.update_imu(sample)))
    return np.array(rows, np.float64).reshape(-1, NAV_COLUMNS)


def _fits(settings: AircraftSettings) -> str:
    """Return a short checksum of version and settings."""
    fused_with = (settings.estimation, settings.calibration)
    return f"{__version__} {zlib.crc32(msgspec.json.encode(fused_with)):08x}"


def with_passphrase(settings: AircraftSettings, passphrase: str) -> AircraftSettings:
    """Give an aircraft another signing passphrase."""
    vehicle = msgspec.structs.replace(settings.vehicle, signing_passphrase=passphrase)
    return msgspec.structs.replace(settings, vehicle=vehicle)
