"""Ground stations that connect by UDP, TCP and WebSocket, send every request, and leave.

    python tools/changing_stations.py UDP_PORT TCP_PORT WS_PORT METRICS_PORT

For `bench_pauses.py`: they request parameters, missions, messages, rates and files from a gateway,
stay for some seconds and leave, until the process is ended. The gateway's metrics are scraped too.
"""

import asyncio
import contextlib
import random
import sys
import urllib.request
from pathlib import Path

from pymavlink.dialects.v20 import common as mavlink

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from gateway.vehicle.services.ftp import Opcode
from tools.bench_hub import HANDSHAKE
from tools.fault_traffic import ftp, heartbeat, packed, request_message

AT_ONCE = 6
"""Number of stations at a time."""
LONGEST_STAY_S = 8.0
SCRAPE_S = 5.0
METADATA = b"/general.json"


def questions() -> list[bytes]:
    """Encode the requests of a ground station at its start."""
    rate = (mavlink.MAVLINK_MSG_ID_ATTITUDE, 20_000, 0, 0, 0, 0, 0)
    return [
        heartbeat(200),
        packed(mavlink.MAVLink_param_request_list_message(1, 1)),
        packed(mavlink.MAVLink_mission_request_list_message(1, 1, 0)),
        request_message(mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION, to_all=False),
        packed(mavlink.MAVLink_command_long_message(1, 1, 511, 0, *rate)),
        ftp(Opcode.OPEN_FILE_RO, 0, METADATA),
        ftp(Opcode.BURST_READ_FILE, 0),
    ]


class Datagrams(asyncio.DatagramProtocol):
    """A client that ignores received data."""


async def visit_udp(port: int, stay_s: float) -> None:
    """Connect by UDP, send the requests, and leave."""
    loop = asyncio.get_running_loop()
    transport, _ = await loop.create_datagram_endpoint(Datagrams, remote_addr=("127.0.0.1", port))
    for question in questions():
        transport.sendto(question)
    for _ in range(round(stay_s)):
        await asyncio.sleep(1.0)
        transport.sendto(heartbeat(200))
    transport.close()


async def visit_stream(port: int, stay_s: float, *, web: bool) -> None:
    """Do the same by TCP, or by WebSocket."""
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    if web:
        writer.write(HANDSHAKE)
        await reader.readuntil(b"\r\n\r\n")
    for question in questions():
        writer.write(_masked(question) if web else question)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(stay_s):
            while await reader.read(65536):
                pass
    writer.close()


def _masked(data: bytes) -> bytes:
    """Return a frame as a WebSocket message of a client, with a mask of zero."""
    size = bytes([0x80 | len(data)]) if len(data) < 126 else b"\xfe" + len(data).to_bytes(2)
    return b"\x82" + size + bytes(4) + data


async def come_and_go(udp: int, tcp: int, web: int) -> None:
    """Run one station after another."""
    while True:
        stay_s = random.uniform(0.5, LONGEST_STAY_S)
        try:
            match random.randrange(3):
                case 0:
                    await visit_udp(udp, stay_s)
                case 1:
                    await visit_stream(tcp, stay_s, web=False)
                case _:
                    await visit_stream(web, stay_s, web=True)
        except OSError:
            await asyncio.sleep(0.5)


async def scrape(port: int) -> None:
    """Read the gateway's metrics repeatedly."""
    url = f"http://127.0.0.1:{port}/metrics"
    while True:
        await asyncio.sleep(SCRAPE_S)
        await asyncio.to_thread(lambda: urllib.request.urlopen(url, timeout=5).read())


async def main() -> None:
    """Run all stations."""
    udp, tcp, web, metrics = map(int, sys.argv[1:])
    stations = [come_and_go(udp, tcp, web) for _ in range(AT_ONCE)]
    await asyncio.gather(scrape(metrics), *stations)


if __name__ == "__main__":
    asyncio.run(main())
