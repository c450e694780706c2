"""The composition root: builds the edges, connects them to the pipeline, and shuts them down."""

import asyncio
import logging
from collections.abc import Callable, Iterator, Mapping
from importlib import import_module
from pathlib import Path

import msgspec

from gateway.aircraft import AircraftSettings
from gateway.clock import GatewayClock, unix_time_us
from gateway.config import ConfigError, GatewaySettings, aircraft_folder, load_aircraft
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
from gateway.live.operation import Operation
from gateway.live.other_gateways import identity_verb, log_other_gateways
from gateway.live.pty_port import PtyPort
from gateway.live.recorder import Recorder
from gateway.live.serial_port import AUTO, SerialPort
from gateway.live.service import ServiceNotifier, set_realtime_priority
from gateway.live.session import RecordingSettings, SessionState, VehicleLocations
from gateway.live.source_port import SourcePort, read_map
from gateway.pipeline import Pipeline, PipelineSettings
from gateway.printable import NO_RECEIVER, without_folders
from gateway.recordings.recorded_table import header_for
from gateway.simulator.timed_frame import TimedFrame
from gateway.sources.kinds import make_sources
from gateway.sources.settings import SourceSettings
from gateway.status import Snapshot, status_of
from gateway.units import US_PER_S
from gateway.vehicle_row import VehicleRow

log = logging.getLogger(__name__)


class Daemon:
    """The running gateway: receiver in, MAVLink out.

    `aircraft` has the settings of single aircraft by vehicle id; `read` reads all settings again,
    or raises ConfigError. `line` yields the frames of a simulated receiver instead of the serial
    port, or the bytes of a source of `simulated_kind`. Endpoints that are added name only files
    below `folder`, that of the settings file.
    """

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
        self._folder, self._read = folder, read
        self._plans = PlanFiles(
            aircraft_folder(settings), lambda *about: self._operation.announce_plans(*about)
        )
        self._timestamps = TimestampFile(aircraft_folder(settings))
        self._pipeline = self._make_pipeline(settings, aircraft)
        needed = serial.port != AUTO or not settings.has_other_sources
        self._pipeline.disconnect(serial.port if needed else NO_RECEIVER)
        self._files = begin_worker("settings")
        kept = (self._plans, self._timestamps, self._files)
        self._operation = Operation(settings, self._pipeline, *kept, self.now_us)
        if self._receiver is not None:
            self._operation.own_ids |= aircraft.keys()
        self._hub = self._make_hub(settings)
        self._recorder = self._make_recorder(settings.recording)
        self._imu = ImuTap(
            lambda vehicle_id: self._pipeline.find(vehicle_id).settings.calibration,
            self._operation.calibrate,
        )
        self._operation.connect(self._hub, self._recorder, self._imu)
        callbacks = (self._operation.on_bytes, self._pipeline.connect, self._pipeline.disconnect)
        self._serial = SerialPort(serial, *callbacks, self.now_us, needed=needed)
        self._sources = [
            SourcePort(each, self._operation.on_source, self._hub) for each in self._pipeline.ported
        ]
        self._control = self._make_control()
        self._opening: asyncio.Task[None] | None = None
        self._metrics = MetricsServer(self._metrics_text)
        self._notifier = ServiceNotifier()

    def _make_pipeline(
        self, settings: GatewaySettings, aircraft: Mapping[int, AircraftSettings]
    ) -> Pipeline:
        plans, timestamps = self._plans.load(), self._timestamps.load()
        at_zero_us = unix_time_us() - self.now_us()
        default = settings.default_aircraft
        try:
            sources = make_sources(settings.sources, read_map)
        except ValueError as error:
            raise ConfigError(str(error)) from error
        return Pipeline(
            PipelineSettings(
                default, aircraft, at_zero_us, plans=plans, timestamps=timestamps, sources=sources
            )
        )

    def _make_hub(self, settings: GatewaySettings) -> Hub:
        operation = self._operation
        return Hub(
            settings.hub,
            operation.on_frame,
            self.now_us,
            on_foreign=operation.on_foreign,
            # No secret is in a run: messages with a target are not forwarded in runs.
            on_run=lambda run: self._recorder.run(run),
            on_gone=operation.on_gone,
            # Others need not know the folders of this machine.
            on_alert=lambda is_trouble, text: operation.announce(is_trouble, without_folders(text)),
            signer=self._pipeline.signer,
            recordings=Path(settings.recording.folder).expanduser(),
        )

    def _make_recorder(self, settings: RecordingSettings) -> Recorder:
        return Recorder(
            settings,
            self.now_us,
            unix_time_us,
            lambda vehicle_id: header_for(self._pipeline.find(vehicle_id).settings, vehicle_id),
            self._operation.announce,
            lambda vehicle_id: self._pipeline.find(vehicle_id).fusion_state,
            self._introduction,
            self._locations,
            lambda: self._operation.watch_vehicles().armed(self.now_us()),
            lambda: self._hub.observe(runs=self._recorder.takes_frames),
            # A simulated time begins with the machine's, and is late by the start-up.
            gps_time=self._receiver is None,
        )

    def _make_control(self) -> ControlServer:
        return ControlServer(
            socket_path("run"),
            {"status": self.snapshot, "reload": self._reload_or_refuse},
            identity_verb(
                lambda: self._operation.own_ids | self._hub.routed_vehicles(), self._hub.endpoints
            ),
            recorder_verbs(
                self._recorder, lambda: bool(self._pipeline.aircraft) or self._hub.announce(())
            ),
            mark_verbs(self._operation.mark),
            serial_verbs(self._serial, is_simulated=self._receiver is not None),
            client_verbs(self._hub, self._folder),
            source_verbs(self._sources),
            self._imu.verbs(),
            introduction_verb(self._introduction),
        )

    def start(self) -> None:
        """Open everything; needs a running event loop. A missing port is retried."""
        if priority := self._operation.settings.hub.realtime_priority:
            set_realtime_priority(priority)
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
        self._operation.poll()

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
        now = self._operation.settings
        vehicle = msgspec.structs.replace(now.vehicle, signing_passphrase=passphrase)
        now = msgspec.structs.replace(now, hub=settings.hub, vehicle=vehicle)
        aircraft = await loop.run_in_executor(self._files, load_aircraft, now)
        own = {k: a.vehicle.signing_passphrase for k, a in aircraft.items()}
        self._notifier.reloading()
        if settings.hub.realtime_priority != self._operation.settings.hub.realtime_priority:
            set_realtime_priority(settings.hub.realtime_priority)
        self._operation.settings = now
        self._hub.apply(settings.hub)
        self._operation.perform(self._pipeline.sign_by(passphrase, own, self.now_us()))
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
        self._operation.close()
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
        aircraft, operation = sorted(self._pipeline.aircraft.items()), self._operation
        return Snapshot(
            time_us=self.now_us(),
            report=self._pipeline.report,
            states=tuple((key, a.state) for key, a in aircraft if a.state is not None),
            clients=self._hub.clients(),
            sent=tuple(sorted(operation.sent.items())),
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
            slow_s=operation.lag.longest_us / US_PER_S if operation.lag.is_slow else 0.0,
        )

    def _vehicle_rows(self) -> tuple[VehicleRow, ...]:
        own = {key: one.vehicle.telemetry.mode[1] for key, one in self._pipeline.aircraft.items()}
        sources: dict[int, str] = {}
        for source in self._pipeline.sources:
            for key in source.vehicles:
                sources[key] = ", ".join(filter(None, (sources.get(key), source.url.name)))
        watch = self._operation.watch_vehicles()
        return watch.rows(self.now_us(), own, self._hub.clients(), sources)

    def _serve_metrics(self) -> None:
        port = self._operation.settings.hub.metrics_port
        if port:
            # Imported here, since most gateways serve no metrics; not at the first request, because
            # loading the library then would stop the telemetry for 0.3 s.
            import_module("gateway.live.metrics")
        self._metrics.listen(port)

    def _metrics_text(self) -> Iterator[str]:
        from gateway.live.metrics import prometheus_text, system_families, text_of

        yield from prometheus_text(self.snapshot())
        yield from text_of(system_families(self._operation.watch_vehicles(), self.now_us()))

    def announce(self, text: str) -> None:
        """Announce an event that is not a problem to the ground stations."""
        self._operation.announce(False, text)

    def toggle_recording(self) -> None:
        """Start the recorder if it is idle, else stop it, whatever the settings."""
        idle = self._recorder.status().state == SessionState.IDLE
        (self._recorder.record if idle else self._recorder.stop)()

    async def _reload_or_refuse(self) -> str:
        try:
            return await self.reload()
        except ConfigError as error:
            raise ControlError(f"settings not reloaded: {error}") from error

    async def _open_control(self) -> None:
        try:
            await self._control.start()
        except ControlError as error:
            log.warning("no control socket: %s", error)
        self._notifier.ready()
        await asyncio.to_thread(log_other_gateways)

    def _introduction(self, vehicle_id: int) -> list[bytes]:
        return [sent.frame for sent in self._pipeline.find(vehicle_id).vehicle.introduction()]

    def _locations(self) -> VehicleLocations:
        return {
            vehicle_id: None
            if (home := each.vehicle.telemetry.home) is None
            else (home.location.lat_deg, home.location.lon_deg)
            for vehicle_id, each in self._pipeline.aircraft.items()
        }


def _with_simulated(settings: GatewaySettings, kind: str, path: str) -> GatewaySettings:
    """Replace the receiver or the sources of the settings by a simulated one."""
    # The type is given because the names of most modes do not show that it is an aeroplane.
    kept = "&type=fixed_wing" if kind == "crsf" else ""
    url = f"{kind}:{path}?id={settings.simulator.vehicle_id}{kept}"
    found = (SourceSettings(url=url),) if kind else ()
    serial = msgspec.structs.replace(settings.serial, port=NO_RECEIVER if kind else path)
    return msgspec.structs.replace(settings, sources=found, serial=serial)
