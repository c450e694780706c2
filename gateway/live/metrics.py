"""Prometheus metrics of the gateway: each family with its meaning and a remedy.

A family has one sample for each node, aircraft, client, and so on; an unknown value has none.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from operator import attrgetter
from typing import Any, Final

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gateway.geometry.quaternion import to_euler
from gateway.hub.stats import ClientStats, HubCounters, ListenerStats
from gateway.live.vehicle_watch import VehicleWatch
from gateway.records import NAN, NavFlags, NodeId
from gateway.status import Snapshot
from gateway.units import MV_PER_V, RAD_PER_DEG, US_PER_S
from gateway.vehicle_state.newest import NewestState

Labels = tuple[str, ...]
Samples = Iterable[tuple[Labels, float | None]]
Labelled = list[tuple[Labels, Any]]

GATEWAY_GAUGES: Final = {
    "up_seconds": "Time since the gateway started.",
    "receiver_connected": "1 while the receiver's port is open; 0: unplugged, or in other use.",
}
GATEWAY_COUNTERS: Final = {
    "receiver_frames": "Frames that the receiver sent.",
    "receiver_frames_lost": "Frames lost on the serial line: a busy computer or a bad cable.",
    "places_not_kept": "Missions, marks and homes not written: the disk is full or read-only.",
    "requests_refused": "Requests for changes by untrusted clients: see trusted= of endpoints.",
    "requests_forged": "Requests with a wrong or old signature: another passphrase, or an attack.",
}
NODE_COUNTERS: Final = {
    "received": "Radio payloads of a node that arrived.",
    "lost": "Radio payloads of a node that never arrived: above some percent check the antennas.",
    "duplicates": "Payloads that arrived twice: the node received no acknowledgement of the first.",
    "restarts": "Restarts of a node: in flight a failing supply or its watchdog.",
}
NODE_GAUGES: Final = {
    "rate_hz": "Radio payloads of a node in the last second.",
    "clock_skew_ratio": "How much faster than the gateway's a node's clock runs.",
}
BOARD_GAUGES: Final = {
    "supply_volts": "Supply of a node; 0 where it does not measure it.",
    "loop_max_seconds": "Longest loop in the last second: above its sample time samples are late.",
}
BOARD_COUNTERS: Final = {
    "bus_errors": "Failed transfers with a sensor, 16 bits: a loose wire, or too long a bus.",
    "radio_failed": "Payloads without acknowledgement, 16 bits: out of reach, or a weak supply.",
    "radio_retries": "Payloads that were sent again, 16 bits: a busy channel or a weak link.",
}
VEHICLE_GAUGES: Final = {
    "latitude_degrees": "Latitude; absent before it is known.",
    "longitude_degrees": "Longitude; absent before it is known.",
    "altitude_metres": "Height above mean sea level.",
    "ground_speed_metres_per_second": "Horizontal speed.",
    "climb_metres_per_second": "Speed upwards.",
    "horizontal_deviation_metres": "Standard deviation of the horizontal position, estimated.",
    "roll_degrees": "Roll, right wing down positive.",
    "pitch_degrees": "Pitch, nose up positive.",
    "heading_degrees": "Heading from true north, once it is known.",
}
FIX_GAUGES: Final = {
    "gps_fix": "Type of GPS fix: 0 none, 2 is 2D, 3 is 3D; others are no fix.",
    "satellites": "Satellites in use.",
    "gps_accuracy_metres": "Horizontal accuracy, as the receiver reports it.",
}
HUB_COUNTERS: Final = {
    "published": "MAVLink frames of the gateway itself.",
    "forwarded": "Frames of other systems, such as an autopilot, that were forwarded.",
    "duplicates": "Copies by a second path, dropped: two endpoints reach one peer.",
    "late": "Frames dropped because newer ones of their system had arrived on another link.",
    "shed": "Telemetry of the gateway dropped because the processor was short of time.",
    "looped": "Frames of ours that came back: an endpoint leads to a router that sends to us.",
    "unroutable": "Frames for an unknown system, or from a client that may not send to it.",
    "unserved": "Requests dropped because their client exceeded its quota.",
}
LISTENER_GAUGES: Final = {
    "open": "1 while a listening port accepts clients; 0: another program has it.",
    "clients": "Clients of a listening port.",
}
LISTENER_COUNTERS: Final = {"turned_away": "Clients turned away for lack of room: see max_clients."}
CLIENT_COUNTERS: Final = {
    "sent": "Frames sent to a client.",
    "dropped": "Frames dropped: the client is too slow for them, or out of reach.",
    "unheard": "Frames sent to a port without a listener, as before a station is started.",
    "bytes_sent": "Bytes sent to a client; their rate over the link's bandwidth is its load.",
    "received": "Frames received from a client.",
    "cut": "Datagrams of a client that were longer than 4096 bytes, and lost their end.",
    "bytes_garbage": "Bytes of a client that were not MAVLink: a wrong baud rate or program.",
}
CLIENT_GAUGES: Final = {
    "queued": "Frames that wait for a client: its link is slower than its telemetry.",
    "open": "1 while frames reach the client as far as is known.",
    "round_trip_seconds": "Time of the newest answer to PING or TIMESYNC.",
}
VALUES: Final[dict[str, Callable[[Any], float | None]]] = {
    "up_seconds": lambda snapshot: snapshot.time_us / US_PER_S,
    "receiver_connected": attrgetter("report.connected"),
    "receiver_frames": attrgetter("report.frames"),
    "receiver_frames_lost": attrgetter("report.frames_lost"),
    "requests_refused": attrgetter("refused"),
    "requests_forged": attrgetter("forged"),
    "clock_skew_ratio": lambda link: link.clock_skew_ppm * 1e-6,
    "supply_volts": lambda board: board.supply_mv / MV_PER_V,
    "loop_max_seconds": lambda board: board.loop_max_us / US_PER_S,
    "latitude_degrees": attrgetter("lat_deg"),
    "longitude_degrees": attrgetter("lon_deg"),
    "altitude_metres": attrgetter("alt_amsl_m"),
    "ground_speed_metres_per_second": lambda state: math.hypot(*state.vel_n_mps[:2]),
    "climb_metres_per_second": lambda state: -state.vel_n_mps[2],
    "horizontal_deviation_metres": lambda state: math.hypot(*state.pos_std_m[:2]),
    "roll_degrees": lambda state: to_euler(state.q_nb)[0] / RAD_PER_DEG,
    "pitch_degrees": lambda state: to_euler(state.q_nb)[1] / RAD_PER_DEG,
    "heading_degrees": lambda state: (
        to_euler(state.q_nb)[2] / RAD_PER_DEG % 360.0
        if NavFlags.HEADING_VALID in state.flags
        else None
    ),
    "gps_fix": attrgetter("fix_type"),
    "gps_accuracy_metres": attrgetter("h_acc_m"),
    "open": lambda port_or_client: port_or_client.state == "open",
    "round_trip_seconds": lambda client: client.round_trip_us and client.round_trip_us / US_PER_S,
}
"""Functions by the name of the family; other families are attributes of the same name."""
VALID: Final = {
    "attitude": NavFlags.ATTITUDE_VALID,
    "heading": NavFlags.HEADING_VALID,
    "position": NavFlags.POSITION_VALID,
    "velocity": NavFlags.VELOCITY_VALID,
    "altitude": NavFlags.ALTITUDE_VALID,
}
TROUBLE: Final = {
    "gps_rejected": NavFlags.GPS_REJECTED,
    "magnetometer_disturbed": NavFlags.MAG_DISTURBED,
}
NODE: Final = ("vehicle", "node")
VEHICLE: Final = ("vehicle",)
LISTENER: Final = ("name", "endpoint")
CLIENT: Final = ("client", "name", "remote")
SYSTEM: Final = ("system",)
Value = Callable[[NewestState, int], float]


def _position(name: str) -> Value:
    return lambda state, now_us: getattr(state.valid_position(now_us), name, NAN)


SYSTEM_GAUGES: Final[dict[str, tuple[str, Value]]] = {
    "altitude_metres": (
        "Height above mean sea level, of a valid position.",
        _position("alt_amsl_m"),
    ),
    "height_metres": ("Height above home, of a valid position.", _position("alt_home_m")),
    "ground_speed_metres_per_second": ("Horizontal speed.", _position("groundspeed_mps")),
    "satellites": ("Satellites of the GPS receiver.", lambda state, _: state.satellites()),
    "battery_volts": ("Voltage of the first battery.", lambda state, _: state.battery()[0]),
    "battery_percent": ("Remaining charge.", lambda state, _: state.battery()[1]),
    "armed": ("1 while the vehicle is armed.", lambda state, _: float(state.is_armed())),
    "silent_seconds": (
        "Time since the newest message: above some seconds the link is broken.",
        lambda state, now_us: state.age_us(now_us, *state.heard_us) / US_PER_S,
    ),
}


class _Moment(Collector):
    """The metrics of one moment, instead of a registry with its own counters."""

    def __init__(self, found: Iterable[Metric]) -> None:
        self._found = found

    def collect(self) -> Iterable[Metric]:
        return self._found


def text_of(found: Iterable[Metric]) -> Iterator[str]:
    """Write families in the Prometheus text format, and yield them one by one."""
    return (generate_latest(_Moment([family])).decode() for family in found)


def gauge(name: str, text: str, labels: Labels, samples: Samples) -> Metric:
    """Build a gauge; its name begins with `mavgate_`."""
    return _filled(GaugeMetricFamily(f"mavgate_{name}", text, labels=labels), samples)


def counter(name: str, text: str, labels: Labels, samples: Samples) -> Metric:
    """Build a counter; its samples are named by its name and `_total`."""
    return _filled(CounterMetricFamily(f"mavgate_{name}", text, labels=labels), samples)


def _filled(family: Any, samples: Samples) -> Metric:
    for labels, value in samples:
        if value is not None and math.isfinite(value):
            family.add_metric(labels, value)
    filled: Metric = family
    return filled


def _families(
    make: Callable[[str, str, Labels, Samples], Metric],
    prefix: str,
    texts: Mapping[str, str],
    labels: Labels,
    found: Labelled,
) -> Iterator[Metric]:
    for name, text in texts.items():
        value_of = VALUES.get(name) or attrgetter(name)
        yield make(prefix + name, text, labels, [(key, value_of(each)) for key, each in found])


def prometheus_text(snapshot: Snapshot) -> Iterator[str]:
    """Write a snapshot in the Prometheus text format."""
    return text_of(families(snapshot))


def families(snapshot: Snapshot) -> Iterator[Metric]:
    """Yield gauges and counters: of the gateway first, then of its parts."""
    report = snapshot.report
    yield from _families(gauge, "", GATEWAY_GAUGES, (), [((), snapshot)])
    yield from _families(counter, "", GATEWAY_COUNTERS, (), [((), snapshot)])
    yield counter(
        "receiver_faults",
        "Damage on the serial line by kind: a wrong baud rate, or a bad cable.",
        ("kind",),
        [((kind,), count) for kind, count in report.faults],
    )
    pipes = () if report.receiver is None else report.receiver.pipes
    yield counter(
        "receiver_overruns",
        "Payloads that the receiver had no room for: too many nodes, or a slow serial line.",
        ("pipe",),
        [((str(number),), pipe.overruns) for number, pipe in enumerate(pipes)],
    )
    yield from _nodes(snapshot)
    yield from _vehicles(snapshot)
    yield from hub_families(snapshot.hub, snapshot.listeners, snapshot.clients, snapshot.time_us)


def _nodes(snapshot: Snapshot) -> Iterator[Metric]:
    links: Labelled = [(_of(link.node), link) for link in snapshot.report.nodes]
    yield from _families(counter, "node_", NODE_COUNTERS, NODE, links)
    yield from _families(gauge, "node_", NODE_GAUGES, NODE, links)
    yield gauge(
        "node_silent_seconds",
        "Time since a node's newest payload: above a second it is off or out of reach.",
        NODE,
        [(key, (snapshot.time_us - link.last_time_us) / US_PER_S) for key, link in links],
    )
    boards: Labelled = [(_of(board.node), board) for a in snapshot.aircraft for board in a.boards]
    yield from _families(gauge, "node_", BOARD_GAUGES, NODE, boards)
    yield from _families(counter, "node_", BOARD_COUNTERS, NODE, boards)
    versions = [((*key, ".".join(map(str, b.firmware_version))), 1.0) for key, b in boards]
    yield gauge("node_info", "Firmware of a node.", (*NODE, "firmware"), versions)


def _vehicles(snapshot: Snapshot) -> Iterator[Metric]:
    states: Labelled = [((str(vehicle_id),), state) for vehicle_id, state in snapshot.states]
    yield from _families(gauge, "vehicle_", VEHICLE_GAUGES, VEHICLE, states)
    trouble = "1 while GPS is rejected, or metal or currents nearby disturb the compass."
    for name, text, label, flags in (
        ("valid", "1 where the estimate is valid, by quantity.", "quantity", VALID),
        ("trouble", trouble, "kind", TROUBLE),
    ):
        samples = [
            ((*key, kind), float(flag in state.flags))
            for key, state in states
            for kind, flag in flags.items()
        ]
        yield gauge(f"vehicle_{name}", text, (*VEHICLE, label), samples)
    fixes: Labelled = [((str(a.vehicle_id),), a.fix) for a in snapshot.aircraft if a.fix]
    yield from _families(gauge, "vehicle_", FIX_GAUGES, VEHICLE, fixes)
    homes = [((str(a.vehicle_id),), a.home.distance_m) for a in snapshot.aircraft if a.home]
    yield gauge("vehicle_home_distance_metres", "Distance over ground to home.", VEHICLE, homes)


def hub_families(
    hub: HubCounters,
    listeners: tuple[ListenerStats, ...],
    clients: tuple[ClientStats, ...],
    now_us: int,
) -> Iterator[Metric]:
    """Yield the metrics of the hub, its listening ports and its clients."""
    yield from _families(counter, "hub_", HUB_COUNTERS, (), [((), hub)])
    ports: Labelled = [((port.name, port.endpoint), port) for port in listeners]
    yield from _families(gauge, "listener_", LISTENER_GAUGES, LISTENER, ports)
    yield from _families(counter, "listener_", LISTENER_COUNTERS, LISTENER, ports)
    found: Labelled = [((str(c.client_id), c.name, c.remote), c) for c in clients]
    yield from _families(counter, "client_", CLIENT_COUNTERS, CLIENT, found)
    yield from _families(gauge, "client_", CLIENT_GAUGES, CLIENT, found)
    yield gauge(
        "client_silent_seconds",
        "Time since the client's newest frame: ground stations send one a second.",
        CLIENT,
        [(key, (now_us - c.heard_us) / US_PER_S) for key, c in found if c.heard_us is not None],
    )


def _of(node: NodeId) -> Labels:
    return (str(node.vehicle_id), str(node.node_id))


def system_families(watch: VehicleWatch, now_us: int) -> Iterator[Metric]:
    """Yield the metrics of the systems that were received recently."""
    present = watch.present(now_us)
    for name, (text, value_of) in SYSTEM_GAUGES.items():
        samples = [((str(key),), value_of(state, now_us)) for key, state in present.items()]
        yield gauge(f"system_{name}", text, SYSTEM, samples)
    streams = [((str(key),), watch.streams[key]) for key in present if key in watch.streams]
    text = "Frames of the vehicle that were received; copies by a second link are not counted."
    frames = [(label, float(stream.count)) for label, stream in streams]
    yield counter("system_frames", text, SYSTEM, frames)
    text = "Frames of the vehicle that were lost on the way here, by their sequence numbers."
    lost = [(label, float(stream.lost)) for label, stream in streams]
    yield counter("system_frames_lost", text, SYSTEM, lost)
