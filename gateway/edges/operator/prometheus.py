"""Prometheus text of the daemon's state, on a loopback port."""

import asyncio
import logging
import socket
from collections.abc import Callable, Iterator
from typing import Final

from gateway.edges.reasons import reason_of
from gateway.routing.client_table import ClientStats, ListenerStats
from gateway.status import Snapshot
from gateway.units import US_PER_S

log = logging.getLogger(__name__)

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
REQUEST_LIMIT_S: Final = 5.0
MAX_REQUEST_BYTES: Final = 8192
MAX_CONNECTIONS: Final = 8
RETRY_S: Final = 5.0
"""Between attempts to bind a port that is taken: whoever scrapes it asks about as often."""

Sample = tuple[dict[str, str], float]


class MetricsServer:
    """Answer every HTTP GET with the state of the moment.

    Parameters
    ----------
    snapshot : callable
        Describes the daemon now.
    """

    def __init__(self, snapshot: Callable[[], Snapshot]) -> None:
        self._snapshot = snapshot
        self._wanted = 0
        self._reason = ""
        self._socket: socket.socket | None = None
        self._retry: asyncio.TimerHandle | None = None
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def port(self) -> int:
        """The port that is bound, or 0."""
        return self._socket.getsockname()[1] if self._socket else 0

    def listen(self, port: int) -> None:
        """Serve on a loopback port, now or as soon as it is free; 0 ends it."""
        if port != self._wanted:
            self.close()
            self._wanted = port
            if port:
                self._bind()

    def close(self) -> None:
        """Stop serving."""
        self._wanted, self._reason = 0, ""
        if self._retry is not None:
            self._retry.cancel()
            self._retry = None
        self._release()

    def listeners(self) -> tuple[ListenerStats, ...]:
        """Describe the port, if one is wanted."""
        if not self._wanted:
            return ()
        url = f"http://127.0.0.1:{self._wanted}/metrics"
        state = "closed" if self._reason else "open"
        count = len(self._tasks)
        return (ListenerStats("metrics", url, state, self._reason, self.port, count, 0),)

    def _bind(self) -> None:
        try:
            self._socket = socket.create_server(("127.0.0.1", self._wanted))
        except OSError as error:
            self._fail(error)
            return
        self._reason = ""
        self._socket.setblocking(False)
        asyncio.get_running_loop().add_reader(self._socket, self._on_readable, self._socket)

    def _fail(self, error: OSError) -> None:
        """Begin anew later."""
        reason = reason_of(error)
        if reason != self._reason:
            log.warning("no metrics on port %d yet: %s", self._wanted, reason)
        self._reason = reason
        self._release()
        self._retry = asyncio.get_running_loop().call_later(RETRY_S, self._bind)

    def _release(self) -> None:
        if self._socket is not None:
            asyncio.get_running_loop().remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _on_readable(self, sock: socket.socket) -> None:
        try:
            connection, _ = sock.accept()
        except BlockingIOError:
            return
        except OSError as error:
            # Out of descriptors: the waiting connection would wake us for ever.
            self._fail(error)
            return
        if len(self._tasks) >= MAX_CONNECTIONS:
            connection.close()
            return
        task = asyncio.get_running_loop().create_task(self._serve(connection))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        loop, request = asyncio.get_running_loop(), b""
        with connection:
            connection.setblocking(False)
            try:
                async with asyncio.timeout(REQUEST_LIMIT_S):
                    while b"\r\n\r\n" not in request and len(request) < MAX_REQUEST_BYTES:
                        data = await loop.sock_recv(connection, 4096)
                        if not data:
                            return
                        request += data
                    await loop.sock_sendall(connection, self._respond(request))
            except (OSError, TimeoutError) as error:
                log.debug("metrics request failed: %s", error)

    def _respond(self, request: bytes) -> bytes:
        words = request.split()
        if words[:1] != [b"GET"]:
            return b"HTTP/1.1 405 Method Not Allowed\r\nContent-Length: 0\r\n\r\n"
        body = prometheus_text(self._snapshot()).encode()
        head = (
            f"HTTP/1.1 200 OK\r\nContent-Type: {CONTENT_TYPE}\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
        )
        return head.encode() + body


def prometheus_text(snapshot: Snapshot) -> str:
    """Write a snapshot in the Prometheus text format.

    Parameters
    ----------
    snapshot : Snapshot
        The daemon's state now.

    Returns
    -------
    str
        One line a sample, with help and type before each family.
    """
    lines: list[str] = []
    for name, kind, meaning, samples in _families(snapshot):
        lines += [f"# HELP mavgate_{name} {meaning}", f"# TYPE mavgate_{name} {kind}"]
        for labels, value in samples:
            text = ",".join(f'{key}="{_escaped(label)}"' for key, label in labels.items())
            lines.append(f"mavgate_{name}{f'{{{text}}}' if text else ''} {value:.15g}")
    return "\n".join(lines) + "\n"


def _families(snapshot: Snapshot) -> Iterator[tuple[str, str, str, list[Sample]]]:
    report, hub, now_us = snapshot.report, snapshot.hub, snapshot.time_us
    yield "up_seconds", "counter", "Time since the start.", [({}, now_us / US_PER_S)]
    yield "receiver_connected", "gauge", "Receiver's port is open.", [({}, report.connected)]
    yield "receiver_frames_total", "counter", "Frames of the receiver.", [({}, report.frames)]
    faults = [({"kind": kind}, float(count)) for kind, count in report.faults]
    yield "receiver_faults_total", "counter", "Damaged bytes on the line, by kind.", faults
    for field, kind, meaning in (
        ("received", "counter", "Radio payloads of a node."),
        ("lost", "counter", "Radio payloads of a node that never came."),
        ("rate_hz", "gauge", "Radio payloads of a node a second."),
    ):
        suffix = "_total" if kind == "counter" else ""
        nodes: list[Sample] = [
            (
                {"vehicle": str(node.node.vehicle_id), "node": str(node.node.node_id)},
                float(getattr(node, field)),
            )
            for node in report.nodes
        ]
        yield f"node_{field}{suffix}", kind, meaning, nodes
    yield from _board_families(snapshot)
    for field in ("published", "forwarded", "duplicates", "looped", "unroutable", "unserved"):
        yield f"hub_{field}_total", "counter", f"Frames {field}.", [({}, getattr(hub, field))]
    ports = [({"name": port.name, "endpoint": port.endpoint}, port) for port in snapshot.listeners]
    is_open: list[Sample] = [(labels, float(port.state == "open")) for labels, port in ports]
    yield "listener_open", "gauge", "A listening port takes clients.", is_open
    away: list[Sample] = [(labels, float(port.turned_away)) for labels, port in ports]
    yield "listener_turned_away_total", "counter", "Clients that found no room.", away
    for name, count, meaning in (
        ("places_not_kept", snapshot.places_not_kept, "Missions, marks or homes not written."),
        ("requests_refused", snapshot.refused, "Requests of clients that may not change anything."),
        ("requests_forged", snapshot.forged, "Requests with a wrong, old or repeated signature."),
    ):
        yield f"{name}_total", "counter", meaning, [({}, float(count))]
    yield from _client_families(snapshot.clients, now_us)


def _board_families(snapshot: Snapshot) -> Iterator[tuple[str, str, str, list[Sample]]]:
    """Yield what the nodes report of their own boards."""
    boards = [board for one in snapshot.aircraft for board in one.boards]
    labels = [
        {"vehicle": str(board.node.vehicle_id), "node": str(board.node.node_id)} for board in boards
    ]
    for name, kind, meaning, values in (
        ("supply_volts", "gauge", "Supply of a node.", [b.supply_mv / 1e3 for b in boards]),
        ("bus_errors_total", "counter", "Failed words with a sensor, 16 bits.",
         [b.bus_errors for b in boards]),
        ("radio_failed_total", "counter", "Payloads that no acknowledgement came for, 16 bits.",
         [b.radio_failed for b in boards]),
        ("radio_retries_total", "counter", "Payloads that were sent again, 16 bits.",
         [b.radio_retries for b in boards]),
        ("loop_max_seconds", "gauge", "Longest loop of a node in the last second.",
         [b.loop_max_us / US_PER_S for b in boards]),
    ):  # fmt: skip
        yield f"node_{name}", kind, meaning, list(zip(labels, map(float, values), strict=True))
    versions: list[Sample] = [
        ({**label, "firmware": ".".join(map(str, board.firmware_version))}, 1.0)
        for label, board in zip(labels, boards, strict=True)
    ]
    yield "node_info", "gauge", "Firmware of a node.", versions
    receiver = snapshot.report.receiver
    overruns: list[Sample] = [
        ({"pipe": str(number)}, float(pipe.overruns))
        for number, pipe in enumerate(receiver.pipes if receiver is not None else ())
    ]
    yield "receiver_overruns_total", "counter", "Payloads the receiver had no room for.", overruns


def _client_families(
    clients: tuple[ClientStats, ...], now_us: int
) -> Iterator[tuple[str, str, str, list[Sample]]]:
    labels = {
        client.client_id: {
            "client": str(client.client_id),
            "name": client.name,
            "remote": client.remote,
        }
        for client in clients
    }
    for field, kind, meaning in (
        ("sent", "counter", "Frames sent to a client."),
        ("dropped", "counter", "Frames that a client was too slow or too far for."),
        ("bytes_sent", "counter", "Bytes sent to a client."),
        ("received", "counter", "Frames of a client."),
        ("bytes_garbage", "counter", "Bytes of a client that were no MAVLink."),
        ("queued", "gauge", "Frames that wait for a client."),
    ):
        suffix = "_total" if kind == "counter" else ""
        samples: list[Sample] = [
            (labels[client.client_id], float(getattr(client, field))) for client in clients
        ]
        yield f"client_{field}{suffix}", kind, meaning, samples
    is_open: list[Sample] = [(labels[c.client_id], float(c.state == "open")) for c in clients]
    yield "client_open", "gauge", "Frames reach the client as far as is known.", is_open
    trips: list[Sample] = [
        (labels[c.client_id], c.round_trip_us / US_PER_S)
        for c in clients
        if c.round_trip_us is not None
    ]
    yield "client_round_trip_seconds", "gauge", "Newest answer to PING or TIMESYNC.", trips
    ages: list[Sample] = [
        (labels[c.client_id], (now_us - c.heard_us) / US_PER_S)
        for c in clients
        if c.heard_us is not None
    ]
    yield "client_silent_seconds", "gauge", "Time since the client's newest frame.", ages


def _escaped(label: str) -> str:
    return label.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
