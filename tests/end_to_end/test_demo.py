"""`mavgate demo` as a ground station meets it."""

import math
from collections.abc import Callable, Iterator

import pytest
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from pymavlink.dialects.v20 import common as mavlink

from gateway.simulator.simulator_settings import SimulatorSettings
from tests.end_to_end.processes import Client, Gateway, MavProxy, first_position, mavsdk_system

HOME = SimulatorSettings()
NEAR_DEG = 0.004
"""The whole simulated flight; how much of it has been flown by then depends on the machine."""
HIGH_M = 100.0
STEEPEST_DEG, FASTEST_CLIMB_MPS = 50.0, 8.0
"""Of the simulated flight."""

EXPECTED = {
    "HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "ATTITUDE_QUATERNION", "ATTITUDE",
    "GLOBAL_POSITION_INT", "VFR_HUD", "GPS_RAW_INT", "HIGHRES_IMU", "SCALED_PRESSURE",
    "HOME_POSITION", "STATUSTEXT",
}  # fmt: skip

pytestmark = [pytest.mark.io, pytest.mark.slow]


def test_every_message_arrives_and_stopping_is_clean(
    start_gateway: Callable[..., Gateway], connect: Callable[..., Client]
) -> None:
    gateway = start_gateway("demo")
    seen = connect(gateway.port).until(lambda seen: set(seen) >= EXPECTED)
    heartbeat, position = seen["HEARTBEAT"], seen["GLOBAL_POSITION_INT"]
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 1)
    assert heartbeat.autopilot == mavlink.MAV_AUTOPILOT_GENERIC
    assert position.lat / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert position.lon / 1e7 == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)
    assert gateway.end() == 0
    assert "Traceback" not in gateway.log.read_text()


@pytest.fixture(scope="module")
def gateway(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gateway]:
    """Start one gateway for the clients, which change nothing."""
    with Gateway(tmp_path_factory.mktemp("gateway"), "demo") as running:
        client = Client(running.port)
        client.until(lambda seen: "HEARTBEAT" in seen)
        client.sock.close()
        yield running


async def test_mavsdk_sees_vehicle_attitude_and_position(gateway: Gateway) -> None:
    async with mavsdk_system(gateway.port) as system:
        telemetry = TelemetryAsync(system)
        position = await first_position(telemetry)
        attitude = await anext(telemetry.subscribe_attitude_euler())
        speeds = await anext(telemetry.subscribe_fixedwing_metrics())
    assert position.latitude_deg == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert position.longitude_deg == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)
    assert position.absolute_altitude_m == pytest.approx(HOME.home_alt_m, abs=HIGH_M)
    assert abs(attitude.roll_deg) < STEEPEST_DEG
    assert abs(speeds.climb_rate_m_s) < FASTEST_CLIMB_MPS


def test_mavproxy_sees_vehicle_attitude_and_position(
    gateway: Gateway, start_mavproxy: Callable[[int], MavProxy]
) -> None:
    proxy = start_mavproxy(gateway.port)
    proxy.until(r"Detected vehicle 1:1")
    position = proxy.until(r"GLOBAL_POSITION_INT \{.*?lat : (-?\d+), lon : (-?\d+),", "status")
    assert int(position[1]) / 1e7 == pytest.approx(HOME.home_lat_deg, abs=NEAR_DEG)
    assert int(position[2]) / 1e7 == pytest.approx(HOME.home_lon_deg, abs=NEAR_DEG)
    attitude = proxy.until(r"ATTITUDE \{.*?roll : (\S+), pitch : (\S+),")
    assert abs(float(attitude[1])) < math.radians(STEEPEST_DEG)
    assert abs(float(attitude[2])) < math.radians(STEEPEST_DEG)
