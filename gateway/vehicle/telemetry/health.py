"""Health of one aircraft: its sensors for SYS_STATUS, and its boards for BATTERY_STATUS and texts.

RADIO_STATUS is sent only for radios that measure their signal (the nRF24L01+ does not): ground
stations show the value for unknown as -1 dBm. The losses of the radio are in SYS_STATUS too.

A node reports once a second the counters since its start. Most faults of cheap boards appear here
first: a supply that sags when the radio sends, a broken cable to the sensors, a lost antenna. They
are announced when they get worse:

| topic  | gets worse                                     | is good again                        |
| ------ | ---------------------------------------------- | ------------------------------------ |
| supply | below the limit of the settings                | `HYSTERESIS_V` above it              |
| bus    | an error more than in the report before        | `QUIET_REPORTS` without one          |
| radio  | as many sends fail in `RADIO_SPAN_US` as       | less than half as many fail          |
|        | `FAILED_SHARE` of the samples in it            |                                      |
| pipe   | the receiver had no room for a payload of it   | `QUIET_REPORTS` of the receiver's    |
"""

import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import (
    NODE_GPS,
    NODE_IMU,
    SOURCE_NODE,
    BaroSample,
    BatteryReport,
    GpsFix,
    ImuFlags,
    ImuSample,
    LinkReport,
    NavFlags,
    NavState,
    NodeLink,
    NodeStatus,
    VehicleReport,
    node_role,
)
from gateway.units import US_PER_S
from gateway.vehicle import encoding
from gateway.vehicle.plan import is_3d
from gateway.vehicle.service import INFO, WARNING, StatusText
from gateway.vehicle.telemetry.reported import Reported, battery_status, whole_or_unknown

HYSTERESIS_V: Final = 0.1
QUIET_REPORTS: Final = 10
FAILED_SHARE: Final = 0.1
RADIO_SPAN_US: Final = 10 * US_PER_S
"""Span of the failed sends: a GPS node sends so rarely that in one second a single lost payload
would be a tenth of all."""
MAX_REPORTS: Final = 20
"""Maximum reports in `RADIO_SPAN_US`; a node reports once a second."""
WORD: Final = 0xFFFF
"""Mask of the nodes' counters, which have 16 bits and wrap."""
BATTERY_TIMEOUT_US: Final = 10 * US_PER_S
"""Timeout of a battery report: autopilots send one every second or so, and links lose many."""
MV: Final = 1e3
GYRO: Final = mavlink.MAV_SYS_STATUS_SENSOR_3D_GYRO
ACCEL: Final = mavlink.MAV_SYS_STATUS_SENSOR_3D_ACCEL
MAG: Final = mavlink.MAV_SYS_STATUS_SENSOR_3D_MAG
PRESSURE: Final = mavlink.MAV_SYS_STATUS_SENSOR_ABSOLUTE_PRESSURE
GPS: Final = mavlink.MAV_SYS_STATUS_SENSOR_GPS
AHRS: Final = mavlink.MAV_SYS_STATUS_AHRS
LOGGING: Final = mavlink.MAV_SYS_STATUS_LOGGING
GEOFENCE: Final = mavlink.MAV_SYS_STATUS_GEOFENCE
PREARM: Final = mavlink.MAV_SYS_STATUS_PREARM_CHECK
SENSORS: Final = (GYRO, ACCEL, MAG, PRESSURE, GPS)
NODE_SENSORS: Final = ((NODE_IMU, GYRO | ACCEL), (1 << 1, MAG), (1 << 2, PRESSURE), (NODE_GPS, GPS))
"""Bits of the masks of NodeStatus, and their sensors."""


class Finding(NamedTuple):
    """The state of one topic, which is announced when it changes."""

    topic: str
    state: object
    """False at the start."""
    text: StatusText
    causes: tuple[str, ...] = ()
    """Topics that cause it if one of them is bad."""


def status_text(is_bad: bool, bad: str, good: str, severity: int = WARNING) -> StatusText:
    """Return the text for a state, with its severity."""
    return StatusText(severity, bad) if is_bad else StatusText(INFO, good)


@dataclass(slots=True)
class _Trouble:
    """A topic that turns bad with one report, and good again after several without errors."""

    quiet: int = QUIET_REPORTS

    def update(self, worse: bool) -> bool:
        self.quiet = 0 if worse else min(self.quiet + 1, QUIET_REPORTS)
        return self.quiet < QUIET_REPORTS


@dataclass(slots=True)
class _Board:
    status: NodeStatus
    low: bool = False
    bus: _Trouble = field(default_factory=_Trouble)
    failed: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_REPORTS))
    """Time of each report and the number of failed sends that it added; a few are usual."""
    loses: bool = False
    """Whether too many sends fail."""
    pipe: _Trouble = field(default_factory=_Trouble)
    overruns: int | None = None

    def add_failed(self, failed: int) -> int:
        """Add the failed sends of a report; return their number in `RADIO_SPAN_US`."""
        time_us = self.status.time_us
        self.failed.append((time_us, failed))
        while self.failed[0][0] <= time_us - RADIO_SPAN_US:
            self.failed.popleft()
        total = sum(number for _, number in self.failed)
        most = FAILED_SHARE * self.status.sample_rate_hz * RADIO_SPAN_US / US_PER_S
        self.loses = 0 < (most / 2 if self.loses else most) <= total
        return total


def _finding(topic: str, name: str, is_bad: bool, bad: str, good: str) -> Finding:
    return Finding(topic, is_bad, status_text(is_bad, f"{name}: {bad}", f"{name}: {good}"))


class Health:
    """Newest samples of the sensors and newest reports of the nodes of one aircraft."""

    def __init__(self, vehicle_id: int, silent_s: float, supply_low_v: float = 0.0) -> None:
        self.vehicle_id = vehicle_id
        self.silent_us = round(silent_s * US_PER_S)
        self.supply_low_v = supply_low_v
        """A lower supply is announced; 0 disables this."""
        self.recording = False
        self.recording_expected = True
        """Whether a missing recording is reported to ground stations."""
        self.reported = Reported()
        """Reports of the vehicle's own autopilot, if it has one."""
        self.is_reported = False
        """Whether the autopilot has sent a report."""
        self._seen_us: dict[int, int] = {}
        self._boards: dict[int, _Board] = {}
        self._imu_flags = ImuFlags(0)
        self._fix: GpsFix | None = None
        self._nav_flags = NavFlags(0)
        self._load_permille = 0
        self._links: tuple[NodeLink, ...] = ()
        self._excused_us: dict[int, int] = {}
        """End of the last stall of the gateway, by node."""
        self._received = 0
        self._lost = 0
        self._drop_rate = 0.0

    @property
    def statuses(self) -> tuple[NodeStatus, ...]:
        """The newest report of each node, in the order of their ids."""
        return tuple(board.status for _, board in sorted(self._boards.items()))

    @property
    def firmware(self) -> int:
        """Firmware version of the first node as MAVLink packs it; 0 before it has reported."""
        statuses = self.statuses
        major, minor = statuses[0].firmware_version if statuses else (0, 0)
        return major << 24 | minor << 16

    def on_state(self, state: NavState, sample: ImuSample) -> None:
        """Note an IMU sample and its estimate."""
        seen, seen_us = self._seen_us, sample.time_us
        # Samples that waited in the kernel during a stall are older than the end of the stall.
        if seen.get(GYRO, 0) > seen_us:
            seen_us = seen[GYRO]
        seen[GYRO] = seen[ACCEL] = seen_us
        if sample.mag_b_ut is not None:
            seen[MAG] = seen_us
        self._nav_flags, self._imu_flags = state.flags, sample.flags

    def on_baro(self, sample: BaroSample) -> None:
        """Note a barometer sample."""
        self._see(PRESSURE, sample.time_us)

    def on_gps(self, fix: GpsFix) -> None:
        """Note a GPS fix, good or not."""
        self._see(GPS, fix.time_us)
        self._fix = fix

    def on_report(self, report: VehicleReport) -> None:
        """Note a report of the vehicle's own autopilot."""
        self.is_reported = True
        if report.attitude_rad is not None:
            self._see(AHRS, report.time_us)

    @property
    def has_imu(self) -> bool:
        """Whether an IMU sample was ever received."""
        return GYRO in self._seen_us

    def is_fused(self, now_us: int) -> bool:
        """Return whether attitude, position, velocity and height are those of our estimator.

        This holds for every vehicle that sends IMU samples; one with an autopilot of its own is
        shown by its reports and fixes once the samples have timed out.
        """
        return self.has_imu and (not self.is_reported or self.is_alive(GYRO, now_us))

    def has_state(self, now_us: int) -> bool:
        """Return whether the source of the state is alive."""
        if self.is_fused(now_us):
            return self.is_alive(GYRO, now_us)
        return self.is_alive(AHRS, now_us) or self.is_alive(GPS, now_us)

    def _see(self, sensor: int, time_us: int) -> None:
        self._seen_us[sensor] = max(time_us, self._seen_us.get(sensor, time_us))

    def on_node_status(self, status: NodeStatus) -> list[Finding]:
        """Note a node's report about itself; return the state of its board."""
        number = status.node.node_id
        known = self._boards.setdefault(number, _Board(status))
        before, known.status = known.status, status
        if status.node_time_us < before.node_time_us:
            # The node has restarted, and with it its counters.
            before = status
        errors = status.bus_errors - before.bus_errors & WORD
        failed = known.add_failed(status.radio_failed - before.radio_failed & WORD)
        if status.sensors_present & NODE_IMU:
            # The duration of the node's longest loop as a share of the sample interval.
            self._load_permille = status.loop_max_us * status.sample_rate_hz // 1000
        name, bus_errors = self.node_name(number), known.bus.update(errors > 0)
        supply_v = status.supply_mv / MV
        limit_v = self.supply_low_v + (HYSTERESIS_V if known.low else 0.0)
        known.low = bool(self.supply_low_v and supply_v) and supply_v < limit_v
        low, good = f"supply low, {supply_v:.2f} V", f"supply OK again, {supply_v:.2f} V"
        radio = f"radio sends failed, {failed} in {RADIO_SPAN_US // US_PER_S} s"
        bus = f"bus errors, {status.bus_errors} so far"
        chips = StatusText(INFO, f"{name}: {', '.join(status.chips)}")
        return [
            Finding(f"chips {number}", status.chips or False, chips),
            _finding(f"supply {number}", name, known.low, low, good),
            _finding(f"bus {number}", name, bus_errors, bus, "bus OK again"),
            _finding(f"radio {number}", name, known.loses, radio, "radio OK again"),
        ]

    def on_link(self, report: LinkReport) -> list[Finding]:
        """Note the state of the radio links to this aircraft's nodes; return its findings."""
        self._links = tuple(
            link for link in report.nodes if link.node.vehicle_id == self.vehicle_id
        )
        received = sum(link.received for link in self._links)
        lost = sum(link.lost for link in self._links)
        fresh = max(0, received - self._received) + max(0, lost - self._lost)
        self._drop_rate = max(0, lost - self._lost) / fresh if fresh else 0.0
        self._received, self._lost = received, lost
        if (receiver := report.receiver) is None:
            return []
        problem, works = receiver.radio.problem, "radio module works again"
        found = [_finding("receiver radio", "Receiver", bool(problem), problem, works)]
        for link in self._links:
            number = link.node.node_id
            board = self._boards.get(number)
            if board is None:
                continue
            overruns = receiver.pipes[link.pipe].overruns
            is_bad = board.pipe.update(board.overruns is not None and overruns > board.overruns)
            board.overruns = overruns
            bad, good = f"receiver overrun, {overruns} so far", "receiver keeps up again"
            found.append(_finding(f"pipe {number}", self.node_name(number), is_bad, bad, good))
        return found

    def on_stall(self, stalled_us: int, now_us: int) -> None:
        """Do not count a time in which the gateway was not running as an outage of a sensor."""
        begin_us = now_us - stalled_us
        for sensor, seen_us in self._seen_us.items():
            if begin_us - seen_us <= self.silent_us:
                self._seen_us[sensor] = seen_us + stalled_us
        self._excused_us |= dict.fromkeys(self.known_nodes() - self.silent_nodes(begin_us), now_us)

    def is_alive(self, sensor: int, now_us: int) -> bool:
        """Return whether a sensor has sent a sample recently."""
        seen = self._seen_us.get(sensor)
        return seen is not None and now_us - seen <= self.silent_us

    def has_fix(self, now_us: int) -> bool:
        """Return whether the newest fix is three-dimensional and not old."""
        return self._fix is not None and is_3d(self._fix) and self.is_alive(GPS, now_us)

    def sensors(self, now_us: int) -> tuple[int, int, int]:
        """Compute the bit masks of SYS_STATUS: present, enabled, healthy."""
        present = healthy = 0
        absent = MAG if self._imu_flags & ImuFlags.MAG_ABSENT else 0
        absent |= PRESSURE if self._imu_flags & ImuFlags.BARO_ABSENT else 0
        faulty = GYRO | ACCEL if self._imu_flags & ImuFlags.SELF_TEST_FAILED else 0
        for board in self._boards.values():
            failed = board.status.sensors_failed & board.status.sensors_present
            faulty |= sum(sensors for bit, sensors in NODE_SENSORS if failed & bit)
        for sensor in SENSORS:
            if sensor not in self._seen_us or absent & sensor:
                continue
            present |= sensor
            if self.is_alive(sensor, now_us) and not faulty & sensor:
                healthy |= sensor
        if not self.has_fix(now_us):
            healthy &= ~GPS
        if present & GYRO:
            present |= AHRS
            is_faulty = self._nav_flags & NavFlags.SENSOR_FAULT
            if healthy & GYRO and self._nav_flags & NavFlags.ATTITUDE_VALID and not is_faulty:
                healthy |= AHRS
        elif AHRS in self._seen_us:
            present |= AHRS
            healthy |= AHRS if self.is_alive(AHRS, now_us) else 0
        present |= PREARM | (LOGGING if self.recording or self.recording_expected else 0)
        # Healthy, because there is no fence: MAVProxy reports a breach without this bit.
        healthy |= GEOFENCE
        enabled = present if self.recording else present & ~LOGGING
        healthy |= LOGGING if self.recording else 0
        imu = GYRO | ACCEL | AHRS
        needed = (imu if self.has_imu or not present & GPS else 0) | GPS | present & (MAG | AHRS)
        if healthy & needed == needed:
            healthy |= PREARM
        return present, enabled, healthy

    def sys_status(self, now_us: int) -> Any:
        """Encode SYS_STATUS.

        The voltage is the lowest supply of the nodes; BATTERY_STATUS reports each. The four error
        counts are the nodes' bus errors, failed and repeated radio sends, and the receiver's
        overruns.
        """
        boards = self._boards.values()
        lowest = self._lowest_supply()
        millivolts = lowest.supply_mv if lowest else encoding.UINT16_MAX
        current = remaining = -1
        if (battery := self.reported.battery(now_us, BATTERY_TIMEOUT_US)) is not None:
            millivolts = encoding.uint16(battery.voltage_v * MV)
            current = whole_or_unknown(battery.current_a * 100.0)
            remaining = whole_or_unknown(battery.remaining_percent, 100)
        return mavlink.MAVLink_sys_status_message(
            *self.sensors(now_us),
            load=min(1000, self._load_permille),
            voltage_battery=millivolts,
            current_battery=current,
            battery_remaining=remaining,
            drop_rate_comm=round(self._drop_rate * 10_000.0),
            errors_comm=encoding.uint16(self._lost),
            errors_count1=_sum(board.status.bus_errors for board in boards),
            errors_count2=_sum(board.status.radio_failed for board in boards),
            errors_count3=_sum(board.status.radio_retries for board in boards),
            errors_count4=_sum(board.overruns or 0 for board in boards),
        )

    def radio_status(self) -> Any:
        """Encode RADIO_STATUS of the weakest link; None if no radio measures its signal.

        Signal and noise are in dBm as signed bytes, which QGroundControl expects of any radio but
        SiK's. The values of the remote side are unknown, and no data waits to be sent to it.
        """
        signals = [link.signal for link in self._links if link.signal is not None]
        if not signals:
            return None
        weakest = min(signals, key=lambda signal: signal.rssi_dbm)
        has_noise = math.isfinite(weakest.snr_db)
        noise_dbm = weakest.rssi_dbm - round(weakest.snr_db if has_noise else 0.0)
        return mavlink.MAVLink_radio_status_message(
            rssi=_signed_byte(weakest.rssi_dbm),
            remrssi=encoding.UINT8_MAX,
            txbuf=100,
            noise=_signed_byte(noise_dbm) if has_noise else encoding.UINT8_MAX,
            remnoise=encoding.UINT8_MAX,
            rxerrors=encoding.uint16(self._lost),
            fixed=0,
        )

    def _lowest_supply(self) -> NodeStatus | None:
        """Return the report with the lowest supply; None if no node measures it."""
        measured = (status for status in self.statuses if status.supply_mv)
        return min(measured, key=lambda status: status.supply_mv, default=None)

    def newest_battery(self, now_us: int) -> Any:
        """Encode BATTERY_STATUS of the vehicle's battery, or of the node with the lowest supply."""
        battery = self.reported.battery(now_us, BATTERY_TIMEOUT_US)
        if battery is not None:
            return battery_status(battery)
        lowest = self._lowest_supply()
        return None if lowest is None else self.battery(lowest)

    def battery(self, status: NodeStatus) -> Any:
        """Encode a node's supply as BATTERY_STATUS; None if it does not measure it."""
        if not status.supply_mv:
            return None
        number = status.node.node_id
        supply = BatteryReport(number=number, voltage_v=status.supply_mv / MV)
        avionics = mavlink.MAV_BATTERY_FUNCTION_AVIONICS
        return battery_status(supply, avionics, self._boards[number].low)

    def silent_nodes(self, now_us: int) -> frozenset[int]:
        """Return the nodes that have sent payloads before and have timed out."""
        limit_us = now_us - self.silent_us
        late = {link.node.node_id for link in self._links if link.last_time_us < limit_us}
        excused = {number for number, us in self._excused_us.items() if us >= limit_us}
        return self.known_nodes() & late - excused

    def node_name(self, node_id: int) -> str:
        """Name a node by its sensors, as far as it has reported them."""
        if node_id >= SOURCE_NODE:
            return f"Source {node_id - SOURCE_NODE + 1}"
        board = self._boards.get(node_id)
        return f"{node_role(board.status.sensors_present) if board else 'Node'} {node_id}"

    def restarts(self) -> dict[int, int]:
        """Return the number of restarts of each node."""
        return {link.node.node_id: link.restarts for link in self._links}

    def gps_nodes(self) -> list[int]:
        """Return the nodes that have reported a GPS receiver."""
        return [s.node.node_id for s in self.statuses if s.sensors_present & NODE_GPS]

    def known_nodes(self) -> frozenset[int]:
        """Return the nodes that have sent a payload."""
        return frozenset(link.node.node_id for link in self._links if link.received)


def _sum(counts: Iterable[int]) -> int:
    return encoding.uint16(sum(counts), unknown=0)


def _signed_byte(dbm: int) -> int:
    """Return a signal strength as the byte of its two's complement."""
    return max(-128, min(dbm, -1)) & 0xFF
