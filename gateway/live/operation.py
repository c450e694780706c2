"""The stages in operation: what arrives goes to the pipeline, and its results are carried out."""

import asyncio
import logging
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from pathlib import Path
from typing import Final

import msgspec

from gateway.aircraft import Aircraft, Order, Outputs, SettingsChanged
from gateway.clock import GatewayClock
from gateway.config import GatewaySettings, save_aircraft
from gateway.hub.hub import Hub
from gateway.live.control_socket import ControlError
from gateway.live.control_verbs import ImuTap
from gateway.live.kept_files import PlanFiles, TimestampFile
from gateway.live.other_gateways import conflicts
from gateway.live.recorded_traffic import RecordedTraffic
from gateway.live.recorder import Recorder
from gateway.live.service import LoopLag
from gateway.live.vehicle_watch import VehicleWatch
from gateway.pipeline import Pipeline
from gateway.printable import reason_of
from gateway.records import ClientInterval, FusedSample, Incoming, Outgoing
from gateway.sensing.calibration import NodeCalibration
from gateway.sources.source import SourceInput
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
from gateway.wire.mavlink_splitter import frame_of

log = logging.getLogger(__name__)

LONGEST_WAIT_S: Final = 0.1
"""Maximum interval of polls: a sample may make something due sooner than the timer is set to."""
SHORTEST_WAIT_S: Final = 0.001


class Operation:
    """Passes bytes and frames to the pipeline; sends, records and stores what results.

    `plans` and `timestamps` have been loaded, and `files` is the thread that writes settings.
    `connect` is called before anything else.
    """

    _hub: Hub
    _recorder: Recorder
    _traffic: RecordedTraffic
    _imu: ImuTap
    _timer: asyncio.TimerHandle | None = None

    def __init__(
        self,
        settings: GatewaySettings,
        pipeline: Pipeline,
        plans: PlanFiles,
        timestamps: TimestampFile,
        files: Executor,
        now_us: GatewayClock,
    ) -> None:
        self.settings = settings
        """The settings in use; the file of an aircraft contains the differences from them."""
        self._pipeline, self._now_us = pipeline, now_us
        self._plans, self._timestamps, self._files = plans, timestamps, files
        self._broken_plans = dict(plans.broken)
        self._announcer = Announcer()
        """Sends the texts of a gateway without an aircraft of its own."""
        self._vehicles = VehicleWatch()
        self.own_ids = set[int]()
        """Vehicle ids of our aircraft: those that are known to be simulated, or received."""
        self.sent: Counter[int] = Counter()
        """Sent messages by their id."""
        self.lag = LoopLag()

    def connect(self, hub: Hub, recorder: Recorder, imu: ImuTap) -> None:
        """Set where results go."""
        self._hub, self._recorder, self._imu = hub, recorder, imu
        self._traffic = RecordedTraffic(recorder)

    def close(self) -> None:
        """Poll no more."""
        if self._timer is not None:
            self._timer.cancel()

    def poll(self) -> None:
        """Do what is due by time, now and from now on; needs a running event loop."""
        # Scheduled first, so that the next turn follows even if an error is raised below.
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(LONGEST_WAIT_S, self.poll)
        now_us = self._now_us()
        self._watch_loop(now_us)
        self.perform(self._pipeline.poll(now_us))
        if appeared := self._pipeline.aircraft.keys() - self.own_ids:
            self.own_ids |= appeared
            loop.run_in_executor(None, self._warn_of_conflicts, appeared)
        for vehicle_id in self._broken_plans.keys() & self._pipeline.aircraft.keys():
            # Only after its first heartbeat: ground stations ignore earlier messages.
            self.announce_plans(vehicle_id, self._broken_plans.pop(vehicle_id))
        self._note_recorder(now_us)
        wait_s = (self._pipeline.next_due_us() - now_us) / US_PER_S
        wait_s = min(max(wait_s, SHORTEST_WAIT_S), LONGEST_WAIT_S)
        self._timer.cancel()
        self._timer = loop.call_later(wait_s, self.poll)
        self.lag.expect(self._now_us() + round(wait_s * US_PER_S))

    def _warn_of_conflicts(self, appeared: set[int]) -> None:
        for text in conflicts(appeared, self._hub.endpoints()):
            log.warning("%s", text)

    def _note_recorder(self, now_us: int) -> None:
        vehicles = [each.vehicle for each in self._pipeline.aircraft.values()]
        recorder = self._recorder
        recorder.set_in_flight(
            in_flight=self._pipeline.in_flight, operates=any(each.operates for each in vehicles)
        )
        self.perform(
            self._pipeline.on_recorder(
                recorder.trouble, now_us, recording=recorder.recording, expected=recorder.expected
            )
        )

    def _watch_loop(self, now_us: int) -> None:
        """Report once that the event loop is late; a stall is not counted as loss of the nodes."""
        was_slow = self.lag.is_slow
        if stalled_us := self.lag.update(now_us):
            self._pipeline.on_stall(stalled_us, now_us)
        if self.lag.is_slow == was_slow:
            return
        if self.lag.is_slow:
            text = f"This computer is too slow: {self.lag.longest_us / US_PER_S:.1f} s late"
            log.warning("%s; samples are lost here, not by the radio", text)
        else:
            text = "This computer keeps up again"
            log.info(text)
        self.announce(self.lag.is_slow, text)

    def on_bytes(self, data: bytes, now_us: int) -> None:
        """Process bytes of the receiver."""
        if now_us > self.lag.stalled_after_us:
            # Reported before the samples that waited in the kernel, which are late for this reason.
            self._watch_loop(now_us)
        self.perform(self._pipeline.feed(data, now_us))

    def on_source(self, source: SourceInput, data: bytes) -> None:
        """Process bytes of another source."""
        if self.settings.recording.source_bytes:
            for frame in source.tunnel.frames(data):
                self._recorder.frame(frame)
        self.perform(self._pipeline.feed_source(source, data, self._now_us()))

    def on_frame(self, incoming: Incoming) -> None:
        """Process a client's frame to our vehicles."""
        now_us = self._now_us()
        out = self._pipeline.handle(incoming, now_us)
        if (timestamps := self._pipeline.timestamps_to_keep()) is not None:
            self._timestamps.save(0, timestamps)
        had_effect = bool(out.frames or out.records or out.orders)
        self._traffic.received(incoming, now_us, had_effect=had_effect)
        self.perform(out)

    def on_foreign(self, frames: Sequence[bytes]) -> None:
        """Process frames of other systems that the hub has forwarded."""
        now_us = self._now_us()
        self._traffic.forwarded(frames)
        for frame in frames:
            self._vehicles.feed(frame_of(frame), now_us)

    def on_gone(self, client_id: int) -> None:
        """Drop the state kept for a client that has gone."""
        self._pipeline.remove_client(client_id)
        self._traffic.quotas.remove_client(client_id)

    def watch_vehicles(self) -> VehicleWatch:
        """Return the present states of all vehicles."""
        self._vehicles.update(self._hub.newest_frames(), self._hub.streams())
        return self._vehicles

    def mark(self, location: Location | None, vehicle_id: int | None) -> None:
        """Mark a location, or clear the mark; see `Pipeline.mark`."""
        self.perform(self._pipeline.mark(location, vehicle_id, self._now_us()))

    def announce(self, is_trouble: bool, text: str) -> None:
        """Announce an event to the ground stations."""
        status = StatusText(WARNING if is_trouble else INFO, text)
        if self._pipeline.aircraft:
            self.perform(self._pipeline.announce(status, self._now_us()))
        else:
            found = self._announcer.announce(status, self._now_us())
            self._hub.announce([reply.message for reply in found if isinstance(reply, Reply)])

    def announce_plans(self, vehicle_id: int, trouble: str | None) -> None:
        """Announce why the plans of an aircraft are not stored, or that they are again."""
        status = StatusText(INFO, "Mission, mark and home are stored again")
        if trouble is not None:
            status = StatusText(WARNING, f"Mission, mark and home not stored: {trouble}")
        aircraft = self._pipeline.find(vehicle_id)
        self._perform_for(aircraft, aircraft.vehicle.announce(status, self._now_us()))

    def perform(self, out: Outputs) -> None:
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

    def _perform_for(self, aircraft: Aircraft, actions: Sequence[Action]) -> None:
        out = Outputs()
        aircraft.perform(actions, self._now_us(), out)
        self.perform(out)

    def _send(self, frames: Sequence[Outgoing]) -> None:
        # Frames that are only recorded too, so that their numbers leave no gap at the clients.
        self._hub.send_all(frames)
        for sent in frames:
            self.sent[sent.message_id] += 1
            if sent.client_id is None:
                self._vehicles.feed(sent.header or frame_of(sent.frame), self._now_us())
            self._traffic.sent(sent, self._now_us())

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

    def calibrate(self, vehicle_id: int, calibration: NodeCalibration) -> None:
        """Use a calibration from now on, and write it to the aircraft's file."""
        aircraft = self._pipeline.find(vehicle_id)
        if aircraft.vehicle.in_flight:
            raise ControlError(f"aircraft {vehicle_id} is in flight")
        changed = msgspec.structs.replace(aircraft.settings, calibration=calibration)
        self.perform(self._pipeline.change(vehicle_id, changed, self._now_us()))
        self._save(aircraft)

    def _save(self, aircraft: Aircraft, request: Request | None = None) -> None:
        """Write an aircraft's settings to its file, and answer a request with the outcome."""
        write = partial(save_aircraft, self.settings, aircraft.vehicle_id, aircraft.settings)
        saving = asyncio.get_running_loop().run_in_executor(self._files, write)
        saving.add_done_callback(partial(self._on_saved, aircraft, request))

    def _on_saved(
        self, aircraft: Aircraft, request: Request | None, saving: asyncio.Future[Path]
    ) -> None:
        vehicle_id, now_us = aircraft.vehicle_id, self._now_us()
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
