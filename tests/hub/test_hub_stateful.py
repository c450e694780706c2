"""Clients connect, stall and forge in any order: a good one misses nothing, no other harms it.

Hypothesis draws the order and shrinks what fails to the fewest steps. After each of them:

* the good client gets every frame of our vehicle without a gap, and every frame of the autopilot;
* what it asks reaches our vehicle and the autopilot, and is answered;
* no frame of an untrusted client reaches it or the autopilot, and nothing of ours has changed;
* an untrusted client gets telemetry and answers to itself, nothing addressed to another.
"""

import asyncio
import functools
import itertools
import os
import socket
import struct
from collections.abc import Callable, Coroutine
from typing import Any

import msgspec
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    rule,
    run_state_machine_as_test,
)
from pymavlink.dialects.v20 import common as dialect

from gateway.records import ClientInterval
from gateway.vehicle.vehicle_settings import VehicleSettings
from gateway.wire.mavlink_splitter import message_id_of, origin_of
from tests.kit.hub import FlyingHub, Rig, Station
from tests.ports import free_port

pytestmark = [pytest.mark.io, pytest.mark.slow]

EXAMPLES = int(os.environ.get("HUB_EXAMPLES", "15"))
STEPS = 20
OURS, AUTOPILOT, GOOD = (1, 1), (42, 1), (255, 190)
TRUSTED, UNTRUSTED = "127.0.0.1", "127.0.0.2"
COMMAND_ACK = dialect.MAVLINK_MSG_ID_COMMAND_ACK
NAMES = st.sampled_from([OURS, AUTOPILOT, GOOD, (42, 190), (7, 7), (1, 240), (200, 190)])


def forged_frames(sender: Any, guessed: bytes) -> dict[str, bytes]:
    """Return forged frames of a name; `guessed` is the next frame of the good client."""
    pack = sender.pack

    def command(target: tuple[int, int]) -> bytes:
        # Unlike any that is meant.
        return pack(dialect.MAVLink_command_long_message(*target, 512, 0, 148, 0, 0, 0, 0, 0, 7))

    return {
        "vehicle": pack(dialect.MAVLink_heartbeat_message(2, 0, 0, 0, 4, 3)),
        "station": pack(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)),
        "telemetry": pack(dialect.MAVLink_attitude_message(5, 1.0, 0, 0, 0, 0, 0)),
        "command to the autopilot": command(AUTOPILOT),
        "command to the station": command(GOOD),
        "request": command(OURS),
        "change": pack(dialect.MAVLink_param_set_message(*OURS, b"RATE_ATT", 0.0, 9)),
        "mission": pack(dialect.MAVLink_mission_clear_all_message(*OURS, 255)),
        "list": pack(dialect.MAVLink_param_request_list_message(0, 0)),
        "ping": pack(dialect.MAVLink_ping_message(5, 1, 0, 0)),
        "to all": pack(dialect.MAVLink_command_long_message(*OURS, 512, 0, 148, 0, 0, 0, 0, 0, 2)),
        "copy in advance": guessed,
        "garbage": b"\xfd\x09\x00" + guessed[:7],
    }


def steps(rule: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Run an asynchronous rule, and let everything arrive."""

    @functools.wraps(rule)
    def run(machine: "HubMachine", **drawn: Any) -> None:
        async def to_end() -> None:
            await rule(machine, **drawn)
            await machine.settle()

        machine.runner.run(to_end())

    return run


class HubMachine(RuleBasedStateMachine):
    """One hub with one good client, an autopilot, and untrusted clients."""

    def __init__(self) -> None:
        super().__init__()
        self.runner = asyncio.Runner()
        self.errors: list[Any] = []
        self.runner.get_loop().set_exception_handler(lambda _, error: self.errors.append(error))
        self.rig = Rig()
        self.numbers = bytearray()
        self.telemetry: list[bytes] = []
        """Frames of the autopilot that the good client has not received yet."""
        self.requests: list[bytes] = []
        """Frames of the good client that the autopilot has not received yet."""
        self.answers = 0
        self.forged: set[bytes] = set()
        self.sent_to_ours: set[bytes] = set()
        self.outsiders: list[Station] = []
        self.readers: list[socket.socket] = []

    @initialize()
    @steps
    async def begin(self) -> None:
        self.good = self.rig.station()
        endpoints = (
            f"udp:127.0.0.1:{self.good.port}",
            f"udp-listen:{TRUSTED}:0",
            f"udp-listen:{UNTRUSTED}:0?trusted=no",
            f"tcp-listen:{TRUSTED}:0",
        )
        self.gateway = FlyingHub(self.rig, OURS[0], *endpoints, max_clients=4, idle_timeout_s=5.0)
        self.hub, self.vehicle = self.gateway.hub, self.gateway.vehicle
        await self.rig.until_open(self.hub)
        self.trusted, self.untrusted, self.tcp = self.hub.listening_ports()
        self.autopilot = self.rig.station(self.trusted, origin=AUTOPILOT)
        self.gateway.fly()
        await self.rig.quiet()
        self._listen()
        await self._second()
        # Proves that the autopilot receives.
        self.autopilot.send(self.autopilot.sender.command(*OURS))

    async def _second(self) -> None:
        """Let a second pass in which vehicle, autopilot and good client send."""
        self.rig.clock.now_us += 1_000_000
        self.gateway.fly()
        self.telemetry.append(self.autopilot.sender.heartbeat())
        self.autopilot.send(self.telemetry[-1])
        self._ask(self.good.sender.heartbeat())
        self.rig.tick(self.hub)
        await self.settle()

    def _ask(self, frame: bytes) -> None:
        self.sent_to_ours.add(frame)
        self.requests.append(frame)
        self.good.send(frame)

    async def settle(self) -> None:
        """Let everything arrive."""

        def arrived() -> bool:
            self._listen()
            return not self.telemetry and not self.requests

        await self.rig.until(arrived)
        await self.rig.quiet()
        self._listen()

    def _listen(self) -> None:
        for frame in self.good.received():
            assert frame not in self.forged
            if origin_of(frame) == OURS:
                self.numbers.append(frame[4])
                self.answers += message_id_of(frame) == COMMAND_ACK
            elif origin_of(frame) == AUTOPILOT:
                assert frame == self.telemetry.pop(0)
        for frame in self.autopilot.received():
            assert frame not in self.forged
            if origin_of(frame) == GOOD:
                assert frame == self.requests.pop(0)
        for outsider in self.outsiders:
            for frame in outsider.received():
                assert frame not in self.sent_to_ours, (
                    "an untrusted client received a frame of the good client"
                )

    @rule(seconds=st.integers(1, 7))
    @steps
    async def time_passes(self, seconds: int) -> None:
        for _ in range(seconds):
            await self._second()

    @rule(count=st.integers(1, 40))
    @steps
    async def fly(self, count: int) -> None:
        for _ in range(count):
            self.rig.clock.now_us += 5_000
            self.gateway.fly()
            self.telemetry.append(self.autopilot.sender.attitude())
            self.autopilot.send(self.telemetry[-1])

    @rule()
    @steps
    async def the_good_client_asks_the_vehicle(self) -> None:
        before = self.answers
        frame = self.good.sender.command(*OURS)
        self.sent_to_ours.add(frame)
        self.good.send(frame)

        def answered() -> bool:
            self._listen()
            return self.answers > before

        await self.rig.until(answered)

    @rule()
    @steps
    async def the_good_client_asks_the_autopilot(self) -> None:
        self._ask(self.good.sender.command(*AUTOPILOT))

    @rule()
    def an_untrusted_client_connects(self) -> None:
        outsider = self.rig.station()
        outsider.target = (UNTRUSTED, self.untrusted)
        self.outsiders.append(outsider)

    @rule(
        data=st.data(),
        name=NAMES,
        kinds=st.lists(
            st.sampled_from(sorted(forged_frames(Rig().sender(1), b""))), min_size=1, max_size=9
        ),
        times=st.integers(1, 8),
    )
    @steps
    async def an_untrusted_client_forges(
        self, data: st.DataObject, name: tuple[int, int], kinds: list[str], times: int
    ) -> None:
        if not self.outsiders:
            return
        outsider = data.draw(st.sampled_from(self.outsiders))
        sender = self.rig.sender(*name)
        sender.link.seq = data.draw(st.integers(0, 255))
        for kind in kinds * times:
            # A listener can know the next number of the good client.
            link = self.good.sender.link
            guessed = self.good.sender.command(*AUTOPILOT)
            link.seq = (link.seq - 1) % 256
            frame = forged_frames(sender, guessed)[kind]
            if kind != "copy in advance":
                self.forged.add(frame)
            outsider.send(frame)
            await asyncio.sleep(0)

    @rule(data=st.data())
    def an_untrusted_client_leaves(self, data: st.DataObject) -> None:
        if self.outsiders:
            gone = data.draw(st.sampled_from(self.outsiders))
            self.outsiders.remove(gone)
            gone.socket.close()

    @rule()
    @steps
    async def a_tcp_client_connects_and_never_reads(self) -> None:
        reader = socket.create_connection((TRUSTED, self.tcp))
        self.rig.closing.append(reader.close)
        self.readers.append(reader)

    @rule(is_reset=st.booleans())
    @steps
    async def a_reader_breaks_off(self, is_reset: bool) -> None:
        if self.readers:
            reader = self.readers.pop()
            if is_reset:
                reader.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            reader.send(self.rig.sender(7).heartbeat()[:9])
            reader.close()

    @rule(
        kind=st.sampled_from(["udp", "tcp"]),
        options=st.sampled_from(["", "?deny=ATTITUDE", "?rate=RAW_IMU:5", "?pack=200"]),
    )
    @steps
    async def an_endpoint_without_a_peer_is_added(self, kind: str, options: str) -> None:
        self.hub.add(f"{kind}:127.0.0.1:{free_port()}{options}")

    @rule()
    @steps
    async def the_last_added_endpoint_is_removed(self) -> None:
        for url in self.hub.endpoints()[4:][-1:]:
            self.hub.remove(url)

    @rule(client_id=st.integers(2, 20), interval_us=st.sampled_from([-1, 0, 100_000]))
    def another_client_requests_an_interval(self, client_id: int, interval_us: int) -> None:
        self.hub.set_interval(ClientInterval(client_id, OURS[0], 30, interval_us))

    @rule(
        options=st.sampled_from(["", "&deny=ATTITUDE", "&rate=ATTITUDE:5", "&pack=300"]),
        most=st.integers(3, 5),
    )
    @steps
    async def settings_are_reloaded(self, options: str, most: int) -> None:
        endpoints = list(self.hub.settings.endpoints)
        endpoints[2] = f"udp-listen:{UNTRUSTED}:0?trusted=no{options}"
        changed = {"endpoints": tuple(endpoints), "max_clients": most}
        self.hub.apply(msgspec.structs.replace(self.hub.settings, **changed))

    @invariant()
    def nothing_is_missed(self) -> None:
        steps = {(b - a) % 256 for a, b in itertools.pairwise(self.numbers)}
        assert steps <= {1}
        assert self.errors == []

    @invariant()
    def nothing_has_changed(self) -> None:
        assert self.vehicle.telemetry.settings == VehicleSettings()
        assert self.vehicle.plan.missions.items[0] == ()

    @invariant()
    def routes_lead_to_trusted_clients_only(self) -> None:
        assert not hasattr(self, "hub") or self.hub.routed_vehicles() <= {AUTOPILOT[0]}

    def teardown(self) -> None:
        self.rig.close()
        self.runner.run(asyncio.sleep(0))
        self.runner.close()


def test_trusted_client_loses_nothing_in_any_order_of_events() -> None:
    bounded = settings(
        max_examples=EXAMPLES, stateful_step_count=STEPS, suppress_health_check=list(HealthCheck)
    )
    run_state_machine_as_test(HubMachine, settings=bounded)
