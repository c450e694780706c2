"""The senders of a recording: ground stations, vehicles, and their best messages.

A vehicle is one component of a system: the autopilot by its heartbeat, else component 1, else the
one that sends the most positions. So the attitude of a gimbal or the position of a camera, which
have the system id of their aircraft, are not taken for the aircraft's.
"""

from collections import Counter, defaultdict
from collections.abc import Set
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from pymavlink.dialects.v20 import all as mavlink

from gateway.units import US_PER_S
from gateway.vehicle_state.positions import (
    GLOBAL_POSITION_INT_ID,
    LOCAL_POSITION_NED_ID,
    ORIGIN_ID,
    POSITION_SOURCES,
    Position,
    holds_position,
    named_position,
)
from gateway.vehicle_state.status_texts import text_of
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS
from gateway.wire.recorded_frames import Batch, columns_of, fields_of

FIRST_GROUND_STATION: Final = 250
"""System ids from here on are ground stations by convention, and keep their id."""
AUTOPILOT: Final = 1
"""MAV_COMP_ID_AUTOPILOT1."""
MODES_ID: Final = MESSAGE_IDS["AVAILABLE_MODES"]
HIGH_LATENCY2_ID: Final = MESSAGE_IDS["HIGH_LATENCY2"]
ATTITUDE_ID: Final = MESSAGE_IDS["ATTITUDE"]
ATTITUDE_QUATERNION_ID: Final = MESSAGE_IDS["ATTITUDE_QUATERNION"]
_COUNTED: Final = (*POSITION_SOURCES, ATTITUDE_ID, ATTITUDE_QUATERNION_ID)
LEAST_SHARE: Final = 0.5
"""Minimum share of the longest time for which a better message must be present to be used."""


def is_station(origin: int, stations: Set[int]) -> bool:
    """Return whether a sender (system << 8 | component) is a ground station."""
    return origin >> 8 >= FIRST_GROUND_STATION or origin in stations


@dataclass(frozen=True, slots=True)
class RecordedSender:
    """The component of a system that is its vehicle, and its messages to use."""

    origin: int
    """Sender: system << 8 | component."""
    position_id: int | None = GLOBAL_POSITION_INT_ID
    """Message with its positions, one of `POSITION_SOURCES`; None if it sent no valid one."""
    attitude_id: int | None = ATTITUDE_QUATERNION_ID
    heartbeat: tuple[int, int] | None = None
    """MAV_TYPE and MAV_AUTOPILOT."""
    frame_origin: Position | None = None
    """Origin of LOCAL_POSITION_NED until the vehicle sends another one."""
    modes: dict[int, str] = field(default_factory=dict, compare=False)
    """Names of its custom modes from AVAILABLE_MODES, by number."""

    @property
    def component(self) -> int:
        """The component id."""
        return self.origin & 0xFF


class Senders:
    """Survey the senders of a recording, batch by batch."""

    def __init__(self) -> None:
        self.origins: set[int] = set()
        """All senders, as system << 8 | component."""
        self.stations: set[int] = set()
        """Senders of a ground station's heartbeat."""
        self.heartbeats: dict[int, tuple[int, int]] = {}
        """MAV_TYPE and MAV_AUTOPILOT by sender."""
        self.seconds: Counter[tuple[int, int]] = Counter()
        """Number of seconds with a valid message, by sender and message id."""
        self.frame_origins: dict[int, Position] = {}
        """First origin of LOCAL_POSITION_NED by sender."""
        self.modes: defaultdict[int, dict[int, str]] = defaultdict(dict)
        """Names of the custom modes by number, by sender."""

    def add(self, batch: Batch) -> None:
        """Add the next batch of a file."""
        if not len(batch):
            return
        self.origins |= set(np.unique(batch.origins).tolist())
        self._add_heartbeats(batch)
        for i in np.flatnonzero(batch.message_ids == ORIGIN_ID).tolist():
            if (found := named_position(fields_of(batch.frame(i)))) is not None:
                self.frame_origins.setdefault(int(batch.origins[i]), found)
        for i in np.flatnonzero(batch.message_ids == MODES_ID).tolist():
            mode = fields_of(batch.frame(i))
            self.modes[int(batch.origins[i])][mode["custom_mode"]] = text_of(mode["mode_name"])
        for message_id in _COUNTED:
            rows = np.flatnonzero(batch.message_ids == message_id)
            if len(rows) and message_id in POSITION_SOURCES:
                fields = columns_of(batch, rows, message_id)
                rows = rows[holds_position(message_id, fields)]
            at_s = np.maximum(batch.time_us[rows], 0) // US_PER_S
            seconds = np.unique(batch.origins[rows] << 44 | at_s)
            for origin, count in zip(*np.unique(seconds >> 44, return_counts=True), strict=True):
                self.seconds[int(origin), message_id] += int(count)

    def vehicle(self, system_id: int) -> RecordedSender:
        """Return the vehicle of a system; component 1 if the system sent nothing."""
        components = [
            origin
            for origin in sorted(self.origins)
            if origin >> 8 == system_id and not is_station(origin, self.stations)
        ]
        origin = self._vehicle_of(components) if components else system_id << 8 | AUTOPILOT
        if not components:
            return RecordedSender(origin)
        known = {message_id: self.seconds[origin, message_id] for message_id in _COUNTED}
        if origin not in self.frame_origins:
            known[LOCAL_POSITION_NED_ID] = 0
        attitude = {key: known[key] for key in (ATTITUDE_QUATERNION_ID, ATTITUDE_ID)}
        return RecordedSender(
            origin,
            _best({key: known[key] for key in POSITION_SOURCES}),
            _best(attitude) or ATTITUDE_QUATERNION_ID,
            self.heartbeats.get(origin),
            self.frame_origins.get(origin),
            dict(self.modes.get(origin, {})),
        )

    def systems(self) -> list[int]:
        """Return the systems with a sender that is not a ground station."""
        vehicles = (one for one in self.origins if not is_station(one, self.stations))
        return sorted({origin >> 8 for origin in vehicles})

    def merge(self, other: "Senders") -> None:
        """Add the senders of another file of the same recording."""
        self.origins |= other.origins
        self.stations |= other.stations
        self.heartbeats = {**other.heartbeats, **self.heartbeats}
        self.seconds += other.seconds
        self.frame_origins = {**other.frame_origins, **self.frame_origins}
        for origin, names in other.modes.items():
            self.modes[origin] |= names

    def _add_heartbeats(self, batch: Batch) -> None:
        for message_id in (HEARTBEAT_ID, HIGH_LATENCY2_ID):
            rows = np.flatnonzero(batch.message_ids == message_id)
            beats = columns_of(batch, rows, message_id)
            keys = np.column_stack([batch.origins[rows], beats["type"], beats["autopilot"]])
            for origin, kind, autopilot in np.unique(keys, axis=0).tolist():
                if kind == mavlink.MAV_TYPE_GCS:
                    self.stations.add(origin)
                known = self.heartbeats.get(origin)
                if known is None or known[1] == mavlink.MAV_AUTOPILOT_INVALID:
                    self.heartbeats[origin] = (kind, autopilot)

    def _vehicle_of(self, components: list[int]) -> int:
        none = (0, mavlink.MAV_AUTOPILOT_INVALID)
        autopilots = [one for one in components if self.heartbeats.get(one, none)[1] != none[1]]
        first = components[0] & ~0xFF | AUTOPILOT
        for candidates in (autopilots, components):
            if first in candidates:
                return first
            if candidates:
                return max(
                    candidates, key=lambda one: max(self.seconds[one, k] for k in POSITION_SOURCES)
                )
        raise ValueError("a system without a component")


def _best(seconds: dict[int, int]) -> int | None:
    """Return the best message that covers nearly as much time as any other."""
    longest = max(seconds.values())
    return next((key for key, n in seconds.items() if n and n >= LEAST_SHARE * longest), None)
