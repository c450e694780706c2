"""Vehicles of other trackers as ground stations see them, through the real bytes of each."""

import json
import math
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.telemetry.telemetry import FlightMode

from gateway.simulator.simulator_settings import SimulatorSettings
from tests.end_to_end.processes import (
    CONFIG,
    Client,
    Gateway,
    MavProxy,
    first_position,
    mavsdk_system,
)
from tests.kit.cli import invoke
from tests.ports import free_port

HOME = SimulatorSettings()
NEAR_DEG = 0.004
STEEPEST_DEG = 60.0

pytestmark = [pytest.mark.io, pytest.mark.slow]


async def test_mavsdk_sees_a_crsf_vehicle(start_gateway: Callable[..., Gateway]) -> None:
    config = CONFIG + '[vehicle]\nautopilot = "ardupilotmega"\n'
    gateway = start_gateway("demo", "--tracker", "crsf", config=config)
    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        attitude = await anext(telemetry.subscribe_attitude_euler())
        position = await first_position(telemetry)
        async for battery in telemetry.subscribe_battery():
            if math.isfinite(battery.voltage_v) and battery.voltage_v > 0.0:
                break
        async for link in telemetry.subscribe_rc_status():
            if math.isfinite(link.signal_strength_percent):
                break
        async for mode in telemetry.subscribe_flight_mode():
            if mode != FlightMode.UNKNOWN:
                break
    assert abs(attitude.roll_deg) < STEEPEST_DEG
    assert position.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert battery.voltage_v == pytest.approx(12.6, abs=1.9)
    assert 69.0 <= link.signal_strength_percent <= 100.0


def test_mavproxy_sees_a_crsf_vehicle(
    start_gateway: Callable[..., Gateway], start_mavproxy: Callable[[int], MavProxy]
) -> None:
    gateway = start_gateway("demo", "--tracker", "crsf")
    proxy = start_mavproxy(gateway.port)
    proxy.until(r"Detected vehicle 1:1")
    proxy.until(r"(STABILIZE|AUTO)>")
    pattern = r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+), lon : (-?\d+),"
    position = proxy.until(pattern, "status GLOBAL_POSITION_INT")
    assert int(position[1]) / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    for name, fields in {
        "ATTITUDE": r"roll : -?[\d.e-]+, pitch : -?[\d.e-]+,",
        "SYS_STATUS": r"voltage_battery : 1[12]\d00, current_battery : 800,",
        "RC_CHANNELS": r"rssi : (100|[7-9]\d)\}",
        "RADIO_STATUS": r"rssi : (1[3-9]|20)\d,",
    }.items():
        proxy.until(rf"{name} \{{.*?{fields}", f"status {name}")


@pytest.mark.parametrize("kind", ["lines", "phone"])
async def test_mavsdk_and_mavproxy_see_a_vehicle_of_samples(
    kind: str,
    start_gateway: Callable[..., Gateway],
    start_mavproxy: Callable[[int], MavProxy],
) -> None:
    gateway = start_gateway("demo", "--tracker", kind)
    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        position = await first_position(telemetry)
        attitude = await anext(telemetry.subscribe_attitude_euler())
        heading = await anext(telemetry.subscribe_heading())
    assert abs(attitude.roll_deg) < STEEPEST_DEG
    assert position.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert 0.0 <= heading.heading_deg <= 360.0
    proxy = start_mavproxy(gateway.port)
    proxy.until(r"Detected vehicle 1:1")
    proxy.until(r"ATTITUDE \{.*?roll : -?[\d.e-]+, pitch : -?[\d.e-]+,", "status ATTITUDE")
    pattern = r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+), lon : (-?\d+),.*?hdg : \d+\}"
    found = proxy.until(pattern, "status GLOBAL_POSITION_INT")
    assert int(found[1]) / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)


@pytest.mark.parametrize("kind", ["lines", "phone"])
def test_samples_of_a_source_are_fused_and_seen(
    kind: str, start_gateway: Callable[..., Gateway], connect: Callable[..., Client]
) -> None:
    gateway = start_gateway("demo", "--tracker", kind)
    wanted = {"ATTITUDE", "GLOBAL_POSITION_INT", "HIGHRES_IMU", "GPS_RAW_INT", "ESTIMATOR_STATUS"}
    seen = connect(gateway.port).until(lambda seen: set(seen) >= wanted)
    assert seen["GLOBAL_POSITION_INT"].lat / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert abs(math.degrees(seen["ATTITUDE"].roll)) < STEEPEST_DEG
    assert seen["HIGHRES_IMU"].zacc == pytest.approx(-9.8, abs=8.0)


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


@pytest.mark.parametrize(
    ("kind", "wanted"),
    [("crsf", ["state roll", "GPS fix"]), ("phone", ["accelerometer", "barometer"])],
)
def test_recorded_bytes_of_a_source_are_decoded_again(
    kind: str,
    wanted: list[str],
    start_gateway: Callable[..., Gateway],
    connect: Callable[..., Client],
    tmp_path: Path,
) -> None:
    folder = tmp_path / "recordings"
    config = CONFIG + f'[recording]\nfolder = "{folder}"\nsource_bytes = true\n'
    gateway = start_gateway("demo", "--record", "--tracker", kind, config=config)
    connect(gateway.port).until(
        lambda seen: "ATTITUDE" in seen and seen["ATTITUDE"].time_boot_ms > 3000
    )
    gateway.end()
    (path,) = folder.glob("*.tlog")
    done = invoke("source", f"{kind}:file:{path}?id=1", "--seconds", "2")
    for words in wanted:
        assert words in done.output, done.output
    assert "fault" not in done.output
