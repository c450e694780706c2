"""A site's endpoint, with real sessions and a real router in another process."""

import asyncio
import itertools
import json
import signal
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import AsyncIterator, Callable, Container
from functools import partial
from pathlib import Path
from unittest.mock import MagicMock

import pytest
import zenoh

from gateway.hub.hub import Hub
from gateway.hub.transports.zenoh import client as zenoh_client
from gateway.hub.transports.zenoh import session as zenoh_session
from gateway.hub.transports.zenoh.session import (
    AT_ONCE,
    MAX_MESSAGE,
    MAX_WAITING,
    OWN,
    Subscription,
    open_session,
    session_config,
)
from gateway.wire.mavlink_json import template
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from tests.kit.hub import Rig
from tests.kit.process import START_LIMIT_S, until
from tests.kit.zenoh_router import Router, router
from tests.ports import free_port

__all__ = ["router"]

pytestmark = pytest.mark.io

OUT = "mavlink/field/*/out"
PATIENT = """{
  scouting: {multicast: {enabled: false}, gossip: {enabled: false}},
  transport: {link: {tx: {queue: {congestion_control: {block: {wait_before_close: 3600000000}}}}}},
}"""
"""Lets Zenoh wait an hour for a stalled link: a caller that waits for it exceeds any time limit."""


class Far:
    """Another session at the router, which keeps the messages it receives."""

    def __init__(self, locator: str, *keys: str) -> None:
        self.session: zenoh.Session = open_session(session_config(locator, ""))
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

    async def join(self, options: str = "site=field", extra: str = "") -> Hub:
        """Return a hub that is linked with the router, and may have one more endpoint."""
        hub = self.hub(f"zenoh:{self.router.locator}?{options}", *filter(None, [extra]))
        self.publish(hub, self.vehicle.heartbeat())
        await self.tick_until(hub, lambda: hub.clients()[0].state == "open")
        return hub

    def visit(self, *keys: str) -> Far:
        far = Far(self.router.locator, *keys)
        self.closing.append(far.session.close)
        return far

    async def until_received(self, hub: Hub, is_received: Callable[[], object]) -> None:
        """Publish until something has arrived: a subscription takes a while."""

        def is_so() -> bool:
            self.publish(hub, self.vehicle.attitude())
            return bool(is_received())

        await self.tick_until(hub, is_so)

    async def exchange(
        self, options: str = "site=field", *keys: str, extra: str = ""
    ) -> tuple[Hub, Far]:
        """Return a site and a session that receives its telemetry."""
        hub, far = await self.join(options, extra), self.visit(*(keys or (OUT,)))
        await self.until_received(hub, lambda: far.got)
        return hub, far


@pytest.fixture
async def site(router: Router) -> AsyncIterator[Site]:
    site = Site(router)
    yield site
    site.close()
    router.restore()


@pytest.fixture
def patient(tmp_path: Path) -> Path:
    """A configuration by which Zenoh never gives a stalled link up."""
    file = tmp_path / "patient.json5"
    file.write_text(PATIENT)
    return file


class TestSite:
    @pytest.mark.parametrize(
        ("options", "key", "mark", "trusted"),
        [
            ("site=field", "mavlink/field/1", OWN, False),
            ("site=field&trusted=no", "mavlink/field/1", OWN, False),
            ("site=field&trusted=yes", "mavlink/field/1", OWN, True),
            ("keys=mavlink_raw", "mavlink_raw", None, False),
        ],
    )
    async def test_frames_pass_and_only_an_explicit_option_makes_a_fleet_trusted(
        self, site: Site, options: str, key: str, mark: bytes | None, trusted: bool
    ) -> None:
        hub, far = await site.exchange(options, f"{key}/out")
        assert far.marks == {f"{key}/out": {mark}}
        command = site.sender(255, 190).command(1, 1)
        far.session.put(f"{key}/in", command)
        await site.tick_until(hub, lambda: bool(site.incoming))
        assert [(each.frame, each.trusted) for each in site.incoming] == [(command, trusted)]

    async def test_garbage_is_counted_and_frames_for_other_sites_are_not(self, site: Site) -> None:
        hub, far = await site.join(), site.visit()
        far.session.put("mavlink/field/1/in", b"no MAVLink")
        await site.tick_until(hub, lambda: hub.clients()[0].bytes_garbage == 10)
        far.session.put("mavlink/other/1/in", site.sender(255, 190).command(1, 1))
        far.session.put("mavlink/field/1/in", site.sender(255, 190).heartbeat())
        await site.tick_until(hub, lambda: hub.clients()[0].received == 1)

    async def test_autopilot_behind_the_site_has_its_own_key_and_no_attachment(
        self, site: Site
    ) -> None:
        hub = await site.join(extra="udp-listen:127.0.0.1:0?trusted=yes")
        station, far = site.station(hub.listening_ports()[0]), site.visit(OUT)
        autopilot = site.sender(7)

        def received() -> bool:
            station.send(autopilot.heartbeat())
            site.publish(hub, site.vehicle.command(1, 1), site.vehicle.heartbeat())
            return far.marks.keys() >= {"mavlink/field/7/out"} and bool(far.messages(76))

        await site.tick_until(hub, received)
        assert far.marks == {"mavlink/field/7/out": {None}, "mavlink/field/1/out": {OWN}}

    async def test_filters_rates_and_packing_apply(self, site: Site) -> None:
        hub, far = await site.exchange("site=field&deny=RAW_IMU&pack=1100")
        await site.quiet_some()
        for _ in range(5):
            site.publish(hub, site.vehicle.raw_imu(), site.vehicle.attitude())
        size = len(site.vehicle.attitude())
        await site.tick_until(hub, lambda: any(len(data) == 5 * size for _, data in far.got))
        assert not far.messages(27)

    async def test_burst_arrives_completely_and_in_order(self, site: Site) -> None:
        """Telemetry gives way on a congested link, never on an idle one."""
        hub, far = await site.exchange()
        burst = [site.vehicle.raw_imu() for _ in range(200)]
        site.publish(hub, *burst)
        await site.tick_until(hub, lambda: far.messages(27)[-1:] == burst[-1:])
        assert far.messages(27) == burst

    async def test_json_keys_of_mavlink_server(self, site: Site) -> None:
        keys = ("mavlink/out", "mavlink/*/*/*", "mavlink/1/1/ATTITUDE/rollspeed")
        hub, far = await site.exchange("keys=mavlink_json&trusted=yes", *keys)
        wanted = {"mavlink/1/1/ATTITUDE", "mavlink/1/1/ATTITUDE/rollspeed"}
        await site.until_received(hub, lambda: wanted <= {key for key, _ in far.got})
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
        await site.tick_until(hub, lambda: bool(site.incoming))
        assert origin_of(site.incoming[0].frame) == (255, 190)
        assert site.incoming[0].frame[4] == 7
        assert hub.clients()[0].bytes_garbage > 4000


class TestTrouble:
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

    @pytest.mark.parametrize(
        ("protocol", "config", "reason"),
        [
            ("tcp", None, "no router answers at {locator}, or it refuses the login"),
            ("tls", None, "no router answers at {locator}, or a certificate does not fit"),
            ("tcp", "{", "zenoh: "),
            *(
                ("tls", f'{{transport: {{link: {{tls: {{{name}: "/missing.pem"}}}}}}}}',
                 f"{name} /missing.pem: No such file or directory")
                for name in zenoh_session.TLS_FILES
            ),
        ],
    )  # fmt: skip
    async def test_session_that_cannot_open_is_reported(
        self, rig: Rig, tmp_path: Path, protocol: str, config: str | None, reason: str
    ) -> None:
        locator, file = f"{protocol}/127.0.0.1:{free_port()}", tmp_path / "zenoh.json5"
        file.write_text(config or "{}")
        hub = rig.hub(f"zenoh:{locator}?site=field" + (f"&config={file}" if config else ""))
        await rig.tick_until(hub, lambda: hub.clients()[0].state == "unreachable")
        assert hub.clients()[0].reason.startswith(reason.format(locator=locator))

    def test_port_in_use_is_reported_in_one_line(self) -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            config = session_config(f"tcp/127.0.0.1:{taken.getsockname()[1]}", "", "router")
            with pytest.raises(OSError, match="another program listens at this port"):
                open_session(config)

    async def test_stalled_router_delays_no_other_client(self, site: Site, patient: Path) -> None:
        hub = await site.join(f"site=field&config={patient}", "udp-listen:127.0.0.1:0")
        station = await site.call(hub)
        site.publish(hub, site.vehicle.attitude())
        station.received()
        # Blocking reads: the loop does nothing meanwhile.
        station.socket.settimeout(START_LIMIT_S)
        site.router.signal(signal.SIGSTOP)
        for _ in range(5000):
            for frame in (site.vehicle.raw_imu(), site.vehicle.command(1, 1)):
                site.publish(hub, frame)
                assert station.socket.recv(65535) == frame, "a local client has it at once"
        fleet, local = hub.clients()
        assert fleet.queued <= zenoh_session.MAX_RELIABLE
        assert fleet.dropped > 0
        assert local.dropped == 0
        site.router.signal(signal.SIGCONT)

    async def test_two_sites_of_one_name_are_reported_on_both(self, site: Site) -> None:
        first, second = [await site.join() for _ in range(2)]
        for hub in (first, second):
            await site.tick_until(hub, lambda: "'field' too" in hub.clients()[0].reason)  # noqa: B023
        second.close()
        await site.tick_until(first, lambda: first.clients()[0].reason == "")

    async def test_missing_zenoh_package_is_reported(
        self, rig: Rig, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "zenoh", None)
        hub = rig.hub("zenoh:tcp/127.0.0.1:7447?site=field")
        await rig.tick_until(hub, lambda: bool(hub.clients()[0].reason))
        assert hub.clients()[0].reason.startswith("this endpoint needs the extra fleet; to install")


class TestFlood:
    """A site takes no more from its fleet at a time than from any other client."""

    @pytest.mark.parametrize("trusted", ["yes", "no"])
    async def test_message_above_the_limit_is_dropped_unread(
        self, site: Site, trusted: str
    ) -> None:
        hub = await site.join(f"site=field&trusted={trusted}")
        beats = site.sender(255, 190).heartbeat() * 1000
        before = hub.untrusted_reads.level
        site.visit().session.put("mavlink/field/1/in", beats)
        await site.until(lambda: hub.clients()[0].bytes_garbage)
        (fleet,) = hub.clients()
        assert (fleet.received, fleet.bytes_garbage) == (0, len(beats))
        assert before - hub.untrusted_reads.level == (MAX_MESSAGE if trusted == "no" else 0)

    async def test_untrusted_fleet_is_not_read_beyond_its_quota(self, site: Site) -> None:
        hub = await site.join("site=field&trusted=no")
        hub.untrusted_reads.level = -1e9
        site.visit().session.put("mavlink/field/1/in", site.sender(255, 190).heartbeat())
        await asyncio.sleep(0.1)
        assert hub.clients()[0].received == 0
        hub.untrusted_reads.level = 1.0
        await site.until(lambda: hub.clients()[0].received)


class Flood:
    """A subscription, and messages to it that all arrive before the loop handles any."""

    def __init__(self) -> None:
        self.session = zenoh.open(session_config("tcp/127.0.0.1:0", "", "router"))
        self.taken: list[tuple[str, bytes]] = []
        self.pauses_s: list[float] = []
        self.reader = Subscription(
            partial(self.session.declare_subscriber, "flood/*"),
            lambda sample: self.taken.append((str(sample.key_expr), sample.payload.to_bytes())),
            pause_s=lambda: self.pauses_s.pop(0) if self.pauses_s else 0.0,
        )

    def put(self, key: str, data: bytes, priority: zenoh.Priority = zenoh.Priority.DATA) -> None:
        self.session.put(f"flood/{key}", data, priority=priority)

    async def most_in_a_turn(self, count: int) -> int:
        """Let the loop handle so many messages."""
        counts = [0]

        def are_handled() -> bool:
            counts.append(len(self.taken))
            return counts[-1] >= count

        await until(are_handled)
        return max(after - before for before, after in itertools.pairwise(counts))


@pytest.fixture
async def flood() -> AsyncIterator[Flood]:
    flood = Flood()
    yield flood
    flood.reader.close()
    flood.reader.undeclare()
    flood.session.close()


class TestSubscription:
    @pytest.mark.parametrize(
        ("size", "count", "expected"),
        [
            pytest.param(MAX_MESSAGE, 40, range(1, 9), id="a few a turn"),
            pytest.param(MAX_MESSAGE + 1, MAX_WAITING + 1, [MAX_WAITING + 1], id="never queued"),
        ],
    )
    async def test_queue_is_bounded_in_bytes(
        self, flood: Flood, size: int, count: int, expected: Container[int]
    ) -> None:
        for _ in range(count):
            flood.put("a", bytes(size))
        assert await flood.most_in_a_turn(count) in expected
        assert flood.reader.dropped == 0

    async def test_flood_is_handled_in_turns_and_the_oldest_telemetry_is_dropped(
        self, flood: Flood
    ) -> None:
        urgent = [b"%d" % number for number in range(3)]
        for data in urgent:
            flood.put("a", data, zenoh.Priority.INTERACTIVE_HIGH)
        telemetry = [
            (key, b"%d" % number) for number in range(MAX_WAITING // 2 + 20) for key in "ab"
        ]
        for key, data in telemetry:
            flood.put(key, data)
        assert await flood.most_in_a_turn(3 + MAX_WAITING) <= 3 + 2 * AT_ONCE
        expected = [("a", data) for data in urgent] + telemetry[40:]
        assert flood.taken == [(f"flood/{key}", data) for key, data in expected]
        assert flood.reader.dropped == 40

    async def test_pause_delays_messages_without_loss(self, flood: Flood) -> None:
        flood.pauses_s = [1e-6, 60.0]
        flood.put("a", b"1")
        await until(lambda: flood.taken)
        assert not flood.pauses_s

    async def test_waiting_messages_are_dropped_on_close(self, flood: Flood) -> None:
        flood.pauses_s = [60.0, 0.0]
        flood.put("a", b"1")
        await until(lambda: len(flood.pauses_s) == 1)
        flood.reader.close()
        await until(lambda: not flood.pauses_s)
        assert flood.taken == []


SITE = """
import asyncio, sys
from gateway.cli.__main__ import _exit_without_hanging_threads
from gateway.clock import GatewayClock
from gateway.hub.transports.zenoh import session as zenoh_session
from gateway.hub.hub import Hub
from gateway.hub.transports.base import READ_BYTES
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
            router.restore()
        assert site.returncode == 7
