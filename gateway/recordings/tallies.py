"""Accumulate the facts of flights from recorded MAVLink, and from the rows of tables."""

import math
import struct
from collections.abc import Iterable
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import all as mavlink

from gateway.recordings.columns import (
    COLUMNS,
    FIX_ALT,
    FIX_LAT,
    FIX_LON,
    FIX_OK,
    GPS,
    NAV,
    NODE_TIME,
    RAW,
    FloatArray,
    has_fix,
    has_group,
    has_position,
)
from gateway.recordings.flight_facts import MAX_TEXTS, POINT_US, FlightTally, checksum, lost_share
from gateway.recordings.table import TableBlock
from gateway.recordings.vehicle_reader import VehicleMessage, VehicleReader
from gateway.records import NAN, NodeStatus
from gateway.units import DEG_PER_DEGE7, FIX_2D, MV_PER_V, US_PER_S
from gateway.vehicle_state.positions import GPS_IDS, Position, named_position
from gateway.vehicle_state.senders import RecordedSender, Senders
from gateway.wire.frame_scan import TIME_SIZE
from gateway.wire.mavlink_messages import HEARTBEAT_ID, MESSAGE_IDS, MESSAGE_NAMES
from gateway.wire.mavlink_splitter import SEQUENCE_V1, SEQUENCE_V2, START_V2
from gateway.wire.recorded_frames import Batch, IntArray, columns_of
from gateway.wire.vehicle_types import CLASSES, SURFACE

ERROR: Final = 3
"""MAV_SEVERITY_ERROR; lower numbers are more severe."""
STATES, FIXES = "states", "GPS fixes"
"""Rows with the positions of a table."""
Columns = NDArray[np.void]
UNKNOWN_U8, UNKNOWN_U16 = 0xFF, 0xFFFF
MAX_DROP: Final = 10_000
"""Greatest valid drop_rate_comm, 100 %."""
_LANDED: Final = {1: 0.0, 2: 1.0, 3: 1.0, 4: 1.0}
"""Whether a MAV_LANDED_STATE is in the air; others are unknown."""
_VIBRATION: Final = ("vibration_x", "vibration_y", "vibration_z")
_IDS: Final = {
    name: MESSAGE_IDS[name]
    for name in (
        *("EXTENDED_SYS_STATE", "HOME_POSITION", "BATTERY_STATUS", "SYS_STATUS", "VIBRATION"),
        *("GPS_RAW_INT", "GPS2_RAW", "PARAM_VALUE", "AUTOPILOT_VERSION"),
    )
}
FACT_IDS: Final = frozenset(
    {
        HEARTBEAT_ID,
        *(_IDS[name] for name in ("EXTENDED_SYS_STATE", "HOME_POSITION", "AUTOPILOT_VERSION")),
    }
)
"""Messages that are read one by one, in addition to positions, attitudes and texts."""
_VELOCITY: Final = ("nav_vel_north_mps", "nav_vel_east_mps", "nav_vel_down_mps")
_PLACED: Final = [
    COLUMNS.index(name)
    for name in ("time_us", "nav_lat_deg", "nav_lon_deg", "nav_alt_amsl_m", *_VELOCITY)
]
_FIXED: Final = [
    *(GPS.start, FIX_LAT, FIX_LON, FIX_ALT),
    *(COLUMNS.index(f"gps_vel_{axis}_mps") for axis in ("north", "east", "down")),
]


class VehicleTally(FlightTally):
    """Collect the facts of one vehicle from its MAVLink."""

    def __init__(self, vehicle: RecordedSender, *, with_attitude: bool = False) -> None:
        super().__init__(with_attitude=with_attitude)
        self.vehicle = vehicle
        self.firmware: str | None = None
        """Version of the autopilot's firmware."""
        self.is_surface = CLASSES.get((vehicle.heartbeat or (0, 0))[0]) in SURFACE
        self._parameters: dict[bytes, float] = {}
        self._drops = np.zeros(2, np.int64)
        """Sum and number of the reported losses."""
        self._sequence: int | None = None
        self._gps_id = vehicle.position_id if vehicle.position_id in GPS_IDS else GPS_IDS[0]
        self._handlers = {
            HEARTBEAT_ID: self._on_heartbeat,
            _IDS["EXTENDED_SYS_STATE"]: self._on_landed,
            _IDS["HOME_POSITION"]: self._on_home,
            _IDS["AUTOPILOT_VERSION"]: self._on_version,
        }
        self._column_handlers = {
            _IDS["BATTERY_STATUS"]: self._add_batteries,
            _IDS["SYS_STATUS"]: self._add_status,
            _IDS["VIBRATION"]: self._add_vibrations,
            _IDS["PARAM_VALUE"]: self._add_parameters,
            self._gps_id: self._add_fixes,
        }

    @property
    def positions(self) -> str | None:
        """Name of the message with the positions; None without any."""
        known = self.ground.distance_m is not None
        return MESSAGE_NAMES[self.vehicle.position_id or 0] if known else None

    @property
    def radio_loss(self) -> float | None:
        """See `FlightFacts`."""
        total, number = self._drops.tolist()
        return total / number / MAX_DROP if number else None

    @property
    def settings_checksum(self) -> str | None:
        """Checksum of the parameters; None without any."""
        sent = sorted(self._parameters.items())
        packed = (name.ljust(16, b"\0") + struct.pack("<f", value) for name, value in sent)
        return checksum(b"".join(packed)) if sent else None

    def add_batch(self, batch: Batch) -> None:
        """Add the times, sequence numbers and frequent messages of the vehicle."""
        rows = batch.origins == self.vehicle.origin
        self.span.add_all(batch.time_us[batch.origins >> 8 == self.vehicle.origin >> 8])
        data, starts = np.frombuffer(batch.data, np.uint8), batch.starts[rows] + TIME_SIZE
        at = np.where(data[starts] == START_V2, SEQUENCE_V2, SEQUENCE_V1)
        numbers = data[starts + at].astype(np.int64)
        if not len(numbers):
            return
        before = int(numbers[0]) - 1 if self._sequence is None else self._sequence
        gaps = (np.diff(numbers, prepend=before) - 1) & 0xFF
        # A large step is a restart, or a frame that was received twice.
        self.frames_lost += int(gaps[gaps < 128].sum())
        self.frames_received += len(numbers)
        self._sequence = int(numbers[-1])
        for message_id, handler in self._column_handlers.items():
            chosen = np.flatnonzero(rows & (batch.message_ids == message_id))
            if len(chosen):
                handler(batch.time_us[chosen], columns_of(batch, chosen, message_id))

    def update(self, message: VehicleMessage) -> None:
        """Process the next message of the vehicle."""
        time_us = message.time_us
        if (text := message.text) is not None:
            self.errors += text.severity <= ERROR
            if len(self.texts) < MAX_TEXTS:
                self.texts.append((time_us, text.severity, text.text))
            return
        if message.position is not None:
            self.add_position(time_us, message.position, message.boot_us)
        if message.q_nb is not None and self._with_attitude:
            if self._is_due("attitude", time_us, POINT_US):
                self.attitude.add(time_us, *message.q_nb)
        elif (handler := self._handlers.get(message.message_id)) is not None:
            handler(message)

    def _on_heartbeat(self, message: VehicleMessage) -> None:
        armed = bool(message.fields["base_mode"] & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
        self.add_armed(message.time_us, armed=armed)
        is_new = not self.modes or self.modes[-1][1] != message.mode
        if is_new and len(self.modes) < MAX_TEXTS:
            self.modes.append((message.time_us, message.mode))

    def _on_landed(self, message: VehicleMessage) -> None:
        self.landed = _LANDED.get(message.fields["landed_state"], NAN)

    def _on_home(self, message: VehicleMessage) -> None:
        self.home = named_position(message.fields) or self.home

    def _add_fixes(self, time_us: IntArray, columns: Columns) -> None:
        for at_us, is_fixed in zip(
            time_us.tolist(), (columns["fix_type"] >= FIX_2D).tolist(), strict=True
        ):
            self.add_gps(at_us, fixed=is_fixed)
        counts = columns["satellites_visible"]
        if len(known := counts[counts != UNKNOWN_U8]):
            fewest = int(known.min())
            self.satellites = fewest if self.satellites is None else min(self.satellites, fewest)

    def _add_batteries(self, _: IntArray, columns: Columns) -> None:
        known = columns[columns["current_consumed"] >= 0]
        for number in np.unique(known["id"]).tolist():
            used = known["current_consumed"][known["id"] == number]
            first, _last = self.used_mah.get(number, (int(used[0]), 0))
            self.used_mah[number] = (first, int(used[-1]))

    def _add_status(self, time_us: IntArray, columns: Columns) -> None:
        drops = columns["drop_rate_comm"][columns["drop_rate_comm"] <= MAX_DROP].astype(np.int64)
        self._drops += (drops.sum(), len(drops))
        # One in a second is enough.
        chosen = np.flatnonzero(np.diff(time_us // US_PER_S, prepend=-1))
        volts, percents = columns["voltage_battery"][chosen], columns["battery_remaining"][chosen]
        for at_us, millivolts, percent in zip(
            time_us[chosen].tolist(), volts.tolist(), percents.tolist(), strict=True
        ):
            is_known = 0 < millivolts != UNKNOWN_U16
            voltage = millivolts / MV_PER_V if is_known else NAN
            self.battery.add(at_us, voltage, percent if percent >= 0 else NAN)

    def _add_vibrations(self, _: IntArray, columns: Columns) -> None:
        worst = max(float(columns[axis].max()) for axis in _VIBRATION)
        self.vibration_mps2 = max(self.vibration_mps2 or 0.0, worst)

    def _add_parameters(self, _: IntArray, columns: Columns) -> None:
        names, values = columns["param_id"].tolist(), columns["param_value"].tolist()
        self._parameters.update(zip(names, values, strict=True))

    def _on_version(self, message: VehicleMessage) -> None:
        version = message.fields["flight_sw_version"]
        self.firmware = ".".join(str(version >> shift & 0xFF) for shift in (24, 16, 8))


class MessageTally:
    """Collect the facts of all vehicles of a recording, or of one, from its MAVLink."""

    def __init__(
        self, senders: Senders, vehicle_id: int | None = None, *, with_attitude: bool = False
    ) -> None:
        self._reader = VehicleReader(senders, FACT_IDS, vehicle_id, with_attitude=with_attitude)
        self.vehicles = {
            system: VehicleTally(senders.vehicle(system), with_attitude=with_attitude)
            for system in (senders.systems() if vehicle_id is None else [vehicle_id])
        }
        """Tallies by system id."""

    def add_all(self, batches: Iterable[Batch]) -> None:
        """Add the batches of the whole file."""
        for message in self._reader.messages(map(self._added, batches)):
            if (tally := self.vehicles.get(message.system_id)) is not None:
                tally.update(message)

    def _added(self, batch: Batch) -> Batch:
        for tally in self.vehicles.values() if len(batch) else ():
            tally.add_batch(batch)
        return batch


class RowTally(FlightTally):
    """Collect the facts of a table, or of rows that were read from another format.

    The positions are those of the states, or of the fixes if no state has a position.
    """

    def __init__(self) -> None:
        super().__init__()
        self.positions: str | None = None
        """Kind of rows with the positions; None without any."""
        self._node_us: list[FloatArray] = []
        self._nodes: dict[int, NodeStatus] = {}

    def add(self, block: TableBlock) -> None:
        """Add the next block of the file."""
        for _, comment in block.comments:
            if isinstance(comment, NodeStatus):
                self._add_status(comment)
        cells = block.cells
        self.span.add_all(cells[:, 0].astype(np.int64))
        self._node_us.append(cells[has_group(cells, RAW), NODE_TIME])
        reports = cells[has_group(cells, GPS)][:, [GPS.start, FIX_OK]]
        for time_us, is_ok in reports.tolist():
            self.add_gps(int(time_us), fixed=is_ok == 1.0)
        placed = cells[has_position(cells)]
        if len(placed) and self.positions != STATES:
            self._restart()
            self.positions = STATES
        if self.positions == STATES:
            self._add_rows(placed[:, _PLACED])
        elif len(fixed := cells[has_fix(cells)][:, _FIXED]):
            fixed[:, 1:3] *= DEG_PER_DEGE7
            self.positions = FIXES
            self._add_rows(fixed)
        states = cells[has_group(cells, NAV)][:, NAV]
        for time_us, *q_nb in states[_first_of_slots(states), :5].tolist():
            self.attitude.add(time_us, *q_nb)

    def _add_rows(self, rows: FloatArray) -> None:
        for time_us, lat, lon, alt, *velocity in rows[_first_of_slots(rows)].tolist():
            north, east, down = velocity
            at = Position(lat, lon, alt, NAN, math.hypot(north, east), (north, east, down))
            self.add_position(int(time_us), at)

    def _add_status(self, status: NodeStatus) -> None:
        """Count the failures of a node since its last report."""
        before = self._nodes.get(status.node.node_id)
        errors, failed = (before.bus_errors, before.sensors_failed) if before else (0, 0)
        # A restart of the node resets the counter.
        self.errors += max(status.bus_errors - errors, 0)
        self.errors += (status.sensors_failed & ~failed).bit_count()
        self._nodes[status.node.node_id] = status

    @property
    def radio_loss(self) -> float | None:
        """See `FlightFacts`."""
        node_us = np.concatenate(self._node_us) if self._node_us else np.empty(0)
        return lost_share(node_us.astype(np.int64))


def _first_of_slots(rows: FloatArray) -> IntArray:
    """Return the first row of each interval of `POINT_US`; the first column is the time."""
    return np.flatnonzero(np.diff(rows[:, 0] // POINT_US, prepend=-1.0))
