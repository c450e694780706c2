"""The telemetry of a vehicle, each message at its own rate; and the landed state.

The streams and the answer to a request for a single message share the message's builder.

The landed state depends on the motion alone:

| state     | becomes   | when                            |
| --------- | --------- | ------------------------------- |
| undefined | on ground | slow and low, for `HOLD_US`     |
| undefined | in air    | fast or high, for `HOLD_US`     |
| on ground | in air    | fast or high, for `HOLD_US`     |
| in air    | on ground | slow and low, for `LANDING_US`  |

Fast is above the take-off speed; high is above the take-off height over the first good fix (not
over home, which may be set anywhere). Slow and low are below half of either, so that a hover, a
stall turn or a touch-and-go does not flip the state.
"""

import math
from collections.abc import Iterable
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import all as mavlink

from gateway.records import (
    NAN,
    BaroSample,
    GpsFix,
    ImuSample,
    NavFlags,
    NavState,
    NodeStatus,
    VehicleReport,
)
from gateway.units import US_PER_S
from gateway.vehicle.plan import Home, is_good_enough, location_of
from gateway.vehicle.service import Answer, Reply
from gateway.vehicle.telemetry import messages
from gateway.vehicle.telemetry.health import AHRS, GPS, Health
from gateway.vehicle.telemetry.messages import BUILDERS, Builder, Newest
from gateway.vehicle.telemetry.reported import WITHOUT_IMU_US, battery_status, named_values
from gateway.vehicle.telemetry.streams import ADDED_MESSAGES, OFF, Pace, Stream, interval_us
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_messages import MESSAGE_IDS

UNDEFINED: Final[int] = mavlink.MAV_LANDED_STATE_UNDEFINED
ON_GROUND: Final[int] = mavlink.MAV_LANDED_STATE_ON_GROUND
IN_AIR: Final[int] = mavlink.MAV_LANDED_STATE_IN_AIR

HOLD_US: Final = 2 * US_PER_S
LANDING_US: Final = 5 * US_PER_S
VELOCITY_VALID: Final = int(NavFlags.VELOCITY_VALID)
ALTITUDE_VALID: Final = int(NavFlags.ALTITUDE_VALID)
SLOW: Final = 0.5
"""Share of the take-off limits below which the vehicle is slow and low."""
HEARTBEAT: Final = mavlink.MAVLINK_MSG_ID_HEARTBEAT
GPS_RAW_INT: Final = mavlink.MAVLINK_MSG_ID_GPS_RAW_INT
BATTERY_STATUS: Final = mavlink.MAVLINK_MSG_ID_BATTERY_STATUS
STATE_MESSAGES: Final = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 0,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 0,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10_000,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 30_000,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50_000,
}
"""Messages sent with IMU samples, and the start of each after the first sample, us: at the usual
rates no sample triggers more than two. The quaternion is first, because its latency is visible."""
ATTITUDE_MESSAGES: Final = tuple(STATE_MESSAGES)[:2]
"""Messages sent with the attitudes that the vehicle's own autopilot reports."""
POSITION_MESSAGES: Final = tuple(STATE_MESSAGES)[2:4]
"""Messages sent with fixes of a vehicle without an IMU."""
REQUESTED_MESSAGES: Final = tuple(
    MESSAGE_IDS[name]
    for name in ("SCALED_IMU", "RAW_IMU", "LOCAL_POSITION_NED", "ODOMETRY", "ALTITUDE")
)
"""Messages sent with IMU samples only to clients that request them: after one ALTITUDE,
QGroundControl shows altitudes of no other message."""
CARRIED_MESSAGES: Final = frozenset({*STATE_MESSAGES, *REQUESTED_MESSAGES})
TIMED_MESSAGES: Final = tuple(
    MESSAGE_IDS[name]
    for name in (
        *("HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "HOME_POSITION", "ESTIMATOR_STATUS"),
        *("EXTENDED_SYS_STATE", "NAV_CONTROLLER_OUTPUT", "MISSION_CURRENT", "HIGH_LATENCY2"),
        *("RADIO_STATUS", "RC_CHANNELS"),
    )
)
APART_US: Final = 13_000
"""Time between the starts of successive timed messages: otherwise those with equal intervals would
always be due together. Not a multiple of 10 ms, at which samples of 100 Hz arrive."""
FIXED_RATES_HZ: Final = {"HEARTBEAT": 1.0, "RADIO_STATUS": 1.0, "RC_CHANNELS": 5.0}
"""Clients report a vehicle with fewer heartbeats as lost; the others are sent only for a radio or
an autopilot that reports them."""


class Motion:
    """The landed state of one vehicle."""

    def __init__(self, takeoff_speed_mps: float, takeoff_height_m: float) -> None:
        self.takeoff_speed_mps = takeoff_speed_mps
        self.takeoff_height_m = takeoff_height_m
        self.landed_state: int = UNDEFINED
        self._candidate = UNDEFINED
        self._since_us = 0

    def update(self, state: NavState, ground_alt_m: float) -> None:
        """Update the landed state from one navigation state."""
        candidate, flags = UNDEFINED, state.flags
        if flags & VELOCITY_VALID:
            north, east, _ = state.vel_n_mps
            most = math.hypot(north, east) / self.takeoff_speed_mps
            if flags & ALTITUDE_VALID and ground_alt_m == ground_alt_m:
                height = (state.alt_amsl_m - ground_alt_m) / self.takeoff_height_m
                most = height if height > most else most
            candidate = IN_AIR if most > 1.0 else ON_GROUND if most < SLOW else UNDEFINED
        if candidate != self._candidate:
            self._candidate, self._since_us = candidate, state.time_us
        if candidate in (self.landed_state, UNDEFINED):
            return
        hold_us = LANDING_US if self.landed_state == IN_AIR else HOLD_US
        if state.time_us - self._since_us >= hold_us:
            self.landed_state = candidate


class Telemetry(Newest):
    """The newest records of one aircraft, and the schedule of the messages built from them."""

    def __init__(self, settings: VehicleSettings, health: Health) -> None:
        super().__init__(settings, health)
        self.motion = Motion(settings.takeoff_speed_mps, settings.takeoff_height_m)
        self.calibrating = False
        self._ground_alt_m = NAN
        """Height of the first good fix, independent of home."""
        self._first_us: int | None = None
        """Time of the first fix."""
        self._announced_modes = 0
        self._batteries: dict[int, Stream] = {}
        self.streams = {message_id: Stream(us) for message_id, us in _intervals(settings).items()}
        self._pace = Pace()
        """Interval of the IMU samples."""
        self._timed_due_us: int | None = None
        """When the next timed message is due; None if it must be computed."""
        self._state_due_us = 0
        """Time before which no sample triggers a message."""
        self._builders: dict[int, Builder] = {
            **BUILDERS,
            HEARTBEAT: Telemetry._heartbeat,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Telemetry._extended_sys_state,
            mavlink.MAVLINK_MSG_ID_SYS_STATUS: lambda _, now_us: health.sys_status(now_us),
            mavlink.MAVLINK_MSG_ID_RADIO_STATUS: lambda *_: health.radio_status(),
            mavlink.MAVLINK_MSG_ID_RC_CHANNELS: lambda _, now_us: health.reported.channels(
                now_us, health.silent_us
            ),
            BATTERY_STATUS: lambda _, now_us: health.newest_battery(now_us),
        }
        self._state_streams = [(self.streams[m], self._builders[m]) for m in STATE_MESSAGES]
        """Schedule and builder of each message that IMU samples trigger."""
        self._timed = [*TIMED_MESSAGES]
        for added in ADDED_MESSAGES.values():
            if added.message_id in self.streams:
                raise ValueError(f"message {added.message_id} is sent by every vehicle already")
            self._timed.append(added.message_id)
            self.streams[added.message_id] = Stream(interval_us(added.rate_hz))
            self.add(added.message_id, lambda newest, _, build=added.build: build(newest))  # type: ignore[misc]
        self._polled = False

    def add(self, message_id: int, builder: Builder) -> None:
        """Add a message that another service builds."""
        self._builders[message_id] = builder

    def knows(self, message_id: int) -> bool:
        """Return whether the vehicle ever sends a message."""
        return message_id in self._builders

    def reconfigure(self, settings: VehicleSettings) -> None:
        """Apply changed settings; only the rates that differ restart."""
        self.settings = settings
        self._state_due_us, self._timed_due_us = 0, None
        self.motion.takeoff_speed_mps = settings.takeoff_speed_mps
        self.motion.takeoff_height_m = settings.takeoff_height_m
        for message_id, us in _intervals(settings).items():
            if self.streams[message_id].interval_us != us:
                self.streams[message_id].change(us)

    @property
    def armed(self) -> bool:
        """Whether the armed bit is set, by the setting `armed_when`."""
        if self.health.reported.armed is not None:
            return self.health.reported.armed
        rule = self.settings.armed_when
        flying = self.motion.landed_state == IN_AIR and rule.startswith("flying")
        recording = self.health.recording and rule.endswith("recording")
        return flying or recording or rule == "always"

    def origins(self, now_us: int) -> dict[str, str]:
        """Return the origin of the present attitude and position; see `Health.is_fused`."""
        health = self.health
        if health.is_fused(now_us):
            return dict.fromkeys(("attitude", "position"), "fused from samples")
        attitude = "reported by its autopilot" if health.is_alive(AHRS, now_us) else "unknown"
        position = "its GPS fixes" if health.has_fix(now_us) else "unknown"
        return {"attitude": attitude, "position": position}

    def on_state(self, state: NavState, sample: ImuSample) -> list[Answer]:
        """Process a navigation state and its IMU sample, and return the messages due."""
        time_us = state.time_us
        if self.state is None:
            for message_id, after_us in STATE_MESSAGES.items():
                self.streams[message_id].begin(time_us + after_us)
        self.state, self.sample = state, sample
        self.updated |= messages.IMU_UPDATED
        if sample.mag_b_ut is not None:
            self.mag_b_ut = sample.mag_b_ut
            self.updated |= messages.MAG_UPDATED
        # Tests for NaN, the latitude first, which is NaN for a long time without GPS.
        if self.reference_alt_m != self.reference_alt_m and state.lat_deg == state.lat_deg:
            self._note_height(state)
        self.motion.update(state, self._ground_alt_m)
        period_us = self._pace.update(time_us)
        return [] if time_us + period_us < self._state_due_us else self._carried(time_us, period_us)

    def _note_height(self, state: NavState) -> None:
        """Refer heights to the first position, until there is a home."""
        if math.isnan(self.reference_alt_m) and messages.has_position(state):
            self.reference_alt_m = state.alt_amsl_m

    def _carried(self, time_us: int, period_us: int) -> list[Answer]:
        """Build the messages that a sample triggers, and note when the next one is due."""
        found: list[Answer] = []
        soon_us, next_us = time_us + period_us, time_us + US_PER_S
        for stream, build in self._state_streams:
            due_us = stream.due_us
            if due_us is None and stream.interval_us == OFF:
                continue
            if due_us is None or due_us <= soon_us:
                if stream.offer_paced(time_us, period_us):
                    message = build(self, time_us)
                    if message is not None:
                        found.append(Reply(message))
                due_us = stream.due_us
            if due_us is not None and due_us < next_us:
                next_us = due_us
        self._state_due_us = next_us
        return found

    def _built(self, message_ids: Iterable[int], now_us: int) -> list[Answer]:
        built = (self.build(message_id, now_us) for message_id in message_ids)
        return [Reply(message) for message in built if message is not None]

    def _offered(self, time_us: int, *message_ids: int) -> list[Answer]:
        """Build those of some messages that are due at the time of a record."""
        return self._built([m for m in message_ids if self.streams[m].offer(time_us)], time_us)

    def on_report(self, report: VehicleReport) -> list[Answer]:
        """Process a report of the vehicle's own autopilot."""
        reported, time_us = self.health.reported, report.time_us
        reported.update(report)
        found: list[Answer] = [Reply(message) for message in named_values(report)]
        if report.attitude_rad is not None and not self.health.is_fused(time_us):
            found += self._on_reported(time_us, ATTITUDE_MESSAGES)
        if report.battery is not None and (
            report.battery.number or self.streams[BATTERY_STATUS].offer(time_us)
        ):
            found.append(Reply(battery_status(report.battery)))
        if reported.mode_changes != self._announced_modes:
            self._announced_modes = reported.mode_changes
            number = reported.mode_changes & 0xFF
            found.append(Reply(mavlink.MAVLink_available_modes_monitor_message(number)))
            found += self._built([mavlink.MAVLINK_MSG_ID_CURRENT_MODE], time_us)
        return found

    def _on_reported(self, time_us: int, carried: tuple[int, ...]) -> list[Answer]:
        """Update the state of a vehicle without an IMU of ours, and return its messages."""
        self.state = state = self.health.reported.state(time_us, self.fix, self.health.silent_us)
        self._note_height(state)
        if carried is POSITION_MESSAGES:
            self.motion.update(state, self._ground_alt_m)
        return self._offered(time_us, *carried)

    def on_baro(self, sample: BaroSample) -> list[Answer]:
        """Process a barometer sample, and return its message if due."""
        self.baro = sample
        self.updated |= messages.PRESSURE_UPDATED
        return self._offered(sample.time_us, mavlink.MAVLINK_MSG_ID_SCALED_PRESSURE)

    def on_gps(self, fix: GpsFix) -> list[Answer]:
        """Process a GPS fix, return its messages if due, and set home at the first good one."""
        self.fix = fix
        if messages.is_located(fix):
            self.located_fix = fix
        if fix.utc_us is not None:
            self.unix_offset_us = fix.utc_us - fix.time_us
        found = self._offered(fix.time_us, GPS_RAW_INT)
        wanted = self.home is None or math.isnan(self._ground_alt_m)
        limits = self.settings
        if wanted and is_good_enough(fix, limits.home_accuracy_m, limits.home_satellites):
            self._ground_alt_m = fix.alt_amsl_m
            if self.home is None:
                found.append(self.set_home(Home(location_of(fix), fix.time_us)))
        # The position of a vehicle that has no IMU.
        if self._first_us is None:
            self._first_us = fix.time_us
        known = self.health.is_reported or fix.time_us - self._first_us >= WITHOUT_IMU_US
        if known and not self.health.is_fused(fix.time_us):
            found += self._on_reported(fix.time_us, POSITION_MESSAGES)
        return found

    def on_node_status(self, status: NodeStatus) -> list[Answer]:
        """Return a node's supply message, if due."""
        common_us = self.streams[BATTERY_STATUS].interval_us
        stream = self._batteries.setdefault(status.node.node_id, Stream(common_us))
        if stream.interval_us != common_us:
            stream.change(common_us)
        message = self.health.battery(status) if stream.offer(status.time_us) else None
        return [] if message is None else [Reply(message)]

    def set_home(self, home: Home) -> Reply:
        """Set home, and return HOME_POSITION."""
        self.home = home
        self.origin = self.origin or home
        self.reference_alt_m = home.location.alt_amsl_m
        return Reply(messages.home_position(self, home.set_time_us))

    def clear_home(self) -> None:
        """Let the next good fix set home; heights stay relative to the old one until then."""
        self.home = None

    def poll(self, now_us: int) -> list[Answer]:
        """Return the timed messages that are due."""
        self.health.reported.expire(now_us, self.health.silent_us)
        if not self._polled:
            self._polled, self._timed_due_us = True, None
            for k, message_id in enumerate(self._timed):
                self.streams[message_id].begin(now_us + k * APART_US)
        if self._timed_due_us is not None and now_us < self._timed_due_us:
            return []
        due = [m for m in self._timed if self.streams[m].tick(now_us)]
        self._timed_due_us = None
        silent = not self.health.is_alive(GPS, now_us)
        if HEARTBEAT in due and silent and self.streams[GPS_RAW_INT].interval_us > 0:
            # Without data from the GPS node, no fix triggers GPS_RAW_INT.
            due.append(GPS_RAW_INT)
        return self._built(due, now_us)

    def next_due_us(self) -> int:
        """Return when `poll` has something to send; the heartbeat never stops."""
        if self._timed_due_us is None:
            due = (self.streams[m].due_us for m in self._timed if self.streams[m].interval_us > 0)
            self._timed_due_us = min(0 if time_us is None else time_us for time_us in due)
        return self._timed_due_us

    def build(self, message_id: int, now_us: int) -> Any:
        """Build one message from the newest records; None if it is never sent, or not yet."""
        builder = self._builders.get(message_id)
        return builder(self, now_us) if builder else None

    def _extended_sys_state(self, _now_us: int) -> Any:
        return mavlink.MAVLink_extended_sys_state_message(
            mavlink.MAV_VTOL_STATE_UNDEFINED, self.motion.landed_state
        )

    def _heartbeat(self, now_us: int) -> Any:
        # The aircraft is flown by radio control; the gateway does not control it.
        base_mode = mavlink.MAV_MODE_FLAG_MANUAL_INPUT_ENABLED
        if self.armed:
            base_mode |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        if self.autopilot != mavlink.MAV_AUTOPILOT_GENERIC or self.health.reported.mode:
            # Clients look up the name of a mode of these autopilots by its number.
            base_mode |= mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        return mavlink.MAVLink_heartbeat_message(
            self.vehicle_type,
            self.autopilot,
            base_mode,
            custom_mode=self.mode[0],
            system_status=self._system_status(now_us),
            mavlink_version=3,
        )

    def _system_status(self, now_us: int) -> int:
        status: int = mavlink.MAV_STATE_STANDBY
        if self.state is None:
            status = mavlink.MAV_STATE_BOOT
        elif self.calibrating:
            status = mavlink.MAV_STATE_CALIBRATING
        elif not self.health.has_state(now_us):
            status = mavlink.MAV_STATE_CRITICAL
        elif self.motion.landed_state == IN_AIR:
            status = mavlink.MAV_STATE_ACTIVE
        return status


def _intervals(settings: VehicleSettings) -> dict[int, int]:
    """Return the interval of every message; the setting of a rate has the name of its message."""
    rates = msgspec.structs.asdict(settings.rates).items()
    rates_hz = {name.removesuffix("_hz").upper(): rate_hz for name, rate_hz in rates}
    return dict.fromkeys(REQUESTED_MESSAGES, OFF) | {
        MESSAGE_IDS[name]: interval_us(rate_hz)
        for name, rate_hz in (FIXED_RATES_HZ | rates_hz).items()
    }
