"""A hub between loopback and an Ethernet cable that is pulled out; needs its own namespace.

The cable is a pair of virtual interfaces, its far end in the namespace of a child process. Writes
what each of the two clients received as JSON.
"""

import asyncio
import json
import socket
import subprocess
import sys

from gateway.clock import GatewayClock
from gateway.hub.hub import Hub
from gateway.hub.settings import HubSettings
from tests.kit.hub import Rig

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
        self.rig = Rig()
        self.near = self.rig.station()
        endpoints = (f"udp:127.0.0.1:{self.near.port}", "udp:10.99.0.2:14550")
        self.hub = Hub(HubSettings(endpoints=endpoints), lambda _: None, GatewayClock())
        self.sent = self.received = 0

    async def fly(self, seconds: float) -> None:
        loop = asyncio.get_running_loop()
        end = loop.time() + seconds
        while loop.time() < end:
            self.rig.publish(self.hub, self.rig.vehicle.attitude())
            self.sent += 1
            await asyncio.sleep(0.005)
            self.received += len(self.near.received())


async def fly(far: "subprocess.Popen[str]") -> dict[str, object]:
    assert far.stdout
    world = World()
    world.hub.start()
    await world.rig.until_open(world.hub)
    await world.fly(0.2)
    ip("link", "set", "near0", "down")
    await world.fly(1.2)
    down = world.hub.clients()[1]
    ip("link", "set", "near0", "up")
    await world.fly(0.1)
    await world.rig.until_open(world.hub)
    sent_down = world.sent
    await world.fly(0.5)
    world.hub.close()
    # The far end reads all that has come before, and ends.
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as last:
        last.sendto(b"", FAR_END)
    far_heard = (await asyncio.to_thread(far.stdout.read)).count("frame")
    world.received += len(world.near.received())
    return {
        "state while down": down.state,
        "dropped while down": down.dropped,
        "loopback lost": world.sent - world.received,
        "sent after": world.sent - sent_down,
        "far end received": far_heard,
        "far end could hear": world.sent - down.dropped,
    }


if __name__ == "__main__":
    child = build()
    try:
        sys.stdout.write(json.dumps(asyncio.run(fly(child))))
    finally:
        child.kill()
