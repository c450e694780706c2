"""The newest state of every vehicle of the hub, foreign ones included, and their lost frames.

Status, live view and metrics are made of it. A message of one kind is decoded a few times a second
at most, since a router passes on thousands. The lost frames of a system are counted by its sequence
numbers; with several links to one system, only frames that all of them lost count.
"""

from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.frame_stream import FrameStream
from gateway.hub.routing_table import Origin
from gateway.hub.stats import ClientStats
from gateway.live.session import VehicleLocations
from gateway.units import US_PER_S
from gateway.vehicle_row import VehicleRow
from gateway.vehicle_state.newest import (
    HEARTBEAT_TIMEOUT_US,
    STATE_IDS,
    NewestState,
    NewestVehicles,
)
from gateway.vehicle_state.senders import MODES_ID
from gateway.wire.mavlink_splitter import MavFrame, frame_of

MAX_SYSTEMS: Final = 32
"""Maximum vehicles; more are forged."""
DECODED_US: Final = US_PER_S // 5
"""Minimum interval at which messages of one kind are decoded."""
RECEIVER: Final = "receiver"
"""Link of a vehicle of the receiver's boards."""


class VehicleWatch:
    """The states of all vehicles, fed with the frames of the hub."""

    def __init__(self) -> None:
        self.streams: dict[int, FrameStream] = {}
        """Received frames by system id."""
        self._vehicles = NewestVehicles()
        self._decoded_us: dict[tuple[int, int], int] = {}
        """When each message of each system was last decoded."""

    def update(
        self, newest: Iterable[tuple[bytes, int]], streams: Mapping[Origin, FrameStream]
    ) -> None:
        """Process the newest frames of others with their times, and all their sequence numbers."""
        for data, time_us in newest:
            self.feed(frame_of(data), time_us)
        self.streams = {
            origin[0]: stream
            for origin, stream in streams.items()
            if self._vehicles.components.is_known(*origin)
        }

    def feed(self, frame: MavFrame, now_us: int) -> None:
        """Process a frame of a vehicle, received or of our own."""
        if frame.message_id not in STATE_IDS:
            return
        system_id, key = frame.origin[0], (frame.origin[0], frame.message_id)
        is_old = now_us - self._decoded_us.get(key, -DECODED_US) >= DECODED_US
        if not is_old and frame.message_id != MODES_ID:
            return
        known = self._vehicles.states
        if system_id not in known and len(self.present(now_us)) >= MAX_SYSTEMS:
            return
        if self._vehicles.feed(frame, now_us) is not None:
            self._decoded_us[key] = now_us

    def present(self, now_us: int) -> dict[int, NewestState]:
        """Return the vehicles that were received recently."""
        return dict(list(self._vehicles.heard(now_us).items())[:MAX_SYSTEMS])

    def armed(self, now_us: int) -> VehicleLocations:
        """Return latitude and longitude of each armed vehicle, deg; None without a position."""
        return {
            system_id: None if (at := state.position) is None else (at.lat_deg, at.lon_deg)
            for system_id, state in self.present(now_us).items()
            if state.is_armed() and state.age_us(now_us, "HEARTBEAT") <= HEARTBEAT_TIMEOUT_US
        }

    def rows(
        self,
        now_us: int,
        own: Mapping[int, str],
        clients: Iterable[ClientStats],
        sources: Mapping[int, str] = MappingProxyType({}),
    ) -> tuple[VehicleRow, ...]:
        """Return the status of each vehicle.

        `own` are the modes of the gateway's own vehicles by system id, and `sources` are the links
        of those that do not come from the receiver.
        """
        links = {system_id: client.name for client in clients for system_id, _ in client.systems}
        links |= {system_id: sources.get(system_id, RECEIVER) for system_id in own}
        return tuple(
            self._row(system_id, state, now_us, own.get(system_id), links.get(system_id, ""))
            for system_id, state in self.present(now_us).items()
        )

    def _row(
        self, system_id: int, state: NewestState, now_us: int, mode: str | None, link: str
    ) -> VehicleRow:
        at, fix = state.valid_position(now_us), state.fix()
        volts, percent = state.battery()
        stream = self.streams.get(system_id)
        kind = mavlink.enums["MAV_TYPE"].get(state.kind())
        return VehicleRow(
            system_id=system_id,
            kind="" if kind is None else kind.name.removeprefix("MAV_TYPE_").lower(),
            mode=mode or state.mode(),
            armed=state.is_armed(),
            lat_deg=None if at is None else at.lat_deg,
            lon_deg=None if at is None else at.lon_deg,
            alt_amsl_m=None if at is None else at.alt_amsl_m,
            fix_type=None if fix is None else fix.fix_type,
            battery_v=volts,
            battery_percent=percent,
            link=link,
            age_s=state.age_us(now_us, *state.heard_us) / US_PER_S,
            loss=stream.lost / (stream.lost + stream.count) if stream else None,
        )
