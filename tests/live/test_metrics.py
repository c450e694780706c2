"""The Prometheus text of gateway and vehicles, its dashboard, and the port that serves it."""

import asyncio
import dataclasses
import itertools
import json
import re
import socket
from collections import defaultdict
from collections.abc import AsyncIterator, Iterator
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from pymavlink.dialects.v20 import all as mavlink

from gateway.hub.frame_stream import FrameStream
from gateway.hub.stats import HubCounters, ListenerStats
from gateway.live import metrics_server
from gateway.live.metrics import prometheus_text, system_families, text_of
from gateway.live.metrics_server import MetricsServer
from gateway.live.vehicle_watch import DECODED_US, MAX_SYSTEMS, VehicleWatch
from gateway.units import US_PER_S
from gateway.vehicle_state.newest import HEARD_US
from gateway.wire.mavlink_splitter import frame_of
from tests.conftest import ROOT
from tests.kit.mavlink import packed
from tests.kit.messages import at, beat, gps
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


BATTERY = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 12_400, -1, 80, 0, 0, 0, 0, 0, 0)


class Watched(VehicleWatch):
    """A watch, and the frames of each system as the hub counts them."""

    def __init__(self) -> None:
        super().__init__()
        self.received: defaultdict[tuple[int, int], FrameStream] = defaultdict(FrameStream)


def feed(systems: Watched, *messages: Any, now_us: int = 0, **sender: Any) -> None:
    for message in messages:
        frame = frame_of(packed(message, **sender))
        systems.received[frame.origin].accept(frame.sequence, 1, now_us)
        systems.update([(frame.data, now_us)], systems.received)


def lines_of(systems: Watched, now_us: int = 0) -> list[str]:
    text = "".join(text_of(system_families(systems, now_us)))
    return [line for line in text.splitlines() if not line.startswith("#")]


def test_values_of_a_foreign_vehicle_have_samples() -> None:
    systems = Watched()
    feed(systems, beat(), at(), gps(), BATTERY, system=9)
    feed(systems, at(alt_m=1.0), system=9, component=154)
    found = lines_of(systems, 2 * US_PER_S)
    for name, value in {
        "altitude_metres": 488.13, "height_metres": 20.0, "ground_speed_metres_per_second": 5.0,
        "satellites": 11.0, "battery_volts": 12.4, "battery_percent": 80.0, "armed": 1.0,
        "silent_seconds": 2.0,
    }.items():  # fmt: skip
        assert f'mavgate_system_{name}{{system="9"}} {value}' in found, name


def test_old_position_and_gone_system_have_no_samples() -> None:
    systems = Watched()
    feed(systems, beat(), at())
    assert not any("altitude" in line for line in lines_of(systems, 6 * US_PER_S))
    assert lines_of(systems, HEARD_US)
    assert lines_of(systems, HEARD_US + 1) == []


def test_lost_frames_are_counted_by_sequence_numbers() -> None:
    for sequences, lost in (
        ([0, 1, 2], 0.0),
        ([250, 255, 0, 4], 7.0),
        ([7, 8, 8, 7, 9], 0.0),
        ([5, 9, 6, 10], 3.0),
    ):
        systems = Watched()
        for sequence in sequences:
            feed(systems, beat(), sequence=sequence)
        feed(systems, gps(), component=154, sequence=77)
        found = lines_of(systems)
        assert f'mavgate_system_frames_total{{system="1"}} {float(len(sequences))}' in found
        assert f'mavgate_system_frames_lost_total{{system="1"}} {lost}' in found, sequences


def test_row_of_a_vehicle_has_mode_position_link_and_loss() -> None:
    systems = Watched()
    names = mavlink.MAVLink_available_modes_message(1, 1, 0, 7, 0, b"Survey")
    # A foreign autopilot whose modes no table has.
    mode = mavlink.MAVLink_heartbeat_message(2, 0, 129, 7, 4, 3)
    feed(systems, mode, at(), gps(), BATTERY, names, system=9)
    for sequence in (1, 2, 4):
        feed(systems, mode, system=9, sequence=sequence)
    client = dataclasses.replace(CLIENT, name="field radio", systems=((9, 1), (9, 154)))
    (row,) = systems.rows(2 * US_PER_S, {}, [client])
    assert (row.kind, row.mode, row.armed, row.link) == ("quadrotor", "Survey", True, "field radio")
    assert (row.alt_amsl_m, row.battery_v, row.age_s) == (488.13, 12.4, 2.0)
    assert row.loss == pytest.approx(1 / 9)
    (own,) = systems.rows(2 * US_PER_S, {9: "Tracking"}, [client])
    assert (own.mode, own.link) == ("Tracking", "receiver")
    (own,) = systems.rows(2 * US_PER_S, {9: ""}, [client], {9: "crsf:stdin", 2: "lines:stdin"})
    assert own.link == "crsf:stdin"


def test_messages_of_one_kind_are_decoded_at_intervals() -> None:
    systems = Watched()
    for alt_m, now_us in ((1.0, 0), (2.0, DECODED_US - 1), (3.0, DECODED_US)):
        feed(systems, beat(), at(alt_m=alt_m), now_us=now_us)
        shown = systems.present(now_us)[1].position
        assert shown is not None
        assert shown.alt_amsl_m == {1.0: 1.0, 2.0: 1.0, 3.0: 3.0}[alt_m]


def test_number_of_systems_is_bounded_and_room_is_made_by_those_that_have_gone() -> None:
    systems = Watched()
    for system in range(1, MAX_SYSTEMS + 10):
        feed(systems, beat(), system=system)
    assert len([line for line in lines_of(systems) if "armed" in line]) == MAX_SYSTEMS
    feed(systems, beat(), system=200, now_us=HEARD_US + 1)
    assert 'mavgate_system_armed{system="200"} 1.0' in lines_of(systems, HEARD_US + 1)


def test_dashboard_uses_metrics_that_exist() -> None:
    systems = Watched()
    feed(systems, beat(), at(), gps(), BATTERY)
    known = set(re.findall(r"^(mavgate_\w+)", "\n".join(lines_of(systems)), re.M))
    known |= set(re.findall(r"^(mavgate_\w+)", TEXT, re.M))
    text = (ROOT / "config" / "grafana-dashboard.json").read_text()
    assert json.loads(text)["panels"]
    assert set(re.findall(r"mavgate_\w+", text)) <= known
