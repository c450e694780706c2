"""One aircraft as a MAVLink system: records in, frames out; requests in, answers out."""

import math
from collections.abc import Iterable, Mapping
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import (
    RECORDED_ONLY,
    BaroSample,
    GpsFix,
    ImuSample,
    Incoming,
    LinkReport,
    NavState,
    NodeStatus,
    Outgoing,
    VehicleReport,
)
from gateway.settings import Settings
from gateway.units import US_PER_S
from gateway.vehicle.encoding import Encoder
from gateway.vehicle.plan import Home, Location, StoredPlan, distance_and_bearing
from gateway.vehicle.request_log import UNANSWERED, RequestLog
from gateway.vehicle.request_reader import RequestReader
from gateway.vehicle.service import (
    INFO,
    NOTICE,
    WARNING,
    Action,
    Answer,
    LogWarning,
    Reply,
    Request,
    Service,
    SettingsChange,
    StatusText,
)
from gateway.vehicle.services.calibrator import FIXED_MAG_CAL_YAW, Calibrator
from gateway.vehicle.services.commands import (
    ACCEPTED,
    DENIED,
    FAILED,
    NOT_IN_CONTROL,
    CommandService,
    IntervalService,
    QueryService,
    RecordingService,
    read_command,
)
from gateway.vehicle.services.ftp import FtpService
from gateway.vehicle.services.operator_control import OperatorControl
from gateway.vehicle.services.parameter_service import HOME_SECTION, PACKED_PATH, ParameterService
from gateway.vehicle.services.parameters import Metadata, ParameterTable
from gateway.vehicle.services.plan_service import PlanService
from gateway.vehicle.telemetry.announcements import Announcements, Announcer
from gateway.vehicle.telemetry.health import Health
from gateway.vehicle.telemetry.telemetry import IN_AIR, Telemetry
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_messages import COMPONENT_METADATA, MESSAGE_IDS
from gateway.wire.mavlink_signing import (
    SigningClock,
    SigningTimestamps,
    Verifier,
    key_from_passphrase,
)
from gateway.wire.system_ids import REQUEST_OPERATOR_CONTROL

OWN_SECTION: Final = "vehicle"
HOME_STEP_M: Final = 20.0
HOME_STEP_SHARE: Final = 0.06
"""Share of the distance to home by which a reported home may differ: an autopilot's radio may send
its direction in steps of 3 degrees."""
REFUSALS_AT_ONCE: Final = 3
REFUSAL_INTERVAL_US: Final = 20 * US_PER_S
"""Least interval of refusals that are announced to all: enough as a warning, without a flood."""

REJECTION_INTERVAL_US: Final = 20 * US_PER_S
"""Least interval of logging wrong signatures, which a station with a wrong clock sends for ever;
`status --requests` lists all of them."""


class Vehicle:
    """The MAVLink side of one aircraft.

    All methods return actions in order, mostly frames to send. None raises on data.
    """

    def __init__(
        self,
        settings: VehicleSettings,
        system_id: int,
        *,
        sections: Mapping[str, Settings] | None = None,
        clock: SigningClock | None = None,
        timestamps: SigningTimestamps | None = None,
        stored: StoredPlan | None = None,
    ) -> None:
        """Start without any data.

        The system id, 1 to 250, is also the id in the radio payloads. The sections are other
        settings of this aircraft that ground stations may change as parameters, by the key that
        `SettingsChange` contains. Clock and timestamps are needed for signing only.
        """
        self.system_id = system_id
        self.refusals = 0
        """Number of refused requests for changes."""
        self.requests = RequestLog(system_id)
        self.health = Health(system_id, settings.node_silent_s, settings.supply_low_v)
        self.telemetry = Telemetry(settings, self.health)
        self._clock = clock or SigningClock(0)
        self._timestamps = timestamps or SigningTimestamps()
        self._encoder = Encoder(system_id)
        self._reader = RequestReader(system_id)
        self.faults = self._reader.faults
        """Frames of clients that were dropped, by reason."""
        self.signing_key: bytes | None = None
        """The key that signs this vehicle's frames as they leave the gateway, if any."""
        self._sign_by(settings.signing_passphrase)
        self._announcements = Announcements(self.health)
        # Separate, so that untrusted clients cannot use up the quota of other events.
        self._refusal_texts = Announcer(REFUSALS_AT_ONCE, REFUSAL_INTERVAL_US)
        self._rejection_due_us = 0
        self.plan = PlanService(
            system_id, self.telemetry, self._announcements.announce, stored or StoredPlan()
        )
        self._published_home = self.telemetry.home
        home = self.plan.home_parameters()
        self._make_services({OWN_SECTION: settings, **(sections or {}), HOME_SECTION: home})

    def _make_services(self, sections: Mapping[str, Settings]) -> None:
        """Make the services, and register those of each message and the polled ones."""
        telemetry = self.telemetry
        self._intervals = IntervalService(self.system_id, telemetry)
        self._parameters = ParameterService(self.system_id, ParameterTable(sections), self.plan)
        self.metadata = Metadata(self._parameters.table, self.system_id)
        """Descriptions of the parameters."""
        telemetry.add(COMPONENT_METADATA.id, self.metadata.announcement)
        ftp = FtpService({**self.metadata.files, PACKED_PATH: self._parameters.packed})
        self._calibrator = Calibrator(lambda: self.in_flight, lambda: telemetry.state)
        self._recording = RecordingService(self._explain)
        self._control = OperatorControl(
            self._explain, exclusive=telemetry.settings.operator_control == "exclusive"
        )
        changing = {
            mavlink.MAV_CMD_PREFLIGHT_STORAGE: self._parameters.store,
            mavlink.MAV_CMD_PREFLIGHT_CALIBRATION: self._calibrator.start,
            FIXED_MAG_CAL_YAW: self._calibrator.start_by_yaw,
            **self.plan.commands,
            **self._recording.commands,
        }
        reading = {**self._intervals.commands, REQUEST_OPERATOR_CONTROL: self._control.command}
        self._timed: tuple[Service, ...] = (
            self._intervals,
            self._parameters,
            self.plan.missions,
            ftp,
            self._calibrator,
            self._recording,
            self._control,
        )
        services = (
            CommandService(telemetry, self._explain, changing, reading),
            QueryService(telemetry.build, self._explain),
            *self._timed,
        )
        self._services = {kind: service for service in services for kind in service.types}

    @property
    def in_flight(self) -> bool:
        """Whether the aircraft is in flight."""
        return self.telemetry.motion.landed_state == IN_AIR

    @property
    def operates(self) -> bool:
        """Whether its autopilot reports it armed; without one, whether it is in flight."""
        reported = self.health.reported.armed
        return self.in_flight if reported is None else reported

    def on_state(self, state: NavState, sample: ImuSample, now_us: int) -> list[Action]:
        """Process the estimate for one IMU sample."""
        self.health.on_state(state, sample)
        found = self.telemetry.on_state(state, sample)
        found += self._announcements.on_state(state, sample, now_us)
        found += self._intervals.on_state(state.time_us)
        found += self._calibrator.on_sample(sample)
        return self._finish(found) if found else []

    def on_baro(self, sample: BaroSample, _now_us: int) -> list[Action]:
        """Process one barometer sample."""
        self.health.on_baro(sample)
        return self._finish(self.telemetry.on_baro(sample))

    def on_gps(self, fix: GpsFix, now_us: int) -> list[Action]:
        """Process one GPS fix."""
        self.health.on_gps(fix)
        had_home = self.telemetry.home is not None
        found = self.telemetry.on_gps(fix)
        if self.telemetry.home is not None and not had_home:
            found += self._announcements.announce(StatusText(INFO, "Home set by GPS"), now_us)
        found += self.plan.on_fix(fix, now_us)
        found += self._announcements.on_fix(now_us)
        return self._finish(found)

    def on_report(self, report: VehicleReport, now_us: int) -> list[Action]:
        """Process a report of the vehicle's own autopilot.

        Home is set by the first fix after arming, unless the autopilot reports it. A reported one
        is coarse: only a change beyond its resolution moves home.
        """
        was_armed = self.telemetry.armed
        self.health.on_report(report)
        found = self.telemetry.on_report(report)
        if report.armed and not was_armed:
            self.telemetry.clear_home()
        if report.home is not None:
            found += self._on_home(Location(*report.home), report.time_us)
        if report.text is not None:
            found += self._announcements.announce(StatusText(*report.text), now_us)
        return self._finish(found)

    def _on_home(self, home: Location, time_us: int) -> list[Answer]:
        """Set home to the one that the vehicle's own autopilot reports, if it differs."""
        telemetry = self.telemetry
        state, known = telemetry.state, telemetry.home
        if known is not None:
            away_m = 0.0
            if state is not None and math.isfinite(state.lat_deg + state.lon_deg):
                here = Location(state.lat_deg, state.lon_deg, 0.0)
                away_m, _ = distance_and_bearing(here, home)
            moved_m, _ = distance_and_bearing(known.location, home)
            if moved_m <= HOME_STEP_M + HOME_STEP_SHARE * away_m:
                return []
        return [telemetry.set_home(Home(home, time_us))]

    @property
    def troubles(self) -> dict[str, str]:
        """See `Announcer.troubles`."""
        return self._announcements.troubles

    def on_latency(self, used_s: float, set_s: float, now_us: int) -> list[Action]:
        """Process the GPS latency that the estimator uses, and that of the settings, s."""
        return self._finish(self._announcements.on_latency(used_s, set_s, now_us))

    def on_node_status(self, status: NodeStatus, now_us: int) -> list[Action]:
        """Process a node's report about itself."""
        findings = self.health.on_node_status(status)
        found = self.telemetry.on_node_status(status)
        return self._finish(found + self._announcements.on_findings(findings, now_us))

    def on_link(self, report: LinkReport, now_us: int) -> list[Action]:
        """Process the state of the serial link and of all radio links."""
        findings = self.health.on_link(report)
        found = self._announcements.on_link(report, now_us)
        return self._finish(found + self._announcements.on_findings(findings, now_us))

    def handle(self, incoming: Incoming, now_us: int) -> list[Action]:
        """Answer one frame of a client; ignore one that is not for this vehicle."""
        request = self._reader.read(incoming, now_us)
        if request is None:
            return []
        if request.is_rejected:
            return self._note_rejected(request, now_us)
        self._control.on_request(request, now_us)
        service = self._services.get(request.message.get_type())
        if service is None:
            is_to_us = getattr(request.message, "target_system", None) == self.system_id
            if is_to_us and request.message.get_type() not in UNANSWERED:
                self.requests.add(request, "no answer", now_us)
            return []
        if service.changes_state(request):
            if not request.may_change:
                return self._refuse(service, request, request.reason, DENIED, now_us)
            if not self._control.permits(request):
                reason = self._control.denial(request)
                return self._refuse(service, request, reason, NOT_IN_CONTROL, now_us)
        answers = service.handle(request, now_us)
        self.requests.add_failed(request, answers, now_us)
        return self._finish(answers)

    def _note_rejected(self, request: Request, now_us: int) -> list[Action]:
        """List a request with a wrong signature; log some of them."""
        self.requests.add(request, f"refused: {request.reason}", now_us)
        if now_us < self._rejection_due_us:
            return []
        self._rejection_due_us = now_us + REJECTION_INTERVAL_US
        sender = f"system {request.system_id}, component {request.component_id}"
        text = f"aircraft {self.system_id} refused the signature of {sender}: {request.reason}"
        return [LogWarning(text)]

    def _refuse(
        self, service: Service, request: Request, reason: str, result: int, now_us: int
    ) -> list[Action]:
        """Answer and announce a request that the sender may not make."""
        self.refusals += 1
        self.requests.add(request, f"refused: {reason}", now_us)
        known = mavlink.enums["MAV_CMD"].get(getattr(request.message, "command", None))
        name = known.name.removeprefix("MAV_CMD_") if known else request.message.get_type()
        status = StatusText(NOTICE, f"Refused {name} of system {request.system_id}: {reason}")
        answers = service.refuse(request, result)
        answers += self._refusal_texts.announce(status, now_us)
        return self._finish(answers)

    def introduction(self) -> list[Outgoing]:
        """Encode the answers that every ground station requests at its start, for a recording only.

        Version, modes, parameters, home, and missions as if they were downloaded, with separate
        sequence numbers, so that no client counts a loss.
        """
        encoder = Encoder(self.system_id)
        asked = ("AUTOPILOT_VERSION", "PROTOCOL_VERSION", "AVAILABLE_MODES", "HOME_POSITION")
        built = [self.telemetry.build(MESSAGE_IDS[name], 0) for name in asked]
        built += [*self._parameters.values(), *self.plan.missions.download()]
        return [encoder.encode(each, RECORDED_ONLY) for each in built if each is not None]

    def poll(self, now_us: int) -> list[Action]:
        """Return the actions that are due by time."""
        self.telemetry.calibrating = self._calibrator.busy
        found = self.telemetry.poll(now_us) + self._announcements.poll(now_us)
        for service in self._timed:
            found += service.poll(now_us)
        return self._finish(found)

    def next_due_us(self) -> int:
        """Return when `poll` is to be called next, at the latest."""
        due = [self.telemetry.next_due_us(), self._announcements.next_due_us()]
        due += [service.next_due_us() for service in self._timed]
        return min(time_us for time_us in due if time_us is not None)

    def remove_client(self, client_id: int) -> None:
        """Discard the state of a client that has gone."""
        for service in self._timed:
            service.remove_client(client_id)

    def on_recorder(
        self, trouble: str, now_us: int, *, recording: bool, expected: bool = True
    ) -> list[Action]:
        """Note the state of the recorder, which the armed bit may follow."""
        self.health.recording, self.health.recording_expected = recording, expected
        return self._finish(self._recording.update(trouble, now_us, recording=recording))

    def on_saved(self, request: Request, text: str, now_us: int, *, stored: bool) -> list[Action]:
        """Acknowledge the request of `SaveSettings`; the text names the file, or the error."""
        ack = read_command(request).ack(ACCEPTED if stored else FAILED)
        saved = StatusText(INFO, f"Settings saved: {text}")
        status = saved if stored else StatusText(WARNING, f"Settings not saved: {text}")
        return self._finish([ack, *self._announcements.announce(status, now_us)])

    def put_mark(self, location: Location | None, now_us: int) -> list[Action]:
        """Mark a location (its height may be NaN), or clear the mark.

        Raises ValueError if its coordinates are out of range.
        """
        return self._finish(self.plan.put_mark(location, now_us))

    def announce(self, text: StatusText, now_us: int) -> list[Action]:
        """Announce an event of the gateway, such as a recording that stopped."""
        return self._finish(self._announcements.announce(text, now_us))

    def apply_settings(self, section: str, settings: Settings) -> list[Action]:
        """Apply a section that was changed elsewhere, and send the parameters that differ."""
        if isinstance(settings, VehicleSettings) and section == OWN_SECTION:
            self._reconfigure(settings)
        return self._finish(self._parameters.update(section, settings))

    def _explain(self, text: str, now_us: int) -> list[Answer]:
        return self._announcements.announce(StatusText(NOTICE, text), now_us)

    def _reconfigure(self, settings: VehicleSettings) -> None:
        self.health.silent_us = round(settings.node_silent_s * 1e6)
        self.health.supply_low_v = settings.supply_low_v
        self.telemetry.reconfigure(settings)
        self._control.exclusive = settings.operator_control == "exclusive"
        self._sign_by(settings.signing_passphrase)

    def _sign_by(self, passphrase: str) -> None:
        """Sign and check with another key; timestamps stay, so that old frames are not accepted."""
        key = key_from_passphrase(passphrase) if passphrase else None
        if key == self.signing_key:
            return
        self.signing_key = key
        self._reader.verifier = Verifier(key, self._clock, self._timestamps) if key else None

    def _finish(self, answers: Iterable[Answer]) -> list[Action]:
        """Encode the messages, and apply the actions that concern the vehicle itself."""
        actions: list[Action] = []
        if self.telemetry.home is not self._published_home:
            self._published_home = self.telemetry.home
            home = self._parameters.update(HOME_SECTION, self.plan.home_parameters())
            answers = [*answers, *home]
        for answer in answers:
            if isinstance(answer, Reply):
                actions.append(self._encoder.encode(answer.message, answer.client_id))
                continue
            actions.append(answer)
            if isinstance(answer, SettingsChange) and isinstance(answer.settings, VehicleSettings):
                self._reconfigure(answer.settings)
        return actions
