"""Prometheus metrics of the gateway: each family with its meaning and what to do."""

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from gateway.geometry.quaternion import to_euler
from gateway.hub.stats import ClientStats, HubCounters, ListenerStats
from gateway.records import GpsFix, NavFlags, NavState, NodeId, NodeLink, NodeStatus
from gateway.status import AircraftStatus, Snapshot
from gateway.units import RAD_PER_DEG, US_PER_S

Labels = tuple[str, ...]
Sample = tuple[Labels, float]
CLIENT: Final = ("client", "name", "remote")
LISTENER: Final = ("name", "endpoint")
HUB_HELP: Final = {
    "published": "MAVLink frames of the gateway itself.",
    "forwarded": "Frames of other systems, such as an autopilot, that were forwarded.",
    "duplicates": "Copies by a second path, dropped: two endpoints reach one peer.",
    "late": "Frames dropped because newer ones of their system had arrived on another link.",
    "shed": "Telemetry of the gateway dropped because the processor was short of time.",
    "looped": "Frames of ours that came back: an endpoint leads to a router that sends to us.",
    "unroutable": "Frames for an unknown system, or from a client that may not send to it.",
    "unserved": "Requests dropped because their client exceeded its quota.",
}
CLIENT_COUNTERS: Final = (
    ("sent", "Frames sent to a client."),
    ("dropped", "Frames dropped: the client is too slow for them, or out of reach."),
    ("unheard", "Frames sent to a port on which nobody listened, as before a station is started."),
    (
        "bytes_sent",
        "Bytes sent to a client; the rate divided by the width of its link is its load.",
    ),
    ("received", "Frames received from a client."),
    (
        "bytes_garbage",
        "Bytes from a client that were not MAVLink: a wrong baud rate or another program.",
    ),
)


def text_of(found: Iterable[Metric]) -> Iterator[str]:
    """Write families in the Prometheus text format, and yield them one by one."""
    return (generate_latest(_Moment([family])).decode() for family in found)


def gauge(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    """Build a gauge; its name begins with `mavgate_`."""
    family = GaugeMetricFamily(f"mavgate_{name}", text, labels=labels)
    return _filled(family, samples)


def counter(name: str, text: str, labels: Labels, samples: Iterable[Sample]) -> Metric:
    """Build a counter; its samples are named by its name and `_total`."""
    family = CounterMetricFamily(f"mavgate_{name}", text, labels=labels)
    return _filled(family, samples)


def hub_families(
    hub: HubCounters,
    listeners: tuple[ListenerStats, ...],
    clients: tuple[ClientStats, ...],
    now_us: int,
) -> Iterator[Metric]:
    """Yield the metrics of the hub, its listening ports and its clients."""
    yield from _hub(hub)
    yield from _listeners(listeners)
    yield from _clients(clients, now_us)


def _hub(hub: HubCounters) -> Iterator[Metric]:
    for field, text in HUB_HELP.items():
        yield counter(f"hub_{field}", text, (), [((), float(getattr(hub, field)))])


def _listeners(listeners: tuple[ListenerStats, ...]) -> Iterator[Metric]:
    ports = [((port.name, port.endpoint), port) for port in listeners]
    yield gauge(
        "listener_open",
        "1 while a listening port accepts clients; 0: another program has it.",
        LISTENER,
        [(labels, float(port.state == "open")) for labels, port in ports],
    )
    yield gauge(
        "listener_clients",
        "Clients of a listening port.",
        LISTENER,
        [(labels, float(port.clients)) for labels, port in ports],
    )
    yield counter(
        "listener_turned_away",
        "Clients turned away for lack of room: see max_clients.",
        LISTENER,
        [(labels, float(port.turned_away)) for labels, port in ports],
    )


def _clients(clients: tuple[ClientStats, ...], now_us: int) -> Iterator[Metric]:
    named = [((str(c.client_id), c.name, c.remote), c) for c in clients]
    for field, text in CLIENT_COUNTERS:
        samples = [(labels, float(getattr(client, field))) for labels, client in named]
        yield counter(f"client_{field}", text, CLIENT, samples)
    yield gauge(
        "client_queued",
        "Frames that wait for a client: it is slower than what it is sent.",
        CLIENT,
        [(labels, float(client.queued)) for labels, client in named],
    )
    yield gauge(
        "client_open",
        "1 while frames reach the client as far as is known.",
        CLIENT,
        [(labels, float(client.state == "open")) for labels, client in named],
    )
    yield gauge(
        "client_round_trip_seconds",
        "Time of the newest answer to PING or TIMESYNC.",
        CLIENT,
        [
            (labels, client.round_trip_us / US_PER_S)
            for labels, client in named
            if client.round_trip_us is not None
        ],
    )
    yield gauge(
        "client_silent_seconds",
        "Time since the client's newest frame: ground stations send one a second.",
        CLIENT,
        [
            (labels, (now_us - client.heard_us) / US_PER_S)
            for labels, client in named
            if client.heard_us is not None
        ],
    )


def _filled(family: Any, samples: Iterable[Sample]) -> Metric:
    for labels, value in samples:
        if not math.isnan(value):
            family.add_metric(labels, value)
    filled: Metric = family
    return filled


class _Moment(Collector):
    """The metrics of one moment, in place of a registry that counts by itself."""

    def __init__(self, found: Iterable[Metric]) -> None:
        self._found = found

    def collect(self) -> Iterable[Metric]:
        return self._found


NODE: Final = ("vehicle", "node")
FRACTION: Final = 1e-6

NODE_COUNTERS: Final = (
    ("received", "Radio payloads of a node that arrived."),
    ("lost", "Radio payloads of a node that never came: above some percent look at the antennas."),
    ("duplicates", "Payloads that came twice: the node did not hear that they had arrived."),
    ("restarts", "Restarts of a node: in flight a failing supply or its watchdog."),
)
VALID: Final = {
    "attitude": NavFlags.ATTITUDE_VALID,
    "heading": NavFlags.HEADING_VALID,
    "position": NavFlags.POSITION_VALID,
    "velocity": NavFlags.VELOCITY_VALID,
    "altitude": NavFlags.ALTITUDE_VALID,
}
VEHICLE_GAUGES: Final[tuple[tuple[str, str, Callable[[NavState], float]], ...]] = (
    ("latitude_degrees", "Latitude; not there before it is known.", lambda s: s.lat_deg),
    ("longitude_degrees", "Longitude; not there before it is known.", lambda s: s.lon_deg),
    ("altitude_metres", "Height above mean sea level.", lambda s: s.alt_amsl_m),
    (
        "ground_speed_metres_per_second",
        "Horizontal speed.",
        lambda s: math.hypot(s.vel_n_mps[0], s.vel_n_mps[1]),
    ),
    ("climb_metres_per_second", "Speed upwards.", lambda s: -s.vel_n_mps[2]),
    (
        "horizontal_deviation_metres",
        "Standard deviation of the horizontal position, by the estimator.",
        lambda s: math.hypot(s.pos_std_m[0], s.pos_std_m[1]),
    ),
    (
        "roll_degrees",
        "Roll, right wing down positive.",
        lambda s: to_euler(s.q_nb)[0] / RAD_PER_DEG,
    ),
    ("pitch_degrees", "Pitch, nose up positive.", lambda s: to_euler(s.q_nb)[1] / RAD_PER_DEG),
    (
        "heading_degrees",
        "Heading from true north, once it is known.",
        lambda s: (
            to_euler(s.q_nb)[2] / RAD_PER_DEG % 360.0
            if s.flags & NavFlags.HEADING_VALID
            else math.nan
        ),
    ),
)
BOARD_GAUGES: Final[tuple[tuple[str, str, Callable[[NodeStatus], float]], ...]] = (
    (
        "supply_volts",
        "Supply of a node; 0 where it does not measure it.",
        lambda b: b.supply_mv / 1e3,
    ),
    (
        "loop_max_seconds",
        "Longest loop of a node in the last second: above its sample time samples are late.",
        lambda b: b.loop_max_us / US_PER_S,
    ),
)
BOARD_COUNTERS: Final = (
    (
        "bus_errors",
        "Failed transfers with a sensor, 16 bits: a loose wire, or a bus that is too long.",
    ),
    ("radio_failed", "Payloads that nobody acknowledged, 16 bits: out of reach, or a weak supply."),
    ("radio_retries", "Payloads that were sent again, 16 bits: a busy channel or a weak link."),
)
FIX_GAUGES: Final[tuple[tuple[str, str, Callable[[GpsFix], float]], ...]] = (
    (
        "gps_fix",
        "Type of GPS fix: 0 none, 2 is 2D, 3 is 3D; others are no fix.",
        lambda f: float(f.fix_type),
    ),
    ("satellites", "Satellites in use.", lambda f: float(f.satellites)),
    (
        "gps_accuracy_metres",
        "Horizontal accuracy, as the receiver reports it.",
        lambda f: f.h_acc_m,
    ),
)


def prometheus_text(snapshot: Snapshot) -> Iterator[str]:
    """Write a snapshot in the Prometheus text format."""
    return text_of(families(snapshot))


def families(snapshot: Snapshot) -> Iterator[Metric]:
    """Yield the metrics of a snapshot."""
    yield from _gateway(snapshot)
    yield from _refusals(snapshot)
    yield from _nodes(snapshot.report.nodes, snapshot.time_us)
    yield from _boards(snapshot)
    yield from _vehicles(snapshot.states)
    yield from _receptions(snapshot.aircraft)
    yield from hub_families(snapshot.hub, snapshot.listeners, snapshot.clients, snapshot.time_us)


def _gateway(snapshot: Snapshot) -> Iterator[Metric]:
    report = snapshot.report
    up_s = snapshot.time_us / US_PER_S
    yield gauge("up_seconds", "Time since the gateway started.", (), [((), up_s)])
    yield gauge(
        "receiver_connected",
        "1 while the receiver's port is open; 0: unplugged, or another program has it.",
        (),
        [((), float(report.connected))],
    )
    yield counter(
        "receiver_frames", "Frames that the receiver sent.", (), [((), float(report.frames))]
    )
    yield counter(
        "receiver_frames_lost",
        "Frames that were lost on the serial line: the computer is too busy, or the cable bad.",
        (),
        [((), float(report.frames_lost))],
    )
    yield counter(
        "receiver_faults",
        "Damage on the serial line by kind: a wrong baud rate, or a bad cable.",
        ("kind",),
        [((kind,), float(count)) for kind, count in report.faults],
    )


def _refusals(snapshot: Snapshot) -> Iterator[Metric]:
    for name, count, text in (
        (
            "places_not_kept",
            snapshot.places_not_kept,
            "Missions, marks and homes that could not be written: the disk is full or read-only.",
        ),
        (
            "requests_refused",
            snapshot.refused,
            "Requests to change something from untrusted clients: see trusted= of endpoints.",
        ),
        (
            "requests_forged",
            snapshot.forged,
            "Requests with a wrong, old or repeated signature: another passphrase, or an attack.",
        ),
    ):
        yield counter(name, text, (), [((), float(count))])


def _nodes(nodes: tuple[NodeLink, ...], now_us: int) -> Iterator[Metric]:
    for field, text in NODE_COUNTERS:
        samples = [(_of(link.node), float(getattr(link, field))) for link in nodes]
        yield counter(f"node_{field}", text, NODE, samples)
    rates = [(_of(link.node), link.rate_hz) for link in nodes]
    yield gauge("node_rate_hz", "Radio payloads of a node in the last second.", NODE, rates)
    silences = [(_of(link.node), (now_us - link.last_time_us) / US_PER_S) for link in nodes]
    yield gauge(
        "node_silent_seconds",
        "Time since a node's newest payload: above a second it is off or out of reach.",
        NODE,
        silences,
    )
    skews = [(_of(link.node), link.clock_skew_ppm * FRACTION) for link in nodes]
    yield gauge(
        "node_clock_skew_ratio",
        "How much faster than the gateway's a node's clock runs.",
        NODE,
        skews,
    )


def _boards(snapshot: Snapshot) -> Iterator[Metric]:
    """Yield the nodes' reports of their own boards."""
    boards = [board for one in snapshot.aircraft for board in one.boards]
    for name, text, value_of in BOARD_GAUGES:
        yield gauge(f"node_{name}", text, NODE, [(_of(b.node), value_of(b)) for b in boards])
    for field, text in BOARD_COUNTERS:
        samples = [(_of(board.node), float(getattr(board, field))) for board in boards]
        yield counter(f"node_{field}", text, NODE, samples)
    versions = [((*_of(b.node), ".".join(map(str, b.firmware_version))), 1.0) for b in boards]
    yield gauge("node_info", "Firmware of a node.", (*NODE, "firmware"), versions)
    receiver = snapshot.report.receiver
    pipes = receiver.pipes if receiver is not None else ()
    yield counter(
        "receiver_overruns",
        "Payloads that the receiver had no room for: too many nodes, or a slow serial line.",
        ("pipe",),
        [((str(number),), float(pipe.overruns)) for number, pipe in enumerate(pipes)],
    )


def _receptions(aircraft: tuple[AircraftStatus, ...]) -> Iterator[Metric]:
    """Yield the aircraft's GPS reception, and the distance to home."""
    for name, text, value_of in FIX_GAUGES:
        samples = [((str(one.vehicle_id),), value_of(one.fix)) for one in aircraft if one.fix]
        yield gauge(f"vehicle_{name}", text, ("vehicle",), samples)
    ways = [
        ((str(one.vehicle_id),), one.home.distance_m)
        for one in aircraft
        if one.home is not None and one.home.distance_m is not None
    ]
    yield gauge("vehicle_home_distance_metres", "Distance over ground to home.", ("vehicle",), ways)


def _vehicles(states: tuple[tuple[int, NavState], ...]) -> Iterator[Metric]:
    for name, text, value_of in VEHICLE_GAUGES:
        samples = [((str(vehicle_id),), value_of(state)) for vehicle_id, state in states]
        yield gauge(f"vehicle_{name}", text, ("vehicle",), samples)
    yield gauge(
        "vehicle_valid",
        "1 where the estimate is valid, by quantity.",
        ("vehicle", "quantity"),
        [
            ((str(vehicle_id), quantity), float(flag in state.flags))
            for vehicle_id, state in states
            for quantity, flag in VALID.items()
        ],
    )
    yield gauge(
        "vehicle_trouble",
        "1 while GPS is rejected, or the compass is disturbed (metal or currents nearby).",
        ("vehicle", "kind"),
        [
            ((str(vehicle_id), kind), float(flag in state.flags))
            for vehicle_id, state in states
            for kind, flag in (
                ("gps_rejected", NavFlags.GPS_REJECTED),
                ("magnetometer_disturbed", NavFlags.MAG_DISTURBED),
            )
        ],
    )


def _of(node: NodeId) -> Labels:
    return (str(node.vehicle_id), str(node.node_id))
