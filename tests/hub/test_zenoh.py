"""A site's endpoint, with real sessions and a real router in another process."""

import asyncio
import json
import signal
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
import zenoh

from gateway.hub.hub import Hub
from gateway.hub.transports.datagram import DatagramPeer
from gateway.hub.transports.zenoh import client as zenoh_client
from gateway.hub.transports.zenoh import session as zenoh_session
from gateway.hub.transports.zenoh.session import (
    AT_ONCE,
    BYTES_AT_ONCE,
    MAX_MESSAGE,
    MAX_WAITING,
    OWN,
    LoopQueue,
    Subscription,
)
from gateway.wire.mavlink_json import template
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S
from tests.ports import free_port

pytestmark = pytest.mark.io

ROUTER = """
import json, sys, time, zenoh
config = zenoh.Config()
config.insert_json5("mode", '"router"')
config.insert_json5("listen/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
# Whoever is linked with it waits for ever for a router that has stalled.
config.insert_json5("transport/link/tx/lease", "3600000")
session = zenoh.open(config)
print("open", flush=True)
sys.stdin.read()
"""

PATIENT = """{
  scouting: {multicast: {enabled: false}, gossip: {enabled: false}},
  transport: {link: {tx: {queue: {congestion_control: {block: {wait_before_close: 3600000000}}}}}},
}"""
"""Lets Zenoh wait an hour for a stalled link: a caller that waits for it exceeds any time limit."""


class Router:
    """A router as a process that can be killed, stopped and started again at the same locator."""

    def __init__(self) -> None:
        self.locator = f"tcp/127.0.0.1:{free_port()}"
        self.process: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-c", ROUTER, self.locator],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == "open\n"

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.communicate()
            self.process = None

    def signal(self, number: signal.Signals) -> None:
        assert self.process is not None
        self.process.send_signal(number)


@pytest.fixture
def router() -> Iterator[Router]:
    router = Router()
    yield router
    router.kill()


class Far:
    """Another session at the router, which keeps the messages it receives."""

    def __init__(self, locator: str, *keys: str) -> None:
        config = zenoh.Config()
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([locator]))
        config.insert_json5("scouting/multicast/enabled", "false")
        self.session = zenoh.open(config)
        self.got: list[tuple[str, bytes]] = []
        self.marks: dict[str, set[bytes | None]] = defaultdict(set)
        """Attachments of messages, by key."""
        self._subscribers = [self.session.declare_subscriber(key, self._note) for key in keys]

    def _note(self, sample: zenoh.Sample) -> None:
        key, mark = str(sample.key_expr), sample.attachment
        self.got.append((key, sample.payload.to_bytes()))
        self.marks[key].add(mark and mark.to_bytes())

    def messages(self, message_id: int) -> list[bytes]:
        return [data for _, data in self.got if message_id_of(data) == message_id]


class Site(Rig):
    """A rig whose hubs are sites at one router, with other sessions there."""

    def __init__(self, router: Router) -> None:
        super().__init__()
        self.router = router

    async def join(self, options: str = "site=field") -> Hub:
        """Return a hub that is linked with the router."""
        hub = self.hub(f"zenoh:{self.router.locator}?{options}")
        hub.send(self.out(self.vehicle.heartbeat()))
        await until(self, hub, lambda: hub.clients()[0].state == "open")
        return hub

    def visit(self, *keys: str) -> Far:
        far = Far(self.router.locator, *keys)
        self.closing.append(far.session.close)
        return far


@pytest.fixture
async def site(router: Router, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Site]:
    monkeypatch.setattr(DatagramPeer, "is_proven", True)
    site = Site(router)
    yield site
    site.close()


@pytest.fixture
def patient(tmp_path: Path) -> Path:
    """A configuration by which Zenoh never gives a stalled link up."""
    file = tmp_path / "patient.json5"
    file.write_text(PATIENT)
    return file


async def until(rig: Rig, hub: Any, condition: Callable[[], bool]) -> None:
    """Let the hub tick until something holds: Zenoh's own threads take their time."""
    async with asyncio.timeout(START_LIMIT_S):
        while not condition():
            rig.clock.now_us += 100_000
            rig.tick(hub)
            await asyncio.sleep(0.01)


async def until_received(rig: Rig, hub: Any, far: Far, count: int = 1) -> None:
    """Publish until so many messages have arrived: a subscription takes a while."""

    def are_received() -> bool:
        hub.send(rig.out(rig.vehicle.attitude()))
        return len(far.got) >= count

    await until(rig, hub, are_received)


class TestSite:
    async def test_frames_pass_in_both_directions(self, site: Site) -> None:
        hub = await site.join()
        far = site.visit("mavlink/field/*/out")
        await until_received(site, hub, far)
        assert far.got[0][0] == "mavlink/field/1/out"
        command = site.sender(255, 190).command(1, 1)
        far.session.put("mavlink/field/1/in", command)
        await until(site, hub, lambda: bool(site.incoming))
        assert site.incoming[0].frame == command
        assert not site.incoming[0].trusted
        far.session.put("mavlink/field/1/in", b"no MAVLink")
        await until(site, hub, lambda: hub.clients()[0].bytes_garbage == 10)
        far.session.put("mavlink/other/1/in", command)
        far.session.put("mavlink/field/1/in", site.sender(255, 190).heartbeat())
        await until(site, hub, lambda: hub.clients()[0].received == 2)

    async def test_autopilot_behind_the_site_has_its_own_key_and_no_attachment(
        self, site: Site
    ) -> None:
        hub = await site.join()
        hub.add("udp-listen:127.0.0.1:0?trusted=yes")
        station = site.station(hub.listening_ports()[0])
        far = site.visit("mavlink/field/*/out")
        autopilot = site.sender(7)

        def received() -> bool:
            station.send(autopilot.heartbeat())
            hub.send(site.out(site.vehicle.command(1, 1)))
            hub.send(site.out(site.vehicle.heartbeat()))
            return far.marks.keys() >= {"mavlink/field/7/out"} and bool(far.messages(76))

        await until(site, hub, received)
        assert far.marks == {"mavlink/field/7/out": {None}, "mavlink/field/1/out": {OWN}}

    async def test_filters_rates_and_packing_apply(self, site: Site) -> None:
        hub = await site.join("site=field&deny=RAW_IMU&pack=1100")
        far = site.visit("mavlink/field/*/out")
        await until_received(site, hub, far)
        client: Any = hub._clients[1]
        (packer,) = client._packers.values()
        await until(site, hub, lambda: not packer._is_flush_due)
        for _ in range(5):
            hub.send(site.out(site.vehicle.raw_imu()))
            hub.send(site.out(site.vehicle.attitude()))
        size = len(site.vehicle.attitude())
        await until(site, hub, lambda: any(len(data) == 5 * size for _, data in far.got))
        assert not far.messages(27)

    async def test_burst_arrives_completely_and_in_order(self, site: Site) -> None:
        """Telemetry gives way on a congested link, never on an idle one."""
        hub = await site.join()
        far = site.visit("mavlink/field/*/out")
        await until_received(site, hub, far)
        burst = [site.vehicle.raw_imu() for _ in range(200)]
        for frame in burst:
            hub.send(site.out(frame))
        await until(site, hub, lambda: far.messages(27)[-1:] == burst[-1:])
        assert far.messages(27) == burst

    @pytest.mark.parametrize(
        ("option", "trusted"), [("", False), ("&trusted=no", False), ("&trusted=yes", True)]
    )
    async def test_only_an_explicit_option_makes_a_fleet_trusted(
        self, site: Site, option: str, trusted: bool
    ) -> None:
        hub = await site.join(f"site=field{option}")
        far = site.visit()
        far.session.put("mavlink/field/1/in", site.sender(255, 190).command(1, 1))
        await until(site, hub, lambda: bool(site.incoming))
        assert site.incoming[0].trusted == trusted

    async def test_raw_keys_of_mavlink_server(self, site: Site) -> None:
        hub = await site.join("keys=mavlink_raw")
        far = site.visit("mavlink_raw/out")
        await until_received(site, hub, far)
        assert far.marks == {"mavlink_raw/out": {None}}
        far.session.put("mavlink_raw/in", site.sender(255, 190).command(1, 1))
        await until(site, hub, lambda: bool(site.incoming))

    async def test_json_keys_of_mavlink_server(self, site: Site) -> None:
        hub = await site.join("keys=mavlink_json&trusted=yes")
        far = site.visit("mavlink/out", "mavlink/*/*/*", "mavlink/1/1/ATTITUDE/rollspeed")
        await until_received(site, hub, far)
        await until(site, hub, lambda: len({key for key, _ in far.got}) >= 3)
        by_key = {key: json.loads(data) for key, data in far.got}
        whole = by_key["mavlink/1/1/ATTITUDE"]
        assert whole["header"] | {"sequence": 0} == {
            "system_id": 1, "component_id": 1, "sequence": 0, "message_id": 30,
        }  # fmt: skip
        assert whole["message"]["type"] == "ATTITUDE"
        assert by_key["mavlink/1/1/ATTITUDE/rollspeed"] == whole["message"]["rollspeed"]
        command = {
            "header": {"system_id": 255, "component_id": 190, "sequence": 7},
            "message": template("COMMAND_LONG") | {"target_system": 1, "target_component": 1},
        }
        for wrong in (b"no JSON", b"{}", b'{"header": {"system_id": 256}}', b"[" * 4000):
            far.session.put("mavlink/in", wrong)
        far.session.put("mavlink/in", json.dumps(command))
        await until(site, hub, lambda: bool(site.incoming))
        assert origin_of(site.incoming[0].frame) == (255, 190)
        assert site.incoming[0].frame[4] == 7
        assert hub.clients()[0].bytes_garbage > 4000


class TestTrouble:
    async def test_site_reconnects_after_a_router_restart(self, site: Site) -> None:
        hub = await site.join()
        hub.add("udp-listen:127.0.0.1:0")
        far = site.visit("mavlink/field/*/out")
        await until_received(site, hub, far)
        site.router.kill()
        await until(site, hub, lambda: hub.clients()[0].state == "connecting")
        dropped = hub.clients()[0].dropped
        for _ in range(500):
            hub.send(site.out(site.vehicle.raw_imu()))
            hub.send(site.out(site.vehicle.command(1, 1)))
        assert hub.clients()[0].dropped == dropped + 1000
        assert hub.clients()[0].queued == 0
        site.router.start()
        await until(site, hub, lambda: hub.clients()[0].state == "open")
        await until_received(site, hub, far, len(far.got) + 1)
        assert not far.messages(27), "old frames are not delivered as new ones"
        assert not far.messages(76)
        numbers = [data[4] for data in far.messages(30)]
        assert len(set(numbers)) == len(numbers), "no frame twice"

    @pytest.mark.parametrize(
        ("locator", "trusted", "warns"),
        [
            ("tcp/192.0.2.1:7447", True, True),
            ("ws/fleet.example:7447", True, True),
            ("tcp/192.0.2.1:7447", False, False),
            ("tls/fleet.example:7447", True, False),
            ("tcp/127.0.0.1:7447", True, False),
            ("tcp/localhost:7447", True, False),
        ],
    )
    def test_trusted_fleet_over_a_network_without_tls_is_warned_of(
        self, locator: str, trusted: bool, warns: bool, caplog: pytest.LogCaptureFixture
    ) -> None:
        client = MagicMock(endpoint=MagicMock(host=locator), trusted=trusted)
        zenoh_client.ZenohClient._warn_of_open_access(client)
        assert ("trusted=yes without TLS" in caplog.text) == warns

    async def test_missing_router_is_reported(self, rig: Rig) -> None:
        locator = f"tcp/127.0.0.1:{free_port()}"
        hub = rig.hub(f"zenoh:{locator}?site=field")
        await until(rig, hub, lambda: hub.clients()[0].state == "unreachable")
        assert hub.clients()[0].reason.startswith(f"no router answers at {locator}")

    def test_port_in_use_is_reported_in_one_line(self) -> None:
        bound = "Can not create a new TCP listener bound to tcp/h:1: "
        error = zenoh.ZError(f"{bound}[h:1: Address already in use (os error 98) at /x/y.rs:61.]")
        text = "another program listens at this port; choose another one by --listen"
        assert zenoh_session._message_of(error) == text

    def test_error_of_a_tls_router_mentions_certificates(self) -> None:
        error = zenoh.ZError("Unable to connect to any of [Single(tls/h:1)]!  at /x/y.rs:4.")
        text = "no router answers at tls/h:1, or a certificate does not fit"
        assert zenoh_session._message_of(error) == text

    @pytest.mark.parametrize("name", zenoh_session.TLS_FILES)
    async def test_missing_certificate_is_named(self, rig: Rig, tmp_path: Path, name: str) -> None:
        file, missing = tmp_path / "zenoh.json5", tmp_path / "missing.pem"
        file.write_text(json.dumps({"transport": {"link": {"tls": {name: str(missing)}}}}))
        hub = rig.hub(f"zenoh:tls/127.0.0.1:7447?site=field&config={file}")
        await until(rig, hub, lambda: hub.clients()[0].state == "unreachable")
        assert hub.clients()[0].reason == f"{name} {missing}: No such file or directory"

    async def test_stalled_router_delays_no_other_client(self, site: Site, patient: Path) -> None:
        hub = await site.join(f"site=field&config={patient}")
        hub.add("udp-listen:127.0.0.1:0")
        station = site.station(hub.listening_ports()[0])
        station.send(station.sender.heartbeat())
        await site.until(lambda: len(hub.clients()) == 2)
        hub.send(site.out(site.vehicle.attitude()))
        station.received()
        # Blocking reads: the loop does nothing meanwhile.
        station.socket.settimeout(START_LIMIT_S)
        site.router.signal(signal.SIGSTOP)
        for _ in range(5000):
            for frame in (site.vehicle.raw_imu(), site.vehicle.command(1, 1)):
                hub.send(site.out(frame))
                assert station.socket.recv(65535) == frame, "a local client has it at once"
        fleet, local = hub.clients()
        assert fleet.queued <= zenoh_session.MAX_RELIABLE
        assert fleet.dropped > 0
        assert local.dropped == 0
        site.router.signal(signal.SIGCONT)

    async def test_two_sites_of_one_name_are_reported_on_both(self, site: Site) -> None:
        first, second = [await site.join() for _ in range(2)]
        for hub in (first, second):
            await until(site, hub, lambda: "'field' too" in hub.clients()[0].reason)  # noqa: B023
        second.close()
        await until(site, first, lambda: first.clients()[0].reason == "")

    async def test_missing_zenoh_package_is_reported(
        self, rig: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "zenoh", None)
        hub = rig.hub("zenoh:tcp/127.0.0.1:7447?site=field")
        await until(rig, hub, lambda: bool(hub.clients()[0].reason))
        assert hub.clients()[0].reason.startswith("this endpoint needs the extra fleet; to install")

    async def test_malformed_configuration_file_is_reported(self, rig: Rig, tmp_path: Path) -> None:
        file = tmp_path / "zenoh.json5"
        file.write_text("{")
        hub = rig.hub(f"zenoh:tcp/127.0.0.1:7447?site=field&config={file}")
        await until(rig, hub, lambda: hub.clients()[0].state == "unreachable")
        assert "zenoh" in hub.clients()[0].reason


class TestLoopQueue:
    async def test_flood_is_handled_in_turns_and_the_oldest_items_are_dropped(self) -> None:
        taken: list[int] = []
        queue = LoopQueue(taken.append)
        for n in range(MAX_WAITING + 10):
            queue.put(n)
        most = 0
        while len(taken) < MAX_WAITING:
            before = len(taken)
            await asyncio.sleep(0)
            most = max(most, len(taken) - before)
        assert taken == list(range(10, MAX_WAITING + 10))
        assert queue.dropped == 10
        assert most <= 2 * AT_ONCE
        queue.close()
        queue.put(0)
        await asyncio.sleep(0)
        assert len(taken) == MAX_WAITING

    async def test_costly_items_are_handled_in_more_turns(self) -> None:
        taken: list[int] = []
        queue = LoopQueue(taken.append, lambda _: 0.5)
        for n in range(8):
            queue.put(n)
        for turn in range(1, 5):
            await asyncio.sleep(0)
            assert taken == list(range(2 * turn))

    async def test_pause_delays_items_without_loss(self) -> None:
        pauses_s, done = [1e-6, 1e-6, 0.0], asyncio.Event()
        queue = LoopQueue(lambda _: done.set(), pause_s=lambda: pauses_s.pop(0))
        queue.put(0)
        async with asyncio.timeout(START_LIMIT_S):
            await done.wait()
        assert not pauses_s


class TestFlood:
    """A site takes no more from its fleet at a time than from any other client."""

    @pytest.mark.parametrize("trusted", ["yes", "no"])
    async def test_message_above_the_limit_is_dropped_unread(self, rig: Rig, trusted: str) -> None:
        hub = rig.hub(f"zenoh:tcp/127.0.0.1:1?site=field&trusted={trusted}")
        client: Any = hub._clients[1]
        beat = rig.sender(255, 190).heartbeat()
        sample = MagicMock(payload=zenoh.ZBytes(beat * 1000))
        before = hub.untrusted_reads.level
        client._handle(zenoh_session.payload_of(sample))
        assert client.counters.received == 0
        assert client.counters.bytes_garbage == 1000 * len(beat)
        assert before - hub.untrusted_reads.level == (MAX_MESSAGE if trusted == "no" else 0)

    def test_large_message_takes_a_whole_turn(self) -> None:
        assert zenoh_client._cost_of((b"", MAX_MESSAGE)) >= 1.0
        assert zenoh_client._cost_of((b"", 1)) == 1 / AT_ONCE


class TestSubscription:
    @pytest.mark.parametrize(
        ("size", "count", "handled"),
        [
            pytest.param(MAX_MESSAGE, 100, BYTES_AT_ONCE // MAX_MESSAGE, id="a few a turn"),
            pytest.param(MAX_MESSAGE + 1, 2 * MAX_WAITING, 2 * MAX_WAITING, id="never queued"),
        ],
    )
    async def test_queue_is_bounded_in_bytes(self, size: int, count: int, handled: int) -> None:
        waiting = [SimpleNamespace(payload=bytes(size))] * count
        subscriber = MagicMock(try_recv=lambda: waiting.pop() if waiting else None)
        subscriber.__iter__.return_value = iter(())
        session = MagicMock(declare_subscriber=lambda *_: subscriber)
        taken: list[Any] = []
        subscription = Subscription(session, "flood", taken.append)
        subscription._drain()
        assert (len(taken), len(subscription._waiting)) == (handled, count - handled)

    async def test_flood_is_handled_in_turns_and_the_oldest_telemetry_is_dropped(
        self, site: Site, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(zenoh_session, "MAX_WAITING", 100)
        monkeypatch.setattr(zenoh_session, "AT_ONCE", 10)
        far, near = site.visit(), site.visit()
        taken: list[tuple[str, bytes]] = []
        all_sent = threading.Event()
        reader = Subscription(
            near.session,
            "flood/*",
            lambda sample: taken.append((str(sample.key_expr), sample.payload.to_bytes())),
        )
        end = near.session.declare_subscriber("end", lambda _: all_sent.set())
        async with asyncio.timeout(START_LIMIT_S):
            while not taken:
                far.session.put("flood/a", b"begin")
                await asyncio.sleep(0.01)
            far.session.put("flood/a", b"last")
            while taken[-1][1] != b"last":
                await asyncio.sleep(0.01)
        high = zenoh.Priority.INTERACTIVE_HIGH
        for number in range(3):
            far.session.put("flood/a", b"%d" % number, priority=high)
        for number in range(80):
            for site in "ab":
                far.session.put(f"flood/{site}", b"%d" % number)
        far.session.put("end", b"")
        assert all_sent.wait(START_LIMIT_S), "the loop stands still meanwhile"
        del taken[:]
        most = 0
        while len(taken) < 103:
            before = len(taken)
            await asyncio.sleep(0)
            most = max(most, len(taken) - before)
        assert taken[:3] == [("flood/a", b"%d" % number) for number in range(3)]
        newest = [(f"flood/{site}", b"%d" % number) for number in range(30, 80) for site in "ab"]
        assert taken[3:] == newest
        assert reader.dropped == 60
        assert most <= 3 + 2 * 10
        end.undeclare()
        reader.close()
        reader.undeclare()


SITE = """
import asyncio, sys
from gateway.cli.__main__ import _exit_without_hanging_threads
from gateway.clock import GatewayClock
from gateway.hub.transports.zenoh import session as zenoh_session
from gateway.hub.hub import Hub
from gateway.records import Outgoing
from gateway.hub.settings import HubSettings
from tests.kit.mavlink import Sender, dialect

# As patient as the session's configuration.
zenoh_session.GIVE_UP_S = 3600.0

async def main():
    hub = Hub(HubSettings(endpoints=(f"zenoh:{sys.argv[1]}?{sys.argv[2]}",)), print, GatewayClock())
    hub.start()
    while hub.clients()[0].state != "open":
        await asyncio.sleep(0.01)
    print("open", flush=True)
    piece = dialect.MAVLink_file_transfer_protocol_message(0, 0, 0, [1] * 251)
    if sys.stdin.readline() == "fill\\n":
        while hub.clients()[0].queued < zenoh_session.MAX_RELIABLE:
            hub.send(Outgoing(Sender(1, 1).pack(piece), piece.get_msgId(), None))
            await asyncio.sleep(0)
    hub.close()

try:
    asyncio.run(main())
    raise SystemExit(7)
finally:
    _exit_without_hanging_threads()
"""


@pytest.mark.parametrize("stalls", [False, True])
def test_process_ends_soon_after_its_session_is_closed(
    router: Router, patient: Path, *, stalls: bool
) -> None:
    """Zenoh may wait for a stalled link, Python for threads and for what is still declared."""
    words = [sys.executable, "-c", SITE, router.locator, f"site=field&config={patient}"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as site:
        assert site.stdin is not None
        assert site.stdout is not None
        assert site.stdout.readline() == "open\n"
        if stalls:
            router.signal(signal.SIGSTOP)
        try:
            site.communicate("fill\n" if stalls else "end\n", timeout=START_LIMIT_S)
        finally:
            site.kill()
        assert site.returncode == 7
