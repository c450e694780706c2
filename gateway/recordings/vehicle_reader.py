"""Read the vehicles in recorded MAVLink, for all files, figures and pages.

It yields, for each vehicle, the positions of its best source, the attitude of its best message, its
joined texts, and any other requested message. Frames of ground stations and of the other components
of a system are left out, except for their texts and the images of cameras. See `Senders`.
"""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from gateway.geometry.quaternion import from_euler, normalise
from gateway.recordings.recorded_clock import FIRST_CIVIL_US
from gateway.records import Quat
from gateway.vehicle_state.positions import ORIGIN_ID, Position, named_position, position_of
from gateway.vehicle_state.senders import MODES_ID, RecordedSender, Senders, is_station
from gateway.vehicle_state.status_texts import STATUSTEXT_ID, JoinedText, TextJoiner, text_of
from gateway.wire.mavlink_messages import DEFINITIONS, HEARTBEAT_ID, ids_of
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from gateway.wire.recorded_frames import Batch, RecordedFrame, fields_of, fields_of_rows
from gateway.wire.vehicle_types import mode_name

BOOT_UNITS_US: Final = {"time_boot_ms": 1000, "time_usec": 1, "timestamp": 1000}
"""Fields with the time since boot, and their unit in µs; a civil time in one is ignored."""
IMAGE_IDS: Final = ids_of("CAMERA_FEEDBACK", "CAMERA_IMAGE_CAPTURED")
"""Messages about images, which the autopilot or any camera of the system sends."""


@dataclass(frozen=True, slots=True)
class VehicleMessage:
    """One message of a vehicle, or one text."""

    system_id: int
    time_us: int
    """Recorded time; for a text, that of its first chunk, so it may precede other messages."""
    message_id: int
    fields: Mapping[str, Any]
    """Fields by name, as they were sent; empty for a text."""
    position: Position | None = None
    """The vehicle's position, if this message is from its best source and contains a valid one."""
    q_nb: Quat | None = None
    """The vehicle's attitude, body FRD to NED, if this is its best message with a valid one."""
    text: JoinedText | None = None
    frame: bytes = b""
    """The whole frame; empty for a text."""
    mode: str = ""
    """Name of the flight mode in a HEARTBEAT: the autopilot's, that of AVAILABLE_MODES, or its
    number."""

    @property
    def boot_us(self) -> int | None:
        """Time since the boot of the vehicle; None if the message does not contain it."""
        for name, unit_us in BOOT_UNITS_US.items():
            if name in self.fields:
                own_us: int = self.fields[name] * unit_us
                return own_us if own_us < FIRST_CIVIL_US else None
        return None


class VehicleReader:
    """Read the vehicles of a recording, or one of them, frame by frame or batch by batch.

    `senders` is the survey of the whole recording; a system that it does not contain is treated as
    one of the gateway's own. `wanted` are the ids of further messages.
    """

    def __init__(
        self,
        senders: Senders,
        wanted: Iterable[int] = (),
        system_id: int | None = None,
        *,
        with_attitude: bool = True,
    ) -> None:
        self._senders = senders
        self._wanted = frozenset(wanted)
        self._system_id = system_id
        self._with_attitude = with_attitude
        self._vehicles: dict[int, RecordedSender] = {}
        self._frame_origins: dict[int, Position] = {}
        self._joiner = TextJoiner()

    def vehicle(self, system_id: int) -> RecordedSender:
        """Return the vehicle of a system."""
        known = self._vehicles.get(system_id)
        if known is None:
            known = self._vehicles[system_id] = self._senders.vehicle(system_id)
            if not self._with_attitude:
                known = self._vehicles[system_id] = replace(known, attitude_id=None)
            if known.frame_origin is not None:
                self._frame_origins[system_id] = known.frame_origin
        return known

    def feed_batch(self, batch: Batch) -> Iterator[VehicleMessage]:
        """Process the next batch of the recording."""
        for origin in np.unique(batch.origins).tolist():
            self.vehicle(origin >> 8)
        ids = {*self._wanted, ORIGIN_ID, MODES_ID}
        for one in self._vehicles.values():
            ids |= {key for key in (one.attitude_id, one.position_id) if key is not None}
        is_own = np.isin(batch.origins, [one.origin for one in self._vehicles.values()])
        is_own |= np.isin(batch.message_ids, [*IMAGE_IDS])
        is_wanted = is_own & np.isin(batch.message_ids, [*ids])
        wanted = np.flatnonzero(is_wanted | (batch.message_ids == STATUSTEXT_ID))
        fields = fields_of_rows(batch, wanted)
        for record, values in zip(batch.records(wanted), fields, strict=True):
            yield from self.feed(record, values)

    def feed(
        self, record: RecordedFrame, fields: Mapping[str, Any] | None = None
    ) -> Iterator[VehicleMessage]:
        """Process the next record, of which the fields may be known."""
        frame, time_us = record.frame, record.time_us
        system_id, component_id = origin_of(frame)
        origin, message_id = system_id << 8 | component_id, message_id_of(frame)
        if self._system_id not in (None, system_id):
            return
        if message_id == STATUSTEXT_ID:
            if not is_station(origin, self._senders.stations):
                yield from map(_of_text, self._joiner.feed(frame, time_us))
            return
        yield from map(_of_text, self._joiner.poll(time_us))
        vehicle = self.vehicle(system_id)
        is_of_vehicle = origin == vehicle.origin or message_id in IMAGE_IDS
        if not is_of_vehicle or is_station(origin, self._senders.stations):
            return
        is_best = message_id in (vehicle.position_id, vehicle.attitude_id)
        is_used = is_best or message_id in self._wanted or message_id in (ORIGIN_ID, MODES_ID)
        if not is_used or message_id not in DEFINITIONS:
            return
        fields = fields or fields_of(frame)
        if message_id == ORIGIN_ID and (found := named_position(fields)) is not None:
            self._frame_origins[system_id] = found
        elif message_id == MODES_ID:
            vehicle.modes[fields["custom_mode"]] = text_of(fields["mode_name"])
        if is_best or message_id in self._wanted:
            yield self._message(vehicle, message_id, record, fields)

    def messages(self, batches: Iterable[Batch]) -> Iterator[VehicleMessage]:
        """Yield the messages in all batches of the recording."""
        for batch in batches:
            yield from self.feed_batch(batch)
        yield from self.flush()

    def flush(self) -> Iterator[VehicleMessage]:
        """Yield the texts that will not be continued."""
        return map(_of_text, self._joiner.flush())

    def _message(
        self,
        vehicle: RecordedSender,
        message_id: int,
        record: RecordedFrame,
        fields: Mapping[str, Any],
    ) -> VehicleMessage:
        system_id, position, q_nb, mode = vehicle.origin >> 8, None, None, ""
        if message_id == vehicle.position_id:
            position = position_of(message_id, fields, self._frame_origins.get(system_id))
        elif message_id == vehicle.attitude_id:
            q_nb = attitude_of(fields)
        elif message_id == HEARTBEAT_ID:
            number = fields["custom_mode"]
            mode = mode_name(fields["autopilot"], fields["type"], number)
            mode = mode or vehicle.modes.get(number) or str(number)
        return VehicleMessage(
            *(system_id, record.time_us, message_id, fields, position, q_nb),
            frame=record.frame,
            mode=mode,
        )


def _of_text(text: JoinedText) -> VehicleMessage:
    return VehicleMessage(text.origin >> 8, text.time_us, STATUSTEXT_ID, {}, text=text)


def attitude_of(fields: Mapping[str, Any]) -> Quat | None:
    """Return the attitude in ATTITUDE or ATTITUDE_QUATERNION; None if it is invalid."""
    if "roll" in fields:
        angles = (fields["roll"], fields["pitch"], fields["yaw"])
        return from_euler(*angles) if math.isfinite(sum(angles)) else None
    q: Quat = (fields["q1"], fields["q2"], fields["q3"], fields["q4"])
    return normalise(q) if math.isfinite(sum(q)) and any(q) else None
