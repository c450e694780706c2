"""Process the receiver's bytes for each aircraft: `wire → sensing → estimation → vehicle`.

    receiver's bytes ─ Link ─ raw records ─┬─ Aircraft 1: SensorChain ─ Estimator ─ Vehicle ─┐
                                           └─ Aircraft 2: …                                  │
    client's frames ──────────────────────────────────────────────────────────── Vehicle ────┤
                                                                                          Outputs

Pure: time is an argument, and results are returned as `Outputs`. An aircraft is created with its
first record. One that sends nothing for `GONE_US` is removed, and restored with its state when a
record of it is received again. Live operation, demo and playback differ only in the caller of
`feed` (bytes) or `feed_record` (raw records of a recording).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import msgspec

from gateway.aircraft import Aircraft, AircraftSettings, FusedStates, Outputs, with_passphrase
from gateway.records import (
    FusionState,
    GpsFix,
    ImuCalibrated,
    Incoming,
    LinkReport,
    LoggedRequest,
    RawRecord,
    VehicleReport,
)
from gateway.sources.source import SourceInput
from gateway.units import US_PER_S
from gateway.vehicle.plan import Location, StoredPlan
from gateway.vehicle.request_reader import BAD_SIGNATURE
from gateway.vehicle.service import Action, StatusText
from gateway.vehicle.vehicle import Vehicle
from gateway.wire.link import Link
from gateway.wire.mavlink_signing import (
    FrameSigner,
    KeptTimestamps,
    SigningClock,
    SigningTimestamps,
    key_from_passphrase,
)
from gateway.wire.timesync import GpsTime

FedRecord = RawRecord | ImuCalibrated | VehicleReport
REPORT_INTERVAL_US: Final = US_PER_S
RADIOHEAD_HEADER: Final = 4
"""Size in bytes: to, from, id and flags."""
GONE_US: Final = 600 * US_PER_S
"""Timeout after which an aircraft is removed; longer than a change of batteries."""


@dataclass(frozen=True, slots=True)
class PipelineSettings:
    """The settings of all aircraft."""

    default: AircraftSettings
    aircraft: Mapping[int, AircraftSettings] = field(default_factory=dict)
    """Settings of single aircraft instead of the default, by vehicle id."""
    unix_us_at_zero: int = 0
    """Civil time at zero of the gateway clock, as far as known."""
    fused: FusedStates | None = None
    """States of a recording that replace the estimator."""
    plans: Mapping[int, StoredPlan] = field(default_factory=dict)
    """Missions, marks and home positions stored by an earlier run, by vehicle id."""
    timestamps: Mapping[int, Mapping[str, Mapping[str, int]]] = field(default_factory=dict)
    """Signing timestamps stored by an earlier run, by vehicle id; see `SigningTimestamps`."""
    sources: Sequence[SourceInput] = ()
    """Sources other than the receiver."""


class Pipeline:
    """All stages from the bytes of the sources to the frames for clients."""

    def __init__(self, settings: PipelineSettings) -> None:
        self._settings = settings
        self._link = Link()
        self.sources = settings.sources
        self._of_receiver = [each for each in self.sources if each.url.transport == "receiver"]
        self.ported = [each for each in self.sources if each not in self._of_receiver]
        """The sources with a transport of their own."""
        self._signing_clock = SigningClock(settings.unix_us_at_zero)
        self.signer = FrameSigner(self._signing_clock)
        """Signs the frames of all aircraft that have a passphrase, when they are sent."""
        self._set_shared_key(settings.default.vehicle.signing_passphrase)
        self._timestamps = {
            key: SigningTimestamps(kept) for key, kept in settings.timestamps.items()
        }
        self._gps_time = GpsTime()
        self._connected = False
        self._port = ""
        self._report_due_us = 0
        self.aircraft: dict[int, Aircraft] = {}
        """The present aircraft, by vehicle id."""
        self._gone: dict[int, Aircraft] = {}
        self.report: LinkReport = self._link.report(0, connected=False, port="")
        """The newest link report, updated once a second."""

    def feed(self, data: bytes, now_us: int) -> Outputs:
        """Process bytes of the receiver, read at `now_us`."""
        out = Outputs()
        for record in self._link.feed(data, now_us):
            self._feed(record, now_us, out)
        if self._link.packets:
            self._feed_packets(now_us, out)
        return out

    def _feed_packets(self, now_us: int, out: Outputs) -> None:
        """Pass packets of other programs, without their RadioHead header, to their sources."""
        for source in self._of_receiver:
            for packet in self._link.packets:
                content = packet.packet[RADIOHEAD_HEADER:]
                for record in source.feed(content, now_us, packet.signal):
                    self._feed(record, now_us, out)
        self._link.packets.clear()

    def feed_source(self, source: SourceInput, data: bytes, now_us: int) -> Outputs:
        """Process bytes of a source other than the receiver."""
        out = Outputs()
        for record in source.feed(data, now_us):
            self._feed(record, now_us, out)
        return out

    def feed_record(self, record: FedRecord, now_us: int) -> Outputs:
        """Process one raw record of a recording."""
        out = Outputs()
        self._feed(record, now_us, out)
        return out

    def _feed(self, record: FedRecord, now_us: int, out: Outputs) -> None:
        vehicle_id = record.node.vehicle_id
        if isinstance(record, GpsFix) and record.utc_us is not None:
            at_zero_us = self._gps_time.update(vehicle_id, record.utc_us, record.time_us)
            if at_zero_us is not None:
                self._signing_clock.set_gps_time(at_zero_us)
        aircraft = self.aircraft.get(vehicle_id)
        if aircraft is None:
            aircraft = self._aircraft_of(vehicle_id)
            # The heartbeat must be first: ground stations ignore an aircraft's messages before it.
            aircraft.perform(aircraft.vehicle.poll(now_us), now_us, out)
        aircraft.received_us = now_us
        aircraft.feed(record, now_us, out)

    def _aircraft_of(self, vehicle_id: int) -> Aircraft:
        aircraft = self.aircraft.get(vehicle_id)
        if aircraft is None:
            aircraft = self._gone.pop(vehicle_id, None) or self._new(vehicle_id)
            self.aircraft[vehicle_id] = aircraft
        return aircraft

    def _new(self, vehicle_id: int) -> Aircraft:
        known = self._settings
        aircraft = Aircraft(
            vehicle_id,
            known.aircraft.get(vehicle_id, known.default),
            clock=self._signing_clock,
            timestamps=self._timestamps.setdefault(vehicle_id, SigningTimestamps()),
            stored=known.plans.get(vehicle_id),
            fused=known.fused,
        )
        self._set_key(aircraft)
        return aircraft

    def _set_key(self, aircraft: Aircraft) -> None:
        """Set an aircraft's key in the signer, or remove it."""
        key = aircraft.vehicle.signing_key
        if key is None:
            self.signer.keys.pop(aircraft.vehicle_id, None)
        else:
            self.signer.keys[aircraft.vehicle_id] = key

    def _set_shared_key(self, passphrase: str) -> None:
        """Set the key with which the signer renews signatures of other systems."""
        self.signer.shared_key = key_from_passphrase(passphrase) if passphrase else b""

    def find(self, vehicle_id: int) -> Aircraft:
        """Return an aircraft that was received at some time; raises KeyError for any other."""
        found = self.aircraft.get(vehicle_id)
        return self._gone[vehicle_id] if found is None else found

    def _all_aircraft(self) -> list[Aircraft]:
        return [*self.aircraft.values(), *self._gone.values()]

    def change(self, vehicle_id: int, settings: AircraftSettings, now_us: int) -> Outputs:
        """Change an aircraft's settings, at the time of the change in the recording."""
        out = Outputs()
        if (aircraft := self.aircraft.get(vehicle_id)) is not None:
            aircraft.change(settings, now_us, out)
        return out

    def restore(self, state: FusionState) -> None:
        """Restore an aircraft's fusion from a state; raises ValueError as `make_fusion`."""
        self._aircraft_of(state.vehicle_id).restore(state)

    def sign_by(self, common: str, own: Mapping[int, str], now_us: int) -> Outputs:
        """Sign frames, and verify signatures, with other passphrases from now on; empty for none.

        `common` is used by every aircraft without its own.
        """
        known = self._settings
        aircraft = {
            key: with_passphrase(known.aircraft.get(key, known.default), own.get(key, common))
            for key in {*known.aircraft, *own}
        }
        default = with_passphrase(known.default, common)
        self._settings = replace(known, default=default, aircraft=aircraft)
        self._set_shared_key(common)
        out = Outputs()
        for each in self._all_aircraft():
            each.sign_by(own.get(each.vehicle_id, common), now_us, out)
            self._set_key(each)
        return out

    def timestamps_to_keep(self) -> dict[int, KeptTimestamps] | None:
        """Return the signing timestamps of all aircraft if they must be stored now."""
        if not any(book.is_due for book in self._timestamps.values()):
            return None
        return {key: book.to_keep() for key, book in self._timestamps.items()}

    def newest_timestamps(self) -> dict[int, KeptTimestamps]:
        """Return the signing timestamps of all aircraft, for a clean shutdown."""
        return {key: found for key, book in self._timestamps.items() if (found := book.exact())}

    def connect(self, port: str) -> None:
        """Set the state to connected; partly received data is dropped."""
        self._link.reopened()
        self._connected, self._port = True, port
        for source in self._of_receiver:
            source.opened()
        self._report_due_us = 0

    def disconnect(self, port: str) -> None:
        """Set the state to disconnected."""
        self._connected, self._port = False, port
        for source in self._of_receiver:
            source.lost("the receiver is not connected")
        self._report_due_us = 0

    def handle(self, incoming: Incoming, now_us: int) -> Outputs:
        """Pass a client's frame to all aircraft; the addressed one answers."""
        return self._each(now_us, lambda vehicle: vehicle.handle(incoming, now_us))

    def _each(self, now_us: int, do: Callable[[Vehicle], list[Action]]) -> Outputs:
        """Perform the actions of all present vehicles."""
        out = Outputs()
        for aircraft in self.aircraft.values():
            aircraft.perform(do(aircraft.vehicle), now_us, out)
        return out

    def remove_client(self, client_id: int) -> None:
        """Drop the state kept for a client that has disconnected."""
        for aircraft in self._all_aircraft():
            aircraft.vehicle.remove_client(client_id)

    def announce(self, status: StatusText, now_us: int) -> Outputs:
        """Send a text from all aircraft."""
        return self._each(now_us, lambda vehicle: vehicle.announce(status, now_us))

    def mark(self, location: Location | None, vehicle_id: int | None, now_us: int) -> Outputs:
        """Mark a location for one aircraft, or for all, or clear the mark.

        Raises ValueError if the position is invalid, or the aircraft is not known.
        """
        wanted = [a for a in self.aircraft.values() if vehicle_id in (None, a.vehicle_id)]
        if not wanted:
            if not self.aircraft:
                raise ValueError("no aircraft received yet")
            known = ", ".join(map(str, sorted(self.aircraft)))
            raise ValueError(f"no aircraft {vehicle_id}; received: {known}")
        out = Outputs()
        for aircraft in wanted:
            aircraft.perform(aircraft.vehicle.put_mark(location, now_us), now_us, out)
        return out

    @property
    def in_flight(self) -> bool:
        """Whether an aircraft is in flight."""
        return any(aircraft.vehicle.in_flight for aircraft in self.aircraft.values())

    @property
    def refused(self) -> int:
        """Number of requests to change something from clients without permission."""
        return sum(aircraft.vehicle.refusals for aircraft in self._all_aircraft())

    @property
    def failed_requests(self) -> tuple[LoggedRequest, ...]:
        """Requests of clients that were refused, failed or not answered, the newest last."""
        found = (entry for each in self._all_aircraft() for entry in each.vehicle.requests.entries)
        return tuple(sorted(found, key=lambda entry: entry.time_us))

    @property
    def forged(self) -> int:
        """Number of requests with a wrong, old or repeated signature."""
        return sum(a.vehicle.faults[BAD_SIGNATURE] for a in self._all_aircraft())

    def on_stall(self, stalled_us: int, now_us: int) -> None:
        """Extend timeouts of sensors and nodes by a time in which this program did not run."""
        for each in self._all_aircraft():
            each.vehicle.health.on_stall(stalled_us, now_us)
            if each.received_us is not None:
                each.received_us += stalled_us

    def on_recorder(
        self, trouble: str, now_us: int, *, recording: bool, expected: bool = True
    ) -> Outputs:
        """Announce whether a recording runs and should run, or why not."""
        state = {"recording": recording, "expected": expected}
        return self._each(now_us, lambda vehicle: vehicle.on_recorder(trouble, now_us, **state))

    def poll(self, now_us: int) -> Outputs:
        """Return what is due by time."""
        out = Outputs()
        reporting = now_us >= self._report_due_us
        if reporting:
            self._report_due_us = now_us + REPORT_INTERVAL_US
            report = self._link.report(now_us, connected=self._connected, port=self._port)
            sources = tuple(source.report(now_us) for source in self.sources)
            self.report = msgspec.structs.replace(report, sources=sources)
            self._remove_gone(now_us)
        for aircraft in self.aircraft.values():
            if reporting:
                report = self._report_for(aircraft.vehicle_id)
                aircraft.perform(aircraft.vehicle.on_link(report, now_us), now_us, out)
            aircraft.perform(aircraft.vehicle.poll(now_us), now_us, out)
        return out

    def _report_for(self, vehicle_id: int) -> LinkReport:
        """Return the report with the state of the source of a vehicle's records, as of nodes."""
        report = self.report
        links = tuple(each for source in self.sources for each in source.links(report.time_us))
        report = msgspec.structs.replace(report, nodes=report.nodes + links)
        for source in self.sources:
            if vehicle_id in source.vehicles:
                known = {"connected": source.connected, "port": source.url.name, "name": "Source"}
                return msgspec.structs.replace(report, **known)
        return report

    def _remove_gone(self, now_us: int) -> None:
        for vehicle_id, aircraft in list(self.aircraft.items()):
            if aircraft.received_us is None:
                aircraft.received_us = now_us
            if now_us - aircraft.received_us > GONE_US:
                self._gone[vehicle_id] = self.aircraft.pop(vehicle_id)

    def next_due_us(self) -> int:
        """Return when `poll` must be called next, at the latest."""
        due = [aircraft.vehicle.next_due_us() for aircraft in self.aircraft.values()]
        return min([self._report_due_us, *due])
