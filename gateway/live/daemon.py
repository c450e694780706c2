"""The composition root: builds the edges, connects them to the pipeline, and shuts them down."""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Final

import msgspec

from gateway.aircraft import Aircraft, AircraftSettings, Order, Outputs, SettingsChanged
from gateway.clock import GatewayClock, unix_time_us
from gateway.config import (
    ConfigError,
    GatewaySettings,
    aircraft_folder,
    load_aircraft,
    save_aircraft,
)
from gateway.hub.hub import Hub
from gateway.live.control_socket import ControlError, ControlServer, socket_path
from gateway.live.control_verbs import (
    ImuTap,
    client_verbs,
    introduction_verb,
    mark_verbs,
    recorder_verbs,
    serial_verbs,
    source_verbs,
)
from gateway.live.kept_files import PlanFiles, TimestampFile, begin_worker
from gateway.live.metrics_server import MetricsServer
from gateway.live.other_gateways import conflicts, identity_verb, log_other_gateways
from gateway.live.pty_port import PtyPort
from gateway.live.recorder import Recorder
from gateway.live.recording_budget import RecordingBudget
from gateway.live.serial_port import AUTO, SerialPort
from gateway.live.service import LoopLag, ServiceNotifier, set_realtime_priority
from gateway.live.session import SessionState, VehicleLocations
from gateway.live.source_port import SourcePort, read_map
from gateway.live.vehicle_watch import VehicleWatch
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.printable import NO_RECEIVER, reason_of, without_folders
from gateway.recordings.recorded_table import header_for
from gateway.recordings.tlog import UNRECORDED
from gateway.records import RECORDED_ONLY, ClientInterval, FusedSample, Incoming, Outgoing
from gateway.sensing.calibration import NodeCalibration
from gateway.simulator.timed_frame import TimedFrame
from gateway.sources.kinds import make_sources
from gateway.sources.settings import SourceSettings
from gateway.sources.source import SourceInput
from gateway.status import Snapshot, status_of
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location
from gateway.vehicle.service import (
    INFO,
    WARNING,
    Action,
    LogWarning,
    RecordingRequest,
    Reply,
    Request,
    SavePlan,
    SaveSettings,
    StatusText,
)
from gateway.vehicle.telemetry.announcements import Announcer
from gateway.vehicle_row import VehicleRow
from gateway.wire.mavlink_messages import ids_of
from gateway.wire.mavlink_splitter import frame_of, message_id_of

log = logging.getLogger(__name__)

LONGEST_WAIT_S: Final = 0.1
"""Maximum interval of polls: a sample may make something due sooner than the timer is set to."""
SHORTEST_WAIT_S: Final = 0.001
SECRET_MESSAGES: Final = ids_of("CHANGE_OPERATOR_CONTROL", "SETUP_SIGNING")
"""Messages that are not recorded: recordings are shared more easily than passwords."""


class Daemon:
    """The running gateway: receiver in, MAVLink out.

    `aircraft` has the settings of single aircraft by vehicle id; `read` reads all settings again,
    or raises ConfigError. `line` yields the frames of a simulated receiver instead of the serial
    port, or the bytes of a source of `simulated_kind`. Endpoints that are added name only files
    below `folder`, that of the settings file.
    """

    _timer: asyncio.TimerHandle | None = None

    def __init__(
        self,
        settings: GatewaySettings,
        aircraft: Mapping[int, AircraftSettings],
        read: Callable[[], GatewaySettings],
        line: Iterator[TimedFrame] | None = None,
        simulated_kind: str = "",
        folder: Path | None = None,
    ) -> None:
        self.now_us = GatewayClock()
        self._receiver = None if line is None else PtyPort(line)
        if self._receiver is not None:
            settings = _with_simulated(settings, simulated_kind, self._receiver.path)
        serial = settings.serial
        self._own_ids = set[int]() if line is None else {*aircraft}
        """Vehicle ids of our aircraft: the simulated ones, or those received so far."""
        self._settings, self._folder, self._read = settings, folder, read
        self._plans = PlanFiles(aircraft_folder(settings), self._announce_plans)
        self._timestamps = TimestampFile(aircraft_folder(settings))
        self._pipeline = self._make_pipeline(aircraft)
        needed = serial.port != AUTO or not settings.has_other_sources
        self._pipeline.disconnect(serial.port if needed else NO_RECEIVER)
        self._hub = Hub(
            settings.hub,
            self._on_frame,
            self.now_us,
            on_foreign=self._record_foreign,
            # No secret is in a run: messages with a target are not forwarded in runs.
            on_run=lambda run: self._recorder.run(run),
            on_gone=self._on_gone,
            # Others need not know the folders of this machine.
            on_alert=lambda is_trouble, text: self._announce(is_trouble, without_folders(text)),
            signer=self._pipeline.signer,
            recordings=Path(settings.recording.folder).expanduser(),
        )
        self._announcer = Announcer()
        """Sends the texts of a gateway without an aircraft of its own."""
        self._recorder, self._budget = self._make_recorder(), RecordingBudget()
        callbacks = (self._on_bytes, self._pipeline.connect, self._pipeline.disconnect)
        self._serial = SerialPort(serial, *callbacks, self.now_us, needed=needed)
        self._sources = [SourcePort(s, self._on_source, self._hub) for s in self._pipeline.ported]
        self._control = self._make_control()
        self._opening: asyncio.Task[None] | None = None
        self._files = begin_worker("settings")
        self._metrics = MetricsServer(self._metrics_text)
        self._vehicles = VehicleWatch()
        self._notifier = ServiceNotifier()
        self._sent: Counter[int] = Counter()
        self._lag = LoopLag()

    def _make_pipeline(self, aircraft: Mapping[int, AircraftSettings]) -> Pipeline:
        plans, timestamps = self._plans.load(), self._timestamps.load()
        self._broken_plans = dict(self._plans.broken)
        at_zero_us = unix_time_us() - self.now_us()
        default = self._settings.default_aircraft
        try:
            sources = make_sources(self._settings.sources, read_map)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        return Pipeline(
            PipelineSettings(
                default, aircraft, at_zero_us, plans=plans, timestamps=timestamps, sources=sources
            )
        )

    def _make_recorder(self) -> Recorder:
        return Recorder(
            self._settings.recording,
            self.now_us,
            unix_time_us,
            lambda vehicle_id: header_for(self._pipeline.find(vehicle_id).settings, vehicle_id),
            self._announce,
            lambda vehicle_id: self._pipeline.find(vehicle_id).fusion_state,
            self._introduction,
            self._locations,
            lambda: self._watch_vehicles().armed(self.now_us()),
            lambda: self._hub.observe(runs=self._recorder.takes_frames),
            # A simulated time begins with the machine's, and is late by the start-up.
            gps_time=self._receiver is None,
        )

    def _make_control(self) -> ControlServer:
        self._imu = ImuTap(
            lambda vehicle_id: self._pipeline.find(vehicle_id).settings.calibration, self._calibrate
        )
        return ControlServer(
            socket_path("run"),
            {"status": self.snapshot, "reload": self._reload_or_refuse},
            identity_verb(lambda: self._own_ids | self._hub.routed_vehicles(), self._hub.endpoints),
            recorder_verbs(
                self._recorder, lambda: bool(self._pipeline.aircraft) or self._hub.say(())
            ),
            mark_verbs(self._mark),
            serial_verbs(self._serial, is_simulated=self._receiver is not None),
            client_verbs(self._hub, self._folder),
            source_verbs(self._sources),
            self._imu.verbs(),
            introduction_verb(self._introduction),
        )

    def start(self) -> None:
        """Open everything; needs a running event loop. A missing port is retried."""
        if self._settings.hub.realtime_priority:
            set_realtime_priority(self._settings.hub.realtime_priority)
        # Several threads, since each look-up of a name takes seconds while the network is down.
        asyncio.get_running_loop().set_default_executor(begin_worker("lookups", 8))
        self._hub.start()
        self._recorder.start()
        self._hub.observe(runs=self._recorder.takes_frames)
        self._serve_metrics()
        self._serial.start()
        for source in self._sources:
            source.start()
        if self._receiver is not None:
            self._receiver.start()
        self._opening = asyncio.get_running_loop().create_task(self._open_control())
        self._poll()

    async def control_socket(self) -> Path:
        """Wait until the control socket listens, and return its path."""
        if self._opening is not None:
            await asyncio.shield(self._opening)
        return self._control.path

    async def reload(self) -> str:
        """Apply changed settings of the hub and of signing; other clients stay connected.

        Other settings apply at the next start: ground stations may have changed them since.

        Raises ConfigError if the settings are wrong; then nothing is changed.
        """
        # In a thread, as in `_save`: files take some milliseconds, or longer on a slow disk.
        loop = asyncio.get_running_loop()
        settings = await loop.run_in_executor(self._files, self._read)
        passphrase = settings.vehicle.signing_passphrase
        now = self._settings
        vehicle = msgspec.structs.replace(now.vehicle, signing_passphrase=passphrase)
        now = msgspec.structs.replace(now, hub=settings.hub, vehicle=vehicle)
        aircraft = await loop.run_in_executor(self._files, load_aircraft, now)
        own = {k: a.vehicle.signing_passphrase for k, a in aircraft.items()}
        self._notifier.reloading()
        if settings.hub.realtime_priority != self._settings.hub.realtime_priority:
            set_realtime_priority(settings.hub.realtime_priority)
        self._settings = now
        self._hub.apply(settings.hub)
        self._perform(self._pipeline.sign_by(passphrase, own, self.now_us()))
        self._serve_metrics()
        self._notifier.ready()
        if self._receiver is not None:
            settings = msgspec.structs.replace(settings, serial=now.serial, sources=now.sources)
        later = "; others need a new start" if settings != now else ""
        status = f"settings of the hub and of signing applied{later}"
        log.info(status)
        return status

    def close(self) -> None:
        """Close everything: first the inputs, then the outputs."""
        self._notifier.stopping()
        if self._receiver is not None:
            self._receiver.close()
        self._serial.close()
        for source in self._sources:
            source.close()
        if self._timer is not None:
            self._timer.cancel()
        if self._opening is not None:
            self._opening.cancel()
        self._control.close()
        self._files.shutdown()
        self._recorder.close()
        self._plans.close()
        if newest := self._pipeline.newest_timestamps():
            self._timestamps.save(0, newest)
        self._timestamps.close()
        self._metrics.close()
        self._hub.close()

    def snapshot(self) -> Snapshot:
        """Return the present state."""
        aircraft = sorted(self._pipeline.aircraft.items())
        return Snapshot(
            time_us=self.now_us(),
            report=self._pipeline.report,
            states=tuple((key, a.state) for key, a in aircraft if a.state is not None),
            clients=self._hub.clients(),
            sent=tuple(sorted(self._sent.items())),
            hub=self._hub.counters(),
            listeners=(*self._hub.listeners(), *self._metrics.listeners()),
            places_not_kept=self._plans.failures,
            refused=self._pipeline.refused,
            forged=self._pipeline.forged,
            simulated=self._receiver is not None,
            aircraft=tuple(status_of(one, self.now_us()) for _, one in aircraft),
            vehicles=self._vehicle_rows(),
            recorder=self._recorder.status(),
            requests=self._pipeline.failed_requests,
            slow_s=self._lag.longest_us / US_PER_S if self._lag.is_slow else 0.0,
        )

    def _vehicle_rows(self) -> tuple[VehicleRow, ...]:
        own = {key: one.vehicle.telemetry.mode[1] for key, one in self._pipeline.aircraft.items()}
        sources: dict[int, str] = {}
        for source in self._pipeline.sources:
            for key in source.vehicles:
                sources[key] = ", ".join(filter(None, (sources.get(key), source.url.name)))
        return self._watch_vehicles().rows(self.now_us(), own, self._hub.clients(), sources)

    def _serve_metrics(self) -> None:
        port = self._settings.hub.metrics_port
        if port:
            # Imported here, since most gateways serve no metrics; not at the first request, because
            # loading the library then would stop the telemetry for 0.3 s.
            import_module("gateway.live.metrics")
        self._metrics.listen(port)

    def _metrics_text(self) -> Iterator[str]:
        from gateway.live.metrics import prometheus_text, system_families, text_of

        yield from prometheus_text(self.snapshot())
        yield from text_of(system_families(self._watch_vehicles(), self.now_us()))

    def announce(self, text: str) -> None:
        """Announce an event that is not a problem to the ground stations."""
        self._announce(False, text)

    def toggle_recording(self) -> None:
        """Start the recorder if it is idle, else stop it, whatever the settings."""
        idle = self._recorder.status().state == SessionState.IDLE
        (self._recorder.record if idle else self._recorder.stop)()

    async def _reload_or_refuse(self) -> str:
        try:
            return await self.reload()
        except ConfigError as error:
            raise ControlError(f"settings not reloaded: {error}") from error

    def _mark(self, location: Location | None, vehicle_id: int | None) -> None:
        self._perform(self._pipeline.mark(location, vehicle_id, self.now_us()))

    def _announce(self, is_trouble: bool, text: str) -> None:
        status = StatusText(WARNING if is_trouble else INFO, text)
        if self._pipeline.aircraft:
            self._perform(self._pipeline.say(status, self.now_us()))
        else:
            said = self._announcer.say(status, self.now_us())
            self._hub.say([reply.message for reply in said if isinstance(reply, Reply)])

    async def _open_control(self) -> None:
        try:
            await self._control.start()
        except ControlError as error:
            log.warning("no control socket: %s", error)
        self._notifier.ready()
        await asyncio.to_thread(log_other_gateways)

    def _warn_of_conflicts(self, appeared: set[int]) -> None:
        for text in conflicts(appeared, self._hub.endpoints()):
            log.warning("%s", text)

    def _introduction(self, vehicle_id: int) -> list[bytes]:
        return [sent.frame for sent in self._pipeline.find(vehicle_id).vehicle.introduction()]

    def _on_bytes(self, data: bytes, now_us: int) -> None:
        if now_us > self._lag.stalled_after_us:
            # Reported before the samples that waited in the kernel, which are late for this reason.
            self._watch_loop(now_us)
        self._perform(self._pipeline.feed(data, now_us))

    def _on_source(self, source: SourceInput, data: bytes) -> None:
        if self._settings.recording.source_bytes:
            for frame in source.tunnel.frames(data):
                self._recorder.frame(frame)
        self._perform(self._pipeline.feed_source(source, data, self.now_us()))

    def _on_frame(self, incoming: Incoming) -> None:
        frame, client_id, now_us = incoming.frame, incoming.client_id, self.now_us()
        self._budget.note(client_id, now_us, trusted=incoming.trusted)
        out = self._pipeline.handle(incoming, now_us)
        if (timestamps := self._pipeline.timestamps_to_keep()) is not None:
            self._timestamps.save(0, timestamps)
        # A ground station's broadcast is both handled and forwarded: it is recorded once. Frames of
        # untrusted clients are recorded only if they had an effect.
        kept = incoming.trusted or bool(out.frames or out.records or out.orders)
        if not incoming.forwarded and kept and self._budget.allows(client_id, len(frame), now_us):
            self._record(frame)
        self._perform(out)

    def _record_foreign(self, frames: Sequence[bytes]) -> None:
        now_us = self.now_us()
        for frame in frames:
            self._record(frame)
            self._vehicles.feed(frame_of(frame), now_us)

    def _watch_vehicles(self) -> VehicleWatch:
        self._vehicles.update(self._hub.newest_frames(), self._hub.streams())
        return self._vehicles

    def _record(self, frame: bytes) -> None:
        """Record a frame of another sender, unless it contains a key or a password."""
        if message_id_of(frame) not in SECRET_MESSAGES:
            self._recorder.frame(frame)

    def _on_gone(self, client_id: int) -> None:
        self._pipeline.remove_client(client_id)
        self._budget.remove_client(client_id)

    def _send(self, frames: Sequence[Outgoing]) -> None:
        # Frames that are only recorded too, so that their numbers leave no gap at the clients.
        self._hub.send_all(frames)
        for sent in frames:
            message_id, to = sent.message_id, sent.client_id
            self._sent[message_id] += 1
            if to is None:
                self._vehicles.feed(sent.header or frame_of(sent.frame), self.now_us())
            if message_id not in UNRECORDED and (
                to is None
                or to == RECORDED_ONLY
                or self._budget.allows(to, len(sent.frame), self.now_us())
            ):
                self._recorder.frame(sent.frame)

    def _poll(self) -> None:
        # Scheduled first, so that the next turn follows even if an error is raised below.
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(LONGEST_WAIT_S, self._poll)
        now_us = self.now_us()
        self._watch_loop(now_us)
        self._perform(self._pipeline.poll(now_us))
        if appeared := self._pipeline.aircraft.keys() - self._own_ids:
            self._own_ids |= appeared
            loop.run_in_executor(None, self._warn_of_conflicts, appeared)
        for vehicle_id in self._broken_plans.keys() & self._pipeline.aircraft.keys():
            # Only after its first heartbeat: ground stations ignore earlier messages.
            self._announce_plans(vehicle_id, self._broken_plans.pop(vehicle_id))
        self._note_recorder(now_us)
        wait_s = (self._pipeline.next_due_us() - now_us) / US_PER_S
        wait_s = min(max(wait_s, SHORTEST_WAIT_S), LONGEST_WAIT_S)
        self._timer.cancel()
        self._timer = loop.call_later(wait_s, self._poll)
        self._lag.expect(self.now_us() + round(wait_s * US_PER_S))

    def _note_recorder(self, now_us: int) -> None:
        vehicles = [each.vehicle for each in self._pipeline.aircraft.values()]
        recorder = self._recorder
        recorder.set_in_flight(
            in_flight=self._pipeline.in_flight, operates=any(each.operates for each in vehicles)
        )
        self._perform(
            self._pipeline.on_recorder(
                recorder.trouble, now_us, recording=recorder.recording, expected=recorder.expected
            )
        )

    def _locations(self) -> VehicleLocations:
        return {
            vehicle_id: None
            if (home := each.vehicle.telemetry.home) is None
            else (home.location.lat_deg, home.location.lon_deg)
            for vehicle_id, each in self._pipeline.aircraft.items()
        }

    def _watch_loop(self, now_us: int) -> None:
        """Report once that the event loop is late; a stall is not counted as loss of the nodes."""
        was_slow = self._lag.is_slow
        if stalled_us := self._lag.update(now_us):
            self._pipeline.on_stall(stalled_us, now_us)
        if self._lag.is_slow == was_slow:
            return
        if self._lag.is_slow:
            text = f"This computer is too slow: {self._lag.longest_us / US_PER_S:.1f} s late"
            log.warning("%s; samples are lost here, not by the radio", text)
        else:
            text = "This computer keeps up again"
            log.info(text)
        self._announce(self._lag.is_slow, text)

    def _perform(self, out: Outputs) -> None:
        """Carry out the results of the pure stages, frames first."""
        if out.frames:
            self._send(out.frames)
        for record in out.records:
            if isinstance(record, FusedSample):
                self._imu.add(record)
            elif isinstance(record, SettingsChanged):
                self._recorder.settings_changed(record.vehicle_id)
                continue
            self._recorder.flight(record)
        for order in out.orders:
            self._carry_out(order)

    def _carry_out(self, order: Order) -> None:
        match order:
            case ClientInterval():
                self._hub.set_interval(order)
            case SaveSettings():
                self._save(self._pipeline.find(order.vehicle_id), order.request)
            case SavePlan():
                self._plans.save(order.vehicle_id, order.plan)
            case RecordingRequest():
                (self._recorder.record if order.start else self._recorder.stop)()
            case LogWarning():
                log.warning("%s", order.text)

    def _calibrate(self, vehicle_id: int, calibration: NodeCalibration) -> None:
        """Use a calibration from now on, and write it to the aircraft's file."""
        aircraft = self._pipeline.find(vehicle_id)
        if aircraft.vehicle.in_flight:
            raise ControlError(f"aircraft {vehicle_id} is in flight")
        changed = msgspec.structs.replace(aircraft.settings, calibration=calibration)
        self._perform(self._pipeline.change(vehicle_id, changed, self.now_us()))
        self._save(aircraft)

    def _save(self, aircraft: Aircraft, request: Request | None = None) -> None:
        """Write an aircraft's settings to its file, and answer a request with the outcome."""
        write = partial(save_aircraft, self._settings, aircraft.vehicle_id, aircraft.settings)
        saving = asyncio.get_running_loop().run_in_executor(self._files, write)
        saving.add_done_callback(partial(self._on_saved, aircraft, request))

    def _on_saved(
        self, aircraft: Aircraft, request: Request | None, saving: asyncio.Future[Path]
    ) -> None:
        vehicle_id, now_us = aircraft.vehicle_id, self.now_us()
        try:
            text, stored = saving.result().name, True
        except OSError as error:
            log.warning("settings of aircraft %d cannot be saved: %s", vehicle_id, error)
            text, stored = reason_of(error), False
        else:
            log.info("settings of aircraft %d saved to %s", vehicle_id, saving.result())
        if request is not None:
            answer = aircraft.vehicle.on_saved(request, text, now_us, stored=stored)
            self._perform_for(aircraft, answer)

    def _announce_plans(self, vehicle_id: int, trouble: str | None) -> None:
        status = StatusText(INFO, "Mission, mark and home are stored again")
        if trouble is not None:
            status = StatusText(WARNING, f"Mission, mark and home not stored: {trouble}")
        aircraft = self._pipeline.find(vehicle_id)
        self._perform_for(aircraft, aircraft.vehicle.say(status, self.now_us()))

    def _perform_for(self, aircraft: Aircraft, actions: Sequence[Action]) -> None:
        out = Outputs()
        aircraft.perform(actions, self.now_us(), out)
        self._perform(out)


def _with_simulated(settings: GatewaySettings, kind: str, path: str) -> GatewaySettings:
    """Replace the receiver or the sources of the settings by a simulated one."""
    # The type is given because the names of most modes do not show that it is an aeroplane.
    kept = "&type=fixed_wing" if kind == "crsf" else ""
    url = f"{kind}:{path}?id={settings.simulator.vehicle_id}{kept}"
    found = (SourceSettings(url=url),) if kind else ()
    serial = msgspec.structs.replace(settings.serial, port=NO_RECEIVER if kind else path)
    return msgspec.structs.replace(settings, sources=found, serial=serial)
