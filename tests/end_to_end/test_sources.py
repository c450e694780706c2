"""Vehicles of other trackers as ground stations see them, through the real bytes of each."""

import asyncio
import json
import math
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.telemetry.telemetry import FlightMode

from tests.end_to_end.processes import (
    CONFIG,
    HOME,
    NEAR_DEG,
    Client,
    Gateway,
    MavProxy,
    first_position,
    mavsdk_system,
)
from tests.kit.cli import invoke
from tests.ports import free_port

STEEPEST_DEG = 60.0

pytestmark = [pytest.mark.io, pytest.mark.slow]


SAMPLES = {
    "ATTITUDE": r"roll : -?[\d.e-]+, pitch : -?[\d.e-]+,",
    "GLOBAL_POSITION_INT": r"hdg : \d+",
}
LINK = {
    "SYS_STATUS": r"voltage_battery : 1[12]\d00, current_battery : 800,",
    "RC_CHANNELS": r"rssi : (100|[7-9]\d)\}",
    "RADIO_STATUS": r"rssi : (1[3-9]|20)\d,",
}
SENSORS = {"HIGHRES_IMU", "GPS_RAW_INT", "ESTIMATOR_STATUS"}
TRACKERS = {
    "crsf": (SAMPLES | LINK, set[str](), ("state roll", "GPS fix")),
    "lines": (SAMPLES, SENSORS, ()),
    "phone": (SAMPLES, SENSORS, ("accelerometer", "barometer")),
}
"""For each tracker: fields as MAVProxy shows them, further messages, words of its decoded bytes."""


async def check_by_mavsdk(port: int, kind: str) -> None:
    """Check position, attitude and heading; with CRSF battery, signal and mode too."""
    async with mavsdk_system(port) as system:
        telemetry = TelemetryAsync(system)
        position = await first_position(telemetry)
        attitude = await anext(telemetry.subscribe_attitude_euler())
        heading = await anext(telemetry.subscribe_heading())
        if kind == "crsf":
            async for battery in telemetry.subscribe_battery():
                if math.isfinite(battery.voltage_v) and battery.voltage_v > 0.0:
                    break
            async for link in telemetry.subscribe_rc_status():
                if math.isfinite(link.signal_strength_percent):
                    break
            async for mode in telemetry.subscribe_flight_mode():
                if mode != FlightMode.UNKNOWN:
                    break
            assert battery.voltage_v == pytest.approx(12.6, abs=1.9)
            assert 69.0 <= link.signal_strength_percent <= 100.0
    assert abs(attitude.roll_deg) < STEEPEST_DEG
    assert position.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert 0.0 <= heading.heading_deg <= 360.0


@pytest.mark.parametrize("kind", TRACKERS)
def test_ground_stations_see_a_tracker_and_its_recorded_bytes_are_decoded_again(
    kind: str,
    start_gateway: Callable[..., Gateway],
    start_mavproxy: Callable[[int], MavProxy],
    connect: Callable[..., Client],
    tmp_path: Path,
) -> None:
    shown, further, decoded = TRACKERS[kind]
    folder = tmp_path / "recordings"
    config = CONFIG + f'[recording]\nfolder = "{folder}"\nsource_bytes = true\n'
    config += '[vehicle]\nautopilot = "ardupilotmega"\n' if kind == "crsf" else ""
    gateway = start_gateway("demo", "--record", "--tracker", kind, config=config)
    asyncio.run(check_by_mavsdk(gateway.port, kind))
    proxy = start_mavproxy(gateway.port)
    proxy.until(r"Detected vehicle 1:1")
    for name, fields in shown.items():
        proxy.until(rf"{name} \{{.*?{fields}", f"status {name}")
    found = re.search(r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+),", proxy.output)
    assert found is not None
    assert int(found[1]) / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    if kind == "crsf":
        proxy.until(r"(STABILIZE|AUTO)>")
    proxy.process.kill()
    proxy.process.wait()

    wanted = {"ATTITUDE", "GLOBAL_POSITION_INT"} | further
    seen = connect(gateway.port).until(lambda seen: set(seen) >= wanted)
    assert abs(math.degrees(seen["ATTITUDE"].roll)) < STEEPEST_DEG
    if "HIGHRES_IMU" in further:
        assert seen["HIGHRES_IMU"].zacc == pytest.approx(-9.8, abs=8.0)
    gateway.end()
    (path,) = folder.glob("*.tlog")
    done = invoke("source", f"{kind}:file:{path}?id=1", "--seconds", "2")
    assert "fault" not in done.output
    for words in decoded:
        assert words in done.output, done.output


def test_datagrams_of_any_program_are_a_vehicle(
    start_gateway: Callable[..., Gateway], connect: Callable[..., Client], tmp_path: Path
) -> None:
    port = free_port()
    gateway = start_gateway("run", "--source", f"lines:udp:127.0.0.1:{port}?id=9")
    client = connect(gateway.port)
    line = {"lat": 48.0, "lon": 11.0, "alt_m": 500, "speed_mps": 3, "course_deg": 90}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:

        def is_seen(seen: dict) -> bool:
            sender.sendto(json.dumps(line).encode(), ("127.0.0.1", port))
            return "GLOBAL_POSITION_INT" in seen

        # Nothing comes before the first datagram, which may be too early.
        client.sock.settimeout(0.2)
        for _ in range(300):
            try:
                seen = client.until(is_seen, limit=10_000)
                break
            except TimeoutError:
                is_seen({})
    assert seen["GLOBAL_POSITION_INT"].get_srcSystem() == 9
    assert seen["GLOBAL_POSITION_INT"].lat == 480000000
