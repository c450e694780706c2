"""The Prometheus text and the port that serves it."""

import asyncio
import dataclasses
import socket
from collections.abc import Iterator

import pytest
from prometheus_client.parser import text_string_to_metric_families

from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live import metrics_server
from gateway.live.metrics import prometheus_text
from gateway.live.metrics_server import MetricsServer
from gateway.records import LinkReport, NodeId, NodeLink, NodeStatus
from gateway.status import AircraftStatus, Snapshot, Way
from tests.client_stats import TABLET
from tests.kit.records import FIX, NOTHING, STATE
from tests.ports import free_port

NODE = NodeLink(
    node=NodeId(1, 2),
    pipe=0,
    received=100,
    lost=3,
    duplicates=0,
    reordered=0,
    restarts=0,
    rate_hz=60.0,
    last_time_us=0,
    clock_skew_ppm=0.0,
)
REPORT = LinkReport(
    time_us=0,
    connected=True,
    port="/dev/ttyUSB0",
    bytes_received=0,
    frames=103,
    frames_lost=0,
    faults=(("crc", 4),),
    nodes=(NODE,),
    receiver=None,
)
CLIENT = dataclasses.replace(
    TABLET,
    client_id=7,
    name='the "tablet"',
    sent=5000,
    dropped=2,
    bytes_sent=200_000,
    received=10,
    bytes_received=200,
    queued=1,
    heard_us=1_000_000,
    round_trip_us=1500,
)
BOARD = NodeStatus(0, NodeId(1, 2), 0, (1, 4), 1, 7, 0, 12, 3, 450, 900, 100, 3290)
SNAPSHOT = Snapshot(
    time_us=3_000_000,
    report=REPORT,
    states=((1, STATE),),
    clients=(CLIENT,),
    sent=(),
    hub=HubCounters(published=9),
    listeners=(
        ListenerStats("here", "tcp-listen:0.0.0.0:1?name=here", "closed", "taken", 0, 0, 4),
    ),
    refused=5,
    forged=6,
    aircraft=(AircraftStatus(1, FIX, Way(47.0, 8.0, 500.0, 120.0, 90.0), None, (BOARD,)),),
)
PORT = '{endpoint="tcp-listen:0.0.0.0:1?name=here",name="here"}'
TEXT = "".join(prometheus_text(SNAPSHOT))
LIMIT_S = 60.0
LABELS = '{client="7",name="the \\"tablet\\"",remote="10.0.0.7:14550"}'


@pytest.mark.parametrize(
    "line",
    [
        "mavgate_up_seconds 3.0",
        "mavgate_receiver_connected 1.0",
        'mavgate_receiver_faults_total{kind="crc"} 4.0',
        'mavgate_node_lost_total{node="2",vehicle="1"} 3.0',
        'mavgate_node_rate_hz{node="2",vehicle="1"} 60.0',
        'mavgate_node_supply_volts{node="2",vehicle="1"} 3.29',
        'mavgate_node_bus_errors_total{node="2",vehicle="1"} 12.0',
        'mavgate_node_radio_failed_total{node="2",vehicle="1"} 3.0',
        'mavgate_node_radio_retries_total{node="2",vehicle="1"} 450.0',
        'mavgate_node_info{firmware="1.4",node="2",vehicle="1"} 1.0',
        'mavgate_vehicle_satellites{vehicle="1"} 11.0',
        'mavgate_vehicle_home_distance_metres{vehicle="1"} 120.0',
        "mavgate_hub_published_total 9.0",
        f"mavgate_client_sent_total{LABELS} 5000.0",
        f"mavgate_client_round_trip_seconds{LABELS} 0.0015",
        f"mavgate_client_silent_seconds{LABELS} 2.0",
        f"mavgate_client_open{LABELS} 1.0",
        f"mavgate_listener_open{PORT} 0.0",
        f"mavgate_listener_turned_away_total{PORT} 4.0",
        "mavgate_requests_refused_total 5.0",
        "mavgate_requests_forged_total 6.0",
        'mavgate_node_silent_seconds{node="2",vehicle="1"} 3.0',
        'mavgate_vehicle_latitude_degrees{vehicle="1"} 47.1234567',
        'mavgate_vehicle_ground_speed_metres_per_second{vehicle="1"} 5.0',
        'mavgate_vehicle_climb_metres_per_second{vehicle="1"} 1.25',
        'mavgate_vehicle_valid{quantity="position",vehicle="1"} 1.0',
        'mavgate_vehicle_trouble{kind="gps_rejected",vehicle="1"} 0.0',
    ],
)
def test_samples(line: str) -> None:
    assert line in TEXT.splitlines()


def test_every_family_is_declared_once_before_its_samples() -> None:
    declared: list[str] = []
    for line in TEXT.splitlines():
        if line.startswith("# TYPE"):
            declared.append(line.split()[2])
        elif not line.startswith("#"):
            assert line.split("{")[0].split()[0] == declared[-1]
    assert len(declared) == len(set(declared))


def test_what_is_not_known_is_left_out() -> None:
    text = "".join(prometheus_text(dataclasses.replace(SNAPSHOT, states=((1, NOTHING),))))
    assert "NaN" not in text
    assert "mavgate_vehicle_latitude_degrees{" not in text
    assert 'mavgate_vehicle_valid{quantity="position",vehicle="1"} 0.0' in text


def test_another_program_reads_it() -> None:
    """Every family of the text, as Prometheus' own reader understands it."""
    read = list(text_string_to_metric_families(TEXT))
    assert {family.type for family in read} == {"counter", "gauge"}
    assert all(len(family.documentation) > 10 for family in read)
    names = {s.labels["name"] for f in read if f.name == "mavgate_client_open" for s in f.samples}
    assert names == {'the "tablet"'}


@pytest.mark.io
class TestServer:
    async def ask(self, port: int, request: bytes, host: str = "127.0.0.1") -> bytes:
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(request)
        answer = await asyncio.wait_for(reader.read(), LIMIT_S)
        writer.close()
        return answer

    async def test_serves_and_refuses(self) -> None:
        server = MetricsServer(lambda: prometheus_text(SNAPSHOT))
        server.listen(free_port())
        answer = await self.ask(server.port, b"GET /metrics HTTP/1.1\r\nHost: localhost:9\r\n\r\n")
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK")
        assert f"Content-Length: {len(body)}".encode() in head
        assert body.decode() == TEXT
        only_head = await self.ask(server.port, b"HEAD /metrics HTTP/1.1\r\n\r\n")
        assert only_head == head + b"\r\n\r\n"
        assert (await self.ask(server.port, b"POST / HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 405")
        port = server.port
        server.close()
        await asyncio.sleep(0)
        assert server.port == 0
        with pytest.raises(ConnectionRefusedError):
            await self.ask(port, b"GET / HTTP/1.1\r\n\r\n")

    @pytest.mark.parametrize(
        ("host", "status"),
        [
            *((host, b"200") for host in ("127.0.0.1", "127.0.0.1:99", "[::1]:99", "LOCALHOST")),
            *(
                (host, b"403")
                for host in ("evil.example", "localhost.evil.example", "", "[", "\xff")
            ),
        ],
    )
    async def test_a_page_that_is_rebound_to_loopback_gets_nothing(
        self, host: str, status: bytes
    ) -> None:
        server = MetricsServer(lambda: iter(["text"]))
        for name in ("Host", "hOST"):
            request = f"GET / HTTP/1.1\r\nAccept: */*\r\n{name}: {host}\r\n\r\n"
            answer = await server._respond(request.encode("latin-1"))
            assert answer.startswith(b"HTTP/1.1 " + status)

    @pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="needs IPv6")
    async def test_serves_ipv6_too(self) -> None:
        server = MetricsServer(lambda: iter(["text"]))
        server.listen(free_port())
        answer = await self.ask(server.port, b"GET / HTTP/1.1\r\n\r\n", "::1")
        server.close()
        assert answer.endswith(b"text")

    async def test_the_loop_goes_on_between_two_families(self) -> None:
        called: list[int] = []
        before: list[int] = []

        def text() -> Iterator[str]:
            for family in prometheus_text(SNAPSHOT):
                before.append(len(called))
                asyncio.get_running_loop().call_soon(called.append, len(before))
                yield family

        server = MetricsServer(text)
        server.listen(free_port())
        await self.ask(server.port, b"GET / HTTP/1.1\r\n\r\n")
        server.close()
        assert before == list(range(TEXT.count("# TYPE")))

    async def test_zero_serves_none(self) -> None:
        server = MetricsServer(lambda: prometheus_text(SNAPSHOT))
        server.listen(0)
        assert (server.port, server.listeners()) == (0, ())

    async def test_idle_connections_are_no_more_than_a_few(self) -> None:
        server = MetricsServer(lambda: prometheus_text(SNAPSHOT))
        server.listen(free_port())
        idle = [
            await asyncio.open_connection("127.0.0.1", server.port)
            for _ in range(metrics_server.MAX_CONNECTIONS)
        ]
        while server.listeners()[0].clients < metrics_server.MAX_CONNECTIONS:
            await asyncio.sleep(0)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        assert await asyncio.wait_for(reader.read(), LIMIT_S) == b"", "closed without a word"
        writer.close()
        idle[0][1].close()
        while server.listeners()[0].clients == metrics_server.MAX_CONNECTIONS:
            await asyncio.sleep(0)
        assert (await self.ask(server.port, b"GET / HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 200")
        for _, other in idle[1:]:
            other.close()
        server.close()
        while any(task.get_coro().__name__ == "_serve" for task in asyncio.all_tasks()):
            await asyncio.sleep(0)

    async def test_a_taken_port_is_reported_and_used_when_it_is_free(
        self, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(metrics_server, "RETRY_S", 0.0)
        server = MetricsServer(lambda: prometheus_text(SNAPSHOT))
        port = free_port()
        with socket.create_server(("127.0.0.1", port)):
            server.listen(port)
            await asyncio.sleep(0)
            (stats,) = server.listeners()
            assert (stats.state, stats.reason) == ("closed", "Address already in use")
        while not server.port:
            await asyncio.sleep(0)
        assert (server.port, server.listeners()[0].state) == (port, "open")
        assert caplog.text.count("no metrics") == 1
        server.close()
        assert server.listeners() == ()
