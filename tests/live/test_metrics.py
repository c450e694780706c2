"""The Prometheus text and the port that serves it."""

import asyncio
import dataclasses
import itertools
import socket
from collections.abc import AsyncIterator, Iterator

import pytest
from prometheus_client.parser import text_string_to_metric_families

from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live import metrics_server
from gateway.live.metrics import prometheus_text
from gateway.live.metrics_server import MetricsServer
from tests.kit.process import until
from tests.live import test_live_view as live
from tests.ports import free_port

CLIENT = dataclasses.replace(
    live.CLIENT, client_id=7, name='the "tablet"', queued=1, round_trip_us=1500
)
SNAPSHOT = dataclasses.replace(
    live.WELL_KNOWN,
    clients=(CLIENT,),
    hub=HubCounters(published=9),
    listeners=(
        ListenerStats("here", "tcp-listen:0.0.0.0:1?name=here", "closed", "taken", 0, 0, 4),
    ),
    refused=5,
    forged=6,
)
NODE = '{node="0",vehicle="1"}'
PORT = '{endpoint="tcp-listen:0.0.0.0:1?name=here",name="here"}'
TEXT = "".join(prometheus_text(SNAPSHOT))
LIMIT_S = 60.0
LABELS = '{client="7",name="the \\"tablet\\"",remote="127.0.0.1:14550"}'


SAMPLES = [
    "mavgate_up_seconds 10.0",
    "mavgate_receiver_connected 1.0",
    'mavgate_receiver_faults_total{kind="crc"} 7.0',
    f"mavgate_node_lost_total{NODE} 10.0",
    f"mavgate_node_rate_hz{NODE} 99.6",
    f"mavgate_node_supply_volts{NODE} 3.29",
    f"mavgate_node_bus_errors_total{NODE} 12.0",
    f"mavgate_node_radio_failed_total{NODE} 3.0",
    f"mavgate_node_radio_retries_total{NODE} 450.0",
    'mavgate_node_info{firmware="1.4",node="0",vehicle="1"} 1.0',
    'mavgate_vehicle_satellites{vehicle="1"} 11.0',
    'mavgate_vehicle_home_distance_metres{vehicle="1"} 1234.4',
    "mavgate_hub_published_total 9.0",
    f"mavgate_client_sent_total{LABELS} 1200.0",
    f"mavgate_client_round_trip_seconds{LABELS} 0.0015",
    f"mavgate_client_silent_seconds{LABELS} 0.5",
    f"mavgate_client_open{LABELS} 1.0",
    f"mavgate_listener_open{PORT} 0.0",
    f"mavgate_listener_turned_away_total{PORT} 4.0",
    "mavgate_requests_refused_total 5.0",
    "mavgate_requests_forged_total 6.0",
    f"mavgate_node_silent_seconds{NODE} 0.1",
    'mavgate_vehicle_latitude_degrees{vehicle="1"} -7.765612',
    'mavgate_vehicle_ground_speed_metres_per_second{vehicle="1"} 5.0',
    'mavgate_vehicle_climb_metres_per_second{vehicle="1"} 1.5',
    'mavgate_vehicle_valid{quantity="position",vehicle="1"} 1.0',
    'mavgate_vehicle_trouble{kind="gps_rejected",vehicle="1"} 1.0',
]


def test_text_contains_the_samples() -> None:
    assert [line for line in SAMPLES if line not in TEXT.splitlines()] == []


def test_every_family_is_declared_once_before_its_samples() -> None:
    declared: list[str] = []
    for line in TEXT.splitlines():
        if line.startswith("# TYPE"):
            declared.append(line.split()[2])
        elif not line.startswith("#"):
            assert line.split("{")[0].split()[0] == declared[-1]
    assert len(declared) == len(set(declared))


def test_unknown_values_have_no_sample() -> None:
    text = "".join(prometheus_text(dataclasses.replace(SNAPSHOT, states=((1, live.LOST),))))
    assert "NaN" not in text
    assert "mavgate_vehicle_latitude_degrees{" not in text
    assert 'mavgate_vehicle_valid{quantity="heading",vehicle="1"} 0.0' in text


def test_text_is_read_by_the_parser_of_prometheus() -> None:
    """Every family of the text, as Prometheus' own reader understands it."""
    read = list(text_string_to_metric_families(TEXT))
    assert {family.type for family in read} == {"counter", "gauge"}
    assert all(len(family.documentation) > 10 for family in read)
    names = {s.labels["name"] for f in read if f.name == "mavgate_client_open" for s in f.samples}
    assert names == {'the "tablet"'}


@pytest.fixture
async def server() -> AsyncIterator[MetricsServer]:
    made = MetricsServer(lambda: prometheus_text(SNAPSHOT))
    made.listen(free_port())
    yield made
    made.close()


@pytest.mark.io
class TestServer:
    async def ask(self, port: int, request: bytes, host: str = "127.0.0.1") -> bytes:
        reader, writer = await asyncio.open_connection(host, port)
        writer.write(request)
        answer = await asyncio.wait_for(reader.read(), LIMIT_S)
        writer.close()
        return answer

    async def test_get_and_head_are_served_and_post_is_refused(self, server: MetricsServer) -> None:
        answer = await self.ask(server.port, b"GET /metrics HTTP/1.1\r\nHost: localhost:9\r\n\r\n")
        head, _, body = answer.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 OK")
        assert f"Content-Length: {len(body)}".encode() in head
        assert body.decode() == TEXT
        only_head = await self.ask(server.port, b"HEAD /metrics HTTP/1.1\r\n\r\n")
        assert only_head == head + b"\r\n\r\n"
        assert (await self.ask(server.port, b"POST / HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 405")
        port = server.port
        server.listen(0)
        await asyncio.sleep(0)
        assert (server.port, server.listeners()) == (0, ())
        with pytest.raises(ConnectionRefusedError):
            await self.ask(port, b"GET / HTTP/1.1\r\n\r\n")

    async def test_request_for_another_host_is_refused(self, server: MetricsServer) -> None:
        own = ("127.0.0.1", "127.0.0.1:99", "[::1]:99", "LOCALHOST")
        others = ("evil.example", "localhost.evil.example", "", "[", "\xff")
        for host, name in itertools.product((*own, *others), ("Host", "hOST")):
            request = f"GET / HTTP/1.1\r\nAccept: */*\r\n{name}: {host}\r\n\r\n"
            answer = await self.ask(server.port, request.encode("latin-1"))
            status = b"200" if host in own else b"403"
            assert answer.startswith(b"HTTP/1.1 " + status), host

    @pytest.mark.skipif(not socket.has_dualstack_ipv6(), reason="needs IPv6")
    async def test_metrics_are_served_over_ipv6(self, server: MetricsServer) -> None:
        answer = await self.ask(server.port, b"GET / HTTP/1.1\r\n\r\n", "::1")
        assert answer.endswith(TEXT.encode())

    async def test_event_loop_runs_between_two_families(self) -> None:
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

    async def test_number_of_idle_connections_is_bounded(self, server: MetricsServer) -> None:
        idle = [
            await asyncio.open_connection("127.0.0.1", server.port)
            for _ in range(metrics_server.MAX_CONNECTIONS)
        ]
        await until(lambda: server.listeners()[0].clients == metrics_server.MAX_CONNECTIONS)
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        assert await asyncio.wait_for(reader.read(), LIMIT_S) == b"", "closed without a word"
        assert server.listeners()[0].clients == metrics_server.MAX_CONNECTIONS
        writer.close()
        idle[0][1].close()
        await until(lambda: server.listeners()[0].clients < metrics_server.MAX_CONNECTIONS)
        assert (await self.ask(server.port, b"GET / HTTP/1.1\r\n\r\n")).startswith(b"HTTP/1.1 200")
        for _, other in idle[1:]:
            other.close()
        server.close()
        await until(lambda: len(asyncio.all_tasks()) == 1)

    async def test_taken_port_is_reported_and_used_when_it_is_free(
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
        await until(lambda: server.port)
        assert (server.port, server.listeners()[0].state) == (port, "open")
        assert caplog.text.count("no metrics") == 1
        server.close()
        assert server.listeners() == ()
