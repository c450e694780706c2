"""State of the boards: supply, radio, sensor bus, overruns; announced when it gets worse.

A node reports once a second what it counted since its start. Most faults of cheap boards show here
first: a supply that sags when the radio sends, a broken cable to the sensors, a lost antenna.

| topic  | gets worse                                     | is good again                        |
| ------ | ---------------------------------------------- | ------------------------------------ |
| supply | below the limit of the settings                | `HYSTERESIS_V` above it              |
| bus    | an error more than in the report before        | `QUIET_REPORTS` without one          |
| radio  | as many sends fail in `RADIO_SPAN_US` as       | less than half as many fail          |
|        | `FAILED_SHARE` of the samples in it            |                                      |
| pipe   | the receiver had no room for a payload of it   | `QUIET_REPORTS` of the receiver's    |
"""

from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import all as mavlink

from gateway.records import LinkReport, NodeStatus
from gateway.units import US_PER_S
from gateway.vehicle.telemetry import fields
from gateway.vehicle.telemetry.events import INFO, WARNING, StatusText

HYSTERESIS_V: Final = 0.1
QUIET_REPORTS: Final = 10
FAILED_SHARE: Final = 0.1
RADIO_SPAN_US: Final = 10 * US_PER_S
"""A GPS node sends so seldom that one lost payload is a tenth of a second's."""
MAX_REPORTS: Final = 20
"""In that time; a node reports once a second."""
WORD: Final = 0xFFFF
"""The nodes' counters have 16 bits, and wrap."""
CELLS: Final = 10
MV: Final = 1e3


@dataclass(frozen=True, slots=True)
class Finding:
    """The state of one topic of one node."""

    topic: str
    is_bad: bool
    text: StatusText


@dataclass(slots=True)
class _Trouble:
    """A topic that turns bad with one report, and good again after several without errors."""

    quiet: int = QUIET_REPORTS

    def note(self, worse: bool) -> bool:
        self.quiet = 0 if worse else min(self.quiet + 1, QUIET_REPORTS)
        return self.quiet < QUIET_REPORTS


@dataclass(slots=True)
class _Radio:
    """Failed sends of the last seconds, of which some are no trouble."""

    failed: deque[tuple[int, int]] = field(default_factory=lambda: deque(maxlen=MAX_REPORTS))
    """Time of each report and what it added."""
    is_bad: bool = False

    def note(self, time_us: int, failed: int, rate_hz: int) -> int:
        """Take in a report, and return how many sends failed in `RADIO_SPAN_US`."""
        self.failed.append((time_us, failed))
        while self.failed[0][0] <= time_us - RADIO_SPAN_US:
            self.failed.popleft()
        total = sum(number for _, number in self.failed)
        most = FAILED_SHARE * rate_hz * RADIO_SPAN_US / US_PER_S
        self.is_bad = 0 < (most / 2 if self.is_bad else most) <= total
        return total


@dataclass(slots=True)
class _Node:
    status: NodeStatus
    low: bool = False
    bus: _Trouble = field(default_factory=_Trouble)
    radio: _Radio = field(default_factory=_Radio)
    pipe: _Trouble = field(default_factory=_Trouble)
    overruns: int | None = None


class NodeHealth:
    """The newest reports of one aircraft's nodes.

    Parameters
    ----------
    vehicle_id : int
        Whose nodes.
    supply_low_v : float
        A lower supply is announced, in V; 0 disables this.
    """

    def __init__(self, vehicle_id: int, supply_low_v: float) -> None:
        self.supply_low_v = supply_low_v
        self._vehicle_id = vehicle_id
        self._nodes: dict[int, _Node] = {}

    @property
    def statuses(self) -> tuple[NodeStatus, ...]:
        """The newest report of each node, in the order of their ids."""
        return tuple(node.status for _, node in sorted(self._nodes.items()))

    @property
    def firmware(self) -> int:
        """Firmware version of the first node as MAVLink packs it; 0 before it has reported."""
        for status in self.statuses:
            major, minor = status.firmware_version
            return major << 24 | minor << 16
        return 0

    def take(self, status: NodeStatus, name: str) -> list[Finding]:
        """Note a report.

        Parameters
        ----------
        status : NodeStatus
            The node's newest.
        name : str
            Name of the node in texts.

        Returns
        -------
        list of Finding
            The state of each topic, to announce changes.
        """
        known = self._nodes.get(status.node.node_id)
        if known is None:
            known = self._nodes[status.node.node_id] = _Node(status)
        before, known.status = known.status, status
        if status.node_time_us < before.node_time_us:
            # It has restarted, and so have its counters.
            before = status
        errors = status.bus_errors - before.bus_errors & WORD
        failed = status.radio_failed - before.radio_failed & WORD
        failed = known.radio.note(status.time_us, failed, status.sample_rate_hz)
        number = status.node.node_id
        return [
            self._supply(known, name),
            _finding(
                f"bus {number}",
                known.bus.note(errors > 0),
                f"{name}: bus errors, {status.bus_errors} so far",
                f"{name}: bus OK again",
            ),
            _finding(
                f"radio {number}",
                known.radio.is_bad,
                f"{name}: radio sends failed, {failed} in {RADIO_SPAN_US // US_PER_S} s",
                f"{name}: radio OK again",
            ),
        ]

    def take_link(self, report: LinkReport, names: dict[int, str]) -> list[Finding]:
        """Note the payloads for which the receiver had no room."""
        if report.receiver is None:
            return []
        found = []
        for link in report.nodes:
            node = self._nodes.get(link.node.node_id)
            if link.node.vehicle_id != self._vehicle_id or node is None:
                continue
            overruns = report.receiver.pipes[link.pipe].overruns
            worse = node.overruns is not None and overruns > node.overruns
            node.overruns = overruns
            name = names.get(link.node.node_id, "Node")
            found.append(
                _finding(
                    f"pipe {link.node.node_id}",
                    node.pipe.note(worse),
                    f"{name}: receiver overrun, {overruns} so far",
                    f"{name}: receiver keeps up again",
                )
            )
        return found

    def error_counts(self) -> tuple[int, int, int, int]:
        """Sum up bus errors, failed sends, repeated sends and overruns, as SYS_STATUS has room."""
        nodes = self._nodes.values()
        counts = (
            sum(node.status.bus_errors for node in nodes),
            sum(node.status.radio_failed for node in nodes),
            sum(node.status.radio_retries for node in nodes),
            sum(node.overruns or 0 for node in nodes),
        )
        bus, failed, retries, overruns = (fields.uint16(count, unknown=0) for count in counts)
        return bus, failed, retries, overruns

    @property
    def lowest_supply_mv(self) -> int | None:
        """The lowest supply of the nodes; None if none measures it."""
        return min((s.supply_mv for s in self.statuses if s.supply_mv), default=None)

    def lowest(self) -> Any:
        """Encode BATTERY_STATUS of the node with the lowest supply; None if none measures it."""
        measured = [s for s in self.statuses if s.supply_mv]
        return self.battery(min(measured, key=lambda s: s.supply_mv)) if measured else None

    def battery(self, status: NodeStatus) -> Any:
        """Encode a node's supply as BATTERY_STATUS; None if it does not measure it."""
        if not status.supply_mv:
            return None
        low = self._nodes[status.node.node_id].low
        state = mavlink.MAV_BATTERY_CHARGE_STATE_LOW if low else mavlink.MAV_BATTERY_CHARGE_STATE_OK
        return mavlink.MAVLink_battery_status_message(
            id=status.node.node_id,
            battery_function=mavlink.MAV_BATTERY_FUNCTION_AVIONICS,
            type=mavlink.MAV_BATTERY_TYPE_UNKNOWN,
            temperature=fields.INT16_MAX,
            voltages=[status.supply_mv] + [fields.UINT16_MAX] * (CELLS - 1),
            current_battery=-1,
            current_consumed=-1,
            energy_consumed=-1,
            battery_remaining=-1,
            time_remaining=0,
            charge_state=state,
        )

    def _supply(self, node: _Node, name: str) -> Finding:
        status, supply_v = node.status, node.status.supply_mv / MV
        limit_v = self.supply_low_v + (HYSTERESIS_V if node.low else 0.0)
        node.low = bool(self.supply_low_v and status.supply_mv) and supply_v < limit_v
        return _finding(
            f"supply {status.node.node_id}",
            node.low,
            f"{name}: supply low, {supply_v:.2f} V",
            f"{name}: supply OK again, {supply_v:.2f} V",
        )


def _finding(topic: str, is_bad: bool, bad: str, good: str) -> Finding:
    return Finding(topic, is_bad, StatusText(WARNING, bad) if is_bad else StatusText(INFO, good))
