"""The one place where the stages meet: `wire → sensing → estimation → vehicle`.

    receiver's bytes ─ Link ─ raw records ─┬─ Aircraft 1: SensorChain ─ Estimator ─ Vehicle ─┐
                                           └─ Aircraft 2: …                                  │
    client's frames ──────────────────────────────────────────────────────────── Vehicle ────┤
                                                                                          actions

Pure: time is an argument, and what should happen outside comes back as a list of actions, in
order. An aircraft comes into being with its first payload. Live, demo and playback differ only in
who calls `feed` (bytes) or `take` (raw records of a recording).
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import msgspec

from gateway.estimation.interface import Estimator
from gateway.estimation.select import EstimationSettings, make_estimator
from gateway.records import (
    BaroRaw,
    ClientInterval,
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
from gateway.sensing.recalibration import (
    absorb_accel_error,
    absorb_gyro_error,
    absorb_mag_error,
    absorb_tilt,
)
from gateway.settings import Settings
from gateway.units import US_PER_S
from gateway.vehicle.actions import Action as VehicleAction
from gateway.vehicle.actions import (
    CalibrationKind,
    CalibrationMeasured,
    RecordingRequest,
    SavePlaces,
    SaveSettings,
    SettingsChange,
)
from gateway.vehicle.events import Told
from gateway.vehicle.home import Place
from gateway.vehicle.settings import VehicleSettings
from gateway.vehicle.stored import StoredPlaces
from gateway.vehicle.vehicle import Vehicle
from gateway.wire.link import Link

REPORT_INTERVAL_US: Final = US_PER_S


@dataclass(frozen=True, slots=True)
class SettingsChanged:
    """What comes from here on was fused with other settings."""

    vehicle_id: int


Recorded = FusedSample | BaroRaw | GpsFix | SettingsChanged
Action = Outgoing | ClientInterval | RecordingRequest | SaveSettings | SavePlaces | Recorded
"""Frames to send, wishes of clients, and what a recording keeps, in the order of its fusion."""

ABSORB: Final = {
    CalibrationKind.GYRO: absorb_gyro_error,
    CalibrationKind.ACCEL: absorb_accel_error,
    CalibrationKind.LEVEL: absorb_tilt,
    CalibrationKind.MAG: absorb_mag_error,
}


class AircraftSettings(Settings, frozen=True):
    """The settings of one aircraft's stages; ground stations may change them as parameters."""

    vehicle: VehicleSettings = VehicleSettings()
    sensing: SensingSettings = SensingSettings()
    estimation: EstimationSettings = EstimationSettings()
    calibration: NodeCalibration = NodeCalibration()


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """The settings of every aircraft."""

    default: AircraftSettings
    aircraft: Mapping[int, AircraftSettings] = field(default_factory=dict)
    """By vehicle id, in place of the default."""
    unix_us_at_zero: int = 0
    """Civil time at the gateway clock's zero, as well as it is known."""
    correct: Callable[[NavState], NavState] | None = None
    """Changes the states before they are told: for a playback that knows what comes."""
    places: Mapping[int, StoredPlaces] = field(default_factory=dict)
    """Missions, marks and homes kept of an earlier run, by vehicle id."""


class Aircraft:
    """The stages of one aircraft, from its raw records on."""

    def __init__(self, vehicle_id: int, common: PipelineSettings) -> None:
        self.vehicle_id = vehicle_id
        self.settings = settings = common.aircraft.get(vehicle_id, common.default)
        self.state: NavState | None = None
        sections = {
            name: getattr(settings, name) for name in ("sensing", "estimation", "calibration")
        }
        self.vehicle = Vehicle(
            settings.vehicle,
            vehicle_id,
            sections=sections,
            unix_us_at_zero=common.unix_us_at_zero,
            stored=common.places.get(vehicle_id),
        )
        self._chain = SensorChain(settings.sensing, settings.calibration)
        self._estimator: Estimator = make_estimator(settings.estimation)
        self._correct = common.correct

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
                return self._recorded(record, self.vehicle.on_baro(baro, now_us), now_us)
            case GpsFix():
                self._estimator.update_gps(record)
                return self._recorded(record, self.vehicle.on_gps(record, now_us), now_us)
            case NodeStatus():
                return self.perform(self.vehicle.on_node_status(record, now_us), now_us)

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
        return self._recorded(fused, self.vehicle.on_state(self.state, sample, now_us), now_us)

    def _recorded(
        self, record: FusedSample | BaroRaw | GpsFix, wanted: Iterable[VehicleAction], now_us: int
    ) -> list[Action]:
        """Put what is recorded behind the frames, which it may not delay, but before a change."""
        actions = self.perform(wanted, now_us)
        changed = [action for action in actions if isinstance(action, SettingsChanged)]
        others = [action for action in actions if not isinstance(action, SettingsChanged)]
        return [*others, record, *changed]

    def perform(self, wanted: Iterable[VehicleAction], now_us: int) -> list[Action]:
        """Carry out what the vehicle asks of the other stages; hand the rest on.

        Parameters
        ----------
        wanted : iterable of VehicleAction
        now_us : int
            Gateway clock.

        Returns
        -------
        list of Action
        """
        actions: list[Action] = []
        for action in wanted:
            if isinstance(action, SettingsChange):
                actions += self._change(action.section, action.settings)
            elif isinstance(action, CalibrationMeasured):
                calibration = ABSORB[action.kind](self.settings.calibration, action.error_b)
                actions += self._change("calibration", calibration)
                told = self.vehicle.take_settings("calibration", calibration, now_us)
                actions += self.perform(told, now_us)
            else:
                actions.append(action)
        return actions

    def change(self, settings: AircraftSettings) -> None:
        """Take over what differs between these settings and those that hold."""
        for section in ("sensing", "calibration", "estimation"):
            wanted = getattr(settings, section)
            if wanted != getattr(self.settings, section):
                self._change(section, wanted)

    def sign_by(self, passphrase: str, now_us: int) -> list[Action]:
        """Sign, and check signatures, by another passphrase from now on."""
        self.settings = _with_passphrase(self.settings, passphrase)
        vehicle = self.settings.vehicle
        return self.perform(self.vehicle.take_settings("vehicle", vehicle, now_us), now_us)

    def _change(self, section: str, settings: Settings) -> list[Action]:
        """Rebuild the stage whose settings changed; the others go on undisturbed."""
        self.settings = msgspec.structs.replace(self.settings, **{section: settings})
        if section in ("sensing", "calibration"):
            self._chain = SensorChain(self.settings.sensing, self.settings.calibration)
        elif section == "estimation":
            self._estimator = _succeed(self._estimator, make_estimator(self.settings.estimation))
        else:
            return []
        return [SettingsChanged(self.vehicle_id)]


def _with_passphrase(settings: AircraftSettings, passphrase: str) -> AircraftSettings:
    vehicle = msgspec.structs.replace(settings.vehicle, signing_passphrase=passphrase)
    return msgspec.structs.replace(settings, vehicle=vehicle)


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

    def take(self, record: RawRecord | ImuCalibrated, now_us: int) -> list[Action]:
        """Take one raw record, from the link or from a recording."""
        vehicle_id = record.node.vehicle_id
        aircraft = self.aircraft.get(vehicle_id)
        if aircraft is None:
            aircraft = self.aircraft[vehicle_id] = Aircraft(vehicle_id, self._settings)
        return aircraft.take(record, now_us)

    def change(self, vehicle_id: int, settings: AircraftSettings) -> None:
        """Let an aircraft go on with other settings, as it did when it was recorded."""
        if vehicle_id in self.aircraft:
            self.aircraft[vehicle_id].change(settings)

    def sign_by(self, common: str, own: Mapping[int, str], now_us: int) -> list[Action]:
        """Sign, and check signatures, by other passphrases from now on.

        Parameters
        ----------
        common : str
            Of every aircraft that has none of its own; empty for none.
        own : mapping of int to str
            By vehicle id.
        now_us : int
            Gateway clock.

        Returns
        -------
        list of Action
        """
        known = self._settings
        aircraft = {
            key: _with_passphrase(known.aircraft.get(key, known.default), own.get(key, common))
            for key in {*known.aircraft, *own}
        }
        default = _with_passphrase(known.default, common)
        self._settings = replace(known, default=default, aircraft=aircraft)
        actions: list[Action] = []
        for key, each in self.aircraft.items():
            actions += each.sign_by(own.get(key, common), now_us)
        return actions

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
            actions += aircraft.perform(aircraft.vehicle.handle(incoming, now_us), now_us)
        return actions

    def forget_client(self, client_id: int) -> None:
        """Drop what was kept for a client that has gone."""
        for aircraft in self.aircraft.values():
            aircraft.vehicle.forget_client(client_id)

    def say(self, told: Told, now_us: int) -> list[Action]:
        """Let every aircraft tell its clients a text."""
        actions: list[Action] = []
        for aircraft in self.aircraft.values():
            actions += aircraft.perform(aircraft.vehicle.say(told, now_us), now_us)
        return actions

    def mark(self, place: Place | None, vehicle_id: int | None, now_us: int) -> list[Action]:
        """Mark a place for one aircraft, or for all, or clear the mark.

        Raises
        ------
        ValueError
            If the place is not on earth, or nothing has been heard of the aircraft.
        """
        wanted = [a for a in self.aircraft.values() if vehicle_id in (None, a.vehicle_id)]
        if not wanted:
            heard = ", ".join(str(known) for known in sorted(self.aircraft)) or "none yet"
            raise ValueError(f"no such aircraft; heard so far: {heard}")
        actions: list[Action] = []
        for aircraft in wanted:
            actions += aircraft.perform(aircraft.vehicle.put_mark(place, now_us), now_us)
        return actions

    @property
    def in_flight(self) -> bool:
        """Whether an aircraft flies."""
        return any(aircraft.vehicle.in_flight for aircraft in self.aircraft.values())

    def on_recorder(self, trouble: str, now_us: int, *, recording: bool) -> list[Action]:
        """Note whether a recording runs, or why not; ground stations are told."""
        actions: list[Action] = []
        for each in self.aircraft.values():
            told = each.vehicle.on_recorder(trouble, now_us, recording=recording)
            actions += each.perform(told, now_us)
        return actions

    def poll(self, now_us: int) -> list[Action]:
        """Do what is due by time."""
        actions: list[Action] = []
        reporting = now_us >= self._report_due_us
        if reporting:
            self._report_due_us = now_us + REPORT_INTERVAL_US
            self.report = self._link.report(now_us, connected=self._connected, port=self._port)
        for aircraft in self.aircraft.values():
            if reporting:
                actions += aircraft.perform(aircraft.vehicle.on_link(self.report, now_us), now_us)
            actions += aircraft.perform(aircraft.vehicle.poll(now_us), now_us)
        return actions

    def next_due_us(self) -> int:
        """Tell when `poll` is to be called next, at the latest."""
        due = [aircraft.vehicle.next_due_us() for aircraft in self.aircraft.values()]
        return min([self._report_due_us, *due])
