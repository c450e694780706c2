"""A hub between loopback and an Ethernet cable that is pulled out; needs its own namespace.

The cable is a pair of virtual interfaces, its far end in the namespace of a child process. Writes
what each of the two clients received as JSON.
"""

import asyncio
import contextlib
import json
import socket
import subprocess
import sys

from pymavlink.dialects.v20 import common as dialect

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from gateway.records import Outgoing

FAR_CLIENT = """
import socket
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("10.99.0.2", 14550))
print("up", flush=True)
while sock.recv(4096):
    print("frame", flush=True)
"""
FAR_END = ("10.99.0.2", 14550)


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


def build() -> subprocess.Popen[str]:
    """Lay the cable and start the client at its far end."""
    ip("link", "set", "lo", "up")
    ip("link", "add", "near0", "type", "veth", "peer", "name", "far0")
    wait = "import sys; print('in', flush=True); sys.stdin.readline(); exec(sys.argv[1])"
    far = subprocess.Popen(
        ["unshare", "--net", sys.executable, "-c", wait, FAR_CLIENT],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert far.stdout
    assert far.stdin
    assert far.stdout.readline() == "in\n"
    ip("link", "set", "far0", "netns", str(far.pid))
    for words in ("addr add 10.99.0.2/24 dev far0", "link set far0 up"):
        subprocess.run(["nsenter", "-t", str(far.pid), "-n", "ip", *words.split()], check=True)
    ip("addr", "add", "10.99.0.1/24", "dev", "near0")
    ip("link", "set", "near0", "up")
    far.stdin.write("\n")
    far.stdin.flush()
    assert far.stdout.readline() == "up\n"
    return far


class World:
    """The hub, its vehicle, and the client on loopback."""

    def __init__(self) -> None:
        self.near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.near.bind(("127.0.0.1", 0))
        self.near.setblocking(False)
        endpoints = (f"udp:127.0.0.1:{self.near.getsockname()[1]}", "udp:10.99.0.2:14550")
        self.hub = Hub(HubSettings(endpoints=endpoints), lambda _: None, GatewayClock())
        self.link = dialect.MAVLink(None, 1, 1)
        self.sent = self.received = 0

    async def fly(self, seconds: float) -> None:
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while loop.time() < end:
            frame = bytes(dialect.MAVLink_attitude_message(5, 0, 0, 0, 0, 0, 0).pack(self.link))
            self.link.seq = (self.link.seq + 1) % 256
            self.hub.send(Outgoing(frame, 30))
            self.sent += 1
            await asyncio.sleep(0.005)
            self.listen()

    def listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while self.near.recv(4096):
                self.received += 1

    def state(self) -> str:
        return self.hub.clients()[1].state

    async def until_open(self) -> None:
        async with asyncio.timeout(60):
            while any(client.state != "open" for client in self.hub.clients()):
                await asyncio.sleep(0.01)


async def fly(far: "subprocess.Popen[str]") -> dict[str, object]:
    assert far.stdout
    world = World()
    world.hub.start()
    await world.until_open()
    await world.fly(0.2)
    ip("link", "set", "near0", "down")
    await world.fly(1.2)
    state_down, dropped = world.state(), world.hub.clients()[1].dropped
    ip("link", "set", "near0", "up")
    await world.fly(0.1)
    await world.until_open()
    sent_down = world.sent
    await world.fly(0.5)
    world.hub.close()
    # The far end reads all that has come before, and ends.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
        last.sendto(b"", FAR_END)
    far_heard = (await asyncio.to_thread(far.stdout.read)).count("frame")
    world.listen()
    return {
        "state while down": state_down,
        "dropped while down": dropped,
        "loopback lost": world.sent - world.received,
        "sent after": world.sent - sent_down,
        "far end received": far_heard,
        "far end could hear": world.sent - dropped,
    }


if __name__ == "__main__":
    child = build()
    try:
        sys.stdout.write(json.dumps(asyncio.run(fly(child))))
    finally:
        child.kill()
