"""The compiled step, the same step as Python, and the general path deliver and count the same."""

import asyncio
import random
import socket
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import common as dialect

from gateway.compiled.entry_point import LibraryError
from gateway.hub import forwarding_step
from gateway.hub import hub as hub_module
from gateway.hub.endpoint import parse_endpoint
from gateway.hub.forwarding import Forwarding
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.hub.stats import ClientStats
from gateway.hub.transports.udp import UdpClient
from gateway.wire.mavlink_splitter import MavFrame, MavlinkSplitter
from tests.kit.hub import Rig
from tests.kit.mavlink import Sender, packed

pytestmark = pytest.mark.io

SOURCES = 4
SHARED = 3
"""The last source brings the system of the first too, and so on a second path."""
MODES = ("compiled", "the step as Python", "general path")
STEPS = 40
UNKNOWN = b"\xfd\x02\0\0\x07\x2a\1\xff\xff\x02ab\x11\x22"


def use(mode: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let hubs forward in one of the modes from now on."""
    if mode == "general path":
        monkeypatch.setattr(hub_module, "Forwarding", partial(Forwarding, is_compiled=False))
    elif mode == "the step as Python":
        point: Any = forwarding_step.forward
        monkeypatch.setattr(
            point, "bound", lambda *addresses: partial(point.__wrapped__, *addresses)
        )


def kinds(system: int) -> dict[str, Callable[[], bytes]]:
    """Return what a source sends; each call gives the next of its frames."""
    sender, signed = Sender(system), Sender(system, 2, signed=True)

    def version1() -> bytes:
        return packed(dialect.MAVLink_sys_status_message(*(1,) * 13), system, 3, version=1)

    def radio() -> bytes:
        return sender.pack(dialect.MAVLink_radio_status_message(1, 2, 50, 4, 5, 6, 7))

    def damaged() -> bytes:
        frame = sender.attitude()
        return frame[:-1] + bytes((frame[-1] ^ 1,))

    return {
        "attitude": sender.attitude,
        "more attitudes": lambda: b"".join(sender.attitude() for _ in range(5)),
        "imu": sender.raw_imu,
        "heartbeat": sender.heartbeat,
        "signed": signed.attitude,
        "version 1": version1,
        "radio": radio,
        "command to another": lambda: sender.command(40 + (system - 39) % SOURCES, 1),
        "command to nobody": lambda: sender.command(250, 1),
        "unknown": lambda: UNKNOWN[:5] + bytes((system,)) + UNKNOWN[6:],
        "damaged": damaged,
        "garbage": lambda: b"\xfd\x09garbage",
        "garbage and frame": lambda: b"garb" + sender.attitude(),
        "nothing": lambda: b"",
    }


class World:
    """A hub with sources and clients of many kinds; all that they receive is kept."""

    def __init__(self, rig: Rig, seed: int) -> None:
        self.rig, self.rng = rig, random.Random(seed)
        self.got: dict[str, list[bytes]] = {}

    async def start(self) -> None:
        rig = self.rig
        self.stations = {name: rig.station() for name in ("plain", "picky", "limited", "all")}
        self.stations |= {name: rig.station() for name in ("packed", "old", "later")}
        self.gone = rig.station()
        self.gone.socket.close()
        options = {
            "picky": "?deny=RAW_IMU", "limited": "?rate=ATTITUDE:5", "all": "?monitor=yes",
            "packed": "?pack=100", "old": "?mavlink=1",
        }  # fmt: skip
        self.urls = {
            name: f"udp:127.0.0.1:{station.port}{options.get(name, '')}"
            for name, station in self.stations.items()
        }
        self.hub = await rig.open(
            "udp-listen:127.0.0.1:0?trusted=yes",
            "udp-listen:127.0.0.2:0?trusted=no",
            "tcp-listen:127.0.0.1:0?trusted=yes",
            f"udp:127.0.0.1:{self.gone.port}",
            *(url for name, url in self.urls.items() if name != "later"),
        )
        trusted, untrusted, tcp = self.hub.listening_ports()
        self.stream = await rig.connect(tcp)
        self.stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.flow = kinds(90)
        self.stream.send(self.flow["heartbeat"]())
        self.sources = [rig.station(trusted) for _ in range(SOURCES)]
        self.kinds = [kinds(40 + number) for number in range(SOURCES)]
        self.untrusted = rig.station()
        self.untrusted.target = ("127.0.0.2", untrusted)
        self.forged = kinds(77)
        await self.narrow()
        for source, known in zip(self.sources, self.kinds, strict=True):
            source.send(known["heartbeat"]())
        await self.settle()

    async def narrow(self) -> None:
        """Add a client with a socket whose buffer fills after some datagrams."""
        url = parse_endpoint("udp:127.0.0.1:1")
        client = UdpClient(self.hub, self.hub.new_client_id(), url)
        self.pair = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        for sock in self.pair:
            sock.setblocking(False)
            self.rig.closing.append(sock.close)
        client.adopt(self.pair[0])
        self.hub.appear(client)

    async def settle(self) -> None:
        """Let everything arrive and be read."""
        before = -1
        while before != (before := sum(map(len, self.got.values()))):
            for _ in range(12):
                await asyncio.sleep(0)
            for name, station in self.stations.items():
                self.got.setdefault(name, []).extend(station.received())
            for number, source in enumerate(self.sources):
                self.got.setdefault(f"source {number}", []).extend(source.received())
            self.got.setdefault("untrusted", []).extend(self.untrusted.received())
            for sock, name in ((self.pair[1], "narrow"), (self.stream, "stream")):
                kept = self.got.setdefault(name, [])
                try:
                    while data := sock.recv(65536):
                        kept.append(data)
                except BlockingIOError:
                    pass

    async def step(self) -> None:
        """Do something, the same for the same seed."""
        action = self.rng.choices(
            [self.send, self.flow_on, self.forge, self.bring_twice, self.cut, self.wait,
             self.add_or_remove, self.change_options],
            [20, 8, 3, 4, 3, 3, 2, 2],
        )[0]  # fmt: skip
        await action(self.rng.randrange(SOURCES))
        await self.settle()

    async def send(self, number: int) -> None:
        known = self.kinds[number]
        weights = [20, 6, 9, *[1] * (len(known) - 3)]
        for name in self.rng.choices([*known], weights, k=self.rng.randrange(90)):
            self.sources[number].send(known[name]())

    async def flow_on(self, _: int) -> None:
        """Send a stream in chunks that end anywhere."""
        names = self.rng.choices([*self.flow], [9, 3, 3, *[1] * (len(self.flow) - 3)], k=50)
        data = b"".join(self.flow[name]() for name in names)
        while data:
            size = self.rng.randrange(1, 300)
            self.stream.send(data[:size])
            data = data[size:]
            await self.settle()

    async def forge(self, _: int) -> None:
        for name in self.rng.choices([*self.forged], k=20):
            self.untrusted.send(self.forged[name]())

    async def bring_twice(self, _: int) -> None:
        frames = [self.kinds[0]["attitude"]() for _ in range(4)]
        for sender in (self.sources[0], self.sources[SHARED]):
            for frame in frames:
                sender.send(frame)
            await self.settle()

    async def cut(self, number: int) -> None:
        data = b"".join(self.kinds[number]["attitude"]() for _ in range(9))
        for begin in range(0, len(data), 25):
            self.sources[number].send(data[begin : begin + 25])

    async def wait(self, _: int) -> None:
        self.rig.clock.now_us += self.rng.choice([1000, 90_000, 400_000, 2_000_000])
        self.rig.tick(self.hub)

    async def add_or_remove(self, _: int) -> None:
        is_there = self.urls["later"] in self.hub.endpoints()
        (self.hub.remove if is_there else self.hub.add)(self.urls["later"])
        await self.rig.until(lambda: all(c.state != "resolving" for c in self.hub.clients()))

    async def change_options(self, _: int) -> None:
        urls = list(self.hub.settings.endpoints)
        denied = self.rng.sample(["27", "30"], self.rng.randrange(3))
        urls[4] = self.urls["plain"] + (f"?deny={','.join(denied)}" if denied else "")
        self.hub.apply(msgspec.structs.replace(self.hub.settings, endpoints=tuple(urls)))

    def figures(self) -> Any:
        """Return all that may not depend on the mode."""
        # Attitudes overtake others in the queue of a stream while its buffer is full.
        stream: dict[bytes, list[bytes]] = {}
        for event in MavlinkSplitter().feed(b"".join(self.got.pop("stream"))):
            assert isinstance(event, MavFrame)
            stream.setdefault(event.key, []).append(event.data)
        # How many frames share a datagram depends on how many are read in one turn.
        self.got["packed"] = [b"".join(self.got["packed"])]
        clients = [comparable(client) for client in self.hub.clients()]
        return self.got, stream, self.rig.foreign, self.hub.counters(), clients


def comparable(client: ClientStats) -> ClientStats:
    """Leave out the port, and how many frames were sent before a refusal was noticed."""
    sent = client.sent + client.unheard
    refused = client.bytes_sent if client.unheard == 0 and client.state == "open" else 0
    return replace(
        client, remote="", name="", endpoint="", sent=sent, unheard=0, bytes_sent=refused, state=""
    )


async def run(rig: Rig, seed: int) -> Any:
    world = World(rig, seed)
    await world.start()
    for _ in range(STEPS):
        await world.step()
    return world.figures()


WORLDS = [(MODES[2], seed) for seed in range(4)] + [(MODES[1], seed) for seed in (4, 5)]


@pytest.mark.parametrize(
    ("mode", "seed"), WORLDS, ids=[f"{mode}, world {seed}" for mode, seed in WORLDS]
)
async def test_all_ways_of_forwarding_deliver_and_count_the_same(
    mode: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = []
    for each in (MODES[0], mode):
        rig = Rig()
        with monkeypatch.context() as patch:
            use(each, patch)
            results.append(await run(rig, seed))
        rig.close()
    compiled, other = results
    for first, second in zip(compiled, other, strict=True):
        assert first == second


async def test_hub_without_the_library_warns_once_and_forwards(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def load() -> None:
        raise LibraryError(Path("kernels.so"), "is missing")

    monkeypatch.setattr(forwarding_step.forward, "load", load)
    station = rig.station()
    hub = await rig.open("udp-listen:127.0.0.1:0", f"udp:127.0.0.1:{station.port}")
    source = await rig.call(hub)
    sender = rig.sender(42)
    for _ in range(3):
        frame = sender.attitude()
        source.send(frame)
        assert await station.receive() == frame
    (warning,) = [text for text in caplog.messages if "compiled kernels" in text]
    assert "Python forwards" in warning


async def test_more_datagrams_than_one_turn_allows_are_forwarded_in_order(rig: Rig) -> None:
    stations = [rig.station() for _ in range(2)]
    urls = [f"udp:127.0.0.1:{station.port}" for station in stations]
    hub = await rig.open("udp-listen:127.0.0.1:0", *urls)
    source = rig.station(hub.listening_ports()[0])
    sender = rig.sender(42)
    frames = []
    for size in (1, 1, 40, 1, 60, 60, 1, 40):
        many = [sender.attitude() for _ in range(size)]
        frames += many
        source.send(b"".join(many))
        if len(frames) == 2:
            await rig.quiet()
    for station in stations:
        got = b"".join([await station.receive() for _ in frames])
        assert got == b"".join(frames)


async def test_runs_are_passed_on_only_while_they_are_observed(rig: Rig) -> None:
    station, runs = rig.station(), list[tuple[list[bytes], bytes]]()
    hub = Hub(
        HubSettings(endpoints=("udp-listen:127.0.0.1:0", f"udp:127.0.0.1:{station.port}")),
        rig.incoming.append,
        rig.clock,
        rig.foreign.extend,
        on_run=lambda run: runs.append((run.run(), run.records(1 << 56 | 5, 4))),
    )
    rig.closing.append(hub.close)
    hub.start()
    await rig.until_open(hub)
    link = rig.station(hub.listening_ports()[0], origin=(7, 1))
    link.send(link.sender.attitude())
    await rig.until(lambda: rig.foreign)
    for is_observed in (True, False):
        hub.observe(runs=is_observed)
        frames = [link.sender.attitude(time_ms=number) for number in range(5)]
        link.send(*frames)
        await rig.quiet()
        assert station.received()[-5:] == frames
        assert len(rig.foreign) == 1
        if is_observed:
            times = [(1 << 56 | 5 + 4 * number).to_bytes(8, "big") for number in range(5)]
            records = b"".join(time + frame for time, frame in zip(times, frames, strict=True))
            assert runs == [(frames, records)]
    assert len(runs) == 1
    assert hub.newest_frames() == [(frames[-1], rig.clock())]
    assert hub.newest_frames() == []
    stream = hub.streams()[7, 1]
    assert (stream.count, stream.lost) == (11, 0)
    link.sender.link.seq += 3
    link.send(link.sender.attitude())
    await rig.until(lambda: stream.lost == 3)
    assert hub.counters().forwarded == 12
